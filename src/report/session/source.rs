use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};

use thiserror::Error;

use super::time_line::TimeLine;
use crate::identification::check_recording;
use crate::learning::{CURVE_BYTES, CurveError, CurvePoint, parse_curve_csv};
use crate::qube::{PlantModel, Profile};
use crate::recording::{Recording, read_on};
use crate::replay::{MotionLog, SimulatedSpecimen};
use crate::report::ReportError;
use crate::report::rollout::RolloutView;
use crate::scoring::{Latencies, Verdict, score_recording};
use crate::session::{
    AttemptId, BestPolicy, Candidate, Entry, FolderError, PolicyPaths, Purpose, ScoredCandidate,
    ScoredRollout, SessionPaths, SessionSettings, SessionState, SessionView, Step, TrainingTime,
    finished_rollout, identified_profile, next_step,
};
use crate::storage::{Disk, SETTINGS_BYTES, checksum_of};

/// Largest number of recordings of each kind that are compared with predictions by the identified
/// Qube.
pub(super) const COMPARED: usize = 3;

/// The content of a session's folder; reading writes nothing there.
#[derive(Debug)]
pub struct SessionSource {
    /// Settings in the folder: the session's first settings, unless the file was changed.
    pub(super) settings: SessionSettings,
    /// True if the settings in the folder differ from the session's first settings.
    pub(super) settings_changed: bool,
    /// Reason why the file of the best verified policy cannot be run; `None` if there is no
    /// verified policy, or if it can be run.
    pub(super) policy_lost: Option<String>,
    /// State that follows from the ledger's entries.
    pub(super) state: SessionState,
    /// Profiles that the session identified and that could be read, each with its number of
    /// recordings, in order.
    pub(super) profiles: Vec<(u32, Profile)>,
    /// Candidates with their verdicts.
    pub(super) candidates: Vec<ScoredCandidate>,
    /// Rollouts with a result, in order, each with its candidate.
    pub(super) rollouts: Vec<(u32, RolloutView)>,
    /// Void attempts.
    pub(super) void: Vec<VoidAttempt>,
    /// Learning curves by candidate.
    pub(super) curves: Vec<(u32, Vec<CurvePoint>)>,
    /// Rollouts and trainings by the wall clock.
    pub(super) time_line: TimeLine,
    /// Timing of the ticks of finished rollouts.
    pub(super) latencies: Latencies,
    /// Number of observer resets in finished rollouts.
    pub(super) observer_resets: u64,
    /// Motions that are compared with predictions by the identified Qube.
    pub(super) motions: Vec<ComparedMotion>,
    /// Number of rollouts of policies, without excitations, that have a motion, by whether the last
    /// profile before the end of the search was fitted to the motion.
    pub(super) comparable: BTreeMap<bool, usize>,
    /// Number of motions added so far that inform the method and can be fitted.
    fittable: usize,
    /// Sentences about files that could not be read.
    pub(super) problems: Vec<String>,
}

/// An attempt at a rollout that the ledger counts as void.
#[derive(Debug)]
pub(super) struct VoidAttempt {
    /// Numbers of its candidate, of the rollout and of the attempt.
    pub(super) attempt: AttemptId,
    /// Reason why the attempt is void, or why this reason is unknown.
    pub(super) reason: String,
}

/// A motion that is compared with predictions by the identified Qube.
#[derive(Debug)]
pub(super) struct ComparedMotion {
    /// Name of the rollout.
    pub(super) name: String,
    /// True if the last profile before the end of the search was fitted to the motion.
    pub(super) fitted: bool,
    /// True if an excitation drove the motion.
    pub(super) excitation: bool,
    /// The motion.
    pub(super) log: MotionLog,
}

