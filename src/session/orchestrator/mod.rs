//! Performs the method's steps in their order: proposals, identification, trainings, rollouts.

mod boards;
mod early_training;
mod identification;
mod policies;
mod prepared;
mod proposals;
mod rollouts;
mod training;
mod training_ahead;

pub use boards::keep_on_board;

use std::collections::{HashMap, HashSet};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use prepared::PreparedTrainings;
use rollouts::SessionRig;
use training_ahead::TrainingAhead;

use super::finished_rollout::check_session;
use super::seeds::SeedFor;
use super::{
    AttemptId, Candidate, Entry, Finished, FolderError, Ledger, LedgerError, ScoredCandidate,
    ScoredRollout, SessionError, SessionEvent, SessionFolder, SessionSettings, SessionState, Step,
    VoidAttempt, finished_rollout, next_step,
};
use crate::control::HomingMethod;
use crate::jobs::{Executor, LocalExecutor};
use crate::qube::Profile;
use crate::recording::{Recording, read_on};
use crate::rig::{ClockChoice, Doubt, RigSettings};
use crate::scoring::{Verdict, score};
use crate::storage::{SETTINGS_BYTES, checksum_of};
use crate::telemetry::Ending;

/// A session in its folder, which performs the method's algorithm ([`next_step`]) step by step.
pub struct Session {
    folder: SessionFolder,
    ledger: Ledger,
    /// Settings of the search: those with which the session began, or those around the identified
    /// Qube.
    settings: SessionSettings,
    /// The rigs that make the rollouts: one, or several that share the session.
    rigs: Vec<SessionRig>,
    /// Verdicts on the recordings read so far, and their quietness, by candidate, rollout and
    /// attempt.
    scored: HashMap<AttemptId, ScoredRollout>,
    stop: Arc<AtomicBool>,
    executor: Arc<dyn Executor>,
    /// Trainings that run beside the rollouts; `None` unless the search proposes while returns are
    /// pending.
    ahead: Option<TrainingAhead>,
    /// Trainings that began before the session needed them.
    prepared: PreparedTrainings,
    /// True if trainings may begin before the session needs them: on this computer, if it has a
    /// core beside the control thread's core, while a Qube moves in real time.
    prepares: bool,
    /// Candidates and rollouts of the recordings that were reported as left out of the fit.
    reported_left_out: HashSet<(u32, u32)>,
    /// Rollout that an earlier process gave up; `None` if there is none.
    given_up_before: Option<GivenUpBefore>,
    /// Index of the rig whose opening, doubt or rollout ended the last run early; `None` if the run
    /// ended otherwise.
    ended_by: Option<usize>,
}

/// A rollout that was given up before this process opened the session.
#[derive(Clone, Copy)]
struct GivenUpBefore {
    candidate: u32,
    rollout: u32,
    /// Number of its attempts that were void by then.
    void: u32,
}

