//! Makes the rollouts: one after another on a single rig, or side by side on several rigs that
//! share the session.

use std::sync::atomic::Ordering;

use super::{Session, doubt_of};
use crate::identification::{DRIFT_ROLLOUTS, Drift};
use crate::policy::{EXCITATION_STEPS, Policy};
use crate::qube::Profile;
use crate::recording::{Recording, RecordingError, read_on};
use crate::rig::{ClockChoice, NotBegun, Rig, RigError, RigSettings, RolloutPlan};
use crate::safety::Limit;
use crate::scoring::{Verdict, score_recording};
use crate::session::finished_rollout::{check_origin, check_policy, check_session};
use crate::session::folder::put_aside;
use crate::session::plan::{identifying, wanted_rollouts};
use crate::session::seeds::{SeedFor, derived_seed};
use crate::session::{
    AttemptId, Entry, Identification, ScoredRollout, SessionError, SessionEvent, rig_of_rollout,
};
use crate::telemetry::Ending;

/// A rig of the session and its state in this process.
pub(super) struct SessionRig {
    pub(super) settings: RigSettings,
    /// The rig itself, opened on first use.
    pub(super) opened: Option<Rig>,
    /// Profile from which the drift of the rig is reported; `None` without one and once the drift
    /// has been reported. The guard uses the profile of `settings`.
    pub(super) drift_reference: Option<Profile>,
    /// First recordings of this rig that this process entered into the ledger, until there are
    /// enough to estimate the drift.
    first_recordings: Vec<Recording>,
    /// Counter of the rollouts in a row that could not begin.
    not_begun: NotBegun,
}

impl SessionRig {
    pub(super) fn of(settings: RigSettings, drift_reference: Option<Profile>) -> Self {
        Self {
            settings,
            opened: None,
            drift_reference,
            first_recordings: Vec::new(),
            not_begun: NotBegun::default(),
        }
    }
}

/// The tracing span that adds the rig's number to its warnings; none for a single rig.
fn span_of(number: Option<u32>) -> tracing::Span {
    number.map_or_else(tracing::Span::none, |number| tracing::warn_span!("rig", number))
}

/// An attempt of a rollout and the index of the rig that makes it.
#[derive(Clone, Copy, Debug)]
struct Turn {
    attempt: AttemptId,
    index: usize,
}

impl Session {
    /// Number of the rig at this index, from 1, where several rigs share the session.
    pub(super) fn number_of(&self, index: usize) -> Option<u32> {
        (self.rigs.len() > 1).then_some(index as u32 + 1)
    }

    /// Returns whether the rig at this index was taken out.
    pub(super) fn is_out(&self, index: usize) -> bool {
        self.ledger.state().is_taken_out(index as u32 + 1)
    }

    /// Number of rigs that were not taken out.
    pub(super) fn rigs_left(&self) -> usize {
        (0..self.rigs.len()).filter(|&it| !self.is_out(it)).count()
    }

    /// Index of the rig that makes this rollout. At least one rig always remains.
    pub(super) fn index_of(&self, rollout: u32) -> usize {
        let taken_out: Vec<u32> =
            self.ledger.state().taken_out().iter().map(|out| out.rig).collect();
        let rig = rig_of_rollout(rollout, self.rigs.len() as u32, &taken_out);
        rig.map_or(0, |rig| rig as usize - 1)
    }

    /// Takes out a rig after a fault if the fault concerns this rig alone, another rig remains and
    /// no stop is requested. Otherwise returns the fault, which ends the session.
    pub(super) fn take_out(
        &mut self,
        index: usize,
        fault: SessionError,
        on_event: &mut dyn FnMut(SessionEvent),
    ) -> Result<(), SessionError> {
        if self.rigs_left() < 2 || !fault.is_of_rig() || self.stop.load(Ordering::Relaxed) {
            self.ended_by = Some(index);
            return Err(fault);
        }
        let (rig, reason) = (index as u32 + 1, fault.to_string());
        self.rigs[index].opened = None;
        self.ledger.append(Entry::RigTakenOut { rig, reason: reason.clone() })?;
        on_event(SessionEvent::RigTakenOut { rig, reason: &reason });
        Ok(())
    }

