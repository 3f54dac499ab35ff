use std::collections::BTreeMap;

use super::start_angle::start_theta_rad;
use crate::estimation::{Calibration, EstimatorSettings};
use crate::qube::{MAX_STEPS, PlantModel, RewardWeights};
use crate::recording::FORMAT_VERSION;
use crate::safety::SafetyBox;
use crate::telemetry::{DeviceFacts, Preflight, RolloutHeader, TickRules, TickSettings};

/// The plan of a rollout: its place among the others, its policy, estimator, box and length.
#[derive(Clone, Debug)]
pub struct RolloutPlan {
    /// Name of the session or experiment, or of the caller, such as `run`.
    pub session: String,
    /// Number of the candidate in its session, or of the policy in its experiment.
    pub candidate: Option<u32>,
    /// Number of the rollout for this candidate.
    pub rollout: u32,
    /// Number of the attempt.
    pub attempt: u32,
    /// Psi of the candidate by name.
    pub psi: BTreeMap<String, f64>,
    /// Seed that determines the start angle of the arm, together with the numbers of candidate and
    /// rollout.
    pub seed: u64,
    /// Name of the policy.
    pub policy: String,
    /// Estimator of the state.
    pub estimator: EstimatorSettings,
    /// Box and guard, which may end the rollout early.
    pub safety_box: SafetyBox,
    /// Largest number of steps under the policy, 10 ms each.
    pub steps: u32,
}

impl RolloutPlan {
    /// A complete rollout outside any search, with the default guard and estimator and seed 0.
    #[must_use]
    pub fn single(session: &str, policy: &str) -> Self {
        Self {
            session: session.into(),
            candidate: None,
            rollout: 0,
            attempt: 0,
            psi: BTreeMap::new(),
            seed: 0,
            policy: policy.into(),
            estimator: EstimatorSettings::default(),
            safety_box: SafetyBox::GUARDED,
            steps: MAX_STEPS as u32,
        }
    }

    /// The header of the recording. The rig fills in everything that it alone knows: device, plant,
    /// check, heat of the motor, calibration, stops, guard and time. It also narrows the box to its
    /// own stops.
    #[must_use]
    pub fn header(&self) -> RolloutHeader {
        RolloutHeader {
            format: FORMAT_VERSION,
            session: self.session.clone(),
            candidate: self.candidate,
            rollout: self.rollout,
            attempt: self.attempt,
            psi: self.psi.clone(),
            seed: self.seed,
            started_unix_ns: None,
            program_version: env!("CARGO_PKG_VERSION").into(),
            git_revision: env!("QUBE_HIL_GIT_REVISION").into(),
            device: DeviceFacts::default(),
            preflight: Preflight::Unknown,
            motor_heat: None,
            hard_stop_accepted: false,
            policy: self.policy.clone(),
            settings: TickSettings {
                calibration: Calibration::IDENTITY,
                estimator: self.estimator,
                safety_box: self.safety_box,
                max_steps: self.steps,
                start_theta_rad: start_theta_rad(
                    self.seed,
                    self.candidate.unwrap_or(0),
                    self.rollout,
                ),
                stops: None,
                foresight: None,
                rules: TickRules::NEWEST,
                plant: PlantModel::QUBE,
            },
            reward: RewardWeights::THESIS,
        }
    }
}
