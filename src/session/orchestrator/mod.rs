//! Performs the method's steps in their order: proposals, identification, trainings, rollouts.

mod identification;
mod policies;
mod proposals;
mod training;
mod training_ahead;

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use training_ahead::TrainingAhead;

use super::folder::put_aside;
use super::seeds::{SeedFor, derived_seed};
use super::{
    Candidate, DRIFT_ROLLOUTS, Drift, Entry, FolderError, Ledger, Purpose, RolloutPlan,
    ScoredCandidate, SessionError, SessionEvent, SessionFolder, SessionSettings, SessionState,
    Step, file_checksum, next_step,
};
use crate::jobs::{Executor, LocalExecutor};
use crate::policy::EXCITATION_STEPS;
use crate::qube::QubeModel;
use crate::recording::{Recording, RecordingError, read_on};
use crate::rig::{ClockChoice, Doubt, MAX_NOT_BEGUN, Rig, RigError, RigSettings};
use crate::scoring::{Verdict, score, score_recording};
use crate::storage::SETTINGS_BYTES;
use crate::telemetry::Ending;

/// A session in its folder: the algorithm of the method's section 1, one step at a time.
pub struct Session {
    folder: SessionFolder,
    ledger: Ledger,
    /// Settings of the search: as the session began, or around the Qube that it has identified.
    settings: SessionSettings,
    rig_settings: RigSettings,
    rig: Option<Rig>,
    verdicts: HashMap<(u32, u32, u32), Verdict>,
    stop: Arc<AtomicBool>,
    executor: Arc<dyn Executor>,
    /// Trainings beside the rollouts, where the search proposes while it awaits returns.
    ahead: Option<TrainingAhead>,
    /// Model in the rig's profile, until today's drift is known.
    profile: Option<QubeModel>,
    /// Today's recordings, until there are enough for the drift.
    today: Vec<Recording>,
    /// Number of consecutive rollouts that could not begin.
    not_begun: u32,
}

impl Session {
    /// Continues a session where its ledger ends; an empty ledger starts a new one, and is bound to the
    /// folder's `session.toml`.
    ///
    /// # Errors
    /// The ledger is damaged or cannot be opened; it belongs to another `session.toml`.
    pub fn open(
        folder: SessionFolder,
        settings: SessionSettings,
        rig_settings: RigSettings,
        stop: Arc<AtomicBool>,
    ) -> Result<Self, SessionError> {
        let mut ledger = Ledger::open(folder.disk(), &folder.paths().ledger())?;
        bind(&mut ledger, &folder)?;
        // An emulated Qube in virtual time is not late, whatever else the computer does.
        let in_real_time = rig_settings.clock == ClockChoice::Wall;
        let executor = if settings.extent.pending > 0 && in_real_time {
            LocalExecutor::beside_control_thread()
        } else {
            LocalExecutor::on_all_cores()
        };
        let mut session = Self {
            folder,
            ledger,
            settings,
            rig_settings,
            rig: None,
            verdicts: HashMap::new(),
            stop,
            executor: Arc::new(executor),
            ahead: None,
            profile: None,
            today: Vec::new(),
            not_begun: 0,
        };
        session.guard_as_unknown();
        session.search_around_identified()?;
        for candidate in session.ledger.state().candidates().iter().filter(|it| has_psi(it)) {
            session.settings.psi.psi(&candidate.psi)?;
        }
        Ok(session)
    }

    /// Compares the rig with its profile after the first rollouts and reports the drift.
    #[must_use]
    pub fn beside(mut self, profile: Option<QubeModel>) -> Self {
        self.profile = profile;
        self
    }

    /// Trains on an executor other than this computer's cores; the policies do not depend on it.
    #[must_use]
    pub fn trained_by(mut self, executor: Arc<dyn Executor>) -> Self {
        self.executor = executor;
        self
    }

    /// Refuses another board than that of this session's first recording, where a real Qube is driven.
    ///
    /// # Errors
    /// The recording cannot be read.
    pub fn on_the_same_board(mut self) -> Result<Self, SessionError> {
        if self.rig_settings.is_hardware() && self.rig_settings.board.is_none() {
            self.rig_settings.board = self.board()?;
        }
        Ok(self)
    }

    /// Serial number of the board that made the first finished recording; `None` before it.
    ///
    /// # Errors
    /// The recording cannot be read.
    pub fn board(&self) -> Result<Option<String>, SessionError> {
        let first = self.ledger.state().candidates().iter().find_map(|it| {
            let finished = it.finished.first()?;
            Some(self.recording(it.number, finished.rollout, finished.attempt))
        });
        let Some(first) = first else { return Ok(None) };
        let recording = read_on(self.folder.disk(), &first)?;
        Ok(recording.header.device.get("serial").cloned())
    }

