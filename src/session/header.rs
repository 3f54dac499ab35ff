use std::collections::BTreeMap;

use super::seeds::start_theta_rad;
use crate::estimation::{Calibration, EstimatorSettings};
use crate::qube::{MAX_STEPS, RewardWeights};
use crate::recording::FORMAT_VERSION;
use crate::safety::SafetyBox;
use crate::telemetry::{Preflight, RolloutHeader, TickRules, TickSettings};

/// What a rollout is: its place among the others, its policy, the rules it runs under.
#[derive(Clone, Debug)]
pub struct RolloutPlan {
    /// The session's name, or `run`.
    pub session: String,
    /// The candidate in its session.
    pub candidate: Option<u32>,
    /// The rollout of this candidate.
    pub rollout: u32,
    /// Which try.
    pub attempt: u32,
    /// The candidate's psi by name.
    pub psi: BTreeMap<String, f64>,
    /// The seed of the session; the start of each rollout follows from it.
    pub seed: u64,
    /// Name of the policy.
    pub policy: String,
    /// How velocities are estimated.
    pub estimator: EstimatorSettings,
    /// The box that ends the rollout.
    pub safety_box: SafetyBox,
    /// Steps that the policy has.
    pub steps: u32,
}

impl RolloutPlan {
    /// A whole rollout that belongs to no search, under the usual guard and estimator; from seed 0.
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

    /// The header as far as it is known before a rig fills in device, check, calibration and time.
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
            device: BTreeMap::new(),
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
            },
            reward: RewardWeights::THESIS,
        }
    }
}
