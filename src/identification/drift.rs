use std::fmt;

use nalgebra::{DMatrix, DVector};
use serde::Serialize;

use super::fit::Fit;
use super::fitness::check_motion;
use super::stretch::Stretch;
use super::uncertainty::{Estimate, Evidence};
use super::{Unfit, Unknown};
use crate::qube::{Nonideality, Profile, Quantity, QubeModel, wrap_angle};
use crate::recording::Recording;
use crate::replay::MotionLog;
use crate::telemetry::Phase;

/// Number of rollouts that are compared with the profile: the first of a `run` that are not void,
/// or the first with a result that a session's process makes on a rig. A shorter `run` compares
/// fewer.
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

/// Shortest motion that is used, s; a swing-up that left the box may be so short.
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

/// The drift of a rig from its profile, estimated from some rollouts of one day.
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
    /// Standard error of the profile's value, 0 where the profile names none. All quantities but
    /// command delay and cable rest count as known, because today's estimate takes them from the
    /// profile too.
    pub profile_standard_error: f64,
    /// True if the change exceeds both the quantity's tolerance and three standard errors of the
    /// change; `false` if the rollouts do not determine the quantity.
    pub moved: bool,
}

impl Compared {
    /// Compares two values, each with its standard error.
    fn new(today: [f64; 2], profile: [f64; 2], tolerance: f64) -> Self {
        let ([today, standard_error], [profile, profile_standard_error]) = (today, profile);
        let of_change = standard_error.hypot(profile_standard_error);
        let moved = (today - profile).abs() > tolerance.max(STANDARD_ERRORS * of_change);
        Self { today, standard_error, profile, profile_standard_error, moved }
    }
}

impl Drift {
    /// Compares rollouts of one day with the profile. Rollouts that cannot be fitted do not count
    /// for delay and cable.
    ///
    /// # Errors
    /// None of the rollouts can be fitted.
    pub fn of(recordings: &[Recording], profile: &Profile) -> Result<Self, Unfit> {
        let motions: Vec<MotionLog> =
            recordings.iter().filter_map(MotionLog::of_recording).collect();
        let motions = usable_motions(&motions)?;
        let [command_delay, cable_rest] = changing(&motions, &profile.model());
        let [delay_error_s, rest_error_rad] = conditional_errors(profile);
        let encoder = motions[0].plant.encoders.alpha;
        let alpha_tolerance_rad = ALPHA_TOLERANCE_COUNTS * encoder.rad_per_count();
        let hanging: Vec<f64> = recordings.iter().filter_map(hanging_rad).collect();
        let alpha_rad =
            (!hanging.is_empty()).then(|| hanging.iter().sum::<f64>() / hanging.len() as f64);
        let nonidealities = &profile.nonidealities;
        let compared = |estimate: &Estimate, profile, tolerance| {
            let today = [estimate.value, estimate.standard_error];
            let mut compared = Compared::new(today, profile, tolerance);
            // A cable without stiffness has no measurable rest angle.
            compared.moved &= estimate.is_determined();
            compared
        };
        Ok(Self {
            command_delay_s: compared(
                &command_delay,
                [nonidealities.command_delay_s, delay_error_s],
                DELAY_TOLERANCE_S,
            ),
            cable_rest_rad: compared(
                &cable_rest,
                [nonidealities.cable_rest_rad, rest_error_rad],
                REST_TOLERANCE_RAD,
            ),
            alpha_zero_rad: alpha_rad
                .map(|today| Compared::new([today, 0.0], [0.0, 0.0], alpha_tolerance_rad)),
            rollouts: motions.len(),
        })
    }

    /// Returns whether the rig has drifted from its profile.
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
    let mut usable = Vec::new();
    for motion in motions {
        match check_motion(motion, SHORTEST_S) {
            Ok(()) => usable.push(motion),
            Err(why) => unfit = why,
        }
    }
    if usable.is_empty() { Err(unfit) } else { Ok(usable) }
}

