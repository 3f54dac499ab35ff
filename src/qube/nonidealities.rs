use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::{
    Acceleration, DomainParameter, DomainParameters, Dynamics, EquationsOfMotion, Nonideality,
    ParameterError, State,
};
use crate::elementary::Scalar;

/// Velocity of the arm at which Coulomb friction has reached three quarters of its torque, rad/s.
/// The friction grows steadily through zero, because a jump there would need an integrator that
/// locates the instant of reversal.
const FRICTION_VELOCITY_RAD_S: f64 = 0.05;

/// Longest accurate step in time constants of the arm's damping near rest.
const LONGEST_STEP_IN_TIME_CONSTANTS: f64 = 0.5;

/// The effects in a real Qube that the thesis's equations leave out: friction, dead zones, cable
/// and delay. With all of them 0 the equations are the thesis's.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Nonidealities {
    /// Friction torque on the arm that is independent of velocity, N m.
    pub coulomb_torque_n_m: f64,
    /// Part of a positive voltage that is lost before the motor turns, V.
    pub positive_dead_zone_v: f64,
    /// Part of a negative voltage that is lost before the motor turns, V.
    pub negative_dead_zone_v: f64,
    /// Stiffness with which the cable to the pendulum's encoder pulls the arm towards
    /// `cable_rest_rad`, N m/rad.
    pub cable_stiffness_n_m_rad: f64,
    /// Angle of the arm at which the cable does not pull, rad.
    pub cable_rest_rad: f64,
    /// Time until a command acts at the motor, s. Simulation, observer and identification count it
    /// from the sample that the command answers, the emulated Qube from the command's arrival at
    /// its board.
    pub command_delay_s: f64,
    /// Drift of the cable's rest angle, rad/min. Only the emulated Qube drifts; the equations use
    /// the rest angle itself, and a training may draw another one for each trajectory.
    #[serde(skip_serializing_if = "is_zero")]
    pub cable_drift_rad_per_min: f64,
}

/// Largest accepted drift of the cable, rad/min: across the arm's travel in about five minutes.
pub const MAX_CABLE_DRIFT_RAD_PER_MIN: f64 = 1.0;

fn is_zero(value: &f64) -> bool {
    *value == 0.0
}

/// The reason why a model describes no Qube.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum ModelError {
    /// A domain parameter is not physical.
    #[error("parameters.{0}")]
    Parameter(#[from] ParameterError),
    /// A nonideality is outside its range.
    #[error("gap.{name} = {value}: give a number from {smallest} to {largest}")]
    Nonideality {
        /// Name of the entry.
        name: &'static str,
        /// Value of the entry, in its unit.
        value: f64,
        /// Smallest accepted value.
        smallest: f64,
        /// Largest accepted value.
        largest: f64,
    },
}

impl Nonidealities {
    /// The cable's rest angle this many seconds after the Qube was switched on, rad.
    #[must_use]
    pub fn cable_rest_after(&self, seconds: f64) -> f64 {
        self.cable_rest_rad + self.cable_drift_rad_per_min * (seconds / 60.0)
    }

    /// The value of one term, in its unit.
    #[must_use]
    pub fn get(&self, term: Nonideality) -> f64 {
        match term {
            Nonideality::CoulombTorque => self.coulomb_torque_n_m,
            Nonideality::PositiveDeadZone => self.positive_dead_zone_v,
            Nonideality::NegativeDeadZone => self.negative_dead_zone_v,
            Nonideality::CableStiffness => self.cable_stiffness_n_m_rad,
            Nonideality::CableRest => self.cable_rest_rad,
            Nonideality::CommandDelay => self.command_delay_s,
        }
    }

    /// Sets one term, in its unit.
    pub fn set(&mut self, term: Nonideality, value: f64) {
        *match term {
            Nonideality::CoulombTorque => &mut self.coulomb_torque_n_m,
            Nonideality::PositiveDeadZone => &mut self.positive_dead_zone_v,
            Nonideality::NegativeDeadZone => &mut self.negative_dead_zone_v,
            Nonideality::CableStiffness => &mut self.cable_stiffness_n_m_rad,
            Nonideality::CableRest => &mut self.cable_rest_rad,
            Nonideality::CommandDelay => &mut self.command_delay_s,
        } = value;
    }
}

/// A Qube: the thesis's parameters and the nonidealities that the thesis leaves out.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct QubeModel {
    /// The nine domain parameters of the thesis.
    pub parameters: DomainParameters,
    /// The effects that the thesis leaves out.
    #[serde(rename = "gap")]
    pub nonidealities: Nonidealities,
}

impl QubeModel {
    /// The thesis's Qube with the values of the name plate.
    pub const NOMINAL: Self = Self {
        parameters: DomainParameters::NOMINAL,
        nonidealities: Nonidealities {
            coulomb_torque_n_m: 0.0,
            positive_dead_zone_v: 0.0,
            negative_dead_zone_v: 0.0,
            cable_stiffness_n_m_rad: 0.0,
            cable_rest_rad: 0.0,
            command_delay_s: 0.0,
            cable_drift_rad_per_min: 0.0,
        },
    };

