use std::collections::BTreeMap;
use std::fmt;

use serde::{Deserialize, Serialize};

use super::{DeviceFacts, Fault, LatencySummary, Phase, Preflight, TickRules};
use crate::estimation::{Calibration, EstimatorSettings, MeasuredStops};
use crate::qube::{PlantModel, RewardWeights};
use crate::safety::{Contradiction, Foreseen, ForesightSettings, Limit, MotorHeat, SafetyBox};

/// The settings of the tick. A replay of a recording needs them, the measurements and the policy.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TickSettings {
    /// Map from counts to angles and from wanted to sent voltage.
    pub calibration: Calibration,
    /// Estimator of the state that the policy sees.
    pub estimator: EstimatorSettings,
    /// Box that the state must not leave, and the guard.
    pub safety_box: SafetyBox,
    /// Largest number of steps of the policy.
    pub max_steps: u32,
    /// Start angle of the arm, rad.
    pub start_theta_rad: f64,
    /// Positions of the arm's stops: the stops that homing touched or, after homing by hand, the
    /// stops that offset and accepted travel imply. If this is `None`, guard and brake assume the
    /// plant's own stops. The guard keeps away from the nearer stop.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stops: Option<MeasuredStops>,
    /// Model and settings of foresight, if foresight is the guard; without this entry, the plant's
    /// defaults hold.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub foresight: Option<ForesightSettings>,
    /// Version of the rules of the tick; recordings that name no version follow
    /// [`TickRules::First`].
    #[serde(default)]
    pub rules: TickRules,
    /// Plant that is driven; recordings that name no plant are of the built-in Qube.
    #[serde(default, skip_serializing_if = "PlantModel::is_qube")]
    pub plant: PlantModel,
}

/// The record that precedes a rollout.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RolloutHeader {
    /// Version of this record's format.
    pub format: u32,
    /// Name of the session or experiment; of a rollout that belongs to none, the command, such as
    /// `run`.
    pub session: String,
    /// Number of the candidate in its session, or of the policy in its experiment, from 0; `None`
    /// for a rollout that belongs to neither.
    pub candidate: Option<u32>,
    /// Number of the rollout among the rollouts of its candidate, policy or run, from 0.
    pub rollout: u32,
    /// Number of the attempt, from 0. Each repetition after a void rollout adds 1.
    pub attempt: u32,
    /// Entries of the candidate's psi by name; empty for a rollout without a psi.
    pub psi: BTreeMap<String, f64>,
    /// Seed of the run.
    pub seed: u64,
    /// Wall-clock start, ns since 1970; `None` under a virtual clock.
    pub started_unix_ns: Option<u64>,
    /// Version of the program.
    pub program_version: String,
    /// Revision that the program was built from, or `unknown`.
    pub git_revision: String,
    /// Facts about the device.
    pub device: DeviceFacts,
    /// Check of the device before the rollout.
    #[serde(default)]
    pub preflight: Preflight,
    /// Motor heat at the start; `None` in recordings that lack it, whose replay ignores the heat.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub motor_heat: Option<MotorHeat>,
    /// True if a real Qube ran under the box alone, without foresight. The operator then accepted
    /// on the command line that the arm may reach its hard stop.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub hard_stop_accepted: bool,
    /// Name of the policy.
    pub policy: String,
    /// Settings of the tick.
    pub settings: TickSettings,
    /// Weights of the reward from which the return is computed.
    pub reward: RewardWeights,
}

impl RolloutHeader {
    /// Serial number of the board that the device named; `None` for a device that names none.
    #[must_use]
    pub fn board(&self) -> Option<&str> {
        self.device.serial()
    }
}

/// The ending of a rollout. Rollouts that end with `Completed` or `LeftBox` have a result, unless
/// their recording lacks ticks; the others are stopped or void.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "kind", content = "detail")]
pub enum Ending {
    /// The policy took all steps.
    Completed,
    /// The state left the safety box, or the guard ended the rollout.
    LeftBox(Limit),
    /// The operator or the program stopped the rollout.
    Stopped,
    /// A fault ended the rollout.
    Fault(Fault),
}

/// The ending as a phrase whose subject is the rollout; a fault is named after `fault: ` instead.
impl fmt::Display for Ending {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Completed => formatter.write_str("completed"),
            Self::LeftBox(limit) => limit.fmt(formatter),
            Self::Stopped => formatter.write_str("stopped"),
            Self::Fault(fault) => write!(formatter, "fault: {fault}"),
        }
    }
}

/// The record that follows a rollout. The return is not part of it; it is computed from the ticks.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RolloutOutcome {
    /// Ending of the rollout.
    pub ending: Ending,
    /// Phase in which the rollout ended.
    pub phase: Phase,
    /// Number of steps that the policy took.
    pub steps: u32,
    /// Number of skipped periods, plus ticks that were more than a period late or had no valid
    /// sample.
    pub missed_deadlines: u32,
    /// Number of records for which the recorder had no room; above 0, the file lacks ticks.
    pub records_lost: u64,
    /// Number of times that the observer diverged and was reset from encoders and filter: its model
    /// does not match the Qube, or something hit the Qube.
    #[serde(default, rename = "times_astray", skip_serializing_if = "is_zero")]
    pub observer_resets: u32,
    /// Prediction because of which foresight ended the policy, also where a fault then ended the
    /// braking; `None` if foresight did not end it, and in recordings that lack it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub foreseen: Option<Foreseen>,
    /// Contradiction between the Qube and its profile that ended the policy; `None` if none did,
    /// and in recordings that lack it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub contradiction: Option<Contradiction>,
    /// Largest load of the motor, 1 at its continuous rating; `None` in recordings that lack it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub largest_motor_load: Option<f64>,
    /// Last voltage that an external controller requested, V, which the guard may have refused; the
    /// ticks contain the earlier requests. `None` for every other policy.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub last_answer_v: Option<f64>,
    /// Lateness of wake-ups, microseconds.
    pub lateness_us: LatencySummary,
    /// Time from sample to act by the device's clock, microseconds.
    pub sample_to_act_us: LatencySummary,
}

fn is_zero(count: &u32) -> bool {
    *count == 0
}
