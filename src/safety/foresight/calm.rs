#![allow(
    clippy::needless_range_loop,
    reason = "a lane indexes many arrays at once, and plain index loops become vector code"
)]

use super::Ends;
use crate::elementary::{inverse_square_root, sin_cos};
use crate::qube::{BLOCK, CONTROL_PERIOD_S, Dynamics, InLanes, Lanes, QubeLanes, State};
use crate::safety::{BrakeLaw, Particle};

/// Reserve of angle before an end of the arm's range, in addition to the angle that the momentum
/// needs, rad. It covers the pendulum's later swings, until the brake has taken their energy. Among
/// 90 000 accepted states in which the pendulum is nearly at rest, one reaches the end 0.7 s later
/// if the reserve is 0.5 rad, and four if it is 0.3 rad.
const SLACK_RAD: f32 = 0.7;

/// Share of the full braking torque that the momentum test relies on.
const BRAKING_SHARE: f32 = 0.25;

/// Largest energy at which the momentum test applies, as a multiple of gravity's torque times one
/// radian, counted from the hanging pendulum; upright at rest it is 2. A pendulum with more energy
/// goes over the top, and each turn may throw the arm again.
const SWINGING: f32 = 2.2;

/// The test whether the brake keeps the arms of all sixteen particles of a block away from the
/// ends, so that the simulation of the block may end early.
///
/// An arm passes if its energy or its momentum is too small to reach an end. The energy test is
/// proven by an argument (`energy_holds`). The momentum test looks no farther than the first swing;
/// its constants are chosen so that the property tests pass. These property tests search for states
/// that the two tests accept and from which an arm reaches an end in a simulation of 1.5 s, and
/// find none.
#[derive(Clone, Debug)]
#[repr(align(64))]
pub(super) struct CalmLanes {
    /// True angle of each arm at which the brake measures the middle, rad.
    middle: Lanes,
    positive_share: Lanes,
    negative_share: Lanes,
    /// Energy that spring and cable hold at the lower and the upper end, J.
    low_j: Lanes,
    high_j: Lanes,
    /// Energy that a late brake may add for each rad/s of the arm, J s/rad.
    late_j_s: Lanes,
    /// Delay of the brake, s: the delay of a command plus the control period for which each voltage
    /// is held.
    late_s: Lanes,
    /// Stopping distance for each (rad/s)^2 of the arm, s^2/rad: half the inverse of the
    /// deceleration that the momentum test relies on.
    stopping_s2: Lanes,
    ends: Ends,
}

impl CalmLanes {
    pub(super) fn new(
        particles: &[&Particle; BLOCK],
        qubes: &QubeLanes,
        brake: &impl BrakeLaw,
        ends: &Ends,
    ) -> Self {
        let of = |number: fn(&Particle) -> f64| particles.map(|particle| number(particle) as f32);
        let mut lanes = Self {
            middle: of(|particle| particle.error.theta),
            positive_share: of(|particle| particle.positive_share),
            negative_share: of(|particle| particle.negative_share),
            low_j: [0.0; BLOCK],
            high_j: [0.0; BLOCK],
            late_j_s: [0.0; BLOCK],
            late_s: of(|particle| particle.model.nonidealities.command_delay_s + CONTROL_PERIOD_S),
            stopping_s2: [0.0; BLOCK],
            ends: *ends,
        };
        for lane in 0..BLOCK {
            let own = qubes.dynamics().lane(lane);
            let Dynamics { arm_inertia, torque_per_volt, .. } = own.ideal;
            lanes.high_j[lane] = lanes.held_j(qubes, brake, lane, ends.high_rad, 1.0);
            lanes.low_j[lane] = lanes.held_j(qubes, brake, lane, ends.low_rad, -1.0);
            let full_v = brake.largest_v() as f32;
            lanes.late_j_s[lane] = torque_per_volt * full_v * lanes.late_s[lane];
            let left_v = (lanes.positive_share[lane] * full_v - own.positive_dead_zone)
                .min(lanes.negative_share[lane] * full_v - own.negative_dead_zone);
            // Inside its dead zone a motor does not decelerate the arm, so the deceleration is
            // never below 0.
            let braking = (BRAKING_SHARE * torque_per_volt * left_v).max(0.0) / arm_inertia;
            lanes.stopping_s2[lane] = 0.5 / braking;
        }
        lanes
    }

    /// Returns whether no arm of the block can reach an end from its state on; `false` if a state
    /// is not a number.
    #[inline(always)]
    pub(super) fn holds(&self, qubes: &QubeLanes, brake: &impl BrakeLaw) -> bool {
        let mut calm = 0;
        for lane in 0..BLOCK {
            let own = qubes.dynamics().ideal.lane(lane);
            let state = qubes.state.lane(lane);
            // Energy in addition to the energy of a resting arm with a hanging pendulum.
            let motion_j = own.energy(&state) + own.gravity_torque;
            let energy = self.energy_holds(qubes, brake, lane, &own, motion_j);
            let momentum = self.momentum_holds(lane, &own, &state);
            let swings = motion_j < SWINGING * own.gravity_torque;
            calm += u32::from(energy | (momentum & swings));
        }
        calm == BLOCK as u32
    }