    /// Makes the rollout that is due and, at the same time, the candidate's next rollouts on the
    /// other rigs. Enters them into the ledger in order, up to the first without a result.
    pub(super) fn roll_out(
        &mut self,
        due: AttemptId,
        on_event: &mut dyn FnMut(SessionEvent),
    ) -> Result<(), SessionError> {
        let turns = self.turns(due);
        let mut missing = Vec::new();
        for turn in &turns {
            if !self.takes_over(turn)? {
                missing.push(*turn);
            }
        }
        for turn in &missing {
            if let Err(error) = self.ready_for(turn, on_event) {
                return self.take_out(turn.index, error, on_event);
            }
        }
        for &Turn { attempt: AttemptId { candidate, rollout, .. }, index } in &missing {
            let rig = self.number_of(index);
            on_event(SessionEvent::RolloutBegins { candidate, rollout, rig });
        }
        let mut failed = self.record(&missing)?;
        for turn in turns {
            let failure = failed.iter().position(|(index, _)| *index == turn.index);
            let goes_on = match failure.map(|place| failed.swap_remove(place).1) {
                None => self.enter(&turn, on_event),
                Some(error @ RigError::NotBegun { .. }) => {
                    self.try_again(&turn, error).map(|()| false)
                }
                Some(error) => Err(error.into()),
            };
            match goes_on {
                Ok(true) => {}
                // The other recordings are on disk and are taken over when they are due.
                Ok(false) => return Ok(()),
                Err(error) => return self.take_out(turn.index, error, on_event),
            }
        }
        Ok(())
    }

    /// The rollout that is due, and the next ones, each on another rig, that can be made at the
    /// same time.
    fn turns(&self, due: AttemptId) -> Vec<Turn> {
        let state = self.ledger.state();
        let purpose = state.candidates()[due.candidate as usize].purpose;
        let identifies = identifying(state, self.settings.identification.as_ref());
        let wanted = wanted_rollouts(purpose, &self.settings.extent, identifies);
        let mut turns = vec![Turn { attempt: due, index: self.index_of(due.rollout) }];
        for rollout in due.rollout + 1..wanted {
            let index = self.index_of(rollout);
            if turns.iter().any(|turn| turn.index == index) {
                break;
            }
            turns.push(Turn { attempt: AttemptId { rollout, attempt: 0, ..due }, index });
        }
        turns
    }

    /// Returns whether the recording of a turn already exists and is taken over: it was made before
    /// a crash or a stop, or at the same time as an earlier rollout. Puts aside a recording that is
    /// unreadable or unfinished, or void where several rigs share the session; no entry of the
    /// ledger refers to it.
    fn takes_over(&self, turn: &Turn) -> Result<bool, SessionError> {
        let path = self.recording(turn.attempt);
        let disk = self.folder.disk();
        if !disk.exists(&path) {
            return Ok(false);
        }
        let recording = match read_on(disk, &path) {
            Ok(recording) => recording,
            Err(RecordingError::Unreadable { .. }) => {
                put_aside(disk, &path)?;
                return Ok(false);
            }
            Err(error) => return Err(error.into()),
        };
        let is_due_again = match score_recording(&recording) {
            Verdict::Result { .. } => false,
            // If there are several rigs, the rig of a void recording may have been mended or taken
            // out since the recording. A doubt about a real Qube is stored apart from the
            // recordings, so it is not lost.
            Verdict::Void { .. } => self.rigs.len() > 1,
            Verdict::Unfinished => true,
        };
        if is_due_again {
            put_aside(disk, &path)?;
            return Ok(false);
        }
        let candidate = turn.attempt.candidate;
        check_session(&recording, &path, &self.settings)?;
        check_origin(&recording, &path, Some(candidate), turn.attempt.of_policy())?;
        check_policy(&recording, disk, &self.policy_path(candidate))?;
        Ok(true)
    }

    /// Makes the rig of a turn ready for its rollout.
    fn ready_for(
        &mut self,
        turn: &Turn,
        on_event: &mut dyn FnMut(SessionEvent),
    ) -> Result<(), SessionError> {
        let Turn { attempt: AttemptId { candidate, rollout, attempt }, index } = *turn;
        self.ready_rig(index, SeedFor::Emulator { candidate, rollout, attempt }, on_event)?;
        // The rig's last rollout may have ended with a fault that is not in the ledger, because
        // another rig's fault ended the round first.
        match self.rigs[index].opened.as_ref().and_then(Rig::last_fault) {
            Some(fault) => self.start_again(turn, fault),
            None => Ok(()),
        }
    }

