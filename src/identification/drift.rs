use std::fmt;

use serde::Serialize;

use super::fit::Fit;
use super::fitness::check_motion;
use super::stretch::Stretch;
use super::uncertainty::{Estimate, Evidence};
use super::{Unfit, Unknown};
use crate::qube::{Nonideality, Quantity, QubeModel, wrap_angle};
use crate::recording::Recording;
use crate::replay::MotionLog;
use crate::telemetry::Phase;

/// Number of first rollouts of a day that are compared with the profile; a `run` of fewer compares
/// those that it has.
pub const DRIFT_ROLLOUTS: usize = 3;

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

/// Change of the delay beyond which the delay counts as moved, s.
const DELAY_TOLERANCE_S: f64 = 0.002;

/// Change of the cable's rest angle beyond which it counts as moved, rad.
const REST_TOLERANCE_RAD: f64 = 0.1;

/// Angle of the hanging pendulum beyond which its zero counts as moved, in counts of its encoder.
const ALPHA_TOLERANCE_COUNTS: f64 = 5.0;

/// Number of standard errors that a change must exceed, as well as the tolerance, to count as
/// moved.
const STANDARD_ERRORS: f64 = 3.0;

/// Number of final ticks of settling, of 10 ms each, over which the pendulum's angle is averaged.
const SETTLED_TICKS: usize = 20;

/// The drift of a rig from its profile, estimated from the first rollouts of a day.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Drift {
    /// Delay from command to motor, s.
    pub command_delay_s: Compared,
    /// Rest angle of the cable from the arm's zero, rad. It changes with the zero that homing finds
    /// and with the cable's position.
    pub cable_rest_rad: Compared,
    /// Angle of the hanging pendulum at rest, rad; 0 in any profile. Its standard error is not
    /// estimated and is 0. `None` if no rollout settled for long enough to tell.
    pub alpha_zero_rad: Option<Compared>,
    /// Number of rollouts from which delay and cable are estimated.
    pub rollouts: usize,
}

/// A quantity, estimated today and from the profile, both in the quantity's unit.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Compared {
    /// Value today.
    pub today: f64,
    /// Standard error of today's value.
    pub standard_error: f64,
    /// Value in the profile.
    pub profile: f64,
    /// Whether the change exceeds both the quantity's tolerance and three standard errors; `false`
    /// if the rollouts do not determine the quantity.
    pub moved: bool,
}

impl Compared {
    fn new(today: f64, standard_error: f64, profile: f64, tolerance: f64) -> Self {
        let allowed = tolerance.max(STANDARD_ERRORS * standard_error);
        Self { today, standard_error, profile, moved: (today - profile).abs() > allowed }
    }
}

impl Drift {
    /// Compares the first rollouts of a day with the profile. Rollouts that cannot be fitted do not
    /// count for delay and cable.
    ///
    /// # Errors
    /// None of the rollouts can be fitted.
    pub fn of(recordings: &[Recording], profile: &QubeModel) -> Result<Self, Unfit> {
        let motions: Vec<MotionLog> =
            recordings.iter().filter_map(MotionLog::of_recording).collect();
        let motions = usable_motions(&motions)?;
        let [command_delay, cable_rest] = changing(&motions, profile);
        let encoder = motions[0].plant.encoders.alpha;
        let alpha_tolerance_rad = ALPHA_TOLERANCE_COUNTS * encoder.rad_per_count();
        let hanging: Vec<f64> = recordings.iter().filter_map(hanging_rad).collect();
        let alpha_rad =
            (!hanging.is_empty()).then(|| hanging.iter().sum::<f64>() / hanging.len() as f64);
        let nonidealities = &profile.nonidealities;
        let compared = |estimate: &Estimate, profile, tolerance| {
            let mut compared =
                Compared::new(estimate.value, estimate.standard_error, profile, tolerance);
            // A cable without stiffness has no measurable rest angle.
            compared.moved &= estimate.is_determined();
            compared
        };
        Ok(Self {
            command_delay_s: compared(
                &command_delay,
                nonidealities.command_delay_s,
                DELAY_TOLERANCE_S,
            ),
            cable_rest_rad: compared(&cable_rest, nonidealities.cable_rest_rad, REST_TOLERANCE_RAD),
            alpha_zero_rad: alpha_rad
                .map(|today| Compared::new(today, 0.0, 0.0, alpha_tolerance_rad)),
            rollouts: motions.len(),
        })
    }