    /// Runs until the best policy is verified, a fault ends the session, or the operator stops it.
    ///
    /// # Errors
    /// The session ends early; finished work is on disk.
    pub fn run(&mut self, tell: &mut dyn FnMut(SessionEvent)) -> Result<(), SessionError> {
        self.run_while(|_| true, tell)
    }

    /// Runs until this many candidates of the search have all their rollouts; the session can be resumed
    /// afterwards.
    ///
    /// # Errors
    /// [`run`](Self::run) would fail.
    pub fn run_to(
        &mut self,
        evaluated: u32,
        tell: &mut dyn FnMut(SessionEvent),
    ) -> Result<(), SessionError> {
        let rollouts = self.settings.extent.rollouts as usize;
        let is_evaluated = |it: &&Candidate| it.finished.len() == rollouts;
        let count = |state: &SessionState| state.searched().filter(is_evaluated).count();
        self.run_while(|state| count(state) < evaluated as usize, tell)
    }

    fn run_while(
        &mut self,
        goes_on: impl Fn(&SessionState) -> bool,
        tell: &mut dyn FnMut(SessionEvent),
    ) -> Result<(), SessionError> {
        let ended = self.perform_while(goes_on, tell);
        if ended.is_err() {
            // Its trainings end, and begin again when the session goes on.
            self.ahead = None;
        }
        ended
    }

    fn perform_while(
        &mut self,
        goes_on: impl Fn(&SessionState) -> bool,
        tell: &mut dyn FnMut(SessionEvent),
    ) -> Result<(), SessionError> {
        self.heed_doubt()?;
        self.connect_early(tell)?;
        while goes_on(self.ledger.state()) {
            if self.stop.load(Ordering::Relaxed) {
                return Err(SessionError::Stopped);
            }
            self.train_ahead(tell)?;
            match self.next_step() {
                Step::Propose { count, purpose } => self.propose(count, purpose, tell)?,
                Step::Identify => self.identify(tell)?,
                Step::Decide => self.decide(tell)?,
                Step::Train { candidates } => self.train(&candidates, tell)?,
                Step::Rollout { candidate, rollout, attempt } => {
                    self.rollout(candidate, rollout, attempt, tell)?;
                }
                Step::GiveUp { candidate, rollout } => {
                    return Err(self.given_up(candidate, rollout));
                }
                Step::Done => break,
            }
        }
        Ok(())
    }

    fn next_step(&self) -> Step {
        let SessionSettings { extent, identification, .. } = &self.settings;
        next_step(self.ledger.state(), extent, identification.as_ref())
    }

    /// Acknowledges the session's doubt for the operator: the Qube is examined when it is next opened.
    pub fn acknowledge(&mut self) {
        self.rig = None;
        self.rig_settings.recovery.acknowledged = true;
    }

    /// Passes a doubt at the end of the ledger to the rig, so that nothing moves without the operator's
    /// acknowledgement, also on another computer.
    fn heed_doubt(&mut self) -> Result<(), SessionError> {
        let Some(&Entry::RolloutVoid { candidate, rollout, attempt }) =
            self.ledger.entries().last()
        else {
            return Ok(());
        };
        let path = self.recording(candidate, rollout, attempt);
        // A missing recording leaves no doubt that could be named; the port's memory holds its own.
        let Some(recording) = read_on(self.folder.disk(), &path).ok() else { return Ok(()) };
        let Some(doubt) = doubt_of(&recording) else { return Ok(()) };
        if !self.rig_settings.recovery.acknowledged {
            return Err(SessionError::InDoubt { candidate, rollout, doubt: Box::new(doubt) });
        }
        self.rig_settings.recovery.doubt = Some(doubt);
        Ok(())
    }

    /// Connects, checks and homes a real Qube before any training, so that its defects do not show after
    /// hours.
    fn connect_early(&mut self, tell: &mut dyn FnMut(SessionEvent)) -> Result<(), SessionError> {
        let is_over = self.next_step() == Step::Done;
        if !is_over && self.rig_settings.is_hardware() {
            let first = SeedFor::Emulator { candidate: 0, rollout: 0, attempt: 0 };
            self.ready_rig(first, tell)?;
        }
        Ok(())
    }

    /// The session's folder.
    #[must_use]
    pub fn folder(&self) -> &SessionFolder {
        &self.folder
    }

    /// The session's settings.
    #[must_use]
    pub fn settings(&self) -> &SessionSettings {
        &self.settings
    }

    /// The state that the ledger gives.
    #[must_use]
    pub fn state(&self) -> &SessionState {
        self.ledger.state()
    }

    /// The ledger's entries so far.
    #[must_use]
    pub fn entries(&self) -> &[Entry] {
        self.ledger.entries()
    }

