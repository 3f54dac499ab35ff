use std::ops::RangeInclusive;

use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize};
use thiserror::Error;

use super::{
    DomainParameter, DomainParameters, Dynamics, Encoders, HARD_STOP_RAD, MAX_VOLTAGE_V,
    MotorRating, Nonideality, PlantName, Quantity, QubeModel,
};

/// A rotary pendulum as its maker describes it: its nominal parameters, encoders, stops and motor.
/// A TOML file can describe one (`docs/reference/plants.md`); [`PlantModel::QUBE`] is built in.
///
/// A `PlantModel` describes the properties that all specimens of a plant share. A
/// [`super::Profile`] describes one identified specimen.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlantModel {
    /// Name that policies and recordings carry.
    pub name: PlantName,
    /// Nominal domain parameters.
    #[serde(deserialize_with = "parameters")]
    pub parameters: DomainParameters,
    /// Encoders of arm and pendulum.
    pub encoders: Encoders,
    /// Limits of the arm and the motor's voltage.
    pub limits: PlantLimits,
    /// Thermal rating of the motor.
    pub motor: PlantMotor,
}

/// The limits of a plant's arm and of its motor's voltage.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlantLimits {
    /// Angle of the arm's hard stop on either side of its middle, rad.
    #[serde(deserialize_with = "hard_stop")]
    pub hard_stop_rad: f64,
    /// Largest voltage that is ever commanded, V: at most [`MAX_VOLTAGE_V`], the largest that the
    /// wire carries.
    #[serde(deserialize_with = "largest_voltage")]
    pub largest_voltage_v: f64,
}

/// The thermal rating of a plant's motor as the file gives it. Unlike a [`MotorRating`], it has no
/// defaults.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlantMotor {
    /// Current that the motor can carry indefinitely, A.
    #[serde(deserialize_with = "current")]
    pub continuous_a: f64,
    /// Thermal time constant of the winding, s.
    #[serde(deserialize_with = "time_constant")]
    pub time_constant_s: f64,
}

/// The reason why a text describes no plant.
#[derive(Debug, Error)]
pub enum PlantError {
    /// The text is not TOML, lacks a key, or has an unknown key or an invalid value.
    #[error("{}", .0.to_string().trim_end())]
    Invalid(#[from] Box<toml::de::Error>),
    /// Another plant has the name of the built-in Qube. Profiles name the plant that they were
    /// fitted to, so its profiles would count as profiles of a Qube.
    #[error(
        "the name `qube` belongs to the built-in Qube, and this plant is another one: give it a name of its own"
    )]
    NameOfQube,
}

impl PlantModel {
    /// The Quanser Qube (QUBE-Servo 2): the values of its name plate, encoders with 512 lines on
    /// both axes, stops at ±137 degrees, and at most 5 V.
    pub const QUBE: Self = Self {
        name: PlantName::QUBE,
        parameters: DomainParameters::NOMINAL,
        encoders: Encoders::QUBE,
        limits: PlantLimits { hard_stop_rad: HARD_STOP_RAD, largest_voltage_v: MAX_VOLTAGE_V },
        motor: PlantMotor {
            continuous_a: MotorRating::NOMINAL.continuous_a,
            time_constant_s: MotorRating::NOMINAL.time_constant_s,
        },
    };

    /// Reads a plant from TOML.
    ///
    /// # Errors
    /// The text is not TOML, a key is missing or unknown, or a value has the wrong type or lies
    /// outside its range; the message names the line. Or a plant that is not the built-in Qube has
    /// the Qube's name.
    pub fn parse(text: &str) -> Result<Self, PlantError> {
        let plant: Self = toml::from_str(text).map_err(Box::new)?;
        if plant.name.is_qube() && !plant.is_qube() {
            Err(PlantError::NameOfQube)
        } else {
            Ok(plant)
        }
    }

    /// Checks that every number is in the range that a file may give.
    ///
    /// # Errors
    /// As [`Self::parse`]; the message shows the entry as a line of TOML.
    pub fn check(&self) -> Result<(), PlantError> {
        let text = toml::to_string(self).map_err(serde::de::Error::custom).map_err(Box::new)?;
        Self::parse(&text).map(|_| ())
    }

    /// Returns whether this is the built-in Qube.
    #[must_use]
    pub fn is_qube(&self) -> bool {
        *self == Self::QUBE
    }

    /// The nominal plant without nonidealities.
    #[must_use]
    pub fn nominal(&self) -> QubeModel {
        QubeModel { parameters: self.parameters, ..QubeModel::NOMINAL }
    }

    /// Thermal rating of the motor.
    #[must_use]
    pub fn motor_rating(&self) -> MotorRating {
        let PlantMotor { continuous_a, time_constant_s } = self.motor;
        MotorRating { continuous_a, time_constant_s }
    }

