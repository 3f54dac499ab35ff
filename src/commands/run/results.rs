use std::fmt::Write;
use std::path::{Path, PathBuf};

use serde_json::{Value, json};

use crate::commands::exit::Failure;
use crate::commands::{
    command_hints, failures, heat_line, observer_resets_line, quietness_line, timing_lines,
};
use crate::identification::{DRIFT_ROLLOUTS, Drift, Unfit, check_recording};
use crate::jobs::starter::quoted;
use crate::qube::Profile;
use crate::recording::{Recording, read};
use crate::replay::MotionLog;
use crate::scoring::{Latencies, Quietness, Verdict, VoidReason, score_recording};

use crate::telemetry::{Ending, Fault};

/// The results of the rollouts, read from their recordings.
#[derive(Debug, Default)]
pub struct RunResults {
    /// The Qube in words, if an excitation drove it. The results then say whether `identify` can
    /// use the recordings, and show no returns.
    excited: Option<String>,
    /// Rollouts in order.
    pub rollouts: Vec<RolloutRow>,
    latencies: Latencies,
    /// Quietness of the balancing, if the policy balanced.
    quietness: Quietness,
    /// Number of observer resets.
    observer_resets: u64,
    /// Largest load of the motor, as a fraction of its continuous rating; `None` if no recording
    /// has it.
    largest_motor_load: Option<f64>,
    /// Reason why the last rollout is void, if it is.
    void: Option<VoidReason>,
    /// Recordings of the first rollouts that are not void, at most [`DRIFT_ROLLOUTS`], for the
    /// estimate of the drift.
    first: Vec<Recording>,
    drift: DriftFromProfile,
}

/// The drift of the rig from its profile, as far as it is known.
#[derive(Debug, Default)]
enum DriftFromProfile {
    /// There is no profile, or no rollout to compare with it.
    #[default]
    NotCompared,
    Estimated(Drift),
    /// No rollout can be fitted.
    Unknown(Unfit),
}

/// The result of one rollout: a row of the table.
#[derive(Debug)]
pub struct RolloutRow {
    recording: PathBuf,
    /// Return; `None` without a result.
    pub return_: Option<f64>,
    success: bool,
    /// Reason why the rollout ended before its last step, or has no result.
    pub ended_early: Option<String>,
    /// Outcome in words; of an excitation with a result, whether `identify` can use the recording.
    outcome: String,
}

impl RolloutRow {
    /// Returns the return and outcome in words.
    pub fn in_words(&self) -> String {
        match self.return_ {
            Some(return_) => format!("return {return_:.0}, {}", self.outcome),
            None => self.outcome.clone(),
        }
    }
}

impl RunResults {
    /// Returns the largest return so far and the number of successes, in words; empty without a
    /// return, and for excitations.
    pub fn best(&self) -> String {
        let returns = self.rollouts.iter().filter_map(|row| row.return_);
        let successes = self.rollouts.iter().filter(|row| row.success).count();
        match returns.max_by(f64::total_cmp) {
            Some(best) if self.excited.is_none() => format!(
                "best return so far: {best:.0}; {successes} of {} rollouts balance",
                self.rollouts.len()
            ),
            _ => String::new(),
        }
    }

    /// Makes results without any rollout yet: of an excitation of this Qube, or else of a policy.
    pub fn new(excited: Option<String>) -> Self {
        Self { excited, ..Self::default() }
    }

    /// Reads and scores one more recording.
    pub fn add(&mut self, path: &Path) -> Result<(), Failure> {
        let recording = read(path).map_err(|error| failures::recording(&error))?;
        self.latencies.add(&recording.ticks);
        self.quietness.add(&recording.ticks, &recording.header.settings.plant);
        let outcome = recording.outcome.as_ref();
        self.observer_resets += outcome.map_or(0, |outcome| u64::from(outcome.observer_resets));
        // `None` is less than any load.
        let load = outcome.and_then(|outcome| outcome.largest_motor_load);
        if self.largest_motor_load < load {
            self.largest_motor_load = load;
        }
        self.void = None;
        let without = |outcome: String| RolloutRow {
            recording: path.to_owned(),
            return_: None,
            success: false,
            ended_early: Some(outcome.clone()),
            outcome,
        };
        self.rollouts.push(match score_recording(&recording) {
            Verdict::Result { return_, success, outcome } => {
                let ended_early = match outcome.ending {
                    Ending::LeftBox(limit) => Some(limit.to_string()),
                    _ => None,
                };
                let outcome = match &ended_early {
                    _ if self.excited.is_some() => fitness(&recording),
                    Some(reason) => format!("{reason} after {} steps", outcome.steps),
                    None if success => "success".into(),
                    None => "not balancing at the end".into(),
                };
                let recording = path.to_owned();
                RolloutRow { recording, return_: Some(return_), success, ended_early, outcome }
            }
            Verdict::Void { reason } => {
                self.void = Some(reason);
                without(format!("void: {reason}"))
            }
            Verdict::Unfinished => without("stopped".into()),
        });
        if self.void.is_none() && self.first.len() < DRIFT_ROLLOUTS {
            self.first.push(recording);
        }
        Ok(())
    }

