//! Effects of a real Qube that the equations of the library omit. Only the emulated plant has these
//! effects, so that identification and training meet differences that their model cannot express.

use libm::{exp, sin, sincos};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::qube::{DomainParameters, NonidealDynamics, State};

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

/// Number of periods of the motor's torque ripple in a turn of the arm.
const RIPPLES_PER_TURN: f64 = 12.0;

/// Velocity at which the friction of the pendulum's bearing has reached three quarters of its
/// torque, rad/s.
const PENDULUM_SLIDING_RAD_S: f64 = 0.05;

/// Angle of the arm at which the arm points down the slope of a tilted base, rad.
const DOWNHILL_RAD: f64 = 1.0;

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
    /// Angle between the arm's axis and the vertical, rad: the base is not level, so that the
    /// pendulum's weight turns the arm, and the pendulum hangs at an angle that depends on the
    /// arm's.
    #[serde(skip_serializing_if = "is_zero")]
    pub tilt_rad: f64,
    /// Largest deviation of the motor's torque from its mean over a turn, as a fraction of that
    /// mean.
    #[serde(skip_serializing_if = "is_zero")]
    pub ripple: f64,
    /// Torque of the dry friction in the pendulum's bearing, N m.
    #[serde(skip_serializing_if = "is_zero")]
    pub pendulum_friction_n_m: f64,
    /// Cubic term of the cable's torque about its rest angle, N m/rad^3: a cable that becomes
    /// stiffer the farther it is bent.
    #[serde(skip_serializing_if = "is_zero")]
    pub cubic_n_m_rad3: f64,
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
        tilt_rad: 0.0,
        ripple: 0.0,
        pendulum_friction_n_m: 0.0,
        cubic_n_m_rad3: 0.0,
    };

    /// Each effect with its name and the largest value that an emulated Qube accepts.
    #[must_use]
    pub fn named(&mut self) -> [(&'static str, &mut f64, f64); 10] {
        [
            ("presliding_rad", &mut self.presliding_rad, 0.2),
            ("stribeck", &mut self.stribeck, 2.0),
            ("hysteresis_n_m", &mut self.hysteresis_n_m, 0.002),
            ("slack", &mut self.slack, 1.0),
            ("warming_per_w", &mut self.warming_per_w, 1.0),
            ("eccentricity_rad", &mut self.eccentricity_rad, 0.1),
            ("tilt_rad", &mut self.tilt_rad, 0.1),
            ("ripple", &mut self.ripple, 0.5),
            ("pendulum_friction_n_m", &mut self.pendulum_friction_n_m, 0.001),
            ("cubic_n_m_rad3", &mut self.cubic_n_m_rad3, 0.002),
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
    /// The arm's friction without the back-EMF, N m s/rad.
    rotary_damping_n_m_s: f64,
    /// Torque of the pendulum's weight, at the arm's end, about a horizontal axis through the arm's
    /// other end, N m. The arm itself is balanced, as its inertia in the equations implies.
    arm_gravity_n_m: f64,
}

impl ActingEffects {
    /// The effects of a cold plant at rest; `None` if all are switched off.
    pub fn new(effects: Effects, parameters: &DomainParameters) -> Option<Self> {
        (effects != Effects::NONE).then_some(Self {
            effects,
            rotary_damping_n_m_s: parameters.rotary_damping_n_m_s,
            arm_gravity_n_m: parameters.pendulum_mass_kg
                * parameters.rotary_length_m
                * parameters.gravity_m_s2,
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
        theta + self.effects.eccentricity_rad * sin(theta - ECCENTRIC_ZERO_RAD)
    }

    /// The motor's torque at an angle of the arm as a multiple of its mean over a turn.
    pub fn torque_factor(&self, theta: f64) -> f64 {
        self.effects.ripple.mul_add(sin(RIPPLES_PER_TURN * theta), 1.0)
    }

    /// The plant's equations with `torque_factor` times the motor's mean torque, and without the
    /// terms that these effects replace.
    pub fn equations(&self, dynamics: &NonidealDynamics, torque_factor: f64) -> NonidealDynamics {
        let coulomb_torque =
            if self.effects.presliding_rad > 0.0 { 0.0 } else { dynamics.coulomb_torque };
        let mut ideal = dynamics.ideal;
        if self.effects.ripple > 0.0 {
            let back_emf_damping = ideal.arm_damping - self.rotary_damping_n_m_s;
            ideal.torque_per_volt *= torque_factor;
            ideal.arm_damping = self.rotary_damping_n_m_s + torque_factor * back_emf_damping;
        }
        NonidealDynamics { ideal, coulomb_torque, ..*dynamics }
    }

    /// The state after the torques of the effects have acted for `step_s`, s.
    pub fn push(&mut self, dynamics: &NonidealDynamics, state: State, step_s: f64) -> State {
        let [of_weight_n_m, pendulum_n_m] = self.gravity_n_m(dynamics, &state);
        let arm_n_m = of_weight_n_m + self.arm_n_m(dynamics, &state, step_s);
        let pendulum_n_m = pendulum_n_m - self.pendulum_friction_n_m(&state);
        let added = dynamics.ideal.acceleration_by(state.alpha, [arm_n_m, pendulum_n_m]);
        State {
            theta_dot: state.theta_dot + step_s * added.theta,
            alpha_dot: state.alpha_dot + step_s * added.alpha,
            ..state
        }
    }

    /// The torques of gravity on arm and pendulum that a tilted base adds, N m.
    fn gravity_n_m(&self, dynamics: &NonidealDynamics, state: &State) -> [f64; 2] {
        let (sin_tilt, cos_tilt) = sincos(self.effects.tilt_rad);
        let (sin_alpha, cos_alpha) = sincos(state.alpha);
        let (across, along) = sincos(DOWNHILL_RAD - state.theta);
        let pendulum_n_m = dynamics.ideal.gravity_torque;
        let arm = self.arm_gravity_n_m * across - pendulum_n_m * sin_alpha * along;
        let pendulum = sin_tilt * cos_alpha * across + (1.0 - cos_tilt) * sin_alpha;
        [sin_tilt * arm, pendulum_n_m * pendulum]
    }

    /// The dry friction of the pendulum's bearing, N m.
    fn pendulum_friction_n_m(&self, state: &State) -> f64 {
        let x = state.alpha_dot / PENDULUM_SLIDING_RAD_S;
        self.effects.pendulum_friction_n_m * x / (1.0 / 3.0 + x.abs())
    }

    /// The torque of friction and cable on the arm beyond the torque in the equations, N m.
    fn arm_n_m(&mut self, dynamics: &NonidealDynamics, state: &State, step_s: f64) -> f64 {
        let Effects { presliding_rad, stribeck, hysteresis_n_m, slack, .. } = self.effects;
        let velocity = state.theta_dot;
        let slow = velocity / STRIBECK_VELOCITY_RAD_S;
        let more = stribeck * exp(-slow * slow);
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
        let bent = state.theta - dynamics.cable_rest;
        let lacking = slack * dynamics.cable_stiffness * bent.min(0.0);
        let stiffening = self.effects.cubic_n_m_rad3 * bent * bent * bent;
        lacking - friction - hysteresis_n_m * self.cable_strain - stiffening
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
        // The push is smaller than the friction's torque.
        let pushed = moved(&mut plant, 0.1, 30_000_000);
        assert!(pushed > 0.003, "{pushed}");
        let back = moved(&mut plant, 0.0, 40_000_000);
        assert!(back < -0.5 * pushed, "{pushed} and {back}");
    }

    #[test]
    fn gravity_on_a_tilted_base_is_the_slope_of_its_potential() {
        let parameters = DomainParameters::NOMINAL;
        let tilt_rad = 0.08;
        let acting =
            ActingEffects::new(Effects { tilt_rad, ..Effects::NONE }, &parameters).unwrap();
        let dynamics = NonidealDynamics::new(&QubeModel::NOMINAL);
        // The energy that a tilt adds, J, from the place of the pendulum's centre.
        let energy = |theta: f64, alpha: f64| {
            let (arm_m, half_m) = (parameters.rotary_length_m, 0.5 * parameters.pendulum_length_m);
            let outward = [theta.cos(), theta.sin(), 0.0];
            let sideward = [-theta.sin(), theta.cos(), 0.0];
            let [down_x, down_y] = [DOWNHILL_RAD.cos(), DOWNHILL_RAD.sin()];
            let added = [tilt_rad.sin() * down_x, tilt_rad.sin() * down_y, 1.0 - tilt_rad.cos()];
            let along = |place: [f64; 3]| -> f64 {
                place.iter().zip(added).map(|(place, added)| place * added).sum()
            };
            let up = [0.0, 0.0, 1.0];
            let pendulum: [f64; 3] = std::array::from_fn(|axis| {
                arm_m * outward[axis]
                    + half_m * (alpha.sin() * sideward[axis] - alpha.cos() * up[axis])
            });
            -parameters.gravity_m_s2 * parameters.pendulum_mass_kg * along(pendulum)
        };
        let step = 1e-5;
        for number in 0..50 {
            let (theta, alpha) = (f64::from(number).sin(), 3.0 * f64::from(number).cos());
            let [arm, pendulum] =
                acting.gravity_n_m(&dynamics, &State { theta, alpha, ..State::default() });
            let slope = |low: f64, high: f64| (low - high) / (2.0 * step);
            let of_theta = slope(energy(theta - step, alpha), energy(theta + step, alpha));
            let of_alpha = slope(energy(theta, alpha - step), energy(theta, alpha + step));
            assert!((arm - of_theta).abs() < 1e-9, "{arm} and {of_theta}");
            assert!((pendulum - of_alpha).abs() < 1e-9, "{pendulum} and {of_alpha}");
        }
    }

    #[test]
    fn a_dry_bearing_holds_the_pendulum_beside_the_vertical() {
        let start = State { alpha: 0.3, ..State::default() };
        let effects = Effects { pendulum_friction_n_m: 5e-4, ..Effects::NONE };
        let settings = EmulatorSettings { effects, start: Some(start), ..Default::default() };
        let mut plant = EmulatedPlant::new(&settings);
        plant.advance_to(3_000_000);
        let dynamics: NonidealDynamics = NonidealDynamics::new(&QubeModel::NOMINAL);
        let gravity_n_m = dynamics.ideal.gravity_torque;
        let held = |state: State| state.alpha_dot.abs() < 0.02 && state.alpha.abs() > 0.002;
        assert!(held(plant.state()), "{:?}", plant.state());
        assert!(plant.state().alpha.abs() < 5e-4 / gravity_n_m, "{:?}", plant.state());
    }

    #[test]
    fn a_motor_with_ripple_has_its_mean_torque_over_a_turn() {
        let effects = Effects { ripple: 0.3, ..Effects::NONE };
        let acting = ActingEffects::new(effects, &DomainParameters::NOMINAL).unwrap();
        let dynamics = NonidealDynamics::new(&QubeModel::NOMINAL);
        let of = |theta: f64| acting.equations(&dynamics, acting.torque_factor(theta)).ideal;
        let angles = || (0..360).map(|degrees| f64::from(degrees).to_radians());
        let per_volt: Vec<f64> = angles().map(|theta| of(theta).torque_per_volt).collect();
        let mean = per_volt.iter().sum::<f64>() / 360.0;
        assert!((mean / dynamics.ideal.torque_per_volt - 1.0).abs() < 1e-12, "{mean}");
        let most = per_volt.iter().copied().fold(0.0, f64::max);
        assert!((most / mean - 1.3).abs() < 0.01, "{most} and {mean}");
        // Torque and back EMF have one constant, so that a motor that is turned brakes everywhere.
        let friction = DomainParameters::NOMINAL.rotary_damping_n_m_s;
        let whole = (dynamics.ideal.arm_damping - friction) / dynamics.ideal.torque_per_volt;
        for theta in angles() {
            let here = (of(theta).arm_damping - friction) / of(theta).torque_per_volt;
            assert!((here / whole - 1.0).abs() < 1e-9, "{here} and {whole}");
        }
    }

    #[test]
    fn a_strain_does_not_exceed_its_largest_value() {
        let mut strain = 0.0;
        for _ in 0..100_000 {
            strain = strained(strain, 40.0, 1.5, 1e-4);
        }
        assert!((strain - 1.5).abs() < 1e-6);
        assert!(strained(strain, 1e9, 1.5, 1e-4) <= 1.5 + 1e-9);
    }

    #[test]
    fn a_winding_that_loses_power_grows_in_resistance() {
        let mut acting = ActingEffects::new(
            Effects { warming_per_w: 0.3, ..Effects::NONE },
            &DomainParameters::NOMINAL,
        )
        .unwrap();
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