    /// Whether anything was decided yet.
    #[must_use]
    pub fn has_decided(&self) -> bool {
        !self.ledger.state().candidates().is_empty()
    }

    /// The session's folder, without the session.
    #[must_use]
    pub fn into_folder(self) -> SessionFolder {
        self.folder
    }

    /// The candidates so far, each with the verdicts on its rollouts.
    ///
    /// # Errors
    /// A recording cannot be read.
    pub fn scored_candidates(&mut self) -> Result<Vec<ScoredCandidate>, SessionError> {
        let mut scored = Vec::new();
        for candidate in self.ledger.state().candidates().to_vec() {
            let mut verdicts = Vec::new();
            for finished in &candidate.finished {
                verdicts.push(self.verdict(
                    candidate.number,
                    finished.rollout,
                    finished.attempt,
                )?);
            }
            scored.push(ScoredCandidate { candidate, verdicts });
        }
        Ok(scored)
    }

    fn searched(&mut self) -> Result<impl Iterator<Item = ScoredCandidate>, SessionError> {
        let scored = self.scored_candidates()?.into_iter();
        Ok(scored.filter(|it| it.candidate.purpose.is_searched()))
    }

    fn recording(&self, candidate: u32, rollout: u32, attempt: u32) -> PathBuf {
        self.folder.paths().candidate(candidate).rollout(rollout, attempt)
    }

    fn policy_path(&self, candidate: u32) -> PathBuf {
        self.folder.paths().candidate(candidate).policy()
    }

    fn rollout(
        &mut self,
        candidate: u32,
        rollout: u32,
        attempt: u32,
        tell: &mut dyn FnMut(SessionEvent),
    ) -> Result<(), SessionError> {
        let path = self.recording(candidate, rollout, attempt);
        // An existing recording was made before a crash or a stop. A complete one is taken over. An
        // unfinished or unreadable one, which a crash or a loss of power cut off, is put aside, because
        // nothing refers to it yet.
        if self.folder.disk().exists(&path) {
            match score(self.folder.disk(), &path) {
                Ok(Verdict::Unfinished) | Err(RecordingError::Unreadable { .. }) => {
                    put_aside(self.folder.disk(), &path)?;
                }
                Ok(Verdict::Result { .. } | Verdict::Void { .. }) => {}
                Err(error) => return Err(error.into()),
            }
        }
        if !self.folder.disk().exists(&path) {
            match self.perform(candidate, rollout, attempt, &path, tell) {
                Ok(()) => self.not_begun = 0,
                Err(SessionError::Rig(error @ RigError::NotBegun { .. })) => {
                    return self.try_again(candidate, rollout, error);
                }
                Err(error) => return Err(error),
            }
        }
        let recording = read_on(self.folder.disk(), &path)?;
        let verdict = score_recording(&recording);
        tell(SessionEvent::Rollout { candidate, rollout, attempt, verdict: &verdict });
        match &verdict {
            Verdict::Result { .. } => {
                self.ledger.append(Entry::RolloutFinished { candidate, rollout, attempt })?;
            }
            Verdict::Void { reason } => {
                self.ledger.append(Entry::RolloutVoid { candidate, rollout, attempt })?;
                if let Some(doubt) = doubt_of(&recording) {
                    self.rig = None;
                    return Err(SessionError::InDoubt {
                        candidate,
                        rollout,
                        doubt: Box::new(doubt),
                    });
                }
                self.start_again(candidate, rollout, reason)?;
            }
            // The stop request is still set and ends the session; --resume repeats the rollout.
            Verdict::Unfinished => {}
        }
        if matches!(verdict, Verdict::Result { .. }) {
            self.watch_drift(recording, tell);
        }
        self.verdicts.insert((candidate, rollout, attempt), verdict);
        Ok(())
    }

    /// Repeats a rollout that could not begin; it left nothing on disk and is the next step again.
    fn try_again(
        &mut self,
        candidate: u32,
        rollout: u32,
        error: RigError,
    ) -> Result<(), SessionError> {
        self.not_begun += 1;
        if self.not_begun > MAX_NOT_BEGUN {
            return Err(error.into());
        }
        self.start_again(candidate, rollout, &error.to_string())
    }

    fn start_again(
        &mut self,
        candidate: u32,
        rollout: u32,
        reason: &str,
    ) -> Result<(), SessionError> {
        let Some(rig) = &mut self.rig else { return Ok(()) };
        rig.start_again().map_err(|source| SessionError::NotStartedAgain {
            candidate,
            rollout,
            fault: reason.to_owned(),
            source: Box::new(source),
        })
    }

    /// Estimates the rig's drift from its profile once enough of today's rollouts exist.
    fn watch_drift(&mut self, recording: Recording, tell: &mut dyn FnMut(SessionEvent)) {
        let Some(profile) = self.profile else { return };
        self.today.push(recording);
        if self.today.len() == DRIFT_ROLLOUTS {
            let drift = Drift::of(&std::mem::take(&mut self.today), &profile);
            self.profile = None;
            tell(SessionEvent::Drift(&drift));
        }
    }

