use serde::{Deserialize, Serialize};

use crate::elementary::Scalar;
use crate::qube::{CONTROL_PERIOD_S, Measurement, MotorRating, PlantModel};

/// [`MotorHeat::load`] at which the operator is warned. Above it the motor cools before the next
/// motion.
pub const WARNING_LOAD: f64 = 0.7;

/// [`MotorHeat::load`] at which the arm is braked. It is below 1, so that the rated current of
/// 0.54 A reaches it in finite time. It is above (0.5 / 0.54)^2 = 0.86, the load at 0.5 A, which
/// the Qube's amplifier may give continuously.
pub const LARGEST_LOAD: f64 = 0.9;

/// [`MotorHeat::load`] to which a motor above [`WARNING_LOAD`] cools before the next motion begins.
pub const COOLED_LOAD: f64 = 0.5;

/// Smallest accepted winding resistance of a Qube, ohm; the smallest resistance found by a fit is
/// 3.7 ohm. For another plant it is scaled by the ratio of the nominal resistances. A current
/// reading that would need a smaller resistance is a fault of the sensor.
const LEAST_RESISTANCE_OHM: f64 = 3.5;

/// Allowed zero error of the current sensor, A.
pub const CURRENT_OFFSET_A: f64 = 0.1;

/// Estimate of the winding's temperature rise relative to the rise at the rated continuous current,
/// from a first-order model with (current / rated current)^2 as its input, known as I^2 t.
///
/// In the long run any current below the rating gives a load below 1. A more detailed thermal model
/// is a weighted mean of first-order models. If none of them is faster than this one, their mean is
/// an average over this model's past, so it stays below 1 as long as this model does.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MotorHeat {
    /// Rating of the motor.
    pub rating: MotorRating,
    /// Load: 0 at ambient temperature, 1 in equilibrium at the rated current.
    pub load: f64,
    /// Electrical constants of the motor; a file that names none means the constants of a Qube.
    #[serde(default, skip_serializing_if = "Winding::is_qube")]
    pub winding: Winding,
}

/// The constants from which a motor's current follows.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Winding {
    /// Nominal resistance, ohm.
    pub resistance_ohm: f64,
    /// Back-EMF constant, V s/rad.
    pub back_emf_v_s: f64,
}

impl Winding {
    /// The winding of a plant's motor.
    #[must_use]
    pub fn of(plant: &PlantModel) -> Self {
        Self {
            resistance_ohm: plant.parameters.motor_resistance_ohm,
            back_emf_v_s: plant.parameters.motor_back_emf_v_s,
        }
    }

    /// The largest current that this motor may draw, A: that of the smallest accepted resistance,
    /// with voltage and back EMF (V) in the same direction, and the allowed zero error of the
    /// sensor.
    #[must_use]
    pub fn largest_current_a(&self, voltage_v: f64, back_emf_v: f64) -> f64 {
        let of_qube = self.resistance_ohm / Self::default().resistance_ohm;
        let least_ohm = of_qube * LEAST_RESISTANCE_OHM;
        (voltage_v.abs() + back_emf_v.abs()) / least_ohm + CURRENT_OFFSET_A
    }

    fn is_qube(&self) -> bool {
        *self == Self::default()
    }
}

impl Default for Winding {
    fn default() -> Self {
        Self::of(&PlantModel::QUBE)
    }
}

impl MotorHeat {
    /// A motor of this plant and rating at ambient temperature.
    #[must_use]
    pub fn cold(plant: &PlantModel, rating: MotorRating) -> Self {
        Self { rating, load: 0.0, winding: Winding::of(plant) }
    }

    /// Returns whether the load has reached [`LARGEST_LOAD`] or is not a number, so that the arm is
    /// braked and the motor must cool.
    #[must_use]
    pub fn is_overheated(&self) -> bool {
        self.load >= LARGEST_LOAD || self.load.is_nan()
    }