    /// Checks that every number is in its range.
    ///
    /// # Errors
    /// A number is outside its range; the error names the first one.
    pub fn check(&self) -> Result<(), ModelError> {
        self.parameters.check()?;
        let drift = self.nonidealities.cable_drift_rad_per_min;
        let drifts = -MAX_CABLE_DRIFT_RAD_PER_MIN..=MAX_CABLE_DRIFT_RAD_PER_MIN;
        let terms =
            Nonideality::ALL.map(|term| (term.name(), self.nonidealities.get(term), term.range()));
        for (name, value, range) in
            terms.into_iter().chain([("cable_drift_rad_per_min", drift, drifts)])
        {
            if !range.contains(&value) {
                let (smallest, largest) = range.into_inner();
                return Err(ModelError::Nonideality { name, value, smallest, largest });
            }
        }
        Ok(())
    }

    /// The Qube between the nominal Qube (`factor` 0) and this one (`factor` 1), or beyond it.
    /// Domain parameters are interpolated in their logarithm, or linearly if one is 0 in either
    /// Qube. Nonidealities are multiplied by `factor`, except the cable's rest angle, which stays
    /// as it is.
    #[must_use]
    pub fn scaled(&self, factor: f64) -> Self {
        self.scaled_from(&DomainParameters::NOMINAL, factor)
    }

    /// The Qube between one with the parameters `nominal` and no nonidealities (`factor` 0) and
    /// this one (`factor` 1), or beyond it; [`Self::scaled`] describes the interpolation.
    #[must_use]
    pub fn scaled_from(&self, nominal: &DomainParameters, factor: f64) -> Self {
        let mut parameters = *nominal;
        for parameter in DomainParameter::ALL {
            let (nominal, own) = (parameters.get(parameter), self.parameters.get(parameter));
            if own > 0.0 && nominal > 0.0 {
                parameters.set(parameter, nominal * (factor * (own / nominal).ln()).exp());
            } else {
                parameters.set(parameter, nominal + factor * (own - nominal));
            }
        }
        let nonidealities = &self.nonidealities;
        Self {
            parameters,
            nonidealities: Nonidealities {
                coulomb_torque_n_m: factor * nonidealities.coulomb_torque_n_m,
                positive_dead_zone_v: factor * nonidealities.positive_dead_zone_v,
                negative_dead_zone_v: factor * nonidealities.negative_dead_zone_v,
                cable_stiffness_n_m_rad: factor * nonidealities.cable_stiffness_n_m_rad,
                // The rest angle is a place, not a strength, so it does not scale.
                cable_rest_rad: nonidealities.cable_rest_rad,
                command_delay_s: factor * nonidealities.command_delay_s,
                cable_drift_rad_per_min: factor * nonidealities.cable_drift_rad_per_min,
            },
        }
    }
}

/// The equations of motion with the forces of the nonidealities.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NonidealDynamics<T = f64> {
    /// The thesis's equations.
    pub ideal: Dynamics<T>,
    /// Coulomb friction, N m.
    pub coulomb_torque: T,
    /// Dead zone for positive voltages, V.
    pub positive_dead_zone: T,
    /// Dead zone for negative voltages, V.
    pub negative_dead_zone: T,
    /// Stiffness of the cable, N m/rad.
    pub cable_stiffness: T,
    /// The cable's rest angle, rad.
    pub cable_rest: T,
}

impl<T: Scalar> NonidealDynamics<T> {
    /// The equations of motion of this Qube. They do not contain the command delay, which the
    /// caller applies.
    #[must_use]
    pub fn new(model: &QubeModel) -> Self {
        let nonidealities = &model.nonidealities;
        Self {
            ideal: Dynamics::new(&model.parameters),
            coulomb_torque: T::from_f64(nonidealities.coulomb_torque_n_m),
            positive_dead_zone: T::from_f64(nonidealities.positive_dead_zone_v),
            negative_dead_zone: T::from_f64(nonidealities.negative_dead_zone_v),
            cable_stiffness: T::from_f64(nonidealities.cable_stiffness_n_m_rad),
            cable_rest: T::from_f64(nonidealities.cable_rest_rad),
        }
    }

    /// The part of a voltage that is left after the dead zone and drives the motor, V.
    #[inline(always)]
    fn effective_voltage(&self, voltage_v: T) -> T {
        let zero = T::from_f64(0.0);
        let above = voltage_v - self.positive_dead_zone;
        let below = voltage_v + self.negative_dead_zone;
        let push = if above > zero { above } else { zero };
        let pull = if below < zero { below } else { zero };
        push + pull
    }

    /// Torque of the Coulomb friction against a velocity of the arm, N m. It is an odd and monotone
    /// function of the velocity with a continuous slope, and within a few percent of the full
    /// torque from 0.5 rad/s on.
    #[inline(always)]
    fn friction(&self, theta_dot: T) -> T {
        let x = theta_dot * T::from_f64(1.0 / FRICTION_VELOCITY_RAD_S);
        self.coulomb_torque * x / (T::from_f64(1.0) / T::from_f64(3.0) + x.abs())
    }
}

