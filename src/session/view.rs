use std::collections::BTreeMap;

use super::ledger::{self, Parsed};
use super::{
    Candidate, Entry, Finished, LedgerError, SessionError, SessionPaths, SessionState,
    finished_rollout, parse_ledger,
};
use crate::policy::Policy;
use crate::recording::Recording;
use crate::scoring::{Quietness, Verdict, mean_of, mean_return};
use crate::search::Observation;
use crate::storage::Disk;

/// Read-only access to a session's ledger and recordings, without locking the session's folder.
pub struct SessionView<'a> {
    disk: &'a dyn Disk,
    paths: SessionPaths,
    entries: Vec<Entry>,
    state: SessionState,
}

impl<'a> SessionView<'a> {
    /// Reads the ledger; a session without a ledger has no entries.
    ///
    /// # Errors
    /// The ledger cannot be read, is too long or is damaged.
    pub fn read(disk: &'a dyn Disk, paths: SessionPaths) -> Result<Self, LedgerError> {
        let path = paths.ledger();
        let bytes = ledger::read_bytes(disk, &path)?;
        let Parsed { entries, state, .. } =
            parse_ledger(&bytes).map_err(|damage| damage.in_file(&path))?;
        Ok(Self { disk, paths, entries, state })
    }

    /// The ledger's entries in order.
    #[must_use]
    pub fn entries(&self) -> &[Entry] {
        &self.entries
    }

    /// The state of the session after all entries of the ledger.
    #[must_use]
    pub fn state(&self) -> &SessionState {
        &self.state
    }

    /// Reads a candidate's recordings and scores them.
    ///
    /// # Errors
    /// The errors of [`finished_rollout`].
    pub fn scored(&self, candidate: &Candidate) -> Result<ScoredCandidate, SessionError> {
        let paths = self.paths.candidate(candidate.number);
        let scored = |finished: &Finished| {
            finished_rollout(self.disk, &paths, candidate.number, finished)
                .map(|(recording, verdict)| ScoredRollout::of(&recording, verdict))
        };
        let rollouts = candidate.finished.iter().map(scored).collect::<Result<Vec<_>, _>>()?;
        Ok(ScoredCandidate::new(candidate.clone(), rollouts))
    }
}

/// The verdict on a rollout, the quietness of its balancing, and the kind of its policy.
#[derive(Clone, Debug, PartialEq)]
pub struct ScoredRollout {
    /// Verdict on the rollout.
    pub verdict: Verdict,
    /// Quietness of its balancing.
    pub quietness: Quietness,
    /// Name of the model that its policy was trained in without psi, such as `robust`; `None` if
    /// the policy was trained for a psi or is no network.
    pub model_without_psi: Option<String>,
}

impl ScoredRollout {
    /// Describes a recorded rollout on which the verdict is known.
    #[must_use]
    pub fn of(recording: &Recording, verdict: Verdict) -> Self {
        let quietness = Quietness::of(&recording.ticks, &recording.header.settings.plant);
        let model_without_psi = match Policy::from_bytes(&recording.policy) {
            Ok(Policy::Network(it)) if it.training.psi.is_none() => Some(it.training.model),
            _ => None,
        };
        Self { verdict, quietness, model_without_psi }
    }
}

/// A candidate with the verdicts on its finished rollouts.
#[derive(Clone, Debug, PartialEq)]
pub struct ScoredCandidate {
    /// Candidate as the ledger describes it.
    pub candidate: Candidate,
    /// Verdict on each finished rollout, in the order of [`Candidate::finished`].
    pub verdicts: Vec<Verdict>,
    /// Quietness of the balancing in these rollouts.
    pub quietness: Quietness,
    /// Name of the model that the policy of these rollouts was trained in without psi, also if the
    /// candidate has a point: a policy for an unidentified Qube competes if an identification is
    /// doubted. `None` if the policy was trained for a psi or is no network.
    pub model_without_psi: Option<String>,
}

/// The results of a candidate's rollouts on one of several rigs.
#[derive(Clone, Debug, PartialEq)]
pub struct RigResults {
    /// Number of the rig, from 1.
    pub rig: u32,
    /// Returns of the candidate's rollouts on this rig.
    pub returns: Vec<f64>,
    /// Number of successful rollouts on this rig.
    pub successes: usize,
}

impl RigResults {
    /// Mean return; `None` without a rollout.
    #[must_use]
    pub fn mean_return(&self) -> Option<f64> {
        mean_of(&self.returns)
    }
}

/// The rank of a candidate among others; the greater one is better. A candidate that succeeds
/// quietly is better than any that does not; among equals, the mean return decides.
#[derive(Clone, Copy, Debug, PartialEq, PartialOrd)]
pub struct CandidateRank {
    /// True if all its rollouts succeeded and balanced quietly (not [`Quietness::is_loud`]).
    pub succeeds_quietly: bool,
    /// Mean return of its rollouts.
    pub mean_return: f64,
}

