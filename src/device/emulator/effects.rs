//! Effects of a real Qube that the equations of the library omit. Only the emulated plant has these
//! effects, so that identification and training meet differences that their model cannot express.

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::qube::{Acceleration, Dynamics, EquationsOfMotion, NonidealDynamics, State};

/// Velocity at which Stribeck's additional friction has fallen to 1/e, rad/s.
const STRIBECK_VELOCITY_RAD_S: f64 = 0.3;

/// Velocity at which Stribeck's additional friction has reached three quarters of its torque,
/// rad/s; with presliding, the strain takes the place of this rise.
const SLIDING_RAD_S: f64 = 0.05;

/// Motion of the arm, rad, after which the torque of the cable's hysteresis has grown from 0 to
/// 1 - 1/e of its largest value.
const CABLE_YIELD_RAD: f64 = 0.1;

/// Time constant of the winding's temperature, s.
const WINDING_S: f64 = 20.0;

/// Angle of the arm at which an encoder off its centre has no error, rad.
const ECCENTRIC_ZERO_RAD: f64 = -0.7;

/// Longest integration step with any of these effects, us.
pub(super) const EFFECTS_STEP_US: u64 = 100;

/// The effects of an emulated Qube beyond the library's equations of motion; a value of 0 switches
/// an effect off.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Effects {
    /// Angle by which the arm's friction gives way like a spring before the arm slides, rad (Dahl
    /// 1968).
    #[serde(skip_serializing_if = "is_zero")]
    pub presliding_rad: f64,
    /// Additional friction near standstill, as a fraction of the Coulomb friction (Stribeck 1902).
    #[serde(skip_serializing_if = "is_zero")]
    pub stribeck: f64,
    /// Largest torque of the cable's hysteresis, which opposes the arm's last motion, N m.
    #[serde(skip_serializing_if = "is_zero")]
    pub hysteresis_n_m: f64,
    /// Fraction of the cable's stiffness that is missing on the negative side of its rest angle, 0
    /// to 1.
    #[serde(skip_serializing_if = "is_zero")]
    pub slack: f64,
    /// Relative growth of the winding's resistance for each watt of heat lost in it, after a long
    /// time, 1/W.
    #[serde(skip_serializing_if = "is_zero")]
    pub warming_per_w: f64,
    /// Largest angle error of an arm encoder that is mounted off its centre, rad.
    #[serde(skip_serializing_if = "is_zero")]
    pub eccentricity_rad: f64,
}

fn is_zero(value: &f64) -> bool {
    *value == 0.0
}

impl Effects {
    /// Every effect switched off.
    pub const NONE: Self = Self {
        presliding_rad: 0.0,
        stribeck: 0.0,
        hysteresis_n_m: 0.0,
        slack: 0.0,
        warming_per_w: 0.0,
        eccentricity_rad: 0.0,
    };

    /// Each effect with its name and the largest value that an emulated Qube accepts.
    #[must_use]
    pub fn named(&mut self) -> [(&'static str, &mut f64, f64); 6] {
        [
            ("presliding_rad", &mut self.presliding_rad, 0.2),
            ("stribeck", &mut self.stribeck, 2.0),
            ("hysteresis_n_m", &mut self.hysteresis_n_m, 0.002),
            ("slack", &mut self.slack, 1.0),
            ("warming_per_w", &mut self.warming_per_w, 1.0),
            ("eccentricity_rad", &mut self.eccentricity_rad, 0.1),
        ]
    }

    /// Checks that each effect is from 0 to its largest value in [`named`](Self::named).
    ///
    /// # Errors
    /// The first effect that is out of its range.
    pub fn check(mut self) -> Result<(), EffectError> {
        for (name, &mut value, largest) in self.named() {
            if !(0.0..=largest).contains(&value) {
                return Err(EffectError { name, value, largest });
            }
        }
        Ok(())
    }
}

/// An effect that is out of its range.
#[derive(Clone, Copy, Debug, Error, PartialEq)]
#[error("{name} = {value}: give a number from 0 to {largest}")]
pub struct EffectError {
    /// Name of the effect.
    pub name: &'static str,
    /// Value of the effect.
    pub value: f64,
    /// Largest accepted value.
    pub largest: f64,
}

/// The effects of a plant, with their internal state.
#[derive(Clone, Copy, Debug)]
pub(super) struct ActingEffects {
    effects: Effects,
    /// Elastic deflection of the friction, in multiples of `presliding_rad`.
    friction_strain: f64,
    /// Elastic deflection of the cable's hysteresis, in multiples of `CABLE_YIELD_RAD`.
    cable_strain: f64,
    /// Copper loss of the winding, W, averaged with the time constant `WINDING_S`, so that it
    /// follows the winding's temperature.
    slow_loss_w: f64,
}

impl ActingEffects {
    /// The effects of a cold plant at rest; `None` if all are switched off.
    pub fn new(effects: Effects) -> Option<Self> {
        (effects != Effects::NONE).then_some(Self {
            effects,
            friction_strain: 0.0,
            cable_strain: 0.0,
            slow_loss_w: 0.0,
        })
    }