    /// The name of the first entry that may be less safe than a Qube's; `None` for a plant that
    /// differs from a Qube only in its name and in smaller limits and motor ratings.
    ///
    /// The guard simulates the nominal parameters and computes angles with the encoders'
    /// resolution, so a wrong value in the file can do harm.
    #[must_use]
    pub fn beyond_qube(&self) -> Option<&'static str> {
        let (own, qube) = (&self.limits, &Self::QUBE.limits);
        [
            ("parameters", self.parameters == Self::QUBE.parameters),
            ("encoders", self.encoders == Self::QUBE.encoders),
            ("limits.hard_stop_rad", own.hard_stop_rad <= qube.hard_stop_rad),
            ("limits.largest_voltage_v", own.largest_voltage_v <= qube.largest_voltage_v),
            ("motor", self.motor_rating().is_within(&MotorRating::NOMINAL)),
        ]
        .into_iter()
        .find_map(|(name, is_harmless)| (!is_harmless).then_some(name))
    }

    /// Travel of this plant's arm as a fraction of a Qube's, at most 1.
    #[must_use]
    pub fn travel_fraction(&self) -> f64 {
        (self.limits.hard_stop_rad / HARD_STOP_RAD).min(1.0)
    }

    /// The number of volts that accelerate this plant's arm as one volt accelerates a Qube's arm.
    /// Gains that were tuned for a Qube are multiplied by this number.
    #[must_use]
    pub fn volts_per_qube_volt(&self) -> f64 {
        let per_volt = |parameters| {
            let dynamics = Dynamics::<f64>::new(parameters);
            dynamics.torque_per_volt / dynamics.arm_inertia
        };
        per_volt(&DomainParameters::NOMINAL) / per_volt(&self.parameters)
    }

    /// The voltage that accelerates this plant's arm as `of_qube_v` (not negative) accelerates a
    /// Qube's arm, at most `largest_voltage_v`, V.
    #[must_use]
    pub fn volts_like(&self, of_qube_v: f64) -> f64 {
        (of_qube_v * self.volts_per_qube_volt()).min(self.limits.largest_voltage_v)
    }

    /// The specimen that differs from the nominal plant in the same proportions in which `qube`
    /// differs from the nominal Qube ([`Self::proportion`]). The cable drifts as in `qube`.
    #[must_use]
    pub fn in_proportion(&self, qube: &QubeModel) -> QubeModel {
        let mut specimen = *qube;
        for quantity in Quantity::all() {
            specimen.set(quantity, self.proportion(quantity) * qube.get(quantity));
        }
        specimen
    }

    /// The factor by which a Qube's value of a quantity is multiplied for this plant: the ratio of
    /// the nominal values for a parameter, the ratio of the motors' torques for Coulomb friction
    /// and the cable's stiffness, and 1 for dead zones, delay and the cable's rest angle.
    #[must_use]
    pub fn proportion(&self, quantity: Quantity) -> f64 {
        match quantity {
            Quantity::Parameter(parameter) => {
                self.parameters.get(parameter) / DomainParameters::NOMINAL.get(parameter)
            }
            Quantity::Nonideality(Nonideality::CoulombTorque | Nonideality::CableStiffness) => {
                self.torque_per_qube_torque()
            }
            Quantity::Nonideality(_) => 1.0,
        }
    }

    /// The current of this plant's motor at rest for each ampere of a Qube's motor, at the same
    /// voltage, at most 1. Current thresholds that were chosen for a Qube are multiplied by this
    /// number. They need not grow for a motor of lower resistance, which draws more current.
    #[must_use]
    pub fn current_per_qube_current(&self) -> f64 {
        let nominal_ohm = DomainParameters::NOMINAL.motor_resistance_ohm;
        (nominal_ohm / self.parameters.motor_resistance_ohm).min(1.0)
    }

    /// The torque of this plant's motor for each N m of a Qube's motor, at the same voltage.
    /// Friction and cable of a plant that is not identified are assumed to be in this proportion.
    #[must_use]
    pub fn torque_per_qube_torque(&self) -> f64 {
        let per_volt = |parameters: &DomainParameters| {
            parameters.motor_back_emf_v_s / parameters.motor_resistance_ohm
        };
        per_volt(&self.parameters) / per_volt(&DomainParameters::NOMINAL)
    }
}

impl Default for PlantModel {
    fn default() -> Self {
        Self::QUBE
    }
}

/// Inclusive range of the values that a file may give.
type Range = RangeInclusive<f64>;

/// Accepted angles of a stop, rad. With a smaller angle no box leaves enough room for a swing-up;
/// from half a turn on the two stops would overlap.
const HARD_STOPS_RAD: Range = 0.6..=3.1;

