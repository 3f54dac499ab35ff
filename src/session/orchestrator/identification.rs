//! Identifies the Qube from the session's recordings and decides whether the search around it
//! continues.

use super::Session;
use super::proposals::Proposal;
use super::rollouts::SessionRig;
use crate::identification::{FitData, FittedProfile, ProfileFit, excitation_after, fit_profile};
use crate::policy::{Excitation, Policy};
use crate::qube::Profile;
use crate::recording::read_on;
use crate::session::decision::{Decision, decide};
use crate::session::settings::INITIAL_AROUND;
use crate::session::{
    Entry, FolderError, GainSource, Identification, Purpose, ScoredCandidate, SessionError,
    SessionEvent, StoredProfile, identified_profile,
};
use crate::storage::{checksum_of, write_whole};

/// Recordings of a session, by candidate and rollout.
type SessionFitData = FitData<(u32, u32)>;

impl Session {
    /// Guards an emulated Qube as an unidentified one if the session will identify it, because
    /// before its identification a real Qube is unknown, too.
    pub(super) fn guard_as_unknown(&mut self) {
        if self.settings.identification.is_some() {
            self.rigs[0].settings.unidentified = true;
        }
    }

    /// Takes over the settings of the search around the identified Qube, and guards the Qube by its
    /// latest profile. Does nothing before an identification.
    pub(super) fn search_around_identified(&mut self) -> Result<(), SessionError> {
        let Identification::Found { profiles, .. } = self.ledger.state().identification() else {
            return Ok(());
        };
        let (Some(first), Some(latest)) = (profiles.first(), profiles.last()) else {
            return Ok(());
        };
        let (first, latest) = (self.profile_of(first)?, self.profile_of(latest)?);
        let plan = self.settings.identification.unwrap_or_default();
        self.settings = self.settings.clone().around(&plan, &first, &latest);
        // The profile of a real Qube holds for one board only. In virtual time each rollout has a
        // board of its own.
        let settings = &self.rigs[0].settings;
        if settings.is_hardware() && settings.board.is_none() {
            self.rigs[0].settings.board = self.board(None)?;
        }
        let SessionRig { settings, opened, .. } = &mut self.rigs[0];
        settings.profile = Some(latest);
        if let Some(rig) = opened {
            rig.use_profile_of(settings);
        }
        Ok(())
    }

    /// The excitation of a candidate, chosen by the recordings so far ([`excitation_after`]).
    pub(super) fn excitation(&self, candidate: u32) -> Result<Excitation, SessionError> {
        let plant = self.settings.plant();
        let of_qube_v = self.settings.identification.unwrap_or_default().excitation_v;
        let limit_v = plant.volts_like(of_qube_v);
        let profile = match self.fitted(&self.fit_data()?) {
            ProfileFit::Found(found) => Some(found.profile),
            ProfileFit::Unfit(_) | ProfileFit::Refused(_) => None,
        };
        Ok(excitation_after(profile.as_ref(), plant, limit_v, candidate))
    }

    /// Identifies the Qube from its excitations, and after the search once more, also from the
    /// recordings of search and verification.
    pub(super) fn identify(
        &mut self,
        on_event: &mut dyn FnMut(SessionEvent),
    ) -> Result<(), SessionError> {
        if self.ledger.state().gain_at_end().is_some() {
            return self.use_verification(on_event);
        }
        let data = self.fit_data_reported(on_event)?;
        match self.fitted(&data) {
            ProfileFit::Found(found) => self.append_profile(*found, on_event),
            ProfileFit::Unfit(reason) if self.may_excite_again() => {
                on_event(SessionEvent::ExcitationRepeated(&reason));
                self.append_proposal(Proposal::of(Purpose::Excitation, Vec::new()), on_event)
            }
            ProfileFit::Unfit(reason) | ProfileFit::Refused(reason) => {
                self.ledger.append(Entry::NotIdentified { reason: reason.clone() })?;
                on_event(SessionEvent::NotIdentified(&reason));
                Ok(())
            }
        }
    }

