//! The criterion of success, for a rollout, a policy and a recommendation of a search.

use std::f64::consts::PI;

use crate::qube::{State, wrap_angle};
use crate::telemetry::{Phase, TickRecord};

/// Smallest return of a successful rollout, and smallest mean return of a successful policy (method
/// of the thesis, section 5.2).
pub const SUCCESS_RETURN: f64 = 400.0;

/// Smallest fraction of successful rollouts of a successful policy: four of five.
pub const POLICY_SHARE: f64 = 0.8;

/// Smallest fraction of successful rollouts of a successful recommendation. All policies that were
/// trained with it count together, because a further policy that is trained with it is expected to
/// be like a random one of them.
pub const RECOMMENDATION_SHARE: f64 = 0.9;

/// Largest distance from upright of a balancing pendulum, rad.
const UPRIGHT_RAD: f64 = 0.2;

/// Angle from upright within which a pendulum is nearly upright, rad: about 29 degrees.
const ABOUT_UPRIGHT_RAD: f64 = 0.5;

/// Number of final steps in each of which the pendulum must balance: the last second.
pub(super) const UPRIGHT_STEPS: usize = 100;

/// Returns whether the pendulum of this state balances.
pub(crate) fn is_upright(state: &State) -> bool {
    from_upright_rad(state) < UPRIGHT_RAD
}

/// Returns whether the pendulum of this state is nearly upright.
pub(crate) fn is_about_upright(state: &State) -> bool {
    from_upright_rad(state) < ABOUT_UPRIGHT_RAD
}

/// Returns whether the pendulum balanced in each of the last 100 steps of the policy. `states` are
/// the states of all its steps.
pub fn balanced_to_the_end<'a>(
    states: impl DoubleEndedIterator<Item = &'a State> + ExactSizeIterator,
) -> bool {
    states.len() >= UPRIGHT_STEPS && states.rev().take(UPRIGHT_STEPS).all(is_upright)
}

/// The ticks in which the policy drove the motor.
pub(super) fn running(ticks: &[TickRecord]) -> Vec<&TickRecord> {
    ticks.iter().filter(|tick| tick.phase == Phase::Running).collect()
}

/// Distance from upright, rad, for either direction of the swing-up.
fn from_upright_rad(state: &State) -> f64 {
    wrap_angle(state.alpha - PI).abs()
}

/// Returns whether the fraction of successful rollouts is at least [`POLICY_SHARE`].
pub(crate) fn is_policy_share(successes: usize, rollouts: usize) -> bool {
    successes as f64 >= POLICY_SHARE * rollouts as f64
}

/// Smallest number of successful rollouts among `rollouts` that makes a recommendation successful.
pub(crate) fn needed_of(rollouts: u32) -> u32 {
    // Without the small term, rounding could turn nine of ten into ten of ten.
    (RECOMMENDATION_SHARE * f64::from(rollouts) - 1e-9).ceil() as u32
}