/// Accepted largest voltages, V: homing needs 2.75 V.
const LARGEST_VOLTAGES_V: Range = 3.0..=MAX_VOLTAGE_V;

fn within<'de, D: Deserializer<'de>>(deserializer: D, range: Range) -> Result<f64, D::Error> {
    let value = f64::deserialize(deserializer)?;
    if range.contains(&value) {
        Ok(value)
    } else {
        let (least, most) = (range.start(), range.end());
        Err(D::Error::custom(format!("{value}: give a number from {least} to {most}")))
    }
}

fn hard_stop<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    within(deserializer, HARD_STOPS_RAD)
}

fn largest_voltage<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    let value = f64::deserialize(deserializer)?;
    if LARGEST_VOLTAGES_V.contains(&value) {
        return Ok(value);
    }
    let (least, most) = (LARGEST_VOLTAGES_V.start(), LARGEST_VOLTAGES_V.end());
    Err(D::Error::custom(format!(
        "{value}: give a number from {least} to {most} V: homing needs nearly {least} V, and the wire carries \
         {most} V at most"
    )))
}

fn current<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    within(deserializer, MotorRating::CURRENTS_A)
}

fn time_constant<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    within(deserializer, MotorRating::TIME_CONSTANTS_S)
}

/// A parameter that must be above 0, in a range that covers table-top pendulums.
#[derive(Clone, Copy, Deserialize)]
struct Positive(#[serde(deserialize_with = "positive")] f64);

/// A mass, kg.
#[derive(Clone, Copy, Deserialize)]
struct Mass(#[serde(deserialize_with = "mass")] f64);

/// A winding's resistance, ohm.
#[derive(Clone, Copy, Deserialize)]
struct Resistance(#[serde(deserialize_with = "resistance")] f64);

/// A length, m.
#[derive(Clone, Copy, Deserialize)]
struct Length(#[serde(deserialize_with = "length")] f64);

/// A parameter that may be 0.
#[derive(Clone, Copy, Deserialize)]
struct NotNegative(#[serde(deserialize_with = "not_negative")] f64);

fn positive<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    within(deserializer, 1e-6..=1e3)
}

/// Reads a resistance, ohm. A motor of more than 50 ohm draws too little current to be
/// distinguished from a dead one, because a sample reports whole milliamperes.
fn resistance<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    within(deserializer, 1e-6..=50.0)
}

fn mass<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    within(deserializer, 1e-6..=DomainParameter::PendulumMass.largest())
}

fn length<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    within(deserializer, 1e-6..=DomainParameter::PendulumLength.largest())
}

fn not_negative<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    within(deserializer, 0.0..=1e3)
}

/// The parameters as a file contains them. Each value is checked as it is read, so that the error
/// names its line.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
#[expect(non_snake_case, reason = "the symbols of the thesis")]
struct NamedParameters {
    g: Positive,
    R_m: Resistance,
    k_m: Positive,
    D_r: NotNegative,
    D_p: NotNegative,
    M_r: Mass,
    M_p: Mass,
    L_r: Length,
    L_p: Length,
}