impl Session {
    /// Opens a session and continues where its ledger ends. An empty ledger starts a new session
    /// and is bound to the folder's `session.toml`.
    ///
    /// If the ledger of a new session cannot be written, the files of the session are removed.
    ///
    /// # Errors
    /// The ledger is damaged, cannot be opened or written, has lost its first line, or belongs to
    /// another `session.toml`; the folder or its `session.toml` cannot be read; a profile that the
    /// session identified cannot be read or was changed; the recording that names the identified
    /// board cannot be read; or a candidate's psi does not fit the settings.
    pub fn open(
        folder: SessionFolder,
        settings: SessionSettings,
        rig_settings: RigSettings,
        stop: Arc<AtomicBool>,
    ) -> Result<Self, SessionError> {
        let ledger = match bound_ledger(&folder) {
            Ok(ledger) => ledger,
            Err(error) => {
                // A ledger that is damaged, or of other settings, is not this session's: it stays.
                if matches!(error, SessionError::Ledger(LedgerError::Io { .. })) {
                    folder.withdraw_if_new();
                }
                return Err(error);
            }
        };
        // Trainings that run beside rollouts leave a core to the control thread, except in virtual
        // time, where no tick is late.
        let in_real_time = rig_settings.clock == ClockChoice::Wall;
        let executor = if settings.extent.pending > 0 && in_real_time {
            LocalExecutor::beside_control_thread()
        } else {
            LocalExecutor::on_all_cores()
        };
        let has_another_core = std::thread::available_parallelism().is_ok_and(|it| it.get() > 1);
        let mut session = Self {
            folder,
            ledger,
            settings,
            rigs: vec![SessionRig::of(rig_settings, None)],
            scored: HashMap::new(),
            stop,
            executor: Arc::new(executor),
            ahead: None,
            prepared: PreparedTrainings::default(),
            prepares: in_real_time && has_another_core,
            reported_left_out: HashSet::new(),
            given_up_before: None,
            ended_by: None,
        };
        session.guard_as_unknown();
        session.search_around_identified()?;
        // A finished session of an older program, whose ledger lacks this first line, is only read.
        let begins = matches!(session.ledger.entries().first(), Some(Entry::Begun { .. }));
        if !begins && session.next_step() != Step::Done {
            return Err(SessionError::BeginningLost { path: session.folder.paths().ledger() });
        }
        for candidate in session.ledger.state().candidates().iter().filter(|it| has_psi(it)) {
            session.settings.psi.psi(&candidate.point)?;
        }
        if let Step::GiveUp { candidate, rollout } = session.next_step() {
            let void = session.ledger.state().candidates()[candidate as usize].void;
            session.given_up_before = Some(GivenUpBefore { candidate, rollout, void });
        }
        Ok(session)
    }

    /// Reports the drift of the first rig from this profile, if there is one, after the rig's first
    /// rollouts. The guard uses the profile of [`RigSettings::profile`] instead.
    #[must_use]
    pub fn reporting_drift_from(mut self, profile: Option<Profile>) -> Self {
        self.rigs[0].drift_reference = profile;
        self
    }

    /// Spreads the rollouts of each candidate over these rigs too, each with the profile from which
    /// its drift is reported, if there is one. The rig with which the session was opened remains the
    /// first rig. The session must not identify its Qube, because an identification describes one
    /// Qube.
    #[must_use]
    pub fn spread_over(
        mut self,
        others: impl IntoIterator<Item = (RigSettings, Option<Profile>)>,
    ) -> Self {
        self.rigs.extend(
            others.into_iter().map(|(settings, profile)| SessionRig::of(settings, profile)),
        );
        self
    }

    /// Trains on this executor instead of this computer's cores; the policies do not depend on the
    /// executor.
    #[must_use]
    pub fn trained_by(mut self, executor: Arc<dyn Executor>) -> Self {
        self.executor = executor;
        self.prepares = false;
        self
    }

    /// Runs until the session is complete, an error ends it, or the operator stops it.
    ///
    /// # Errors
    /// The session ends early; finished work is on disk.
    pub fn run(&mut self, on_event: &mut dyn FnMut(SessionEvent)) -> Result<(), SessionError> {
        self.run_while(|_| true, on_event)
    }

    /// Runs until this many candidates of the search have all their rollouts, or the session is
    /// complete. The session can be resumed afterwards. It must not identify its Qube, because a
    /// search around an identified Qube makes another number of rollouts of each candidate.
    ///
    /// # Errors
    /// The errors of [`run`](Self::run).
    pub fn run_to(
        &mut self,
        evaluated: u32,
        on_event: &mut dyn FnMut(SessionEvent),
    ) -> Result<(), SessionError> {
        let rollouts = self.settings.extent.rollouts as usize;
        let is_evaluated = |it: &&Candidate| it.finished.len() == rollouts;
        let count = |state: &SessionState| state.searched().filter(is_evaluated).count();
        self.run_while(|state| count(state) < evaluated as usize, on_event)
    }