    /// Updates the profile with the recordings of the verification. The search is over by then, so
    /// these recordings improve the guard, the report and the profile for later use, but do not
    /// influence the search.
    fn use_verification(
        &mut self,
        on_event: &mut dyn FnMut(SessionEvent),
    ) -> Result<(), SessionError> {
        let data = self.fit_data_reported(on_event)?;
        let reason = if data.usable() > self.ledger.state().identification().fitted_recordings() {
            match self.fitted(&data) {
                ProfileFit::Found(found) => return self.append_profile(*found, on_event),
                ProfileFit::Unfit(reason) | ProfileFit::Refused(reason) => reason,
            }
        } else {
            "none of its recordings can be fitted".to_owned()
        };
        self.ledger.append(Entry::NotUpdated { recordings: None, reason: reason.clone() })?;
        on_event(SessionEvent::NotUpdated(&reason));
        Ok(())
    }

    /// Fits the Qube anew during the search, if more recordings can be fitted than in any fit so
    /// far, and enters the profile, or the reason why there is none, into the ledger.
    fn refit(&mut self, on_event: &mut dyn FnMut(SessionEvent)) -> Result<Refit, SessionError> {
        let data = self.fit_data_reported(on_event)?;
        let recordings = data.usable();
        if recordings <= self.ledger.state().identification().fitted_recordings() {
            return Ok(Refit::NothingNew);
        }
        match self.fitted(&data) {
            ProfileFit::Found(found) => {
                self.append_profile(*found, on_event)?;
                Ok(Refit::Found)
            }
            ProfileFit::Unfit(reason) | ProfileFit::Refused(reason) => {
                let entry =
                    Entry::NotUpdated { recordings: Some(recordings), reason: reason.clone() };
                self.ledger.append(entry)?;
                on_event(SessionEvent::RefitFailed { recordings, reason: &reason });
                Ok(Refit::Failed(reason))
            }
        }
    }

    /// Returns whether another excitation may be recorded, after excitations that cannot be fitted
    /// or after the Qube contradicted its profile. A session may record as many extra excitations
    /// in all as it may repeat a void rollout.
    fn may_excite_again(&self) -> bool {
        let planned = self.settings.identification.unwrap_or_default().excitations;
        let made = self.ledger.state().count_of(Purpose::Excitation);
        made < planned + self.settings.extent.repetitions
    }

    /// Decides how the search around the identified Qube continues, and appends the next proposal
    /// or the end of the search. Before a proposal it may fit the Qube anew.
    pub(super) fn decide(
        &mut self,
        on_event: &mut dyn FnMut(SessionEvent),
    ) -> Result<(), SessionError> {
        let plan = self.settings.identification.unwrap_or_default();
        let scored = self.scored_candidates()?;
        let decision = decide(&scored, plan.candidates);
        let source = GainSource::of(&scored);
        let drives = matches!(decision, Decision::Propose | Decision::Verify { .. });
        let is_contradicted = drives && self.has_contradicted_profile();
        if is_contradicted && self.fits_or_excites_again(on_event)? {
            return Ok(());
        }
        match decision {
            // The fit was just tried.
            Decision::Propose if is_contradicted => self.propose_next(on_event),
            Decision::Propose => self.propose_around(on_event),
            Decision::Verify { candidate } => {
                let incumbent = &self.ledger.state().candidates()[candidate as usize];
                self.append_proposal(Proposal::again(incumbent), on_event)
            }
            Decision::EndBelow { verification, smallest_gain } => {
                let verification = &scored[verification as usize];
                let quietness = &verification.quietness;
                if let Some(figures) = quietness.figures().filter(|_| quietness.is_loud()) {
                    on_event(SessionEvent::TooLoud(figures));
                    return self.propose_around(on_event);
                }
                let expected_gain = self.expected_gain(&scored, Some(verification))?;
                if expected_gain < smallest_gain {
                    return self.end_search(expected_gain, source, on_event);
                }
                let continues =
                    SessionEvent::SearchContinues { expected_gain, source, smallest_gain };
                on_event(continues);
                self.propose_around(on_event)
            }
            Decision::End => {
                let verification =
                    ScoredCandidate::best_verified(&scored).map(|index| &scored[index]);
                let expected_gain = self.expected_gain(&scored, verification)?;
                self.end_search(expected_gain, source, on_event)
            }
        }
    }