impl NonidealDynamics {
    /// Slope of the friction torque at rest, N m s/rad: the stiffest term of the equations.
    #[must_use]
    pub fn friction_slope(&self) -> f64 {
        3.0 * self.coulomb_torque / FRICTION_VELOCITY_RAD_S
    }

    /// The longest step with which Runge-Kutta integrates the friction near rest accurately, s:
    /// half a time constant of the arm's damping near rest; infinite without damping. Runge-Kutta
    /// is stable for steps of up to 2.78 time constants, but inaccurate there: an arm that creeps
    /// and sticks does not follow its equations then, and a fit to its motion finds wrong dead
    /// zones.
    #[must_use]
    pub fn accurate_step_s(&self) -> f64 {
        let ideal = &self.ideal;
        let arm_inertia =
            ideal.arm_inertia - ideal.coupling * ideal.coupling / ideal.pendulum_inertia;
        LONGEST_STEP_IN_TIME_CONSTANTS * arm_inertia / (self.friction_slope() + ideal.arm_damping)
    }
}

impl<T: Scalar> EquationsOfMotion<T> for NonidealDynamics<T> {
    #[inline(always)]
    fn acceleration(&self, state: &State<T>, voltage_v: T) -> Acceleration<T> {
        let motor = self.ideal.torque_per_volt * self.effective_voltage(voltage_v);
        let cable = self.cable_stiffness * (state.theta - self.cable_rest);
        self.ideal.acceleration_under(state, motor - cable - self.friction(state.theta_dot))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn with(nonidealities: Nonidealities) -> NonidealDynamics {
        NonidealDynamics::new(&QubeModel { nonidealities, ..QubeModel::NOMINAL })
    }

    #[test]
    fn without_nonidealities_the_equations_equal_the_thesis_equations() {
        let (ideal, nonidealities) =
            (Dynamics::<f64>::new(&DomainParameters::NOMINAL), with(Nonidealities::default()));
        for step in 0..1000 {
            let x = f64::from(step);
            let state =
                State { theta: x.sin(), alpha: x, theta_dot: 9.0 * x.cos(), alpha_dot: -x.sin() };
            let voltage_v = 5.0 * (1.3 * x).sin();
            assert_eq!(
                nonidealities.acceleration(&state, voltage_v),
                ideal.acceleration(&state, voltage_v)
            );
        }
    }

    #[test]
    fn a_scaled_model_passes_through_the_nominal_model_and_itself() {
        let parameters =
            DomainParameters { motor_resistance_ohm: 4.2, ..DomainParameters::NOMINAL };
        let nonidealities = Nonidealities {
            command_delay_s: 0.01,
            cable_rest_rad: 0.2,
            ..Nonidealities::default()
        };
        let model = QubeModel { parameters, nonidealities };
        assert_eq!(model.scaled(0.0).parameters, DomainParameters::NOMINAL);
        assert_eq!(model.scaled(0.0).nonidealities.command_delay_s, 0.0);
        let same = model.scaled(1.0);
        assert!((same.parameters.motor_resistance_ohm - 4.2).abs() < 1e-12);
        assert_eq!(same.nonidealities, nonidealities);
        assert!((model.scaled(2.0).parameters.motor_resistance_ohm - 2.1).abs() < 1e-12);
    }

    #[test]
    fn friction_and_cable_take_energy_and_never_give_it() {
        let nonidealities = Nonidealities {
            coulomb_torque_n_m: 1e-3,
            cable_stiffness_n_m_rad: 2e-3,
            cable_rest_rad: 0.3,
            ..Nonidealities::default()
        };
        let dynamics = with(nonidealities);
        let energy = |state: &State| {
            let stretch = state.theta - nonidealities.cable_rest_rad;
            dynamics.ideal.energy(state)
                + 0.5 * nonidealities.cable_stiffness_n_m_rad * stretch * stretch
        };
        let mut state = State { theta: 1.5, alpha: 2.0, theta_dot: 3.0, alpha_dot: -2.0 };
        for _ in 0..20_000 {
            let next = crate::qube::runge_kutta_4(&dynamics, state, 0.0, 1e-3);
            assert!(energy(&next) <= energy(&state) + 1e-12);
            state = next;
        }
        // The cable's pull is no more than friction here, so the arm stays at rest.
        let pull = nonidealities.cable_stiffness_n_m_rad
            * (state.theta - nonidealities.cable_rest_rad).abs();
        assert!(pull < nonidealities.coulomb_torque_n_m, "{state:?}");
    }

    #[test]
    fn the_dead_zone_takes_a_part_of_each_sign() {
        let nonidealities = Nonidealities {
            positive_dead_zone_v: 0.1,
            negative_dead_zone_v: 0.3,
            ..Nonidealities::default()
        };
        let dynamics = with(nonidealities);
        for (command_v, expected_v) in
            [(0.05, 0.0), (-0.2, 0.0), (1.1, 1.0), (-1.3, -1.0), (0.0, 0.0)]
        {
            assert!((dynamics.effective_voltage(command_v) - expected_v).abs() < 1e-12);
        }
    }
}