    /// Whether the rig has drifted from its profile.
    #[must_use]
    pub fn has_moved(&self) -> bool {
        let alpha_zero_moved = self.alpha_zero_rad.is_some_and(|compared| compared.moved);
        self.command_delay_s.moved || self.cable_rest_rad.moved || alpha_zero_moved
    }
}

impl fmt::Display for Drift {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let moved = |compared: &Compared| if compared.moved { "  MOVED" } else { "" };
        let (delay, rest) = (&self.command_delay_s, &self.cable_rest_rad);
        let rollouts = if self.rollouts == 1 { "rollout" } else { "rollouts" };
        writeln!(f, "today beside the profile, from {} {rollouts}:", self.rollouts)?;
        writeln!(
            f,
            "  command delay {:6.1} ± {:.1} ms, profile {:6.1} ms{}",
            1e3 * delay.today,
            1e3 * delay.standard_error,
            1e3 * delay.profile,
            moved(delay)
        )?;
        writeln!(
            f,
            "  cable rest    {:6.2} ± {:.2} rad, profile {:5.2} rad{}",
            rest.today,
            rest.standard_error,
            rest.profile,
            moved(rest)
        )?;
        match &self.alpha_zero_rad {
            Some(zero) => write!(f, "  alpha at rest {:6.3} rad{}", zero.today, moved(zero))?,
            None => write!(f, "  alpha at rest unknown: no rollout settled for long enough")?,
        }
        if self.has_moved() {
            write!(
                f,
                "\nthe rig has moved away from its profile: check cable and homing, or make a new profile"
            )?;
        }
        Ok(())
    }
}

/// The motions that can be fitted, at least one.
///
/// # Errors
/// No motion can be fitted: the reason for the last one, or [`Unfit::Short`] if there are none.
fn usable_motions(motions: &[MotionLog]) -> Result<Vec<&MotionLog>, Unfit> {
    let mut unfit = Unfit::Short { duration_s: 0.0, shortest_s: SHORTEST_S };
    let mut fit = Vec::new();
    for motion in motions {
        match check_motion(motion, SHORTEST_S) {
            Ok(()) => fit.push(motion),
            Err(why) => unfit = why,
        }
    }
    if fit.is_empty() { Err(unfit) } else { Ok(fit) }
}

/// Estimates the quantities in [`CHANGING`], in that order, from motions of one plant; all others
/// are as in `reference`.
fn changing(motions: &[&MotionLog], reference: &QubeModel) -> [Estimate; 2] {
    let stretches = motions.iter().flat_map(|log| Stretch::windows(&log.samples, STRETCH_S));
    let mut fit = Fit::new(&CHANGING, &motions[0].plant, *reference, stretches.collect());
    fit.run();
    let found =
        Evidence::of(&fit, fit.noise).uncertainty(&CHANGING, fit.plant, &fit.model).estimates;
    [found[0], found[1]]
}

/// Mean angle of the pendulum over the last ticks of settling, rad; `None` if there are too few.
fn hanging_rad(recording: &Recording) -> Option<f64> {
    let settled: Vec<f64> = recording
        .ticks
        .iter()
        .filter(|tick| tick.phase == Phase::Settling)
        .map(|tick| wrap_angle(tick.state.alpha))
        .collect();
    let last = settled.get(settled.len().checked_sub(SETTLED_TICKS)?..)?;
    Some(last.iter().sum::<f64>() / SETTLED_TICKS as f64)
}
