//! Decides how the search around an identified Qube continues.

use super::settings::INITIAL_AROUND;
use super::{CandidateRank, ScoredCandidate};

/// Smallest gain in return that is worth one more candidate, as a fraction of the verified return.
pub const WORTHWHILE_GAIN: f64 = 0.01;

/// The next move of the search around an identified Qube.
#[derive(Clone, Debug, PartialEq)]
pub enum Decision {
    /// Evaluate one more candidate.
    Propose,
    /// Verify the policy of this candidate.
    Verify {
        /// Number of the candidate.
        candidate: u32,
    },
    /// End the search if the verified policy is quiet and the estimated gain of one more candidate
    /// is less than `smallest_gain`; otherwise evaluate one more candidate.
    EndBelow {
        /// Number of the candidate that verified the policy.
        verification: u32,
        /// Smallest gain in return that is worth a candidate.
        smallest_gain: f64,
    },
    /// End the search: the largest number of candidates is reached, and the best one is verified.
    End,
}

/// The reason for which a search around an identified Qube ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SearchEnd {
    /// A policy succeeded quietly in all its verifying rollouts, and one more candidate was not
    /// worthwhile ([`WORTHWHILE_GAIN`]).
    Verified,
    /// The largest number of candidates, this one, was reached.
    Candidates(u32),
}

impl SearchEnd {
    /// The reason for which the search over these candidates ended; `largest` is the largest number
    /// of searched candidates.
    #[must_use]
    pub fn of(candidates: &[ScoredCandidate], largest: u32) -> Self {
        if is_full(candidates, largest) { Self::Candidates(largest) } else { Self::Verified }
    }
}

impl std::fmt::Display for SearchEnd {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Verified => write!(
                formatter,
                "a policy succeeded quietly in all its verifying rollouts, and one more candidate is estimated to \
                 gain less than {} %",
                100.0 * WORTHWHILE_GAIN
            ),
            Self::Candidates(1) => formatter.write_str("its only candidate has run"),
            Self::Candidates(largest) => {
                write!(formatter, "the largest number of candidates, {largest}, is reached")
            }
        }
    }
}

/// The source of the gain in return that is expected from one more candidate of a search around an
/// identified Qube.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum GainSource {
    /// The surrogate of the return over psi: its largest expected improvement.
    Surrogate {
        /// Number of candidates to whose returns the surrogate is fitted.
        candidates: usize,
    },
    /// Simulations of the identified Qube, before there are enough candidates for a surrogate: the
    /// largest simulated return of a policy minus the verified return, a difference of means.
    Simulations,
}

impl GainSource {
    /// The source of the estimated gain after these candidates.
    #[must_use]
    pub fn of(candidates: &[ScoredCandidate]) -> Self {
        let searched = candidates.iter().filter(|it| it.candidate.purpose.is_searched());
        match searched.filter(|it| it.informs_search()).count() {
            candidates if candidates >= INITIAL_AROUND as usize => Self::Surrogate { candidates },
            _ => Self::Simulations,
        }
    }

    /// Describes a gain in return from this source; a sentence without capital letter and full
    /// stop.
    #[must_use]
    pub fn words(self, gain: f64) -> String {
        // Smaller gains would read as 0.0.
        let is_none = gain < 0.05;
        match self {
            Self::Surrogate { candidates } if is_none => format!(
                "by the surrogate, which is fitted to {candidates} candidates, one more candidate is expected to gain \
                 nothing over the best so far"
            ),
            Self::Surrogate { candidates } => format!(
                "by the surrogate, which is fitted to {candidates} candidates, one more candidate is expected to gain \
                 {gain:.1} over the best so far"
            ),
            Self::Simulations if is_none => {
                "in simulations of the identified Qube, no policy earns more than the \
                 verified one on the Qube"
                    .into()
            }
            Self::Simulations => format!(
                "in simulations of the identified Qube, the best policy earns {gain:.1} more than the verified one on \
                 the Qube"
            ),
        }
    }
}

/// Returns whether the search has its largest number of candidates.
fn is_full(candidates: &[ScoredCandidate], largest: u32) -> bool {
    let searched = candidates.iter().filter(|it| it.candidate.purpose.is_searched());
    searched.count() as u32 >= largest
}