impl SessionSource {
    /// Reads a session's folder. Recordings of finished rollouts, profiles, curves and times of
    /// trainings that cannot be read are left out, and the report names them.
    ///
    /// # Errors
    /// The folder is not a session; its settings or its ledger cannot be read; or the ledger has no
    /// candidate, although candidates have folders.
    pub fn read(disk: &dyn Disk, folder: &Path) -> Result<Self, ReportError> {
        let paths = SessionPaths::new(folder);
        if !disk.exists(&paths.configuration()) {
            return Err(FolderError::NotASession { path: folder.to_owned() }.into());
        }
        let settings = SessionSettings::load(&paths.configuration())?;
        let view = SessionView::read(disk, paths.clone())?;
        if view.state().candidates().is_empty() && disk.exists(paths.candidate(0).folder()) {
            return Err(ReportError::LedgerLost { path: paths.ledger() });
        }
        let bytes = disk.read(&paths.configuration(), SETTINGS_BYTES);
        let settings_changed = bytes.is_ok_and(|bytes| changed(&bytes, view.entries()));
        let mut source = Self {
            settings,
            settings_changed,
            policy_lost: None,
            state: view.state().clone(),
            profiles: Vec::new(),
            candidates: Vec::new(),
            rollouts: Vec::new(),
            void: Vec::new(),
            curves: Vec::new(),
            time_line: TimeLine::default(),
            latencies: Latencies::default(),
            observer_resets: 0,
            motions: Vec::new(),
            comparable: BTreeMap::new(),
            fittable: 0,
            problems: Vec::new(),
        };
        for found in source.state.identification().profiles() {
            match identified_profile(disk, &paths, found) {
                Ok(profile) => source.profiles.push((found.recordings, profile)),
                Err(error) => source.problems.push(error.to_string()),
            }
        }
        for candidate in source.state.candidates().to_vec() {
            source.read_candidate(disk, &paths, candidate);
        }
        source.policy_lost =
            source.best_policy(&paths).and_then(|best| Some(best.check().err()?.to_string()));
        Ok(source)
    }

    /// The best verified policy; `paths` are the session's paths.
    fn best_policy(&self, paths: &SessionPaths) -> Option<BestPolicy> {
        let candidate = ScoredCandidate::best_verified(&self.candidates)?;
        let number = self.candidates[candidate].candidate.number;
        Some(BestPolicy { candidate, policy: paths.candidate(number).policy() })
    }

    /// Returns whether the settings in the folder differ from the session's first settings. Such a
    /// session can be neither continued nor repeated.
    #[must_use]
    pub fn settings_changed(&self) -> bool {
        self.settings_changed
    }

    /// Returns whether several rigs share the session. The command line, and not the settings,
    /// names the rigs of a new session.
    #[must_use]
    pub fn is_shared(&self) -> bool {
        !self.settings.rigs.is_empty()
    }

    /// The plant of the session.
    #[must_use]
    pub fn plant(&self) -> &PlantModel {
        self.settings.plant()
    }

    /// The reason why the file of the best verified policy cannot be run; `None` if there is no
    /// verified policy, or if it can be run.
    #[must_use]
    pub fn policy_lost(&self) -> Option<&str> {
        self.policy_lost.as_deref()
    }

    /// Sentences about the files that could not be read, each with the file's path; the page has
    /// them, too.
    #[must_use]
    pub fn problems(&self) -> &[String] {
        &self.problems
    }

    fn read_candidate(&mut self, disk: &dyn Disk, paths: &SessionPaths, candidate: Candidate) {
        let of_candidate = paths.candidate(candidate.number);
        let number = candidate.number;
        if disk.exists(&of_candidate.curve()) {
            match read_curve(disk, &of_candidate.curve()) {
                Ok(curve) => self.curves.push((number, curve)),
                Err(error) => self.problems.push(error.to_string()),
            }
        }
        let times = of_candidate.training_times();
        if disk.exists(&times) {
            match TrainingTime::read_all(disk, &times) {
                Ok(times) => self.time_line.add_trainings(&times),
                Err(error) => self.problems.push(error.to_string()),
            }
        }
        let mut rollouts = Vec::new();
        for finished in &candidate.finished {
            for attempt in 0..finished.attempt {
                let attempt = AttemptId { candidate: number, rollout: finished.rollout, attempt };
                self.read_void(disk, &of_candidate, attempt);
            }
            match finished_rollout(disk, &of_candidate, number, finished) {
                Ok((recording, verdict)) => {
                    rollouts.push(ScoredRollout::of(&recording, verdict));
                    self.add(&candidate, &recording);
                }
                Err(error) => self.problems.push(error.to_string()),
            }
        }
        for attempt in 0..candidate.void {
            let rollout = candidate.finished.len() as u32;
            let attempt = AttemptId { candidate: number, rollout, attempt };
            self.read_void(disk, &of_candidate, attempt);
        }
        self.candidates.push(ScoredCandidate::new(candidate, rollouts));
    }