    /// Time constant of the model, s: so short that the rated current reaches [`LARGEST_LOAD`]
    /// after the motor's time constant, and larger currents reach it sooner.
    #[must_use]
    pub fn time_constant_s(&self) -> f64 {
        // ln(1 / (1 - 0.9)).
        self.rating.time_constant_s / std::f64::consts::LN_10
    }

    /// Advances the model by one control period and the periods skipped before it. The voltage (mV)
    /// acted during these periods; voltage and arm velocity have the signs of the conventions of
    /// [`crate::qube`]. Without a measurement the current follows from voltage and velocity alone.
    pub fn pass(
        &mut self,
        skipped_periods: u32,
        measurement: Option<&Measurement>,
        voltage_mv: i16,
        theta_dot_rad_s: f64,
    ) {
        let voltage_v = f64::from(voltage_mv) * 1e-3;
        let current_a = current_a(measurement, voltage_v, theta_dot_rad_s, self.winding);
        let heating = (current_a / self.rating.continuous_a).powi(2);
        let elapsed_s = f64::from(1 + skipped_periods) * CONTROL_PERIOD_S;
        let step = elapsed_s / self.time_constant_s();
        // Implicit Euler: stable for any number of skipped periods.
        self.load = (self.load + step * heating) / (1.0 + step);
    }

    /// The motor after this time without current, s.
    #[must_use]
    pub fn cooled(self, elapsed_s: f64) -> Self {
        Self { load: self.load * Scalar::exp(-elapsed_s / self.time_constant_s()), ..self }
    }

    /// Time without current that the motor needs before the next motion, s; 0 at loads up to
    /// [`WARNING_LOAD`].
    #[must_use]
    pub fn cooling_s(&self) -> f64 {
        if self.load <= WARNING_LOAD {
            return 0.0;
        }
        self.time_constant_s() * (self.load / COOLED_LOAD).ln()
    }
}

