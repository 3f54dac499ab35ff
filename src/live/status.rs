use schemars::JsonSchema;
use serde::Serialize;

// The doc comments are part of the schema that viewers get.

/// The state of the command that runs.
#[derive(Clone, Debug, Default, PartialEq, Serialize, JsonSchema)]
#[schemars(title = "qube.Session")]
pub struct LiveStatus {
    /// The command: session, run or experiment.
    pub command: String,
    /// Present activity of the command, in words.
    pub doing: String,
    /// Number of the candidate, from 0.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(with = "u32", default)]
    pub candidate: Option<u32>,
    /// Number of candidates of a session, or of rollouts of `run`. Absent in an experiment, and in a session that may end early.
    #[serde(rename = "of", skip_serializing_if = "Option::is_none")]
    #[schemars(with = "u32", default)]
    pub total: Option<u32>,
    /// Largest return so far; the largest possible is 600.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(with = "f64", default)]
    pub best_return: Option<f64>,
    /// Estimate of the time until the session's last candidate is trained, s. Absent before the second update of the first training, after the last training, and outside a session.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(with = "f64", default)]
    pub time_left_s: Option<f64>,
    /// Somebody has asked to stop.
    pub stop_requested: bool,
    /// The command has ended.
    pub ended: bool,
}