    fn read_void(&mut self, disk: &dyn Disk, of_candidate: &PolicyPaths, attempt: AttemptId) {
        let read = read_on(disk, &of_candidate.rollout(attempt.of_policy())).map(|recording| {
            self.time_line.add_rollout(&recording);
            score_recording(&recording)
        });
        let reason = match read {
            Ok(Verdict::Void { reason }) => reason.to_string(),
            Ok(_) => "the ledger counts it as void, but its recording does not show why".into(),
            Err(error) => error.to_string(),
        };
        self.void.push(VoidAttempt { attempt, reason });
    }

    fn add(&mut self, candidate: &Candidate, recording: &Recording) {
        self.latencies.add(&recording.ticks);
        self.time_line.add_rollout(recording);
        self.observer_resets +=
            recording.outcome.as_ref().map_or(0, |outcome| u64::from(outcome.observer_resets));
        let specimen = match self.profiles.last() {
            Some((recordings, profile)) => {
                SimulatedSpecimen::of_profile(profile, &SessionPaths::profile_name(*recordings))
            }
            None => SimulatedSpecimen::nominal(&recording.header.settings.plant),
        };
        let number = candidate.number;
        self.rollouts.push((number, RolloutView::of(recording, &specimen)));
        let Some(&(fitted_to, _)) = self.profile_before_end() else { return };
        let Some(log) = MotionLog::of_recording(recording) else { return };
        let informs = candidate.purpose.informs() && check_recording(&log).is_ok();
        let fitted = informs && self.fittable < fitted_to as usize;
        self.fittable += usize::from(informs);
        let excitation = candidate.purpose == Purpose::Excitation;
        if !excitation {
            *self.comparable.entry(fitted).or_default() += 1;
        }
        let of_kind = |it: &&ComparedMotion| (it.fitted, it.excitation) == (fitted, excitation);
        if self.motions.iter().filter(of_kind).count() < COMPARED {
            let name = format!("candidate {number}, rollout {}", recording.header.rollout);
            self.motions.push(ComparedMotion { name, fitted, excitation, log });
        }
    }

    /// The last profile that was identified before the search ended, or so far if it has not ended;
    /// the recordings of the verification did not inform this profile. `None` if there is no such
    /// profile, or if it could not be read.
    pub(super) fn profile_before_end(&self) -> Option<&(u32, Profile)> {
        self.state.profile_before_end().and_then(|recordings| self.profile_of(recordings))
    }

    /// The profile that was fitted to this many recordings; `None` if it could not be read.
    fn profile_of(&self, recordings: u32) -> Option<&(u32, Profile)> {
        self.profiles.iter().find(|(of, _)| *of == recordings)
    }

    /// The candidates with the verdicts on their rollouts.
    #[must_use]
    pub fn candidates(&self) -> &[ScoredCandidate] {
        &self.candidates
    }

    /// Returns whether all rollouts with a result were made in virtual time, so that a repetition
    /// of the session gives the same bytes; true before the first rollout.
    #[must_use]
    pub fn is_of_computed_time(&self) -> bool {
        self.rollouts.iter().all(|(_, view)| view.header.started_unix_ns.is_none())
    }

    /// Returns whether the session has no further step.
    #[must_use]
    pub fn is_finished(&self) -> bool {
        let SessionSettings { extent, identification, .. } = &self.settings;
        next_step(&self.state, extent, identification.as_ref()) == Step::Done
    }