    /// Fits the Qube anew after it has contradicted its profile. If the fit gives no new profile,
    /// proposes another excitation if one may be recorded. Returns whether it proposed one. Under a
    /// profile that is not trusted, the guard would treat the Qube as unidentified and end nearly
    /// every swing-up.
    fn fits_or_excites_again(
        &mut self,
        on_event: &mut dyn FnMut(SessionEvent),
    ) -> Result<bool, SessionError> {
        let cause = match self.refit(on_event)? {
            Refit::Found => return Ok(false),
            Refit::Failed(reason) => reason,
            Refit::NothingNew => "no new recording can be fitted".to_owned(),
        };
        if !self.may_excite_again() {
            return Ok(false);
        }
        let reason = format!("the Qube has moved unlike its profile, and {cause}");
        on_event(SessionEvent::ExcitationRepeated(&reason));
        let excitation = Proposal::of(Purpose::Excitation, Vec::new());
        self.append_proposal(excitation, on_event).map(|()| true)
    }

    fn end_search(
        &mut self,
        expected_gain: f64,
        source: GainSource,
        on_event: &mut dyn FnMut(SessionEvent),
    ) -> Result<(), SessionError> {
        self.ledger.append(Entry::SearchEnded { expected_gain })?;
        on_event(SessionEvent::SearchEnded { expected_gain, source });
        Ok(())
    }

    /// Updates the profile with the recordings so far, unless nothing has been searched yet or no
    /// further recording can be fitted, and proposes the next candidate.
    fn propose_around(
        &mut self,
        on_event: &mut dyn FnMut(SessionEvent),
    ) -> Result<(), SessionError> {
        if self.ledger.state().searched().next().is_some() {
            self.refit(on_event)?;
        }
        self.propose_next(on_event)
    }

    /// Proposes a candidate: first the distribution exactly as identified, then points of the
    /// search around the identified Qube.
    fn propose_next(&mut self, on_event: &mut dyn FnMut(SessionEvent)) -> Result<(), SessionError> {
        if self.ledger.state().searched().next().is_none() {
            let psi = self.settings.psi.as_identified();
            return self.append_proposal(Proposal::of(Purpose::Initial, psi), on_event);
        }
        // An initial point counts once a policy that was trained at it has run.
        let observations = self.observations()?;
        let is_initial = (observations.len() as u32) < INITIAL_AROUND;
        let purpose = if is_initial { Purpose::Initial } else { Purpose::Search };
        let strategy = self.settings.search()?;
        let skipped = self.points_without_observation()?;
        let psi = strategy.propose(&observations, &skipped, 1)?.remove(0);
        self.append_proposal(Proposal::of(purpose, psi), on_event)
    }

    /// The return that one more candidate is expected to gain, at least 0, by which the search
    /// decides whether to go on.
    ///
    /// Once there are [`INITIAL_AROUND`] observations, it is the surrogate's largest expected
    /// improvement: over the best of the evaluated psi, or over the verified return if the verified
    /// policy was trained without psi. Before, it is a difference of means, which ignores how
    /// uncertain these are: the highest mean return of a candidate's policy in simulations of the
    /// identified Qube, other than those in which the policy was chosen, minus the verified return.
    /// This assumes that another candidate may regain the loss from simulation to reality; a policy
    /// that no candidate has found yet may gain more.
    fn expected_gain(
        &mut self,
        scored: &[ScoredCandidate],
        verification: Option<&ScoredCandidate>,
    ) -> Result<f64, SessionError> {
        let verified = verification.and_then(ScoredCandidate::mean_return).unwrap_or(0.0);
        let observations = self.observations()?;
        if observations.len() as u32 >= INITIAL_AROUND {
            let is_without_psi = verification.is_some_and(|it| it.model_without_psi.is_some());
            let known = is_without_psi.then_some(verified);
            return Ok(self
                .settings
                .bayesian_search()?
                .expected_improvement(&observations, known)?);
        }
        let mut simulated = 0.0_f64;
        for it in scored.iter().filter(|it| it.candidate.purpose.is_searched()) {
            let number = it.candidate.number;
            if let Ok(Policy::Network(policy)) = Policy::from_bytes(&self.policy(number)?) {
                let evaluation = self.trainer().simulated_afresh(number, &policy.network)?;
                simulated = simulated.max(evaluation.mean_return());
            }
        }
        Ok((simulated - verified).max(0.0))
    }