    /// Opens the rig at this index if it is not open. In virtual time each rollout gets a new rig
    /// that follows from the seed alone, so that a resumed session repeats byte for byte.
    pub(super) fn ready_rig(
        &mut self,
        index: usize,
        emulator: SeedFor,
        on_event: &mut dyn FnMut(SessionEvent),
    ) -> Result<(), SessionError> {
        let number = self.number_of(index);
        let contradicted = self.has_contradicted_profile();
        let SessionRig { settings, opened, .. } = &mut self.rigs[index];
        if settings.clock == ClockChoice::Virtual {
            settings.emulator.seed = derived_seed(self.settings.seed, emulator);
            *opened = None;
        }
        if opened.is_none() {
            let is_acknowledged = settings.recovery.acknowledged;
            let announce = |is_examined| {
                on_event(SessionEvent::FirstMotion { rig: number, is_examined, is_acknowledged });
            };
            let rig =
                span_of(number).in_scope(|| Rig::open_announced(settings, &self.stop, announce));
            let rig = rig.map_err(|error| match (number, error) {
                (Some(rig), error @ RigError::Homing { .. }) => {
                    SessionError::NotHomed { rig, source: Box::new(error) }
                }
                (_, error) => error.into(),
            })?;
            // An acknowledgement holds for one doubt only.
            settings.recovery.acknowledged = false;
            settings.recovery.doubt = None;
            if contradicted {
                rig.distrust_profile();
            }
            on_event(SessionEvent::Connected { rig: number, opened: &rig });
            *opened = Some(rig);
        }
        Ok(())
    }

    /// Returns whether the Qube, under a policy, has moved unlike its latest profile in a finished
    /// rollout since the session found that profile. A rig that stays open distrusts the profile by
    /// itself; a rig that is opened anew does so after [`Rig::distrust_profile`].
    pub(super) fn has_contradicted_profile(&self) -> bool {
        let state = self.ledger.state();
        if !matches!(state.identification(), Identification::Found { .. }) {
            return false;
        }
        state.finished_since_profile().iter().any(|attempt| {
            let Some(Verdict::Result { outcome, .. }) =
                self.scored.get(attempt).map(|it| &it.verdict)
            else {
                return false;
            };
            outcome.ending == Ending::LeftBox(Limit::Unpredicted)
        })
    }

