use serde::{Deserialize, Serialize};

use super::LatencySummary;

/// The result of one check of a device.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct CheckResult {
    /// Name of the check, the same in every version of the program.
    pub name: String,
    /// Verdict: passed, failed, or skipped.
    pub verdict: CheckVerdict,
    /// Figure or fact that was found, in words; for a skipped check, the reason.
    pub value: String,
    /// Advice to the operator on how to remedy a failure; `None` unless the check failed.
    #[serde(rename = "cure", default, skip_serializing_if = "Option::is_none")]
    pub remedy: Option<String>,
    /// Help with this remedy; recordings do not contain it. `None` if there is none.
    #[serde(skip)]
    pub hint: Option<Hint>,
}

/// Help with the remedy of a failed check, for which a program may have a command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Hint {
    /// A command finds the signs of the encoders and the motor, and writes them into the Qube's
    /// file.
    FindSigns,
    /// A test shows whether the board conforms to the protocol.
    TestConformance,
    /// A test shows whether the computer keeps time.
    TestTiming,
}

/// The verdict of a check.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CheckVerdict {
    /// The check passed.
    Pass,
    /// The check failed.
    Fail,
    /// The check was not done, because an earlier check failed or there is nothing to check.
    Skipped,
}

/// The measured timing of a link, and the control loop's setting for it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct MeasuredLink {
    /// Time from the request of a sample to its complete answer, µs.
    pub round_trip_us: LatencySummary,
    /// Number of requests to which no sample came in time.
    pub lost: u32,
    /// Time that a tick waits for its sample, µs.
    pub sample_time_us: u32,
}

/// The record of whether and how the device was checked before a rollout.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "kind", content = "checks")]
pub enum Preflight {
    /// The recording does not mention a check: it is from a version of the program that had none.
    #[default]
    Unknown,
    /// There was no check, because the embedded emulator needs none.
    NotNeeded,
    /// There was no check, because the operator skipped it by a flag.
    SkippedByFlag,
    /// The check was done, with these results.
    Done(Vec<CheckResult>),
}

impl CheckResult {
    /// A check that passed.
    pub fn pass(name: &str, value: impl Into<String>) -> Self {
        Self {
            name: name.into(),
            verdict: CheckVerdict::Pass,
            value: value.into(),
            remedy: None,
            hint: None,
        }
    }

    /// A failed check with its remedy.
    pub fn fail(name: &str, value: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self {
            name: name.into(),
            verdict: CheckVerdict::Fail,
            value: value.into(),
            remedy: Some(remedy.into()),
            hint: None,
        }
    }

    /// Adds help with the remedy to the result.
    #[must_use]
    pub fn with_hint(self, hint: Option<Hint>) -> Self {
        Self { hint, ..self }
    }

    /// A check that was not done, with the reason `why`.
    pub fn skipped(name: &str, why: impl Into<String>) -> Self {
        Self {
            name: name.into(),
            verdict: CheckVerdict::Skipped,
            value: why.into(),
            remedy: None,
            hint: None,
        }
    }

    /// Returns whether the check failed.
    #[must_use]
    pub fn failed(&self) -> bool {
        self.verdict == CheckVerdict::Fail
    }
}