impl ScoredCandidate {
    /// A candidate with its finished rollouts, in the order of [`Candidate::finished`].
    #[must_use]
    pub fn new(candidate: Candidate, rollouts: impl IntoIterator<Item = ScoredRollout>) -> Self {
        let (mut verdicts, mut quietness) = (Vec::new(), Quietness::NONE);
        let mut model_without_psi = None;
        for rollout in rollouts {
            verdicts.push(rollout.verdict);
            quietness.merge(&rollout.quietness);
            model_without_psi = model_without_psi.or(rollout.model_without_psi);
        }
        Self { candidate, verdicts, quietness, model_without_psi }
    }

    /// Returns of the rollouts.
    #[must_use]
    pub fn returns(&self) -> Vec<f64> {
        self.verdicts.iter().filter_map(Verdict::return_).collect()
    }

    /// Mean return; `None` without a rollout.
    #[must_use]
    pub fn mean_return(&self) -> Option<f64> {
        mean_return(&self.verdicts)
    }

    /// Number of successful rollouts.
    #[must_use]
    pub fn successes(&self) -> usize {
        self.verdicts.iter().filter(|verdict| verdict.is_success()).count()
    }

    /// The rank of the candidate among others; `None` without a rollout.
    #[must_use]
    pub fn rank(&self) -> Option<CandidateRank> {
        let all_succeeded = self.successes() == self.verdicts.len();
        let succeeds_quietly = all_succeeded && !self.quietness.is_loud();
        self.mean_return().map(|mean_return| CandidateRank { succeeds_quietly, mean_return })
    }

    /// The results on each rig, in the order of the rigs' numbers; empty if the session has a
    /// single rig.
    #[must_use]
    pub fn by_rig(&self) -> Vec<RigResults> {
        let mut results: BTreeMap<u32, RigResults> = BTreeMap::new();
        // Verdicts belong to rollouts by their order: if one is missing, the others cannot be
        // assigned to rigs.
        let is_whole = self.verdicts.len() == self.candidate.finished.len();
        let made = self.candidate.finished.iter().zip(&self.verdicts).filter(|_| is_whole);
        for (finished, verdict) in made {
            let Some(rig) = finished.rig else { continue };
            let of_rig = results.entry(rig).or_insert_with(|| RigResults {
                rig,
                returns: Vec::new(),
                successes: 0,
            });
            of_rig.returns.extend(verdict.return_());
            of_rig.successes += usize::from(verdict.is_success());
        }
        results.into_values().collect()
    }

    /// Returns whether the search learns from the returns: there is at least one verdict, and the
    /// policy was trained at the candidate's point.
    #[must_use]
    pub fn informs_search(&self) -> bool {
        !self.verdicts.is_empty() && self.model_without_psi.is_none()
    }

    /// The candidate's point with its returns: the data of the search, if the candidate
    /// [informs it](Self::informs_search).
    #[must_use]
    pub fn observation(&self) -> Observation {
        Observation { point: self.candidate.point.clone(), returns: self.returns() }
    }

    /// The index of the verified candidate of the highest [`Self::rank`]; in a tie, the index of
    /// the candidate that was proposed first.
    #[must_use]
    pub fn best_verified(candidates: &[Self]) -> Option<usize> {
        let mut best: Option<(usize, CandidateRank)> = None;
        for (index, it) in candidates.iter().enumerate() {
            let verified = it.candidate.purpose.verifies();
            let Some(rank) = it.rank().filter(|_| verified) else { continue };
            if best.is_none_or(|(_, so_far)| rank > so_far) {
                best = Some((index, rank));
            }
        }
        best.map(|(index, _)| index)
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::policy::{NetworkPolicy, TrainingRecord};
    use crate::recording::samples;
    use crate::scoring::VoidReason;
    use crate::session::Purpose;

    #[test]
    fn a_policy_without_psi_does_not_inform_the_search() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("policies/robust.safetensors");
        let Ok(Policy::Network(robust)) = Policy::load(&path) else {
            panic!("the file holds no network")
        };
        assert_eq!(robust.training.psi, None);
        let psi = Some(BTreeMap::from([("filter".to_owned(), 50.0)]));
        let training = TrainingRecord { psi, ..robust.training.clone() };
        let at_psi = NetworkPolicy { training, ..robust.clone() };
        let candidate = Candidate {
            number: 0,
            purpose: Purpose::Initial,
            point: vec![50.0],
            trained: true,
            policy_checksum: None,
            finished: Vec::new(),
            void: 0,
            void_before: 0,
            policy_of: None,
            identified_from: None,
        };
        let informs = |policy: NetworkPolicy| {
            let policy = Policy::Network(policy).to_bytes();
            let recording = crate::recording::parse(&samples::recorded(&[])).unwrap();
            let recording = Recording { policy, ..recording };
            let verdict = Verdict::Void { reason: VoidReason::LostTicks };
            let rollout = ScoredRollout::of(&recording, verdict);
            ScoredCandidate::new(candidate.clone(), [rollout]).informs_search()
        };
        assert!(informs(at_psi) && !informs(robust));
        assert!(!ScoredCandidate::new(candidate.clone(), []).informs_search());
    }
}