/// Decides the next move; all rollouts of `candidates` must be finished. `largest` is the largest
/// number of searched candidates.
///
/// The candidate of the highest [`rank`](ScoredCandidate::rank), in a tie the latest, is verified
/// at once if all its rollouts succeeded. A candidate whose verification failed, or was loud,
/// counts as loud. If every rollout of the verification succeeded too, the search continues only
/// while the policy is loud ([`Quietness::is_loud`](crate::scoring::Quietness::is_loud)), or the
/// estimated gain of one more candidate is at least the fraction [`WORTHWHILE_GAIN`] of the
/// verified return. If a verifying rollout failed, the search continues in any case.
///
/// At the largest number of candidates the best candidate is verified even if its rollouts failed.
/// Once it is verified, the search ends.
#[must_use]
pub fn decide(candidates: &[ScoredCandidate], largest: u32) -> Decision {
    let searched = || candidates.iter().filter(|it| it.candidate.purpose.is_searched());
    let is_full = is_full(candidates, largest);
    let verification_of = |searched: &ScoredCandidate| {
        candidates.iter().find(|it| it.candidate.runs_policy_of(&searched.candidate))
    };
    let mut best: Option<(&ScoredCandidate, CandidateRank)> = None;
    for it in searched() {
        let Some(mut rank) = it.rank() else { continue };
        let verified = verification_of(it).and_then(ScoredCandidate::rank);
        rank.succeeds_quietly &= verified.is_none_or(|verified| verified.succeeds_quietly);
        if best.is_none_or(|(_, so_far)| rank >= so_far) {
            best = Some((it, rank));
        }
    }
    let Some((best, _)) = best else { return Decision::Propose };
    let verification = verification_of(best);
    let succeeds = |it: &ScoredCandidate| it.successes() == it.verdicts.len();
    match verification {
        None if is_full || succeeds(best) => Decision::Verify { candidate: best.candidate.number },
        None => Decision::Propose,
        Some(_) if is_full => Decision::End,
        Some(verified) if succeeds(verified) => {
            let verification = verified.candidate.number;
            let smallest_gain = WORTHWHILE_GAIN * verified.mean_return().unwrap_or(0.0);
            Decision::EndBelow { verification, smallest_gain }
        }
        Some(_) => Decision::Propose,
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use super::*;
    use crate::qube::{PlantModel, State};
    use crate::recording::samples;
    use crate::scoring::{Quietness, Verdict};
    use crate::session::{Candidate, Purpose, ScoredRollout};
    use crate::telemetry::{Ending, Phase, RolloutOutcome, TickRecord};

    fn scored(
        number: u32,
        purpose: Purpose,
        place: f64,
        returns: &[(f64, bool)],
    ) -> ScoredCandidate {
        let candidate = Candidate {
            number,
            purpose,
            point: vec![place],
            trained: true,
            policy_checksum: None,
            finished: Vec::new(),
            void: 0,
            void_before: 0,
            policy_of: None,
            identified_from: None,
        };
        let verdict = |&(return_, success): &(f64, bool)| Verdict::Result {
            return_,
            success,
            outcome: RolloutOutcome { ending: Ending::Completed, ..samples::outcome() },
        };
        let rollout = |it| ScoredRollout {
            verdict: verdict(it),
            quietness: Quietness::NONE,
            model_without_psi: None,
        };
        ScoredCandidate::new(candidate, returns.iter().map(rollout))
    }

    const GOOD: (f64, bool) = (540.0, true);
    const BAD: (f64, bool) = (120.0, false);

    #[test]
    fn the_gain_after_a_failed_verification_is_described_with_its_size() {
        let mut candidates: Vec<ScoredCandidate> =
            (0..2).map(|number| scored(number, Purpose::Initial, 0.1, &[BAD])).collect();
        candidates.push(scored(2, Purpose::Incumbent, 0.1, &[BAD]));
        let source = GainSource::of(&candidates);
        assert_eq!(source, GainSource::Simulations);
        assert!(source.words(31.26).contains("the best policy earns 31.3 more than the verified"));
        assert!(source.words(0.0).contains("no policy earns more"), "{}", source.words(0.0));
        candidates.push(scored(3, Purpose::Search, 0.2, &[BAD]));
        let source = GainSource::of(&candidates);
        assert_eq!(source, GainSource::Surrogate { candidates: 3 });
        assert!(source.words(3.0).contains("fitted to 3 candidates"), "{}", source.words(3.0));
        assert!(source.words(0.01).contains("to gain nothing over"), "{}", source.words(0.01));
    }

    #[test]
    fn the_best_candidate_is_verified_and_a_verified_one_ends_the_search() {
        let mut candidates = vec![scored(0, Purpose::Excitation, 0.0, &[(1.0, false)])];
        assert_eq!(decide(&candidates, 10), Decision::Propose);
        candidates.push(scored(1, Purpose::Initial, 0.0, &[BAD]));
        assert_eq!(decide(&candidates, 10), Decision::Propose);
        candidates.push(scored(2, Purpose::Search, 1.0, &[GOOD]));
        assert_eq!(decide(&candidates, 10), Decision::Verify { candidate: 2 });
        candidates.push(scored(3, Purpose::Incumbent, 1.0, &[GOOD; 5]));
        let end = Decision::EndBelow { verification: 3, smallest_gain: 5.4 };
        assert_eq!(decide(&candidates, 10), end);
        assert_eq!(decide(&candidates, 2), Decision::End);
        // A candidate that is better than the verified one is verified too.
        candidates.push(scored(4, Purpose::Search, 2.0, &[(545.0, true)]));
        assert_eq!(decide(&candidates, 10), Decision::Verify { candidate: 4 });
    }

    #[test]
    fn a_quiet_candidate_is_better_than_a_loud_one_that_earned_more() {
        let loud = |scored: ScoredCandidate| {
            let tick = |tick: u32| TickRecord {
                tick,
                phase: Phase::Running,
                state: State { alpha: PI, ..State::default() },
                voltage_mv: if tick.is_multiple_of(2) { 900 } else { -900 },
                ..TickRecord::default()
            };
            let ticks: Vec<_> = (0..100).map(tick).collect();
            ScoredCandidate { quietness: Quietness::of(&ticks, &PlantModel::QUBE), ..scored }
        };
        let mut candidates = vec![
            loud(scored(1, Purpose::Initial, 0.0, &[GOOD])),
            loud(scored(2, Purpose::Incumbent, 0.0, &[GOOD; 5])),
        ];
        // The loud candidate is the only searched one.
        let end = Decision::EndBelow { verification: 2, smallest_gain: 5.4 };
        assert_eq!(decide(&candidates, 10), end);
        candidates.push(scored(3, Purpose::Search, 1.0, &[BAD]));
        assert_eq!(decide(&candidates, 10), end);
        candidates.push(scored(4, Purpose::Search, 2.0, &[(510.0, true)]));
        assert_eq!(decide(&candidates, 10), Decision::Verify { candidate: 4 });
        assert_eq!(ScoredCandidate::best_verified(&candidates), Some(1));
        // Candidate 4 was quiet once, and buzzes or fails when it is verified: the next quiet
        // candidate is verified.
        for verification in [
            loud(scored(5, Purpose::Incumbent, 2.0, &[(505.0, true); 5])),
            scored(5, Purpose::Incumbent, 2.0, &[GOOD, BAD]),
        ] {
            let third = scored(6, Purpose::Search, 3.0, &[(500.0, true)]);
            let more = [&candidates[..], &[verification, third]].concat();
            assert_eq!(decide(&more, 10), Decision::Verify { candidate: 6 });
        }
        candidates.push(scored(5, Purpose::Incumbent, 2.0, &[(505.0, true); 5]));
        assert_eq!(ScoredCandidate::best_verified(&candidates), Some(4));
        assert_eq!(decide(&candidates, 3), Decision::End);
    }

    #[test]
    fn a_verification_counts_for_its_own_candidate_and_not_for_another_with_the_same_psi() {
        let verification = scored(2, Purpose::Incumbent, 1.0, &[GOOD; 5]);
        let of = |policy_of| {
            let candidate = Candidate { policy_of, ..verification.candidate.clone() };
            let candidates = [
                scored(1, Purpose::Initial, 1.0, &[GOOD]),
                ScoredCandidate { candidate, ..verification.clone() },
                scored(3, Purpose::Search, 1.0, &[(545.0, true)]),
            ];
            decide(&candidates, 10)
        };
        assert_eq!(of(Some(1)), Decision::Verify { candidate: 3 });
        let end = Decision::EndBelow { verification: 2, smallest_gain: 5.4 };
        assert_eq!(of(Some(3)), end);
        // A ledger of an older program names no candidate.
        assert_eq!(of(None), end);
    }

    #[test]
    fn a_policy_that_fails_its_verification_keeps_the_search_going_to_its_largest_number() {
        let candidates = vec![
            scored(1, Purpose::Initial, 0.0, &[GOOD]),
            scored(2, Purpose::Incumbent, 0.0, &[GOOD, GOOD, BAD, GOOD, GOOD]),
        ];
        assert_eq!(decide(&candidates, 2), Decision::Propose);
        assert_eq!(decide(&candidates, 1), Decision::End);
    }

    #[test]
    fn without_a_success_the_best_is_verified_at_the_largest_number() {
        let candidates = vec![
            scored(1, Purpose::Initial, 0.0, &[BAD]),
            scored(2, Purpose::Search, 1.0, &[(300.0, false)]),
        ];
        assert_eq!(decide(&candidates, 3), Decision::Propose);
        assert_eq!(decide(&candidates, 2), Decision::Verify { candidate: 2 });
    }
}