    /// Returns the fault that ended the last rollout, if one did.
    pub fn fault(&self) -> Option<Fault> {
        match self.void? {
            VoidReason::Fault(fault) => Some(fault),
            VoidReason::LostTicks => None,
        }
    }

    /// Returns a failure if the last rollout is void for another reason than a
    /// [`fault`](Self::fault).
    pub fn check_not_void(&self) -> Result<(), Failure> {
        match self.void {
            Some(reason @ VoidReason::LostTicks) => {
                Err(Failure::fault(format!("the last rollout is void: {reason}")))
            }
            Some(VoidReason::Fault(_)) | None => Ok(()),
        }
    }

    /// Estimates from the first rollouts, if there are any, how far the rig has drifted from its
    /// profile.
    pub fn compare(&mut self, profile: &Profile) {
        if !self.first.is_empty() {
            self.drift = match Drift::of(&self.first, profile) {
                Ok(drift) => DriftFromProfile::Estimated(drift),
                Err(unfit) => DriftFromProfile::Unknown(unfit),
            };
        }
    }

    /// Returns whether no rollout was run.
    pub fn is_empty(&self) -> bool {
        self.rollouts.is_empty()
    }

    /// Returns the results for people.
    pub fn text(&self) -> String {
        let Some(first) = self.rollouts.first() else { return "no rollout was run".into() };
        let directory = first.recording.parent().unwrap_or(Path::new(".")).display();
        let mut text = String::new();
        for (number, RolloutRow { return_, outcome, .. }) in self.rollouts.iter().enumerate() {
            let _ = match return_.filter(|_| self.excited.is_none()) {
                Some(return_) => {
                    writeln!(text, "rollout {number}: return {return_:6.1}  {outcome}")
                }
                None => writeln!(text, "rollout {number}: {outcome}"),
            };
        }
        text.push_str(&observer_resets_line(self.observer_resets));
        text.push_str(&quietness_line(&self.quietness));
        text.push_str(&heat_line(self.largest_motor_load));
        let _ = match &self.drift {
            DriftFromProfile::Estimated(drift) => writeln!(text, "{}", command_hints::drift(drift)),
            DriftFromProfile::Unknown(unfit) => {
                writeln!(text, "the rig's drift cannot be estimated from these rollouts: {unfit}")
            }
            DriftFromProfile::NotCompared => Ok(()),
        };
        text.push_str(&timing_lines(&self.latencies));
        let _ = write!(text, "recordings in {directory}");
        let is_recorded = self.rollouts.iter().any(|it| it.return_.is_some());
        if let Some(qube) = self.excited.as_ref().filter(|_| is_recorded) {
            let word = quoted(&directory.to_string());
            let _ = write!(text, "\nqube-hil identify {word}/*.mcap identifies {qube}");
        }
        text
    }

    /// Returns the results for scripts.
    pub fn json(&self) -> Value {
        let drift = match &self.drift {
            DriftFromProfile::Estimated(drift) => Some(drift),
            DriftFromProfile::NotCompared | DriftFromProfile::Unknown(_) => None,
        };
        fn each<T>(of: &RunResults, field: impl Fn(&RolloutRow) -> T) -> Vec<T> {
            of.rollouts.iter().map(field).collect()
        }
        json!({
            "returns": each(self, |it| it.return_),
            "ended_early": each(self, |it| it.ended_early.clone()),
            "success": each(self, |it| it.success),
            "times_astray": self.observer_resets,
            "balancing": self.quietness.figures(),
            "largest_motor_load": self.largest_motor_load,
            "missed_deadlines": self.latencies.missed_deadlines(),
            "lateness_us": self.latencies.lateness_us(),
            "sample_to_act_us": self.latencies.sample_to_act_us(),
            "recordings": each(self, |it| it.recording.to_string_lossy().into_owned()),
            "drift": drift,
        })
    }
}

/// Says in words whether `identify` can use the recording of an excitation.
fn fitness(recording: &Recording) -> String {
    let Some(log) = MotionLog::of_recording(recording) else {
        return "no motion: `identify` cannot use it".into();
    };
    let duration_s = log.samples.last().map_or(0.0, |last| last.time_s);
    match check_recording(&log) {
        Ok(()) => format!("{duration_s:.1} s recorded, usable by identify"),
        Err(unfit) => format!("{duration_s:.1} s recorded, but not usable by identify: {unfit}"),
    }
}
