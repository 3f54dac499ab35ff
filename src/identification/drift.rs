use super::fit::Fit;
use super::fitness::check_motion;
use super::stretch::Stretch;
use super::uncertainty::{Estimate, uncertainty};
use super::{Unfit, Unknown};
use crate::qube::{GapTerm, Quantity, QubeModel};
use crate::replay::MotionLog;

/// What changes from day to day while the machine stays the same: how long a command takes, and
/// where the cable pulls the arm to, seen from the zero that homing has found.
const CHANGING: [Unknown; 2] =
    [Unknown(Quantity::Gap(GapTerm::CommandDelay)), Unknown(Quantity::Gap(GapTerm::CableRest))];

/// Length of the stretches that are fitted, s: short enough for a pendulum that stands, whose motion
/// no model predicts for long.
const STRETCH_S: f64 = 0.5;

/// The shortest motion that is used, s: a swing-up that left the box is worth something.
const SHORTEST_S: f64 = 1.0;

/// What changed since a profile was made.
#[derive(Clone, Debug, PartialEq)]
pub struct DriftEstimate {
    /// From command to motor, s.
    pub command_delay: Estimate,
    /// Where the cable does not pull, rad.
    pub cable_rest: Estimate,
    /// How many of the motions could be used.
    pub motions: usize,
}

/// Estimates what changes from day to day, all else being as in `reference`; rollouts of a policy
/// will do as motions. Those that cannot be fitted are left out.
///
/// # Errors
/// None can be fitted: why the last one cannot. [`Unfit::Short`] for no motion at all.
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
    let stretches = usable.iter().flat_map(|log| Stretch::cut(&log.samples, STRETCH_S));
    let mut fit = Fit::new(&CHANGING, *reference, stretches.collect());
    fit.run();
    let found = uncertainty(&fit).estimates;
    let [command_delay, cable_rest] = [found[0], found[1]];
    Ok(DriftEstimate { command_delay, cable_rest, motions: usable.len() })
}