    /// Reads the recordings so far that identify the Qube: of excitations and of the search's
    /// candidates, and after the end of the search also of the verification.
    fn fit_data(&self) -> Result<SessionFitData, SessionError> {
        let mut data = SessionFitData::default();
        let state = self.ledger.state();
        let is_used = |purpose: Purpose| {
            purpose.informs() || (state.gain_at_end().is_some() && purpose.verifies())
        };
        for candidate in state.candidates().iter().filter(|it| is_used(it.purpose)) {
            for finished in &candidate.finished {
                let path = self.recording(finished.of_candidate(candidate.number));
                let recording = read_on(self.folder.disk(), &path)?;
                let rollout = recording.header.rollout;
                data.add(&recording, (candidate.number, rollout));
            }
        }
        Ok(data)
    }

    /// Reads the recordings that identify the Qube, and reports once each recording that cannot be
    /// fitted.
    fn fit_data_reported(
        &mut self,
        on_event: &mut dyn FnMut(SessionEvent),
    ) -> Result<SessionFitData, SessionError> {
        let data = self.fit_data()?;
        for it in &data.left_out {
            let (candidate, rollout) = it.name;
            if self.reported_left_out.insert((candidate, rollout)) {
                let reason = it.reason();
                on_event(SessionEvent::RecordingLeftOut { candidate, rollout, reason: &reason });
            }
        }
        Ok(data)
    }

    /// Fits a profile to recordings.
    fn fitted(&self, data: &SessionFitData) -> ProfileFit {
        fit_profile(data, self.settings.plant(), "identified")
    }

    fn append_profile(
        &mut self,
        found: FittedProfile,
        on_event: &mut dyn FnMut(SessionEvent),
    ) -> Result<(), SessionError> {
        let FittedProfile { profile, recordings, verdict, missing_effects } = found;
        let path = self.folder.paths().profile(recordings);
        let io = |error: toml::ser::Error| FolderError::Io {
            path: path.clone(),
            source: std::io::Error::other(error),
        };
        let text = toml::to_string_pretty(&profile).map_err(io)?;
        write_whole(self.folder.disk(), &path, text.as_bytes())?;
        let verdict = verdict.name().to_owned();
        let checksum = checksum_of(text.as_bytes());
        let named = missing_effects.clone();
        self.ledger.append(Entry::Identified { recordings, verdict, missing_effects, checksum })?;
        on_event(SessionEvent::Identified { recordings, missing_effects: &named });
        self.search_around_identified()
    }

    /// The latest profile; `None` if the Qube is not identified.
    ///
    /// # Errors
    /// The profile cannot be read or was changed.
    pub fn latest_profile(&self) -> Result<Option<Profile>, SessionError> {
        match self.ledger.state().identification() {
            Identification::Found { profiles, .. } => {
                profiles.last().map(|latest| self.profile_of(latest)).transpose()
            }
            _ => Ok(None),
        }
    }

    /// Reads a profile from the session's folder and checks it against the ledger.
    fn profile_of(&self, found: &StoredProfile) -> Result<Profile, SessionError> {
        identified_profile(self.folder.disk(), self.folder.paths(), found)
    }
}

/// The result of fitting the Qube anew during the search.
enum Refit {
    /// There is a new profile.
    Found,
    /// The latest profile stays and is questionable, for this reason.
    Failed(String),
    /// The latest profile stays: each recording that can be fitted was in an earlier fit.
    NothingNew,
}