    fn perform(
        &mut self,
        candidate: u32,
        rollout: u32,
        attempt: u32,
        path: &Path,
        tell: &mut dyn FnMut(SessionEvent),
    ) -> Result<(), SessionError> {
        let policy = self.policy(candidate)?;
        let Candidate { psi, purpose, .. } =
            self.ledger.state().candidates()[candidate as usize].clone();
        let (name, steps) = match purpose {
            Purpose::Excitation => ("excitation by chirp".into(), EXCITATION_STEPS),
            _ => (format!("candidate {candidate}"), self.settings.extent.steps),
        };
        let plan = RolloutPlan {
            session: self.settings.name.clone(),
            candidate: Some(candidate),
            rollout,
            attempt,
            psi: self.settings.psi.with_names(&psi),
            seed: self.settings.seed,
            policy: name,
            estimator: self.settings.estimator,
            safety_box: self.settings.safety_box,
            steps,
        };
        let disk = self.folder.shared_disk();
        let rig = self.ready_rig(SeedFor::Emulator { candidate, rollout, attempt }, tell)?;
        rig.rollout(disk.as_ref(), path, plan.header(), &policy)?;
        Ok(())
    }

    /// The rig, opened on first use. Under virtual time each rollout has a new one that follows from the
    /// seed alone, so that a resumed session repeats byte for byte.
    fn ready_rig(
        &mut self,
        emulator: SeedFor,
        tell: &mut dyn FnMut(SessionEvent),
    ) -> Result<&Rig, SessionError> {
        if self.rig_settings.clock == ClockChoice::Virtual {
            self.rig_settings.emulator.seed = derived_seed(self.settings.seed, emulator);
            self.rig = None;
        }
        let rig = match self.rig.take() {
            Some(rig) => rig,
            None => {
                let rig = Rig::open(&self.rig_settings, &self.stop)?;
                // An acknowledgement holds for one doubt only.
                self.rig_settings.recovery.acknowledged = false;
                self.rig_settings.recovery.doubt = None;
                tell(SessionEvent::Connected(&rig));
                rig
            }
        };
        Ok(self.rig.insert(rig))
    }

    fn verdict(
        &mut self,
        candidate: u32,
        rollout: u32,
        attempt: u32,
    ) -> Result<Verdict, SessionError> {
        let key = (candidate, rollout, attempt);
        if let Some(verdict) = self.verdicts.get(&key) {
            return Ok(verdict.clone());
        }
        let verdict = score(self.folder.disk(), &self.recording(candidate, rollout, attempt))?;
        self.verdicts.insert(key, verdict.clone());
        Ok(verdict)
    }

    fn given_up(&mut self, candidate: u32, rollout: u32) -> SessionError {
        let tries = self.settings.extent.repetitions + 1;
        let last = score(self.folder.disk(), &self.recording(candidate, rollout, tries - 1));
        let reason = match last {
            Ok(Verdict::Void { reason }) => reason,
            Ok(_) | Err(_) => "its recording cannot be read".into(),
        };
        SessionError::GivenUp { candidate, rollout, tries, reason }
    }
}

/// Whether the candidate has a psi: excitations and the baseline have none.
fn has_psi(candidate: &Candidate) -> bool {
    candidate.purpose.is_searched() || candidate.purpose.verifies()
}

/// Writes into an empty ledger which settings it belongs to, and compares those of another with the
/// folder's. A ledger of a program that wrote no such line belongs to any.
fn bind(ledger: &mut Ledger, folder: &SessionFolder) -> Result<(), SessionError> {
    let path = folder.paths().configuration();
    let bytes = folder
        .disk()
        .read(&path, SETTINGS_BYTES)
        .map_err(|source| FolderError::Io { path: path.clone(), source })?;
    let found = file_checksum(&bytes);
    match ledger.entries().first() {
        None => Ok(ledger.append(Entry::Begun { settings: found })?),
        Some(Entry::Begun { settings }) if *settings != found => {
            Err(SessionError::SettingsChanged { path })
        }
        Some(_) => Ok(()),
    }
}

/// The doubt that the ending of a recorded rollout leaves.
fn doubt_of(recording: &Recording) -> Option<Doubt> {
    let Ending::Fault(fault) = recording.outcome.as_ref()?.ending else { return None };
    let board = recording.header.device.get("serial").cloned().unwrap_or_default();
    let unix_s = recording.header.started_unix_ns.map(|time_ns| time_ns / 1_000_000_000);
    fault.leaves_doubt().then_some(Doubt { fault: Some(fault), board, unix_s })
}