/// Estimates the quantities in [`CHANGING`], in that order, from motions of one plant; all others
/// are as in `reference`.
fn changing(motions: &[&MotionLog], reference: &QubeModel) -> [Estimate; 2] {
    let stretches = motions.iter().flat_map(|log| Stretch::windows(&log.samples, STRETCH_S));
    let mut fit = Fit::new(&CHANGING, &motions[0].plant, *reference, stretches.collect());
    fit.run();
    let found =
        Evidence::of(&fit, fit.noise, None).uncertainty(&CHANGING, fit.plant, &fit.model).estimates;
    [found[0], found[1]]
}

/// Standard errors of the profile's values of the quantities in [`CHANGING`], with all other
/// quantities known: from the Schur complement of the others in the covariance. Where the
/// covariance is not positive definite, the standard errors are the profile's own.
fn conditional_errors(profile: &Profile) -> [f64; 2] {
    let changing = CHANGING.map(|Unknown(quantity)| quantity);
    let others: Vec<Quantity> = Quantity::all()
        .filter(|it| !changing.contains(it) && profile.standard_error(*it) > 0.0)
        .collect();
    // In units of the standard errors, because the errors of different quantities differ by many
    // powers of 10.
    let scaled = |one: Quantity, other: Quantity| {
        profile.covariance(one, other)
            / (profile.standard_error(one) * profile.standard_error(other))
    };
    let size = others.len();
    let correlations =
        DMatrix::from_fn(size, size, |row, column| scaled(others[row], others[column]));
    let inverse = correlations.cholesky();
    changing.map(|quantity| {
        let error = profile.standard_error(quantity);
        let Some(inverse) = inverse.as_ref().filter(|_| error > 0.0) else { return error };
        let shared = DVector::from_fn(size, |row, _| scaled(others[row], quantity));
        let left = 1.0 - shared.dot(&inverse.solve(&shared));
        if left > 0.0 { error * left.sqrt() } else { error }
    })
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::{Correlations, DomainParameter};

    const DELAY: Quantity = Quantity::Nonideality(Nonideality::CommandDelay);
    const RESISTANCE: Quantity = Quantity::Parameter(DomainParameter::MotorResistance);

    /// A profile whose errors of delay (1 ms) and resistance (0.5 ohm) have this correlation.
    fn profile(correlation: f64) -> Profile {
        let mut profile = Profile::exact("test", &QubeModel::NOMINAL);
        profile.standard_errors.insert(DELAY.name().into(), 1e-3);
        profile.standard_errors.insert(RESISTANCE.name().into(), 0.5);
        let names = vec![DELAY.name().to_owned(), RESISTANCE.name().to_owned()];
        let matrix = [vec![1.0, correlation], vec![correlation, 1.0]];
        profile.correlations = Some(Correlations::new(names, &matrix));
        profile
    }

    #[test]
    fn the_error_of_a_profile_excludes_the_part_that_the_other_quantities_explain() {
        let [delay_s, rest_rad] = conditional_errors(&profile(0.8));
        assert!((delay_s - 0.6e-3).abs() < 1e-12, "{delay_s}");
        assert_eq!(rest_rad, 0.0);
        assert_eq!(conditional_errors(&profile(0.0)), [1e-3, 0.0]);
        assert_eq!(conditional_errors(&Profile::exact("test", &QubeModel::NOMINAL)), [0.0, 0.0]);
    }

    #[test]
    fn a_change_within_the_errors_of_both_values_is_no_move() {
        let moved = |today_s: f64, profile_error_s: f64| {
            Compared::new([today_s, 0.3e-3], [0.010, profile_error_s], DELAY_TOLERANCE_S).moved
        };
        assert!(moved(0.0129, 0.0) && !moved(0.0119, 0.0));
        assert!(!moved(0.0129, 1e-3) && moved(0.0133, 1e-3));
    }
}