    fn run_while(
        &mut self,
        goes_on: impl Fn(&SessionState) -> bool,
        on_event: &mut dyn FnMut(SessionEvent),
    ) -> Result<(), SessionError> {
        let mut ended = self.perform_while(goes_on, on_event);
        if matches!(ended, Ok(()) | Err(SessionError::Stopped)) {
            // The recording of the last rollout does not say whether its motor was confirmed to be
            // off.
            ended = self.check_motors_off().and(ended);
        }
        if ended.is_err() {
            // An error ends the trainings that run ahead; they begin again when the session is
            // resumed.
            self.ahead = None;
            self.prepared = PreparedTrainings::default();
        }
        ended
    }

    fn perform_while(
        &mut self,
        goes_on: impl Fn(&SessionState) -> bool,
        on_event: &mut dyn FnMut(SessionEvent),
    ) -> Result<(), SessionError> {
        self.ended_by = None;
        self.ledger.check_rigs(self.rigs.len() as u32)?;
        self.check_boards()?;
        self.pass_doubt_to_rig(on_event)?;
        // Reads every recording and policy before anything moves or is trained, because the search
        // needs every return.
        self.scored_candidates()?;
        self.check_policies()?;
        self.prepare_trainings()?;
        self.connect_early(on_event)?;
        while goes_on(self.ledger.state()) {
            if self.stop.load(Ordering::Relaxed) {
                return Err(SessionError::Stopped);
            }
            self.train_ahead(on_event)?;
            self.prepare_trainings()?;
            match self.next_step() {
                Step::Propose { count, purpose } => self.propose(count, purpose, on_event)?,
                Step::Identify => self.identify(on_event)?,
                Step::Decide => self.decide(on_event)?,
                Step::Train { candidates } => self.train(&candidates, on_event)?,
                Step::Rollout { candidate, rollout, attempt } => {
                    self.roll_out(AttemptId { candidate, rollout, attempt }, on_event)?;
                }
                Step::GiveUp { candidate, rollout } => match self.attempt_again(candidate, rollout)
                {
                    Some(attempt) => {
                        self.roll_out(AttemptId { candidate, rollout, attempt }, on_event)?;
                    }
                    None => {
                        let given_up = self.given_up(candidate, rollout);
                        let index = self.index_of(rollout);
                        self.take_out(index, given_up, on_event)?;
                    }
                },
                Step::Done => break,
            }
        }
        Ok(())
    }

    fn check_motors_off(&self) -> Result<(), SessionError> {
        for rig in self.rigs.iter().filter_map(|rig| rig.opened.as_ref()) {
            rig.check_off()?;
        }
        Ok(())
    }

    fn next_step(&self) -> Step {
        let SessionSettings { extent, identification, .. } = &self.settings;
        next_step(self.ledger.state(), extent, identification.as_ref())
    }

    /// Acknowledges for the operator the doubt that ended the last run, or that the ledger ends
    /// with; the Qube is examined when its rig is next opened. A doubt about another rig remains.
    pub fn acknowledge(&mut self) {
        let index = self.rig_in_doubt();
        let rig = &mut self.rigs[index];
        rig.opened = None;
        rig.settings.recovery.acknowledged = true;
    }

    /// The homing method of the Qube whose doubt [`acknowledge`](Self::acknowledge) acknowledges.
    #[must_use]
    pub fn homing_after_doubt(&self) -> HomingMethod {
        self.rigs[self.rig_in_doubt()].settings.homing.method
    }

    /// Index of the rig at which the last run ended early, or whose void rollout the ledger ends
    /// with; 0 if there is neither.
    fn rig_in_doubt(&self) -> usize {
        let void = self.ledger.state().last_void().and_then(|void| void.rig);
        let void = void.map(|rig| (rig as usize).saturating_sub(1));
        // The ledger may be of a session of more rigs, which a run then refuses.
        self.ended_by.or(void).filter(|index| *index < self.rigs.len()).unwrap_or(0)
    }