    /// Factor on the motor's resistance after a step of `step_s`, s, with the copper loss `loss_w`,
    /// W.
    pub fn resistance_factor(&mut self, loss_w: f64, step_s: f64) -> f64 {
        self.slow_loss_w += step_s / WINDING_S * (loss_w - self.slow_loss_w);
        1.0 + self.effects.warming_per_w * self.slow_loss_w
    }

    /// The angle that the arm's encoder counts at the true angle `theta`, rad.
    pub fn counted_theta(&self, theta: f64) -> f64 {
        theta + self.effects.eccentricity_rad * (theta - ECCENTRIC_ZERO_RAD).sin()
    }

    /// The plant's equations without the terms that these effects replace.
    pub fn equations(&self, dynamics: &NonidealDynamics) -> NonidealDynamics {
        let coulomb_torque =
            if self.effects.presliding_rad > 0.0 { 0.0 } else { dynamics.coulomb_torque };
        NonidealDynamics { coulomb_torque, ..*dynamics }
    }

    /// The state after the torques of the effects have acted on the arm for `step_s`, s.
    pub fn push(&mut self, dynamics: &NonidealDynamics, state: State, step_s: f64) -> State {
        let torque_n_m = self.torque_n_m(dynamics, &state, step_s);
        // The equations are linear in the torque, so the difference of two accelerations is the
        // effects' part; as their torques are small, an Euler step suffices.
        let unit = Dynamics { torque_per_volt: 1.0, ..dynamics.ideal };
        let with: Acceleration = unit.acceleration(&state, torque_n_m);
        let without: Acceleration = unit.acceleration(&state, 0.0);
        State {
            theta_dot: state.theta_dot + step_s * (with.theta - without.theta),
            alpha_dot: state.alpha_dot + step_s * (with.alpha - without.alpha),
            ..state
        }
    }

