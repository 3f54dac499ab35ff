//! Provides the policies of candidates: trained when they are due or ahead of their rollouts,
//! copied from the incumbent, or excitations.

use std::sync::Arc;

use super::Session;
use super::early_training::{EarlyKind, EarlyTraining};
use super::training::Trainer;
use super::training_ahead::TrainingAhead;
use crate::policy::{MAX_FILE_BYTES as MAX_POLICY_BYTES, Policy};
use crate::rig::ClockChoice;
use crate::session::{
    Candidate, Entry, Purpose, SessionError, SessionEvent, SessionSettings, Step, trains_ahead,
};
use crate::storage::{checksum_of, write_whole};

impl Session {
    /// Makes the policies of these candidates, or waits for their trainings that run ahead, and
    /// enters the candidates into the ledger as trained.
    pub(super) fn train(
        &mut self,
        numbers: &[u32],
        on_event: &mut dyn FnMut(SessionEvent),
    ) -> Result<(), SessionError> {
        if let Some(ahead) = &mut self.ahead {
            for &candidate in numbers {
                ahead.wait_for(candidate, &self.stop, on_event)?;
            }
        } else {
            let mut due = Vec::new();
            for &number in numbers {
                due.extend(self.write_unless_trained(number)?);
            }
            self.trainer().train(due, &mut self.prepared, &self.stop, on_event)?;
        }
        // The entries are in the order of the candidates' numbers, whichever was trained first.
        for &candidate in numbers {
            let checksum = Some(checksum_of(&self.policy_file(candidate)?));
            self.ledger.append(Entry::Trained { candidate, checksum })?;
        }
        Ok(())
    }

    /// Begins the trainings of the proposed candidates that have not begun, and reports the
    /// progress of the others. Does nothing unless the search proposes while returns are pending.
    pub(super) fn train_ahead(
        &mut self,
        on_event: &mut dyn FnMut(SessionEvent),
    ) -> Result<(), SessionError> {
        let SessionSettings { extent, identification, .. } = &self.settings;
        if !trains_ahead(self.ledger.state(), extent, identification.as_ref()) {
            return Ok(());
        }
        let mut ahead = self.ahead.take().unwrap_or_else(|| TrainingAhead::new(self.trainer()));
        ahead.report_events(on_event);
        let candidates = self.ledger.state().candidates().iter();
        let untrained: Vec<u32> = candidates
            .filter(|it| !it.trained && ahead.note(it.number))
            .map(|it| it.number)
            .collect();
        for number in untrained {
            if let Some(candidate) = self.write_unless_trained(number)? {
                ahead.train(candidate);
            }
        }
        self.ahead = Some(ahead);
        Ok(())
    }

    /// Begins the training that depends on no recording and may be needed later, so that it runs
    /// while the Qube is homed and moves. Stops an earlier such training that is not needed. Does
    /// nothing if the session does not identify its Qube, prepares no trainings, or is done.
    pub(super) fn prepare_trainings(&mut self) -> Result<(), SessionError> {
        let prepares = self.prepares && self.next_step() != Step::Done;
        let Some(plan) = self.settings.identification.filter(|_| prepares) else { return Ok(()) };
        let has_baseline = self.settings.extent.baseline;
        let Some(early) = EarlyTraining::of(self.ledger.state(), &plan, has_baseline) else {
            self.prepared.keep_only(None);
            return Ok(());
        };
        let job = match early.kind {
            EarlyKind::Competitor => self.trainer().competitor_for_unknown(early.candidate)?,
            EarlyKind::Baseline => self.trainer().baseline(early.candidate)?,
        };
        self.prepared.keep_only(Some(&job));
        if early.may_begin {
            self.prepared.begin(job);
        }
        Ok(())
    }

    /// Makes the folder of a candidate, and its policy if it need not be trained. Returns the
    /// candidate if its policy must be trained.
    pub(super) fn write_unless_trained(
        &mut self,
        number: u32,
    ) -> Result<Option<Candidate>, SessionError> {
        self.folder.make_candidate(number)?;
        // Policy files appear atomically: an existing file is whole, from before a crash or a stop.
        if self.folder.disk().exists(&self.policy_path(number)) {
            return Ok(None);
        }
        let candidate = self.ledger.state().candidates()[number as usize].clone();
        let policy = match candidate.purpose {
            Purpose::Incumbent => {
                let incumbent = match candidate.policy_of {
                    Some(incumbent) => incumbent,
                    None => self.incumbent()?.number,
                };
                self.policy(incumbent)?
            }
            Purpose::Excitation => Policy::Excitation(self.excitation(number)?).to_bytes(),
            Purpose::Initial | Purpose::Search | Purpose::Verification | Purpose::Baseline => {
                return Ok(Some(candidate));
            }
        };
        write_whole(self.folder.disk(), &self.policy_path(number), &policy)?;
        Ok(None)
    }

    /// The trainer of the session's candidates, with its own copy of settings and identification.
    pub(super) fn trainer(&self) -> Trainer {
        Trainer {
            disk: self.folder.shared_disk(),
            paths: self.folder.paths().clone(),
            settings: self.settings.clone(),
            identification: self.ledger.state().identification().clone(),
            executor: Arc::clone(&self.executor),
            in_real_time: self.rigs[0].settings.clock == ClockChoice::Wall,
        }
    }

    /// Reads and checks the policy of a candidate; returns it in the format of its file.
    pub(super) fn policy(&self, candidate: u32) -> Result<Vec<u8>, SessionError> {
        let path = self.policy_path(candidate);
        let bytes = self.policy_file(candidate)?;
        let policy = Policy::from_bytes(&bytes).map_err(|fault| SessionError::PolicyLost {
            path: path.clone(),
            reason: fault.to_string(),
        })?;
        let entered = &self.ledger.state().candidates()[candidate as usize].policy_checksum;
        if entered.as_ref().is_some_and(|entered| *entered != checksum_of(&bytes)) {
            return Err(SessionError::PolicyChanged { path });
        }
        Ok(policy.to_bytes())
    }

    /// Reads the file of a candidate's policy.
    fn policy_file(&self, candidate: u32) -> Result<Vec<u8>, SessionError> {
        let path = self.policy_path(candidate);
        let bytes = self.folder.disk().read(&path, MAX_POLICY_BYTES);
        bytes.map_err(|error| SessionError::PolicyLost { path, reason: error.to_string() })
    }

    /// Checks the policies of all trained candidates, each of which may drive the Qube again. Does
    /// nothing if the session is complete.
    pub(super) fn check_policies(&self) -> Result<(), SessionError> {
        if self.next_step() == Step::Done {
            return Ok(());
        }
        let candidates = self.ledger.state().candidates().iter();
        candidates.filter(|it| it.trained).try_for_each(|it| self.policy(it.number).map(drop))
    }
}
