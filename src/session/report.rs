use std::path::PathBuf;

use super::{
    Candidate, Identification, Purpose, ScoredCandidate, SearchEnd, Session, SessionError,
    TakenOutRig,
};
use crate::policy::{Policy, PolicyError};
use crate::qube::Profile;
use crate::recording::read_on;
use crate::scoring::Latencies;
use crate::simulation::PsiSpace;

/// The results of a session so far, read from its folder: candidates, verified policies, timing.
pub struct SessionReport {
    /// Search space of psi.
    pub psi: PsiSpace,
    /// Candidates in the order of their numbers, with the verdicts on their rollouts.
    pub candidates: Vec<ScoredCandidate>,
    /// Timing of all ticks of the finished rollouts.
    pub latencies: Latencies,
    /// Number of attempts at rollouts that are void: a fault ended them, or their recordings lack
    /// ticks.
    pub void_rollouts: u64,
    /// Number of observer resets in the finished rollouts.
    pub observer_resets: u64,
    /// Folder of the session.
    pub directory: PathBuf,
    /// State of the identification of the Qube.
    pub identification: Identification,
    /// Latest profile of the Qube, if it was identified.
    pub profile: Option<Profile>,
    /// End of the search around an identified Qube; `None` before its end and for other searches.
    pub ended: Option<EndedSearch>,
    /// Devices of the rigs that share the session, as the operator named them when the session
    /// began; empty if there is one rig.
    pub rigs: Vec<String>,
    /// Rigs that were taken out.
    pub taken_out: Vec<TakenOutRig>,
    /// Policy to use: the verified policy of the highest [`ScoredCandidate::rank`]; `None` before a
    /// verification.
    pub best: Option<BestPolicy>,
}

/// The end of a search around an identified Qube.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EndedSearch {
    /// Reason of the end.
    pub end: SearchEnd,
    /// Gain in return that one more candidate was expected to bring.
    pub expected_gain: f64,
}

/// The policy that a session recommends for use.
pub struct BestPolicy {
    /// Index of its candidate in [`SessionReport::candidates`].
    pub candidate: usize,
    /// Path of its file.
    pub policy: PathBuf,
}

impl BestPolicy {
    /// Checks that the file is a policy that can be run.
    ///
    /// # Errors
    /// The file is missing or not a policy.
    pub fn check(&self) -> Result<(), PolicyError> {
        Policy::load(&self.policy).map(drop)
    }
}

impl SessionReport {
    /// Reads the results of a session from its ledger and its recordings.
    ///
    /// # Errors
    /// A recording or the latest profile cannot be read or was changed.
    pub fn read(session: &mut Session) -> Result<Self, SessionError> {
        let candidates = session.scored_candidates()?;
        let folder = session.folder();
        let paths = folder.paths();
        let mut report = Self {
            psi: session.settings().psi.clone(),
            latencies: Latencies::default(),
            void_rollouts: session.state().candidates().iter().map(Candidate::all_void).sum(),
            observer_resets: 0,
            directory: paths.root().to_owned(),
            identification: session.state().identification().clone(),
            profile: session.latest_profile()?,
            ended: session.state().gain_at_end().map(|expected_gain| {
                let plan = session.settings().identification.unwrap_or_default();
                EndedSearch { end: SearchEnd::of(&candidates, plan.candidates), expected_gain }
            }),
            rigs: session.settings().rigs.iter().map(|rig| rig.device.clone()).collect(),
            taken_out: session.state().taken_out().to_vec(),
            best: ScoredCandidate::best_verified(&candidates).map(|candidate| BestPolicy {
                candidate,
                policy: paths.candidate(candidates[candidate].candidate.number).policy(),
            }),
            candidates: Vec::new(),
        };
        for ScoredCandidate { candidate, .. } in &candidates {
            let of_candidate = paths.candidate(candidate.number);
            for finished in &candidate.finished {
                let path = of_candidate.rollout(finished.of_policy());
                let recording = read_on(folder.disk(), &path)?;
                report.latencies.add(&recording.ticks);
                report.observer_resets +=
                    recording.outcome.map_or(0, |outcome| u64::from(outcome.observer_resets));
            }
        }
        report.candidates = candidates;
        Ok(report)
    }

    /// The number of the searched candidate whose policy the candidate `again` runs once more; if
    /// there is none, the number of `again`.
    #[must_use]
    pub fn incumbent(&self, again: &Candidate) -> u32 {
        let mut candidates = self.candidates.iter().map(|it| &it.candidate);
        candidates.find(|it| again.runs_policy_of(it)).unwrap_or(again).number
    }

    /// The candidates of the purposes for which `accepts` returns true.
    pub fn of_purpose(
        &self,
        accepts: fn(Purpose) -> bool,
    ) -> impl Iterator<Item = &ScoredCandidate> {
        self.candidates.iter().filter(move |it| accepts(it.candidate.purpose))
    }

    /// Number of real rollouts whose data the method used: excitations and rollouts of the search,
    /// without the rollouts that verify a result or serve for comparison.
    #[must_use]
    pub fn real_rollouts(&self) -> usize {
        let used = self.candidates.iter().filter(|it| it.candidate.purpose.informs());
        used.map(|it| it.verdicts.len()).sum()
    }

    /// Number of rollouts with a result.
    #[must_use]
    pub fn rollouts(&self) -> usize {
        self.candidates.iter().map(|it| it.verdicts.len()).sum()
    }
}
