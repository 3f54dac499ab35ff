/// An attempt at a rollout of a policy.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct RolloutAttempt {
    /// Number of the rollout among the policy's rollouts, from 0.
    pub rollout: u32,
    /// Number of the attempt at this rollout, from 0.
    pub attempt: u32,
}

impl RolloutAttempt {
    /// The first attempt at the first rollout.
    pub const FIRST: Self = Self { rollout: 0, attempt: 0 };
}

/// An attempt at a rollout of a candidate's policy.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct AttemptId {
    /// Number of the candidate.
    pub candidate: u32,
    /// Number of the rollout among the candidate's rollouts, from 0.
    pub rollout: u32,
    /// Number of the attempt at this rollout, from 0.
    pub attempt: u32,
}

impl AttemptId {
    /// The same attempt among the attempts of the candidate's policy.
    #[must_use]
    pub fn of_policy(self) -> RolloutAttempt {
        RolloutAttempt { rollout: self.rollout, attempt: self.attempt }
    }
}
