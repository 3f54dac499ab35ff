use serde::{Deserialize, Serialize};

use crate::qube::MAX_STEPS;

/// The extent of a session: numbers of candidates and rollouts.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Extent {
    /// Number of initial points of the search.
    pub initial_candidates: u32,
    /// Number of points that the search proposes after the initial ones.
    pub iterations: u32,
    /// Number of rollouts of each candidate.
    pub rollouts: u32,
    /// Number of rollouts that verify the recommendation.
    pub verification_rollouts: u32,
    /// True if the best candidate's existing policy is verified too, by `verification_rollouts`.
    #[serde(default)]
    pub verifies_incumbent: bool,
    /// Largest number of steps of a rollout under a candidate's policy, 10 ms each; the thesis uses
    /// 600, and a search around an identified Qube needs as many. A shorter rollout succeeds from
    /// the same return ([`SUCCESS_RETURN`](crate::scoring::criterion::SUCCESS_RETURN)), at most 1 a
    /// step.
    pub steps: u32,
    /// Number of times that one rollout is repeated because it was void. If it is void once more,
    /// the session stops or, if other rigs share it, goes on without the rig.
    pub repetitions: u32,
    /// True if a policy that was trained on the nominal Qube makes one rollout at the end, for
    /// comparison.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub baseline: bool,
    /// Number of candidates whose returns may still be unknown when the search proposes the next
    /// one. The next candidate is then trained while the earlier ones run on the Qube. With 0, the
    /// Qube and the trainings wait for each other. A search around an identified Qube acts as with
    /// 0.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub pending: u32,
}

fn is_zero(count: &u32) -> bool {
    *count == 0
}

/// Largest number of rollouts with a result that the settings of a session may ask for. The
/// ledger has room for so many.
pub(super) const MOST_ROLLOUTS: u32 = 100_000;

impl Extent {
    /// The extent of a session of some minutes.
    pub const QUICK: Self = Self {
        initial_candidates: 6,
        iterations: 4,
        rollouts: 2,
        verification_rollouts: 5,
        verifies_incumbent: true,
        steps: MAX_STEPS as u32,
        repetitions: 3,
        baseline: false,
        pending: 0,
    };

    /// The thesis's extent: 15 initial points and 10 iterations, with five rollouts for each
    /// candidate.
    pub const THESIS: Self =
        Self { initial_candidates: 15, iterations: 10, rollouts: 5, ..Self::QUICK };
}

impl Default for Extent {
    fn default() -> Self {
        Self::QUICK
    }
}
