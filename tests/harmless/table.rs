//! The results of many starts of one case, as a line of a table.

use std::collections::BTreeMap;
use std::fmt;

use qube_hil::control::ControlState;
use qube_hil::telemetry::Ending;

use super::case::{Case, Start};
use super::trial::Trial;

/// Largest accepted speed of a contact while homing or settling, rad/s.
const FASTEST_CONTACT_RAD_S: f64 = 2.0;

/// Longest accepted time from a failure of the arm's encoder in a rollout until the motor is off,
/// s.
const FOUND_WITHIN_S: f64 = 0.3;

impl Trial {
    /// Returns whether every contact with a stop while homing or settling was at most as fast as
    /// [`FASTEST_CONTACT_RAD_S`], or at most 1 % faster than with the amplifier off.
    pub fn is_harmless(&self) -> bool {
        self.contact_before_policy_rad_s <= FASTEST_CONTACT_RAD_S.max(1.01 * self.contact_off_rad_s)
    }

    /// Returns whether the fault was named correctly, or the start ended without a fault and may.
    pub fn is_named_rightly(&self, start: &Start) -> bool {
        match self.ending {
            Ending::Fault(fault) => start.case.names_rightly(fault),
            _ => !start.must_be_named(),
        }
    }

    /// Returns whether the arm touched a stop too fast in a case without a hand, the fault was not named
    /// correctly, or a failing arm encoder led to a false result.
    pub fn falls_short(&self, start: &Start) -> bool {
        !self.is_harmless() && !start.case.is_by_hand()
            || !self.is_named_rightly(start)
            || start.case.is_of_theta_encoder() && self.false_results > 0
    }
}

impl Start {
    /// Returns whether this start must end with a fault.
    fn must_be_named(&self) -> bool {
        !matches!(
            self.case,
            Case::Healthy
                | Case::MotorHalf
                | Case::MotorWeak
                | Case::BesideAStop
                | Case::BesideAStopFalling
                | Case::ArmPushed
                | Case::PendulumHeld
        )
    }
}

/// A line of the table: the case, counts and extremes over its starts, and their endings.
pub struct Row {
    case: Case,
    starts: usize,
    pub harmless: bool,
    contact_before_policy_rad_s: f64,
    /// Fastest contact with a stop in a rollout, rad/s.
    pub rollout_rad_s: f64,
    too_fast: usize,
    named_rightly: usize,
    /// Number of rollouts that counted although the arm's zero was wrong.
    pub false_results: u32,
    /// Number of starts whose arm's encoder failed in a rollout and whose motor was on for more
    /// than [`FOUND_WITHIN_S`] after that.
    pub slow_to_find: usize,
    struck_running: usize,
    slowest_homing_s: f64,
    mean_homing_s: f64,
    endings: BTreeMap<String, usize>,
}

impl Row {
    pub const HEAD: &str = "| case | starts | fastest contact, homing and settling, rad/s | too fast | \
        named rightly | false results | fastest contact, rollout, rad/s | faults that began in a rollout: \
        of the arm's encoder with the motor on for more than 300 ms after it, of all | homing, mean and longest | how they ended |\n| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |";

    pub fn of(case: Case, trials: &[(Start, Trial)]) -> Self {
        let largest = |value: fn(&Trial) -> f64| {
            trials.iter().map(|(_, trial)| value(trial)).fold(0.0, f64::max)
        };
        let count = |keep: &dyn Fn(&Start, &Trial) -> bool| {
            trials.iter().filter(|(start, trial)| keep(start, trial)).count()
        };
        let homed: Vec<f64> = trials.iter().filter_map(|(_, trial)| trial.homed_after_s).collect();
        let mut endings = BTreeMap::new();
        for (_, trial) in trials {
            let name = match trial.ending {
                Ending::Fault(fault) => format!("{fault:?}"),
                Ending::LeftBox(_) => "LeftBox".to_owned(),
                other => format!("{other:?}"),
            };
            *endings.entry(name).or_insert(0) += 1;
        }
        let running = |trial: &Trial| trial.struck_in == Some(ControlState::Running);
        Self {
            case,
            starts: trials.len(),
            harmless: case.is_by_hand() || trials.iter().all(|(_, trial)| trial.is_harmless()),
            contact_before_policy_rad_s: largest(|trial| trial.contact_before_policy_rad_s),
            rollout_rad_s: largest(|trial| trial.rollout_contact_rad_s),
            too_fast: count(&|_, trial| !trial.is_harmless()),
            named_rightly: count(&|start, trial| trial.is_named_rightly(start)),
            false_results: trials.iter().map(|(_, trial)| trial.false_results).sum(),
            slow_to_find: count(&|start, trial| {
                start.case.is_of_theta_encoder()
                    && running(trial)
                    && trial.off_after_s > FOUND_WITHIN_S
            }),
            struck_running: count(&|_, trial| running(trial)),
            slowest_homing_s: homed.iter().copied().fold(0.0, f64::max),
            mean_homing_s: homed.iter().sum::<f64>() / homed.len().max(1) as f64,
            endings,
        }
    }
}

impl fmt::Display for Row {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let endings: Vec<String> =
            self.endings.iter().map(|(name, count)| format!("{name} {count}")).collect();
        write!(
            formatter,
            "| {:?} | {} | {:.2} | {} | {} | {} | {:.1} | {} of {} | {:.1}, {:.1} s | {} |",
            self.case,
            self.starts,
            self.contact_before_policy_rad_s,
            self.too_fast,
            self.named_rightly,
            self.false_results,
            self.rollout_rad_s,
            self.slow_to_find,
            self.struck_running,
            self.mean_homing_s,
            self.slowest_homing_s,
            endings.join(", ")
        )
    }
}