    /// Returns whether a lane's energy is too small for its arm to reach an end.
    ///
    /// Brake and friction only take energy. An arm at an end has at least the energy that spring
    /// and cable store there, with a pendulum that hangs at rest. A late brake may add energy while
    /// the arm's velocity changes sign: at most the work of the full voltage for as long as the
    /// brake is late, at the largest velocity that the energy of motion, spring and cable allows.
    #[inline(always)]
    fn energy_holds(
        &self,
        qubes: &QubeLanes,
        brake: &impl BrakeLaw,
        lane: usize,
        own: &Dynamics<f32>,
        motion_j: f32,
    ) -> bool {
        let theta = qubes.state.theta[lane];
        let spring = brake.potential_v_rad(theta - self.middle[lane]);
        let most_j = own.torque_per_volt.mul_add(spring, motion_j + cable_j(qubes, lane, theta));
        // The arm's effective inertia is smallest while the pendulum hangs or is upright, because
        // the pendulum then gives way most.
        let lightest = own.arm_inertia - own.coupling * own.coupling / own.pendulum_inertia;
        let square = 2.0 * most_j / lightest;
        let fastest = square * inverse_square_root(square);
        let energy_j = self.late_j_s[lane].mul_add(fastest, motion_j);
        let high_j = self.high_j[lane] - self.held_j(qubes, brake, lane, theta, 1.0);
        let low_j = self.low_j[lane] - self.held_j(qubes, brake, lane, theta, -1.0);
        (energy_j < high_j) & (energy_j < low_j)
    }

    /// Least energy, J up to a constant, that spring and cable have taken from a lane's arm at this
    /// angle, for an arm that moves to the end on this side (1 or -1). Short of the brake's middle
    /// the spring's energy counts in full; past it, the part that the motor's dead zone withholds
    /// is subtracted.
    #[inline(always)]
    fn held_j(
        &self,
        qubes: &QubeLanes,
        brake: &impl BrakeLaw,
        lane: usize,
        theta: f32,
        side: f32,
    ) -> f32 {
        let dynamics = qubes.dynamics();
        let (positive, negative) = (self.positive_share[lane], self.negative_share[lane]);
        let zones = (dynamics.positive_dead_zone[lane], dynamics.negative_dead_zone[lane]);
        let high = side > 0.0;
        let (against, towards) = if high { (negative, positive) } else { (positive, negative) };
        let dead_zone = if high { zones.1 } else { zones.0 };
        // Positive on this side of the brake's middle.
        let out = side * (theta - self.middle[lane]);
        let potential = brake.potential_v_rad(out);
        let beyond = against.mul_add(potential, -(dead_zone * out));
        let spring = if out > 0.0 { beyond } else { towards * potential };
        dynamics.ideal.torque_per_volt[lane].mul_add(spring, cable_j(qubes, lane, theta))
    }

    /// Returns whether a lane's arm comes to rest short of the ends after the pendulum has given it
    /// all its momentum.
    ///
    /// Only torques on the arm change the momentum p = (A + q sin^2 a) th' + c cos a a', where th
    /// is theta, a is alpha, A is `arm_inertia`, q is `quarter_inertia` and c is `coupling`. At the
    /// moment at which the arm has all the momentum, its angle lies within r = c / A of
    /// th + r sin a.
    #[inline(always)]
    fn momentum_holds(&self, lane: usize, own: &Dynamics<f32>, state: &State<f32>) -> bool {
        let (sin, cos) = sin_cos(state.alpha);
        let per_inertia = 1.0 / own.arm_inertia;
        let recoil = own.coupling * per_inertia;
        let heavier = (own.quarter_inertia * per_inertia * sin).mul_add(sin, 1.0);
        let velocity = heavier.mul_add(state.theta_dot, recoil * cos * state.alpha_dot);
        let square = velocity * velocity;
        let goes_on = self.stopping_s2[lane].mul_add(square, self.late_s[lane] * velocity.abs());
        let up = if velocity > 0.0 { goes_on } else { 0.0 };
        let down = if velocity < 0.0 { goes_on } else { 0.0 };
        let centre = recoil.mul_add(sin, state.theta);
        let high = centre + recoil + up + SLACK_RAD;
        let low = centre - recoil - down - SLACK_RAD;
        (high < self.ends.high_rad) & (low > self.ends.low_rad)
    }
}

/// Energy that the cable of a lane's arm stores at this angle, J.
#[inline(always)]
fn cable_j(qubes: &QubeLanes, lane: usize, theta: f32) -> f32 {
    let dynamics = qubes.dynamics();
    let stretch = theta - dynamics.cable_rest[lane];
    0.5 * dynamics.cable_stiffness[lane] * stretch * stretch
}
