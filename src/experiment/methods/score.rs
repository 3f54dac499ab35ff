use super::RecommendationScore;
use super::run::{Access, OnDisk, trained_and_run};
use crate::experiment::series::PolicySeries;
use crate::experiment::{ExperimentError, Made, Plant, RolloutResult};
use crate::scoring::{Behaviour, criterion};

impl RecommendationScore {
    /// Returns whether the recommendation succeeds over `rollouts` rollouts; `None` while the
    /// remaining rollouts can change the decision.
    fn decided(self, rollouts: u32) -> Option<bool> {
        let needed = criterion::needed_of(rollouts);
        let failed = self.ran - self.balanced;
        if self.balanced >= needed {
            Some(true)
        } else if failed > rollouts - needed {
            Some(false)
        } else {
            None
        }
    }

    fn add(&mut self, results: &[RolloutResult]) {
        let balanced = results.iter().filter(|it| it.behaviour == Behaviour::Balanced).count();
        self.balanced += balanced as u32;
        self.ran += results.len() as u32;
    }
}

/// The score of a recommendation, and whether it succeeds.
pub(super) struct ScoredDecision {
    /// Score at the time of the decision.
    pub score: RecommendationScore,
    /// True if the recommendation succeeds.
    pub succeeds: bool,
    /// Time of the last training or rollout for the score.
    pub made: Made,
}

/// Scores a recommendation by up to `policies` policies with `rollouts` rollouts each, and stops
/// after the policy that settles the decision.
///
/// # Errors
/// The work ends early, or a file cannot be read.
pub(super) fn score(
    series: &PolicySeries,
    plant: &Plant,
    policies: u32,
    rollouts: u32,
    access: Access,
) -> Result<OnDisk<ScoredDecision>, ExperimentError> {
    let (mut score, mut made) = (RecommendationScore::default(), Made::Earlier);
    for policy in 0..policies {
        let ran = match trained_and_run(series, policy, plant, rollouts, access)? {
            OnDisk::Found(ran) => ran,
            OnDisk::Missing => return Ok(OnDisk::Missing),
        };
        made = made.max(ran.made);
        score.add(&ran.results);
        if let Some(succeeds) = score.decided(policies * rollouts) {
            return Ok(OnDisk::Found(ScoredDecision { score, succeeds, made }));
        }
    }
    Ok(OnDisk::Missing)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn decided(balanced: u32, ran: u32, rollouts: u32) -> Option<bool> {
        RecommendationScore { balanced, ran }.decided(rollouts)
    }

    #[test]
    fn success_needs_nine_of_ten_and_is_decided_as_early_as_possible() {
        assert_eq!(decided(9, 10, 10), Some(true));
        assert_eq!(decided(9, 9, 10), Some(true));
        assert_eq!(decided(8, 9, 10), None);
        assert_eq!(decided(8, 10, 10), Some(false));
        assert_eq!(decided(0, 2, 10), Some(false));
        // 14 of 15 are 93 %, 13 are 87 %.
        assert_eq!(decided(14, 15, 15), Some(true));
        assert_eq!(decided(12, 14, 15), Some(false));
        assert_eq!(decided(0, 0, 1), None);
    }

    #[test]
    fn the_decision_is_made_once_all_rollouts_have_run() {
        for rollouts in 1..60 {
            for balanced in 0..=rollouts {
                let succeeds = f64::from(balanced) / f64::from(rollouts) > 0.9 - 1e-9;
                assert_eq!(
                    decided(balanced, rollouts, rollouts),
                    Some(succeeds),
                    "{balanced}/{rollouts}"
                );
            }
        }
    }
}
