use super::fit::Fit;
use super::fitness::check_motion;
use super::stretch::Stretch;
use super::uncertainty::{Estimate, uncertainty};
use super::{Unfit, Unknown};
use crate::qube::{Nonideality, Quantity, QubeModel};
use crate::replay::MotionLog;

/// The quantities that change from day to day on an unchanged machine: the command delay, and the
/// cable's rest angle relative to the zero that homing found.
const CHANGING: [Unknown; 2] = [
    Unknown(Quantity::Nonideality(Nonideality::CommandDelay)),
    Unknown(Quantity::Nonideality(Nonideality::CableRest)),
];

/// Length of the fitted stretches of a motion whose pendulum never comes upright, s.
/// [`Stretch::windows`] cuts other motions into windows of at most 0.5 s, because no model predicts
/// a balancing pendulum for long.
const STRETCH_S: f64 = 0.5;

/// Shortest motion that is used, s: a swing-up that left the box still counts.
const SHORTEST_S: f64 = 1.0;

/// The quantities of a Qube that change from day to day, estimated from recent motions.
#[derive(Clone, Debug, PartialEq)]
pub struct DriftEstimate {
    /// Delay from command to motor, s.
    pub command_delay: Estimate,
    /// Rest angle of the cable, rad.
    pub cable_rest: Estimate,
    /// Number of motions that could be used.
    pub motions: usize,
}

/// Estimates the quantities that change from day to day; all others are as in `reference`. The
/// motions must be of one plant; rollouts of a policy suffice. Motions that cannot be fitted are
/// left out.
///
/// # Errors
/// No motion can be fitted: the reason of the last one, or [`Unfit::Short`] without any motion.
pub fn drift(motions: &[MotionLog], reference: &QubeModel) -> Result<DriftEstimate, Unfit> {
    let mut unfit = Unfit::Short { duration_s: 0.0, shortest_s: SHORTEST_S };
    let mut usable = Vec::new();
    for motion in motions {
        match check_motion(motion, SHORTEST_S) {
            Ok(()) => usable.push(motion),
            Err(why) => unfit = why,
        }
    }
    if usable.is_empty() {
        return Err(unfit);
    }
    let stretches = usable.iter().flat_map(|log| Stretch::windows(&log.samples, STRETCH_S));
    let plant = &usable[0].plant;
    let mut fit = Fit::new(&CHANGING, plant, *reference, stretches.collect());
    fit.run();
    let found = uncertainty(&fit).estimates;
    let [command_delay, cable_rest] = [found[0], found[1]];
    Ok(DriftEstimate { command_delay, cable_rest, motions: usable.len() })
}