    /// Reacts to a doubt that the last entry of the ledger left, even if the session continues on
    /// another computer: passes the doubt to its rig, which is then examined first. If the operator
    /// has not acknowledged the doubt, takes the rig out, or ends the session if no other rig
    /// remains.
    fn pass_doubt_to_rig(
        &mut self,
        on_event: &mut dyn FnMut(SessionEvent),
    ) -> Result<(), SessionError> {
        let Some(VoidAttempt { attempt, rig }) = self.ledger.state().last_void() else {
            return Ok(());
        };
        let path = self.recording(attempt);
        // Without the recording the fault is unknown here; the computer that drove the board has
        // the doubt in its store.
        let Some(recording) = read_on(self.folder.disk(), &path).ok() else { return Ok(()) };
        let Some(doubt) = doubt_of(&recording) else { return Ok(()) };
        let index = rig.map_or(0, |rig| rig as usize - 1);
        let recovery = &mut self.rigs[index].settings.recovery;
        if !recovery.acknowledged {
            let AttemptId { candidate, rollout, .. } = attempt;
            let in_doubt = SessionError::InDoubt { candidate, rollout, doubt: Box::new(doubt) };
            return self.take_out(index, in_doubt, on_event);
        }
        recovery.doubt = Some(doubt);
        Ok(())
    }

