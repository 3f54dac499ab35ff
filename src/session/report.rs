use std::path::PathBuf;

use super::{Candidate, Identification, Purpose, ScoredCandidate, Session, SessionError};
use crate::policy::{Policy, PolicyError};
use crate::recording::read_on;
use crate::scoring::{Latencies, Quietness};
use crate::simulation::PsiSpace;

/// The results of a session so far, read from its folder: candidates, verified policies, timing.
pub struct SessionReport {
    /// Search space of psi.
    pub psi: PsiSpace,
    /// Candidates in order, with the verdicts on their rollouts.
    pub candidates: Vec<ScoredCandidate>,
    /// Timing of all ticks.
    pub latencies: Latencies,
    /// Number of rollouts that a fault ended and that were repeated.
    pub void_rollouts: u64,
    /// Number of observer resets.
    pub observer_resets: u64,
    /// Folder of the session.
    pub directory: PathBuf,
    /// The state of the identification.
    pub identification: Identification,
    /// Return that one more candidate was expected to gain when the search around an identified Qube ended.
    pub settled: Option<f64>,
    /// Devices of the rigs that share the session, as they were named when it began; empty with one rig.
    pub rigs: Vec<String>,
    /// Rigs that were taken out, by their numbers from 1, each with the reason.
    pub taken_out: Vec<(u32, String)>,
    /// Policy to use: the verified one with the highest mean return.
    pub best: Option<BestPolicy>,
}

/// The policy that a session recommends for use.
pub struct BestPolicy {
    /// Index of its candidate.
    pub candidate: usize,
    /// Path of its file.
    pub policy: PathBuf,
    /// Quietness of its balancing.
    pub quietness: Quietness,
}

impl BestPolicy {
    /// Checks that the file can be run.
    ///
    /// # Errors
    /// The file is missing or not a policy.
    pub fn check(&self) -> Result<(), PolicyError> {
        Policy::load(&self.policy).map(drop)
    }
}

impl SessionReport {
    /// Reads ledger and recordings.
    ///
    /// # Errors
    /// A recording cannot be read.
    pub fn read(session: &mut Session) -> Result<Self, SessionError> {
        let candidates = session.scored_candidates()?;
        let folder = session.folder();
        let paths = folder.paths();
        let mut report = Self {
            psi: session.settings().psi.clone(),
            latencies: Latencies::default(),
            void_rollouts: 0,
            observer_resets: 0,
            directory: paths.root().to_owned(),
            identification: session.state().identification().clone(),
            settled: session.state().settled(),
            rigs: session.settings().rigs.iter().map(|rig| rig.device.clone()).collect(),
            taken_out: session.state().taken_out().to_vec(),
            best: ScoredCandidate::best_verified(&candidates).map(|candidate| BestPolicy {
                candidate,
                policy: paths.candidate(candidate as u32).policy(),
                quietness: Quietness::NONE,
            }),
            candidates: Vec::new(),
        };
        for (index, ScoredCandidate { candidate, .. }) in candidates.iter().enumerate() {
            let of_candidate = paths.candidate(candidate.number);
            for finished in &candidate.finished {
                let path = of_candidate.rollout(finished.rollout, finished.attempt);
                let recording = read_on(folder.disk(), &path)?;
                report.latencies.add(&recording.ticks);
                if let Some(best) = report.best.as_mut().filter(|best| best.candidate == index) {
                    best.quietness.add(&recording.ticks, &recording.header.settings.plant);
                }
                report.void_rollouts += u64::from(finished.attempt);
                report.observer_resets +=
                    recording.outcome.map_or(0, |outcome| u64::from(outcome.observer_resets));
            }
        }
        report.candidates = candidates;
        Ok(report)
    }

    /// The searched candidate whose policy this one runs again; they share their psi.
    #[must_use]
    pub fn incumbent(&self, again: &Candidate) -> u32 {
        let is_same = |it: &&Candidate| it.purpose.is_searched() && it.psi == again.psi;
        let mut candidates = self.candidates.iter().map(|it| &it.candidate);
        candidates.find(is_same).unwrap_or(again).number
    }

    /// The candidates of these purposes.
    pub fn of_purpose(&self, is: fn(Purpose) -> bool) -> impl Iterator<Item = &ScoredCandidate> {
        self.candidates.iter().filter(move |it| is(it.candidate.purpose))
    }

    /// Number of real rollouts whose data the method used: excitations and the search's rollouts, without those that
    /// verify or compare.
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