    /// The settings of the search at the proposal of this candidate, or the latest settings if
    /// `candidate` is `None`. The search is around the latest profile at that time; if there was no
    /// profile, the settings are the session's. `None` if that profile or the first profile cannot
    /// be read.
    pub(super) fn search_settings(&self, candidate: Option<u32>) -> Option<SessionSettings> {
        let proposed = candidate.and_then(|it| self.state.candidates().get(it as usize));
        let known = proposed.map_or(self.state.latest_profile(), |it| it.identified_from);
        let profiles = self.state.identification().profiles();
        let (Some(first), Some(known)) = (profiles.first(), known) else {
            return Some(self.settings.clone());
        };
        let ((_, first), (_, latest)) =
            self.profile_of(first.recordings).zip(self.profile_of(known))?;
        let plan = self.settings.identification.unwrap_or_default();
        Some(self.settings.clone().around(&plan, first, latest))
    }

    /// Number of the candidate whose training made this candidate's policy: for a verification of
    /// the incumbent, the incumbent.
    pub(super) fn trained_as(&self, candidate: &Candidate) -> u32 {
        let mut searched = self.state.searched();
        searched.find(|it| candidate.runs_policy_of(it)).unwrap_or(candidate).number
    }

    /// Name of a candidate's purpose, as tables show it.
    pub(super) fn purpose_words(&self, candidate: &Candidate) -> String {
        match candidate.purpose {
            Purpose::Excitation => "excitation".into(),
            Purpose::Initial => "initial".into(),
            Purpose::Search => "search".into(),
            Purpose::Verification => "recommended".into(),
            Purpose::Incumbent => format!("{} again", self.trained_as(candidate)),
            Purpose::Baseline => "nominal".into(),
        }
    }
}

/// Returns whether these settings differ from the settings that the first entry of the ledger
/// names; `false` if it names none.
fn changed(settings: &[u8], entries: &[Entry]) -> bool {
    match entries.first() {
        Some(Entry::Begun { settings: began, .. }) => *began != checksum_of(settings),
        _ => false,
    }
}

/// Reads the learning curve of a training.
///
/// # Errors
/// The file cannot be read, or is no learning curve.
fn read_curve(disk: &dyn Disk, path: &Path) -> Result<Vec<CurvePoint>, CurveFileError> {
    let path = || path.to_owned();
    let bytes = disk
        .read(&path(), CURVE_BYTES)
        .map_err(|source| CurveFileError::Read { path: path(), source })?;
    parse_curve_csv(&String::from_utf8_lossy(&bytes))
        .map_err(|source| CurveFileError::Format { path: path(), source })
}

/// The reason why the file of a learning curve is left out.
#[derive(Debug, Error)]
enum CurveFileError {
    #[error("{path}: {source}")]
    Read { path: PathBuf, source: io::Error },
    #[error("{path}: {source}")]
    Format { path: PathBuf, source: CurveError },
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::session::IdentificationSettings;
    use crate::storage::MachineDisk;

    #[test]
    fn settings_changed_after_the_beginning_are_noticed() {
        let begun = [Entry::Begun { settings: checksum_of(b"seed = 1"), chained: true }];
        assert!(!changed(b"seed = 1", &begun));
        assert!(changed(b"seed = 2", &begun));
        assert!(!changed(b"seed = 2", &[]));
    }

    #[test]
    fn without_its_first_profile_the_coordinates_of_a_search_are_unknown() {
        let folder = tempfile::tempdir().unwrap();
        let plan = IdentificationSettings::default();
        let settings = SessionSettings { identification: Some(plan), ..SessionSettings::quick() };
        let path = SessionPaths::new(folder.path()).configuration();
        std::fs::write(path, settings.to_toml().unwrap()).unwrap();
        let mut source = SessionSource::read(&MachineDisk, folder.path()).unwrap();
        let identified = |recordings| Entry::Identified {
            recordings,
            verdict: "fits".into(),
            missing_effects: Vec::new(),
            checksum: String::new(),
        };
        source.state = SessionState::of(&[identified(1), identified(3)]).unwrap();
        source.profiles = vec![(1, Profile::lab()), (3, Profile::lab())];
        assert_ne!(source.search_settings(None).unwrap(), source.settings);
        source.profiles.remove(0);
        assert_eq!(source.search_settings(None), None);
        source.state = SessionState::default();
        assert_eq!(source.search_settings(None).unwrap(), source.settings);
    }
}
