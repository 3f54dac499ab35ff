use serde::{Deserialize, Serialize};

use super::LatencySummary;

/// What one check of a device came to.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct CheckResult {
    /// A name that stays.
    pub name: String,
    /// Passed, failed, or not done.
    pub verdict: CheckVerdict,
    /// The figure or fact that was found, in words; why it was not done.
    pub value: String,
    /// What to do about a failure.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cure: Option<String>,
}

/// Passed, failed, or not done.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CheckVerdict {
    /// As it should be.
    Pass,
    /// Not as it should be.
    Fail,
    /// Not done, because one before it failed or there is nothing to check.
    Skipped,
}

/// What was measured of a link, and what the control loop makes of it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct MeasuredLink {
    /// From the request of a sample to its whole answer, microseconds.
    pub round_trip_us: LatencySummary,
    /// Samples without an answer.
    pub lost: u32,
    /// How long a tick waits for its sample, microseconds.
    pub sample_time_us: u32,
}

/// What is known about the check of the device before a rollout.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "kind", content = "checks")]
pub enum Preflight {
    /// Nothing: the recording is older than the check.
    #[default]
    Unknown,
    /// The embedded emulator needs none.
    NotNeeded,
    /// Somebody asked to leave it out.
    SkippedByFlag,
    /// It was done, with these results.
    Done(Vec<CheckResult>),
}

impl CheckResult {
    /// A check that passed.
    pub fn pass(name: &str, value: impl Into<String>) -> Self {
        Self { name: name.into(), verdict: CheckVerdict::Pass, value: value.into(), cure: None }
    }

    /// A check that failed, and what to do about it.
    pub fn fail(name: &str, value: impl Into<String>, cure: impl Into<String>) -> Self {
        Self {
            name: name.into(),
            verdict: CheckVerdict::Fail,
            value: value.into(),
            cure: Some(cure.into()),
        }
    }

    /// A check that was not done, and why.
    pub fn skipped(name: &str, why: impl Into<String>) -> Self {
        Self { name: name.into(), verdict: CheckVerdict::Skipped, value: why.into(), cure: None }
    }

    /// Whether it failed.
    #[must_use]
    pub fn failed(&self) -> bool {
        self.verdict == CheckVerdict::Fail
    }
}