    fn torque_n_m(&mut self, dynamics: &NonidealDynamics, state: &State, step_s: f64) -> f64 {
        let Effects { presliding_rad, stribeck, hysteresis_n_m, slack, .. } = self.effects;
        let velocity = state.theta_dot;
        let slow = velocity / STRIBECK_VELOCITY_RAD_S;
        let more = stribeck * (-slow * slow).exp();
        let friction = if presliding_rad > 0.0 {
            let largest = 1.0 + more;
            self.friction_strain =
                strained(self.friction_strain, velocity / presliding_rad, largest, step_s);
            dynamics.coulomb_torque * self.friction_strain
        } else {
            let x = velocity / SLIDING_RAD_S;
            dynamics.coulomb_torque * more * x / (1.0 / 3.0 + x.abs())
        };
        self.cable_strain = strained(self.cable_strain, velocity / CABLE_YIELD_RAD, 1.0, step_s);
        let beyond_rest = (state.theta - dynamics.cable_rest).min(0.0);
        let lacking = slack * dynamics.cable_stiffness * beyond_rest;
        lacking - friction - hysteresis_n_m * self.cable_strain
    }
}

/// The strain of an elastoplastic element after a step of `step_s`, s. The strain grows at `rate`,
/// 1/s, at first, and more and more slowly as it approaches `largest` in the direction of `rate`.
fn strained(strain: f64, rate: f64, largest: f64, step_s: f64) -> f64 {
    // The step is implicit in the strain, so that a fast arm cannot make the strain oscillate.
    (strain + step_s * rate) / (1.0 + step_s * rate.abs() / largest)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::emulator::{EmulatedPlant, EmulatorSettings};
    use crate::qube::{HARD_STOP_RAD, Nonidealities, QubeModel};

    fn plant(effects: Effects) -> EmulatedPlant {
        let nonidealities = Nonidealities {
            coulomb_torque_n_m: 1e-3,
            cable_stiffness_n_m_rad: 1e-3,
            ..Nonidealities::default()
        };
        let model = QubeModel { nonidealities, ..QubeModel::NOMINAL };
        EmulatedPlant::new(&EmulatorSettings { model, effects, ..EmulatorSettings::default() })
    }

    /// Applies a voltage until `until_us`; returns the angle by which the arm has moved, rad.
    fn moved(plant: &mut EmulatedPlant, voltage_v: f64, until_us: u64) -> f64 {
        let start = plant.state().theta;
        plant.set_voltage(voltage_v);
        plant.advance_to(until_us);
        plant.state().theta - start
    }

    #[test]
    fn each_effect_changes_the_motion_and_gives_no_energy() {
        let mut each = Effects::NONE;
        let count = each.named().len();
        for index in 0..count {
            let mut effects = Effects::NONE;
            let (name, value, most) = &mut effects.named()[index];
            **value = 0.5 * *most;
            let (name, mut with, mut without) = (*name, plant(effects), plant(Effects::NONE));
            for (from_s, voltage_v) in [(0, 3.0), (1, -5.0), (2, 5.0), (3, 0.0)] {
                for plant in [&mut with, &mut without] {
                    moved(plant, voltage_v, (from_s + 1) * 1_000_000);
                    assert!(plant.state().theta.abs() <= HARD_STOP_RAD);
                }
            }
            assert_ne!(with.theta_counts(), without.theta_counts(), "{name}");
            with.advance_to(60_000_000);
            let state = with.state();
            assert!(
                state.theta_dot.abs() < 0.05 && state.alpha_dot.abs() < 0.5,
                "{name}: {state:?}"
            );
        }
    }

    #[test]
    fn an_encoder_off_its_centre_miscounts_an_arm_that_moves_as_before() {
        let mut with = plant(Effects { eccentricity_rad: 0.05, ..Effects::NONE });
        let mut without = plant(Effects::NONE);
        moved(&mut with, 2.0, 200_000);
        moved(&mut without, 2.0, 200_000);
        let moved_apart = (with.state().theta - without.state().theta).abs();
        assert!(moved_apart < 1e-3, "{moved_apart}");
        let apart = with.theta_counts() - without.theta_counts();
        assert!((1..=17).contains(&apart.abs()), "{apart}");
    }

    #[test]
    fn friction_with_presliding_springs_back_from_a_small_push() {
        let mut plant = plant(Effects { presliding_rad: 0.05, ..Effects::NONE });
        moved(&mut plant, 0.0, 20_000_000);
        // Less than the friction's torque.
        let pushed = moved(&mut plant, 0.1, 30_000_000);
        assert!(pushed > 0.003, "{pushed}");
        let back = moved(&mut plant, 0.0, 40_000_000);
        assert!(back < -0.5 * pushed, "{pushed} and {back}");
    }

    #[test]
    fn a_strain_slips_at_its_largest() {
        let mut strain = 0.0;
        for _ in 0..100_000 {
            strain = strained(strain, 40.0, 1.5, 1e-4);
        }
        assert!((strain - 1.5).abs() < 1e-6);
        assert!(strained(strain, 1e9, 1.5, 1e-4) <= 1.5 + 1e-9);
    }

    #[test]
    fn a_winding_that_loses_power_grows_in_resistance() {
        let mut acting =
            ActingEffects::new(Effects { warming_per_w: 0.3, ..Effects::NONE }).unwrap();
        let factor = (0..1_000_000).map(|_| acting.resistance_factor(0.5, 1e-4)).last().unwrap();
        assert!((factor - 1.15).abs() < 2e-3, "{factor}");
    }

    #[test]
    fn an_effect_out_of_range_is_named() {
        assert_eq!(Effects::NONE.check(), Ok(()));
        let reason = Effects { slack: 1.5, ..Effects::NONE }.check().unwrap_err().to_string();
        assert!(reason.contains("slack = 1.5") && reason.contains("from 0 to 1"), "{reason}");
        assert!(Effects { stribeck: f64::NAN, ..Effects::NONE }.check().is_err());
    }
}
