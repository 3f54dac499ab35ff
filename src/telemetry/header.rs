use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::{Fault, Phase, Preflight};
use crate::estimation::{Calibration, EstimatorSettings, MeasuredStops};
use crate::qube::RewardWeights;
use crate::safety::{Foreseen, ForesightSettings, Limit, MotorHeat, SafetyBox};

/// Everything beside measurements and policy that decides what the tick does: with these three a
/// recording can be run again.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TickSettings {
    /// Counts to angles, wanted to sent voltage.
    pub calibration: Calibration,
    /// How the state is estimated that the policy sees.
    pub estimator: EstimatorSettings,
    /// The box that ends the rollout.
    pub safety_box: SafetyBox,
    /// Steps that the policy has.
    pub max_steps: u32,
    /// Where the arm starts, rad.
    pub start_theta_rad: f64,
    /// Where the arm's stops are, where homing has touched them: the guard keeps off the nearer one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stops: Option<MeasuredStops>,
    /// What the guard knew of the Qube and how it looked ahead, where foresight is the guard.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub foresight: Option<ForesightSettings>,
    /// By which of its rules the tick decided: recordings that name none ran by those of the first.
    #[serde(default)]
    pub rules: TickRules,
}

/// The rules of settling, watching and braking that have changed since the first recordings.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TickRules {
    /// Those that recordings ran by that name none.
    #[default]
    First,
    /// Arm and pendulum are watched against each other, settling is gentle, and a braked arm is at rest
    /// wherever it is not near a stop.
    Witnessed,
    /// As before; besides, an arm whose count is doubted while a policy has the motor is damped before the
    /// motor goes off.
    Damped,
}

impl TickRules {
    /// Those of this program.
    pub const NEWEST: Self = Self::Damped;
}

/// What is known of a rollout before it starts.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RolloutHeader {
    /// Version of this record.
    pub format: u32,
    /// The session's name, or `run`.
    pub session: String,
    /// The candidate's number in its session.
    pub candidate: Option<u32>,
    /// The rollout's number for its candidate.
    pub rollout: u32,
    /// 0, or which repetition of a void rollout this is.
    pub attempt: u32,
    /// The candidate's psi by name; empty where there is none.
    pub psi: BTreeMap<String, f64>,
    /// The seed of the run.
    pub seed: u64,
    /// Wall-clock start, ns since 1970; none under a virtual clock.
    pub started_unix_ns: Option<u64>,
    /// Version of this program.
    pub program_version: String,
    /// The revision it was built from, or `unknown`.
    pub git_revision: String,
    /// The device, as it named itself: kind, serial, firmware version, protocol version, port.
    pub device: BTreeMap<String, String>,
    /// The check of the device before it.
    #[serde(default)]
    pub preflight: Preflight,
    /// How warm the motor was at the start; none in a recording that is older than the estimate of
    /// it, which then plays no part.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub motor_heat: Option<MotorHeat>,
    /// The guard was off on hardware, because the operator had accepted on the command line
    /// that the arm may reach its hard stop.
    #[serde(default, skip_serializing_if = "is_false")]
    pub hard_stop_accepted: bool,
    /// Name of the policy.
    pub policy: String,
    /// What decides the tick.
    pub settings: TickSettings,
    /// The weights of the reward that the return is computed with.
    pub reward: RewardWeights,
}

/// How a rollout ended. Only `Completed` and `LeftBox` are results; the others are void or stopped.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "kind", content = "detail")]
pub enum Ending {
    /// All steps were taken.
    Completed,
    /// The state left the safety box.
    LeftBox(Limit),
    /// Somebody asked to stop.
    Stopped,
    /// A fault of timing, link or machine.
    Fault(Fault),
}

/// What is known of a rollout when it is over; the return is not here, it is computed from the ticks.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RolloutOutcome {
    /// How it ended.
    pub ending: Ending,
    /// What the tick was doing then.
    pub phase: Phase,
    /// Steps that the policy took.
    pub steps: u32,
    /// Ticks that were late by more than a whole period, or without a valid sample.
    pub missed_deadlines: u32,
    /// Records that the recorder had no room for: above 0, the file has gaps.
    pub records_lost: u64,
    /// How often the observer had lost the Qube and started anew from encoders and filter: its model
    /// is of another Qube, or something hit this one.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub times_astray: u32,
    /// Why foresight ended it, where it did; none in older recordings.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub foreseen: Option<Foreseen>,
    /// The motor's largest load, 1 being what it stands continuously; none in older recordings.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub largest_motor_load: Option<f64>,
    /// Wake-up lateness, microseconds.
    pub lateness_us: LatencySummary,
    /// From sample to act by the device's clock, microseconds.
    pub sample_to_act_us: LatencySummary,
}

fn is_false(flag: &bool) -> bool {
    !flag
}

fn is_zero(count: &u32) -> bool {
    *count == 0
}

/// Percentiles of a latency.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct LatencySummary {
    /// Median.
    pub p50: f64,
    /// 99 %.
    pub p99: f64,
    /// 99.9 %.
    pub p999: f64,
    /// Largest.
    pub max: f64,
}