    /// Records these rollouts side by side; returns the errors with the indices of their rigs.
    fn record(&mut self, turns: &[Turn]) -> Result<Vec<(usize, RigError)>, SessionError> {
        let Some(first) = turns.first() else { return Ok(Vec::new()) };
        let policy = self.policy(first.attempt.candidate)?;
        let disk = self.folder.shared_disk();
        let recordings: Vec<_> = turns
            .iter()
            .map(|turn| {
                let path = self.recording(turn.attempt);
                let span = span_of(self.number_of(turn.index));
                (turn.index, path, self.plan_of(turn, &policy).header(), span)
            })
            .collect();
        let (policy, disk) = (policy.as_slice(), &disk);
        let mut results = Vec::new();
        std::thread::scope(|scope| {
            let mut threads = Vec::new();
            let mut recordings = recordings.into_iter();
            let first = recordings.next();
            let mut rigs: Vec<_> = self.rigs.iter_mut().map(|rig| rig.opened.as_mut()).collect();
            for (index, path, header, span) in recordings {
                let Some(rig) = rigs[index].take() else { continue };
                let record = move || {
                    span.in_scope(|| rig.rollout(disk.as_ref(), &path, header, policy).map(drop))
                };
                threads.push((index, scope.spawn(record)));
            }
            // This thread makes the first recording, so that a session of one rig starts no other
            // thread.
            if let Some((index, path, header, span)) = first
                && let Some(rig) = rigs[index].take()
            {
                let record = || rig.rollout(disk.as_ref(), &path, header, policy).map(drop);
                results.push((index, span.in_scope(record)));
            }
            for (index, thread) in threads {
                let result = thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic));
                results.push((index, result));
            }
        });
        let mut failed = Vec::new();
        for (index, result) in results {
            match result {
                Ok(()) => self.rigs[index].not_begun.reset(),
                Err(error) => failed.push((index, error)),
            }
        }
        Ok(failed)
    }

    /// The plan of a rollout of a candidate's policy, given in the format of its file.
    fn plan_of(&self, turn: &Turn, policy: &[u8]) -> RolloutPlan {
        let AttemptId { candidate: number, rollout, attempt } = turn.attempt;
        let candidate = &self.ledger.state().candidates()[number as usize];
        let (policy, steps) = match Policy::from_bytes(policy) {
            Ok(Policy::Excitation(excitation)) => {
                (format!("excitation by {}", excitation.shape().name()), EXCITATION_STEPS)
            }
            _ => (format!("candidate {number}"), self.settings.extent.steps),
        };
        RolloutPlan {
            session: self.settings.name.clone(),
            candidate: Some(number),
            rollout,
            attempt,
            psi: self.settings.psi.by_name(&candidate.point),
            seed: self.settings.seed,
            policy,
            estimator: self.settings.estimator,
            safety_box: self.settings.safety_box,
            steps,
        }
    }

    /// Enters a recorded rollout into the ledger, unless the rollout is unfinished. Returns whether
    /// it has a result; only then is the next rollout due.
    fn enter(
        &mut self,
        turn: &Turn,
        on_event: &mut dyn FnMut(SessionEvent),
    ) -> Result<bool, SessionError> {
        let Turn { attempt: AttemptId { candidate, rollout, attempt }, index } = *turn;
        let rig = self.number_of(index);
        let path = self.recording(turn.attempt);
        let recording = read_on(self.folder.disk(), &path)?;
        let verdict = score_recording(&recording);
        let purpose = self.ledger.state().candidates()[candidate as usize].purpose;
        let rolled_out =
            SessionEvent::Rollout { candidate, purpose, rollout, attempt, rig, verdict: &verdict };
        on_event(rolled_out);
        match &verdict {
            Verdict::Result { .. } => {
                self.ledger.append(Entry::RolloutFinished { candidate, rollout, attempt, rig })?;
            }
            Verdict::Void { reason } => {
                self.ledger.append(Entry::RolloutVoid { candidate, rollout, attempt, rig })?;
                if let Some(doubt) = doubt_of(&recording) {
                    self.rigs[index].opened = None;
                    return Err(SessionError::InDoubt {
                        candidate,
                        rollout,
                        doubt: Box::new(doubt),
                    });
                }
                self.start_again(turn, reason)?;
            }
            // The stop request stays set and ends the session; `--resume` repeats the rollout.
            Verdict::Unfinished => {}
        }
        let has_result = matches!(verdict, Verdict::Result { .. });
        let scored = ScoredRollout::of(&recording, verdict);
        self.scored.insert(turn.attempt, scored);
        if has_result {
            self.watch_drift(index, recording, on_event);
        }
        Ok(has_result)
    }

    /// Starts the rig again after a rollout that could not begin. Nothing of that rollout is on
    /// disk, so the rollout is the next step again.
    fn try_again(&mut self, turn: &Turn, error: RigError) -> Result<(), SessionError> {
        if !self.rigs[turn.index].not_begun.may_repeat(&error) {
            return Err(error.into());
        }
        self.start_again(turn, error)
    }

    fn start_again(&mut self, turn: &Turn, reason: impl ToString) -> Result<(), SessionError> {
        let span = span_of(self.number_of(turn.index));
        let Some(rig) = &mut self.rigs[turn.index].opened else { return Ok(()) };
        span.in_scope(|| rig.start_again()).map_err(|source| match source {
            // The operator requested a stop: the session ends as stopped, not with the fault.
            RigError::Stopped { .. } => SessionError::Stopped,
            source => SessionError::NotStartedAgain {
                candidate: turn.attempt.candidate,
                rollout: turn.attempt.rollout,
                fault: reason.to_string(),
                source: Box::new(source),
            },
        })
    }

    /// Estimates a rig's drift from its profile once this process has entered [`DRIFT_ROLLOUTS`] of
    /// its rollouts.
    fn watch_drift(
        &mut self,
        index: usize,
        recording: Recording,
        on_event: &mut dyn FnMut(SessionEvent),
    ) {
        let rig = self.number_of(index);
        let SessionRig { drift_reference, first_recordings, .. } = &mut self.rigs[index];
        if drift_reference.is_none() {
            return;
        }
        first_recordings.push(recording);
        if first_recordings.len() == DRIFT_ROLLOUTS
            && let Some(reference) = drift_reference.take()
        {
            let drift = Drift::of(&std::mem::take(first_recordings), &reference);
            on_event(SessionEvent::Drift { rig, drift: &drift });
        }
    }
}