/// Absolute motor current, A: the larger of the reading and the value from voltage and speed. A
/// reading that no motor could give is ignored, and a speed that is not finite counts as 0.
fn current_a(
    measurement: Option<&Measurement>,
    voltage_v: f64,
    theta_dot_rad_s: f64,
    winding: Winding,
) -> f64 {
    let Winding { resistance_ohm, back_emf_v_s } = winding;
    let speed_rad_s = if theta_dot_rad_s.is_finite() { theta_dot_rad_s } else { 0.0 };
    let back_emf_v = back_emf_v_s * speed_rad_s;
    let modelled_a = (voltage_v - back_emf_v).abs() / resistance_ohm;
    let largest_a = winding.largest_current_a(voltage_v, back_emf_v);
    let measured_a = measurement.map_or(0.0, |sample| f64::from(sample.current_a).abs());
    // The comparison is false for NaN too.
    if measured_a <= largest_a { measured_a.max(modelled_a) } else { modelled_a }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample(current_a: f32) -> Measurement {
        Measurement { current_a, ..Measurement::default() }
    }

    /// Seconds until a motor that starts cold must be braked; `None` if it need not within ten
    /// minutes.
    fn trips_after_s(current_a: f32, voltage_mv: i16, theta_dot_rad_s: f64) -> Option<f64> {
        let mut heat = MotorHeat::default();
        (1..=60_000).find_map(|tick| {
            heat.pass(0, Some(&sample(current_a)), voltage_mv, theta_dot_rad_s);
            heat.is_overheated().then(|| f64::from(tick) * CONTROL_PERIOD_S)
        })
    }

    /// The time until a cold motor must be braked, s, by the closed formula for a constant current.
    fn computed_s(current_a: f64) -> f64 {
        let heat = MotorHeat::default();
        let heating = (current_a / heat.rating.continuous_a).powi(2);
        -heat.time_constant_s() * (1.0 - LARGEST_LOAD / heating).ln()
    }

    #[test]
    fn a_stalled_motor_trips_in_the_computed_time_by_either_source_of_its_current() {
        // 5 V across 8.4 ohm at rest: 0.595 A.
        let computed = computed_s(5.0 / 8.4);
        assert!((17.0..18.5).contains(&computed), "{computed} s");
        for (measured_a, voltage_mv) in
            [(0.0, 5000), (0.0, -5000), (0.595_238, 2500), (f32::NAN, 5000)]
        {
            let tripped = trips_after_s(measured_a, voltage_mv, 0.0).unwrap();
            assert!((tripped - computed).abs() < 0.05, "{tripped} s, computed {computed} s");
        }
    }

    #[test]
    fn the_rated_current_trips_within_the_motors_time_constant_and_the_amplifiers_never() {
        let time_constant_s = MotorRating::NOMINAL.time_constant_s;
        for current_a in [0.5401_f32, 0.6, 0.7, 1.0, 1.4] {
            let tripped = trips_after_s(current_a, 5000, 0.0).unwrap();
            assert!(tripped <= time_constant_s, "{current_a} A: {tripped} s");
        }
        assert_eq!(trips_after_s(0.5, 4200, 0.0), None);
    }

    #[test]
    fn no_rating_however_small_hides_the_heat() {
        // A file may lower a rating as far as it likes, and the arithmetic then leaves its range.
        for (continuous_a, time_constant_s) in [(0.54, 1e-320), (1e-200, 30.0), (1e-200, 1e-320)] {
            let rating = MotorRating { continuous_a, time_constant_s };
            let mut heat = MotorHeat { rating, ..MotorHeat::default() };
            assert!(rating.is_within(&MotorRating::NOMINAL));
            heat.pass(0, None, 5000, 0.0);
            assert!(heat.is_overheated(), "{heat:?}");
        }
    }

    #[test]
    fn a_reading_that_no_motor_could_give_is_left_out() {
        // The sensor sticks at 1 A while nothing drives the motor, or at the end of its range.
        for stuck_a in [1.0, 5.8, f32::INFINITY, f32::NAN] {
            assert_eq!(trips_after_s(stuck_a, 0, 0.0), None, "{stuck_a} A");
        }
        // A shorted winding draws more than a nominal one; such a reading is accepted.
        assert!(trips_after_s(1.2, 5000, 0.0).unwrap() < 5.0);
    }

    #[test]
    fn a_motor_that_turns_with_its_voltage_draws_less_and_one_that_is_braked_more() {
        let current_of = |theta_dot| current_a(None, 5.0, theta_dot, Winding::default());
        assert!((current_of(20.0) - (5.0 - 0.84) / 8.4).abs() < 1e-12);
        assert!((current_of(-20.0) - (5.0 + 0.84) / 8.4).abs() < 1e-12);
        assert_eq!(current_of(f64::NAN), 5.0 / 8.4);
    }

    #[test]
    fn skipped_periods_heat_as_much_as_those_that_were_not() {
        let (mut whole, mut skipping) = (MotorHeat::default(), MotorHeat::default());
        for tick in 0..1000 {
            whole.pass(0, None, 5000, 0.0);
            if tick % 10 == 9 {
                skipping.pass(9, None, 5000, 0.0);
            }
        }
        assert!((whole.load - skipping.load).abs() < 2e-3, "{whole:?}, {skipping:?}");
    }

    #[test]
    fn a_hot_motor_rests_until_it_is_cool_and_a_warm_one_does_not() {
        let hot = MotorHeat { load: 0.9, ..MotorHeat::default() };
        let rest_s = hot.cooling_s();
        assert!((7.0..8.5).contains(&rest_s), "{rest_s} s");
        assert!((hot.cooled(rest_s).load - COOLED_LOAD).abs() < 1e-9);
        assert_eq!(MotorHeat { load: 0.69, ..hot }.cooling_s(), 0.0);
        assert_eq!(hot.cooled(0.0), hot);
    }
}