    /// Connects, checks and homes every real Qube that was not taken out, before the session waits
    /// for any training, so that a defect shows at once and not after hours. Does nothing if the
    /// session is complete.
    fn connect_early(
        &mut self,
        on_event: &mut dyn FnMut(SessionEvent),
    ) -> Result<(), SessionError> {
        let is_over = self.next_step() == Step::Done;
        for index in 0..self.rigs.len() {
            if !is_over && !self.is_out(index) && self.rigs[index].settings.is_hardware() {
                let first = SeedFor::Emulator { candidate: 0, rollout: 0, attempt: 0 };
                if let Err(error) = self.ready_rig(index, first, on_event) {
                    self.ended_by = Some(index);
                    return Err(error);
                }
            }
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

    /// The state that follows from the ledger's entries.
    #[must_use]
    pub fn state(&self) -> &SessionState {
        self.ledger.state()
    }

    /// The ledger's entries so far.
    #[must_use]
    pub fn entries(&self) -> &[Entry] {
        self.ledger.entries()
    }

    /// Returns whether the session has proposed a candidate.
    #[must_use]
    pub fn has_proposed(&self) -> bool {
        !self.ledger.state().candidates().is_empty()
    }

    /// Ends the session and returns its folder.
    #[must_use]
    pub fn into_folder(self) -> SessionFolder {
        self.folder
    }

    /// The candidates so far, each with the verdicts on its rollouts.
    ///
    /// # Errors
    /// The errors of [`finished_rollout`].
    pub fn scored_candidates(&mut self) -> Result<Vec<ScoredCandidate>, SessionError> {
        let mut scored = Vec::new();
        for candidate in self.ledger.state().candidates().to_vec() {
            let mut rollouts = Vec::new();
            for finished in &candidate.finished {
                rollouts.push(self.scored_rollout(candidate.number, finished)?);
            }
            scored.push(ScoredCandidate::new(candidate, rollouts));
        }
        Ok(scored)
    }

    fn searched(&mut self) -> Result<impl Iterator<Item = ScoredCandidate>, SessionError> {
        let scored = self.scored_candidates()?.into_iter();
        Ok(scored.filter(|it| it.candidate.purpose.is_searched()))
    }

    fn recording(&self, attempt: AttemptId) -> PathBuf {
        self.folder.paths().candidate(attempt.candidate).rollout(attempt.of_policy())
    }

    fn policy_path(&self, candidate: u32) -> PathBuf {
        self.folder.paths().candidate(candidate).policy()
    }

    fn scored_rollout(
        &mut self,
        candidate: u32,
        finished: &Finished,
    ) -> Result<ScoredRollout, SessionError> {
        let attempt = finished.of_candidate(candidate);
        if let Some(scored) = self.scored.get(&attempt) {
            return Ok(scored.clone());
        }
        let (disk, paths) = (self.folder.disk(), self.folder.paths().candidate(candidate));
        let (recording, verdict) = finished_rollout(disk, &paths, candidate, finished)?;
        check_session(&recording, &paths.rollout(finished.of_policy()), &self.settings)?;
        let scored = ScoredRollout::of(&recording, verdict);
        self.scored.insert(attempt, scored.clone());
        Ok(scored)
    }

    /// The next attempt of a rollout that is to be given up, if an earlier process gave it up and
    /// no other rig can make it: somebody who resumes the session has looked at the Qube, so the
    /// rollout may be repeated as often as before. `None` if it is given up now.
    fn attempt_again(&self, candidate: u32, rollout: u32) -> Option<u32> {
        let before =
            self.given_up_before.filter(|it| (it.candidate, it.rollout) == (candidate, rollout))?;
        let attempt = self.ledger.state().candidates()[candidate as usize].void;
        let may_repeat = attempt - before.void <= self.settings.extent.repetitions;
        (may_repeat && self.rigs_left() < 2).then_some(attempt)
    }

    fn given_up(&mut self, candidate: u32, rollout: u32) -> SessionError {
        // The attempts of rigs that were taken out count too.
        let attempts = self.ledger.state().candidates()[candidate as usize].void;
        let last = AttemptId { candidate, rollout, attempt: attempts.saturating_sub(1) };
        let last = score(self.folder.disk(), &self.recording(last));
        let reason = match last {
            Ok(Verdict::Void { reason }) => reason.to_string(),
            Ok(_) | Err(_) => "its recording cannot be read".into(),
        };
        SessionError::GivenUp { candidate, rollout, attempts, reason }
    }
}

/// Returns whether the candidate has a psi: excitations and the baseline have none.
fn has_psi(candidate: &Candidate) -> bool {
    candidate.purpose.is_searched() || candidate.purpose.verifies()
}

/// Opens the ledger of a session and binds it to the session's settings.
fn bound_ledger(folder: &SessionFolder) -> Result<Ledger, SessionError> {
    let mut ledger = Ledger::open(folder.disk(), &folder.paths().ledger())?;
    bind(&mut ledger, folder)?;
    Ok(ledger)
}

/// Binds a ledger to its settings: the empty ledger of a new session records their checksum; a
/// ledger that records another checksum than the folder's settings have is refused. An empty
/// ledger is refused, too, if it is beside candidates, whose policies may have been trained with
/// other settings, or beside settings that no session wrote, such as a file that was emptied.
fn bind(ledger: &mut Ledger, folder: &SessionFolder) -> Result<(), SessionError> {
    let path = folder.paths().configuration();
    let bytes = folder
        .disk()
        .read(&path, SETTINGS_BYTES)
        .map_err(|source| FolderError::Io { path: path.clone(), source })?;
    let found = checksum_of(&bytes);
    match ledger.entries().first() {
        None if folder.has_candidates()? => {
            Err(SessionError::BeginningLost { path: folder.paths().ledger() })
        }
        None if !folder.is_new() && !is_written_by_session(&bytes) => {
            Err(SessionError::SettingsChanged { path })
        }
        None => Ok(ledger.append(Entry::Begun { settings: found, chained: true })?),
        Some(Entry::Begun { settings, .. }) if *settings != found => {
            Err(SessionError::SettingsChanged { path })
        }
        Some(_) => Ok(()),
    }
}

/// Returns whether these bytes are settings as a session writes them: complete, and in the same
/// form.
fn is_written_by_session(bytes: &[u8]) -> bool {
    let text = std::str::from_utf8(bytes).unwrap_or_default();
    let settings = toml::from_str::<SessionSettings>(text);
    settings.is_ok_and(|settings| settings.to_toml().is_ok_and(|written| written == text))
}

/// The doubt that the ending of a recorded rollout leaves, if it leaves one.
fn doubt_of(recording: &Recording) -> Option<Doubt> {
    let Ending::Fault(fault) = recording.outcome.as_ref()?.ending else { return None };
    let board = recording.header.board().unwrap_or_default().to_owned();
    let unix_s = recording.header.started_unix_ns.map(|time_ns| time_ns / 1_000_000_000);
    fault.leaves_doubt().then_some(Doubt { fault: Some(fault), board, unix_s })
}