fn parameters<'de, D: Deserializer<'de>>(deserializer: D) -> Result<DomainParameters, D::Error> {
    let named = NamedParameters::deserialize(deserializer)?;
    Ok(DomainParameters {
        gravity_m_s2: named.g.0,
        motor_resistance_ohm: named.R_m.0,
        motor_back_emf_v_s: named.k_m.0,
        rotary_damping_n_m_s: named.D_r.0,
        pendulum_damping_n_m_s: named.D_p.0,
        rotary_mass_kg: named.M_r.0,
        pendulum_mass_kg: named.M_p.0,
        rotary_length_m: named.L_r.0,
        pendulum_length_m: named.L_p.0,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const LARGER: &str = include_str!("../../plants/furuta-130.toml");

    #[test]
    fn a_written_plant_reads_back_the_same() {
        for plant in [PlantModel::QUBE, PlantModel::parse(LARGER).unwrap()] {
            let text = toml::to_string(&plant).unwrap();
            assert_eq!(PlantModel::parse(&text).unwrap(), plant, "{text}");
            let json = serde_json::to_string(&plant).unwrap();
            assert_eq!(serde_json::from_str::<PlantModel>(&json).unwrap(), plant);
        }
    }

    #[test]
    fn the_qube_compares_with_itself_without_rounding() {
        let qube = PlantModel::QUBE;
        assert_eq!(qube.volts_per_qube_volt(), 1.0);
        assert_eq!(qube.torque_per_qube_torque(), 1.0);
        assert_eq!(qube.travel_fraction(), 1.0);
        assert_eq!(qube.volts_like(1.5), 1.5);
        assert_eq!(qube.in_proportion(&QubeModel::NOMINAL), QubeModel::NOMINAL);
        assert_eq!(qube.beyond_qube(), None);
    }

    #[test]
    fn a_missing_unknown_or_impossible_entry_is_named_with_its_line() {
        let with = |old: &str, new: &str| {
            assert!(LARGER.contains(old), "{old}");
            PlantModel::parse(&LARGER.replacen(old, new, 1)).unwrap_err().to_string()
        };
        let line_of = |key: &str| {
            let line = LARGER.lines().position(|line| line.starts_with(key)).unwrap();
            format!("line {}", line + 1)
        };
        for (key, value, words) in [
            ("M_p", "0.0", "from 0.000001"),
            ("L_r", "-0.1", "from 0.000001"),
            ("R_m", "nan", "NaN"),
            ("D_p", "-1e-9", "from 0 to"),
            ("hard_stop_rad", "3.2", "from 0.6 to 3.1"),
            ("largest_voltage_v", "2.0", "from 3 to 5 V: homing needs nearly 3 V"),
            ("largest_voltage_v", "12.0", "the wire carries 5 V at most"),
            ("theta_counts_per_revolution", "12", "from 1000"),
            ("continuous_a", "0.0", "from 0.05"),
            ("time_constant_s", "inf", "from 1 to 1000"),
            ("name", "\"a name with spaces\"", "name"),
            ("alpha_counts_per_revolution", "\"many\"", "i32"),
        ] {
            let old = LARGER.lines().find(|line| line.starts_with(key)).unwrap();
            let message = with(old, &format!("{key} = {value}"));
            for word in [words, key, &line_of(key)] {
                assert!(message.contains(word), "{key}: {word:?} is missing in {message}");
            }
            let message = with(old, "");
            assert!(message.contains(&format!("missing field `{key}`")), "{message}");
        }
        let old = LARGER.lines().find(|line| line.starts_with("name")).unwrap();
        let message = with(old, "name = \"qube\"");
        assert!(message.contains("give it a name of its own"), "{message}");
        let old = LARGER.lines().find(|line| line.starts_with("largest_voltage_v")).unwrap();
        let message = with(old, "largest_voltage_v = \"five\"");
        assert!(message.contains("f64") && !message.contains("wire"), "{message}");
        let message = with("[limits]", "[limits]\nhard_stop_deg = 90\n");
        assert!(message.contains("hard_stop_deg"), "{message}");
    }

    #[test]
    fn a_specimen_differs_from_its_plant_as_the_qube_from_the_nominal_one() {
        let larger = PlantModel::parse(LARGER).unwrap();
        let nominal = larger.in_proportion(&QubeModel::NOMINAL).parameters;
        for parameter in DomainParameter::ALL {
            let ratio = nominal.get(parameter) / larger.parameters.get(parameter);
            assert!((ratio - 1.0).abs() < 1e-12, "{parameter:?}: {ratio}");
        }
        let mut qube = QubeModel::NOMINAL;
        qube.parameters.pendulum_mass_kg *= 1.1;
        qube.nonidealities.coulomb_torque_n_m = 5e-4;
        qube.nonidealities.command_delay_s = 0.01;
        let specimen = larger.in_proportion(&qube);
        let heavier = specimen.parameters.pendulum_mass_kg / larger.parameters.pendulum_mass_kg;
        assert!((heavier - 1.1).abs() < 1e-12);
        let torque = specimen.nonidealities.coulomb_torque_n_m / larger.torque_per_qube_torque();
        assert!((torque - 5e-4).abs() < 1e-12);
        assert_eq!(specimen.nonidealities.command_delay_s, 0.01);
        assert!(larger.volts_like(100.0) <= larger.limits.largest_voltage_v);
    }

    #[test]
    fn only_smaller_limits_are_harmless() {
        let harmless = PlantModel {
            limits: PlantLimits { hard_stop_rad: 1.8, largest_voltage_v: 4.0 },
            ..PlantModel::QUBE
        };
        assert_eq!(harmless.beyond_qube(), None);
        let beyond = |change: fn(&mut PlantModel)| {
            let mut plant = harmless;
            change(&mut plant);
            plant.beyond_qube()
        };
        assert_eq!(beyond(|plant| plant.parameters.pendulum_mass_kg *= 1.01), Some("parameters"));
        assert_eq!(beyond(|plant| plant.limits.hard_stop_rad = 2.4), Some("limits.hard_stop_rad"));
        assert_eq!(beyond(|plant| plant.motor.continuous_a = 0.6), Some("motor"));
        assert_eq!(PlantModel::parse(LARGER).unwrap().beyond_qube(), Some("parameters"));
    }
}
