use thiserror::Error;

use super::{AttemptId, Entry, Purpose, RolloutAttempt};

/// A candidate of a session, as the ledger's entries describe it.
#[derive(Clone, Debug, PartialEq)]
pub struct Candidate {
    /// Number of the candidate, from 0.
    pub number: u32,
    /// Reason of its proposal.
    pub purpose: Purpose,
    /// Point of the search space: its psi's values, in the order of the space's dimensions
    /// ([`crate::simulation::PsiSpace::psi`]). It is empty for an excitation and the baseline.
    pub point: Vec<f64>,
    /// True once its policy is on disk.
    pub trained: bool,
    /// Checksum of its policy's file; `None` before its training, and in ledgers of older programs.
    pub policy_checksum: Option<String>,
    /// Finished rollouts in order.
    pub finished: Vec<Finished>,
    /// Number of attempts at the current rollout that are void.
    pub void: u32,
    /// Number of void attempts at the current rollout before the last rig was taken out. They do
    /// not count towards the allowed repetitions.
    pub void_before: u32,
    /// Number of the searched candidate whose policy it runs again; `None` if it has a policy of
    /// its own, or if an older program proposed it.
    pub policy_of: Option<u32>,
    /// Number of recordings of the latest profile when it was proposed; `None` if the Qube was not
    /// identified then.
    pub identified_from: Option<u32>,
}

impl Candidate {
    /// Number of void attempts at all its rollouts.
    #[must_use]
    pub fn all_void(&self) -> u64 {
        let repeated = self.finished.iter().map(|it| u64::from(it.attempt));
        repeated.sum::<u64>() + u64::from(self.void)
    }

    /// Returns whether this candidate runs the policy of `other` again, to verify it. An older
    /// program's ledger does not name the other candidate, which is then recognised by the point
    /// that both share.
    #[must_use]
    pub fn runs_policy_of(&self, other: &Self) -> bool {
        let is_same = match self.policy_of {
            Some(number) => number == other.number,
            None => self.point == other.point,
        };
        self.purpose == Purpose::Incumbent && other.purpose.is_searched() && is_same
    }
}

/// A rollout that has a result.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Finished {
    /// Number of the rollout among the candidate's rollouts, from 0.
    pub rollout: u32,
    /// Number of the attempt that has the result, from 0.
    pub attempt: u32,
    /// Number of the rig that made the rollout, from 1; `None` if the session has a single rig.
    pub rig: Option<u32>,
}

impl Finished {
    /// The attempt that has the result, without the number of the candidate.
    #[must_use]
    pub fn of_policy(&self) -> RolloutAttempt {
        RolloutAttempt { rollout: self.rollout, attempt: self.attempt }
    }

    /// The attempt that has the result; `candidate` is the number of the candidate.
    #[must_use]
    pub fn of_candidate(&self, candidate: u32) -> AttemptId {
        AttemptId { candidate, rollout: self.rollout, attempt: self.attempt }
    }
}

/// A profile that a session identified, as a file in its folder.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct StoredProfile {
    /// Number of recordings that it was fitted to.
    pub recordings: u32,
    /// Checksum of its file.
    pub checksum: String,
}

/// A rig that was taken out of a session.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TakenOutRig {
    /// Number of the rig, from 1.
    pub rig: u32,
    /// Fault for which it was taken out.
    pub reason: String,
}

/// A fit that used more recordings than the latest profile and gave no new profile.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FailedRefit {
    /// Number of its recordings.
    pub recordings: u32,
    /// Reason, as a text for the operator.
    pub reason: String,
}

/// The state of a session's identification of its Qube.
#[derive(Clone, Debug, Default, PartialEq)]
pub enum Identification {
    /// The Qube is not identified yet, or the session does not identify it.
    #[default]
    None,
    /// The Qube is identified.
    Found {
        /// Number of recordings that its latest profile was fitted to.
        recordings: u32,
        /// Verdict of that fit, by name.
        verdict: String,
        /// Names of the effects that the model lacks according to the verdict.
        missing_effects: Vec<String>,
        /// Profiles in the order in which they were found. Psi shifts the simulations along
        /// directions of the errors of the first profile.
        profiles: Vec<StoredProfile>,
        /// The latest fit, if it was made during the search and gave no new profile.
        failed_refit: Option<FailedRefit>,
    },
    /// The recordings identify no Qube, for this reason.
    Refused(String),
}

impl Identification {
    /// Returns whether the Qube is identified and its profile is questionable: the verdict on its
    /// fit names effects that the model lacks, or a later fit to more recordings failed.
    #[must_use]
    pub fn is_questionable(&self) -> bool {
        match self {
            Self::Found { missing_effects, failed_refit, .. } => {
                !missing_effects.is_empty() || failed_refit.is_some()
            }
            Self::None | Self::Refused(_) => false,
        }
    }

    /// The profiles in the order in which they were found; none if the Qube is not identified.
    #[must_use]
    pub fn profiles(&self) -> &[StoredProfile] {
        match self {
            Self::Found { profiles, .. } => profiles,
            Self::None | Self::Refused(_) => &[],
        }
    }

    /// Largest number of recordings that a profile was fitted to, whether the fit succeeded or not;
    /// 0 if the Qube is not identified.
    #[must_use]
    pub fn fitted_recordings(&self) -> u32 {
        match self {
            Self::Found { recordings, failed_refit, .. } => {
                failed_refit.as_ref().map_or(*recordings, |failed| failed.recordings)
            }
            Self::None | Self::Refused(_) => 0,
        }
    }
}

/// The reason why an entry cannot follow the earlier ones.
#[derive(Clone, Copy, Debug, Error, PartialEq, Eq)]
pub enum EntryError {
    /// The entry names rig 0.
    #[error("rigs are numbered from 1")]
    RigZero,
    /// A session begins after its first entry.
    #[error("a session begins in the first line")]
    BegunLater,
    /// A candidate does not have the next number.
    #[error("candidates are not numbered in their order")]
    CandidateNumber,
    /// A candidate counts as pending and is none of the search's, or has a return already.
    #[error("a pending candidate is not a candidate of the search or has returns")]
    NotPending,
    /// A candidate that is not of the purpose `Incumbent` runs another's policy, or the other is
    /// none of the search's candidates.
    #[error("the candidate cannot run the policy of that candidate")]
    PolicyOfNone,
    /// A candidate was not proposed.
    #[error("there is no such candidate")]
    NoSuchCandidate,
    /// A candidate is trained twice.
    #[error("the candidate is trained already")]
    TrainedAlready,
    /// A rollout or an attempt is out of order, or precedes the training.
    #[error("this is not the rollout or the attempt that was due")]
    NotDue,
    /// An identification adds no recordings to the last fit, or follows a refused identification.
    #[error("the Qube cannot be identified from these recordings now")]
    IdentifiedAlready,
    /// An identification is refused after it was decided.
    #[error("the identification of the Qube is decided already")]
    IdentificationDecided,
    /// The verification precedes the end of the search, or was used already.
    #[error("the verification cannot update the profile now")]
    NoUpdateDue,
    /// A search ends twice.
    #[error("the search has ended already")]
    SearchEndedAlready,
    /// A rig is taken out twice.
    #[error("the rig is taken out already")]
    TakenOutAlready,
    /// A failed fit to these recordings is not due.
    #[error("these recordings cannot update the profile now")]
    RecordingsNotDue,
}

/// An attempt at a rollout that is void: a fault ended it, or its recording lacks ticks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct VoidAttempt {
    /// Numbers of its candidate, of the rollout and of the attempt.
    pub attempt: AttemptId,
    /// Number of the rig that made it, from 1; `None` if the session has a single rig.
    pub rig: Option<u32>,
}

/// The end of the search around an identified Qube, as the ledger describes it.
#[derive(Clone, Copy, Debug, PartialEq)]
struct RecordedEnd {
    /// Gain in return that one more candidate was expected to bring.
    expected_gain: f64,
    /// Number of recordings of the latest profile at the end, if there was one.
    profile: Option<u32>,
}

/// The state of a session: the result of applying the ledger's entries one after the other.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SessionState {
    entries: usize,
    candidates: Vec<Candidate>,
    identification: Identification,
    search_end: Option<RecordedEnd>,
    verification_is_used: bool,
    /// Reason why the recordings of the verification left the profile as it was, if they did.
    unchanged_by_verification: Option<String>,
    /// Rollouts with a result since the latest profile was found, or since the beginning.
    finished_since_profile: Vec<AttemptId>,
    last_void: Option<VoidAttempt>,
    taken_out: Vec<TakenOutRig>,
}

impl SessionState {
    /// The state after these entries.
    ///
    /// # Errors
    /// An entry cannot follow the earlier ones.
    pub fn of<'a>(entries: impl IntoIterator<Item = &'a Entry>) -> Result<Self, EntryError> {
        let mut state = Self::default();
        entries.into_iter().try_for_each(|entry| state.apply(entry))?;
        Ok(state)
    }

    /// All candidates in the order of their numbers.
    #[must_use]
    pub fn candidates(&self) -> &[Candidate] {
        &self.candidates
    }

    /// The candidates whose psi the search evaluates: the initial and the proposed ones.
    pub fn searched(&self) -> impl Iterator<Item = &Candidate> {
        self.candidates.iter().filter(|candidate| candidate.purpose.is_searched())
    }

    /// The candidates of the search that have fewer finished rollouts than `rollouts`.
    pub fn awaited(&self, rollouts: u32) -> impl Iterator<Item = &Candidate> {
        self.searched().filter(move |candidate| candidate.finished.len() < rollouts as usize)
    }

    /// Number of candidates with this purpose.
    #[must_use]
    pub fn count_of(&self, purpose: Purpose) -> u32 {
        self.candidates.iter().filter(|candidate| candidate.purpose == purpose).count() as u32
    }

    /// The state of the identification.
    #[must_use]
    pub fn identification(&self) -> &Identification {
        &self.identification
    }

    /// The gain in return that one more candidate was expected to bring when the search around an
    /// identified Qube ended; `None` before its end and for other searches.
    #[must_use]
    pub fn gain_at_end(&self) -> Option<f64> {
        self.search_end.map(|end| end.expected_gain)
    }

    /// Number of recordings of the latest profile; `None` if the Qube is not identified.
    #[must_use]
    pub fn latest_profile(&self) -> Option<u32> {
        self.identification.profiles().last().map(|profile| profile.recordings)
    }

    /// Number of recordings of the last profile that was found before the search ended, or so far
    /// if it has not ended; `None` if there is none. The recordings of the verification did not
    /// inform this profile.
    #[must_use]
    pub fn profile_before_end(&self) -> Option<u32> {
        self.search_end.map_or_else(|| self.latest_profile(), |end| end.profile)
    }

    /// Returns whether the session has used the recordings of the verification: they have led to
    /// the last profile, or left the profile as it was.
    #[must_use]
    pub fn verification_is_used(&self) -> bool {
        self.verification_is_used
    }

    /// The reason why the recordings of the verification left the profile as it was; `None` if they
    /// changed it, or are not used yet.
    #[must_use]
    pub fn unchanged_by_verification(&self) -> Option<&str> {
        self.unchanged_by_verification.as_deref()
    }

    /// The rollouts with a result since the latest profile was found, or since the beginning if the
    /// Qube is not identified.
    #[must_use]
    pub fn finished_since_profile(&self) -> &[AttemptId] {
        &self.finished_since_profile
    }

    /// The attempt that the last entry names as void; `None` if the last entry is of another kind.
    #[must_use]
    pub fn last_void(&self) -> Option<VoidAttempt> {
        self.last_void
    }

    /// The rigs that were taken out, in the order of these events.
    #[must_use]
    pub fn taken_out(&self) -> &[TakenOutRig] {
        &self.taken_out
    }

    /// Returns whether the rig with this number was taken out.
    #[must_use]
    pub fn is_taken_out(&self, rig: u32) -> bool {
        self.taken_out.iter().any(|out| out.rig == rig)
    }

    /// Applies the next entry. An entry that cannot follow the earlier ones changes nothing.
    ///
    /// # Errors
    /// The entry cannot follow the earlier ones.
    pub fn apply(&mut self, entry: &Entry) -> Result<(), EntryError> {
        if entry.rig() == Some(0) {
            return Err(EntryError::RigZero);
        }
        match *entry {
            Entry::Begun { .. } if self.entries > 0 => return Err(EntryError::BegunLater),
            Entry::Begun { .. } => {}
            Entry::Proposed { candidate, purpose, ref point, ref pending, policy_of } => {
                self.check_proposal(candidate, purpose, pending, policy_of)?;
                self.candidates.push(Candidate {
                    number: candidate,
                    purpose,
                    point: point.clone(),
                    trained: false,
                    policy_checksum: None,
                    finished: Vec::new(),
                    void: 0,
                    void_before: 0,
                    policy_of,
                    identified_from: self.latest_profile(),
                });
            }
            Entry::Trained { candidate, ref checksum } => {
                let candidate = self.candidate(candidate)?;
                if candidate.trained {
                    return Err(EntryError::TrainedAlready);
                }
                candidate.trained = true;
                candidate.policy_checksum.clone_from(checksum);
            }
            Entry::RolloutFinished { candidate, rollout, attempt, rig } => {
                let id = AttemptId { candidate, rollout, attempt };
                let candidate = self.candidate_due(id)?;
                candidate.finished.push(Finished { rollout, attempt, rig });
                (candidate.void, candidate.void_before) = (0, 0);
                self.finished_since_profile.push(id);
            }
            Entry::Identified { recordings, ref verdict, ref missing_effects, ref checksum } => {
                let mut profiles = self.profiles_before(recordings)?.to_vec();
                profiles.push(StoredProfile { recordings, checksum: checksum.clone() });
                self.identification = Identification::Found {
                    recordings,
                    verdict: verdict.clone(),
                    missing_effects: missing_effects.clone(),
                    profiles,
                    failed_refit: None,
                };
                self.verification_is_used = self.search_end.is_some();
                self.finished_since_profile.clear();
            }
            Entry::NotUpdated { recordings: Some(recordings), ref reason } => {
                let is_due = self.search_end.is_none()
                    && recordings > self.identification.fitted_recordings();
                match &mut self.identification {
                    Identification::Found { failed_refit, .. } if is_due => {
                        *failed_refit = Some(FailedRefit { recordings, reason: reason.clone() });
                    }
                    _ => return Err(EntryError::RecordingsNotDue),
                }
            }
            Entry::NotUpdated { recordings: None, ref reason } => {
                if self.search_end.is_none() || self.verification_is_used {
                    return Err(EntryError::NoUpdateDue);
                }
                self.verification_is_used = true;
                self.unchanged_by_verification = Some(reason.clone());
            }
            Entry::NotIdentified { ref reason } => {
                if self.identification != Identification::None {
                    return Err(EntryError::IdentificationDecided);
                }
                self.identification = Identification::Refused(reason.clone());
            }
            Entry::SearchEnded { expected_gain } => {
                if self.search_end.is_some() {
                    return Err(EntryError::SearchEndedAlready);
                }
                let profile = self.latest_profile();
                self.search_end = Some(RecordedEnd { expected_gain, profile });
            }
            Entry::RolloutVoid { candidate, rollout, attempt, .. } => {
                self.candidate_due(AttemptId { candidate, rollout, attempt })?.void += 1;
            }
            Entry::RigTakenOut { rig, ref reason } => {
                if self.is_taken_out(rig) {
                    return Err(EntryError::TakenOutAlready);
                }
                self.taken_out.push(TakenOutRig { rig, reason: reason.clone() });
                self.candidates.iter_mut().for_each(|it| it.void_before = it.void);
            }
        }
        self.last_void = match *entry {
            Entry::RolloutVoid { candidate, rollout, attempt, rig } => {
                Some(VoidAttempt { attempt: AttemptId { candidate, rollout, attempt }, rig })
            }
            _ => None,
        };
        self.entries += 1;
        Ok(())
    }

    /// Checks that a candidate can be proposed.
    fn check_proposal(
        &self,
        candidate: u32,
        purpose: Purpose,
        pending: &[u32],
        policy_of: Option<u32>,
    ) -> Result<(), EntryError> {
        if candidate as usize != self.candidates.len() {
            return Err(EntryError::CandidateNumber);
        }
        let searched = |number: u32| {
            self.candidates.get(number as usize).filter(|it| it.purpose.is_searched())
        };
        let is_awaited = |number: &u32| searched(*number).is_some_and(|it| it.finished.is_empty());
        if !pending.iter().all(is_awaited) {
            return Err(EntryError::NotPending);
        }
        let is_wrong = |it: u32| purpose != Purpose::Incumbent || searched(it).is_none();
        if policy_of.is_some_and(is_wrong) {
            return Err(EntryError::PolicyOfNone);
        }
        Ok(())
    }

    /// The profiles that were identified from fewer recordings than these.
    fn profiles_before(&self, recordings: u32) -> Result<&[StoredProfile], EntryError> {
        match &self.identification {
            Identification::None => Ok(&[]),
            Identification::Found { profiles, .. }
                if recordings > self.identification.fitted_recordings() =>
            {
                Ok(profiles)
            }
            _ => Err(EntryError::IdentifiedAlready),
        }
    }

    fn candidate(&mut self, number: u32) -> Result<&mut Candidate, EntryError> {
        self.candidates.get_mut(number as usize).ok_or(EntryError::NoSuchCandidate)
    }

    /// The candidate of this attempt, if the attempt is due next.
    fn candidate_due(&mut self, attempt: AttemptId) -> Result<&mut Candidate, EntryError> {
        let candidate = self.candidate(attempt.candidate)?;
        let due =
            RolloutAttempt { rollout: candidate.finished.len() as u32, attempt: candidate.void };
        if candidate.trained && attempt.of_policy() == due {
            Ok(candidate)
        } else {
            Err(EntryError::NotDue)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn identified(recordings: u32, missing_effects: &[&str]) -> Entry {
        Entry::Identified {
            recordings,
            verdict: "fits".into(),
            missing_effects: missing_effects.iter().map(ToString::to_string).collect(),
            checksum: String::new(),
        }
    }

    fn failed(recordings: u32) -> Entry {
        Entry::NotUpdated { recordings: Some(recordings), reason: "it does not fit".into() }
    }

    #[test]
    fn a_failed_fit_leaves_the_profile_in_doubt_until_another_fit_succeeds() {
        let known = |entries: &[Entry]| SessionState::of(entries).map(|it| it.identification);
        let mut entries = vec![identified(1, &[])];
        assert!(!known(&entries).unwrap().is_questionable());
        entries.push(failed(3));
        let doubted = known(&entries).unwrap();
        assert!(doubted.is_questionable());
        assert_eq!(doubted.fitted_recordings(), 3);
        // A resumed session does not fit the same recordings again.
        assert!(known(&[&entries[..], &[failed(3)]].concat()).is_err());
        entries.push(identified(4, &[]));
        assert!(!known(&entries).unwrap().is_questionable());
        entries.push(identified(5, &["play"]));
        assert!(known(&entries).unwrap().is_questionable());
        // Recordings of the verification are entered without their number.
        entries.push(Entry::SearchEnded { expected_gain: 0.0 });
        assert!(known(&[&entries[..], &[failed(6)]].concat()).is_err());
        let refused = Entry::NotIdentified { reason: "it does not fit".into() };
        assert!(known(&[refused, failed(2)]).is_err() && known(&[failed(1)]).is_err());
    }

    #[test]
    fn the_state_names_the_profile_of_each_proposal_and_of_the_end() {
        let proposed = |candidate| Entry::Proposed {
            candidate,
            purpose: Purpose::Initial,
            point: Vec::new(),
            pending: Vec::new(),
            policy_of: None,
        };
        let mut state = SessionState::of(&[proposed(0), identified(1, &[]), proposed(1)]).unwrap();
        assert_eq!(state.profile_before_end(), Some(1));
        let reason = "it does not fit".to_owned();
        let kept = Entry::NotUpdated { recordings: None, reason: reason.clone() };
        for entry in [identified(3, &[]), proposed(2), Entry::SearchEnded { expected_gain: 0.0 }] {
            state.apply(&entry).unwrap();
        }
        let mut refused = state.clone();
        refused.apply(&kept).unwrap();
        assert_eq!(refused.unchanged_by_verification(), Some(reason.as_str()));
        state.apply(&identified(5, &[])).unwrap();
        assert_eq!(state.unchanged_by_verification(), None);
        assert_eq!((state.profile_before_end(), state.latest_profile()), (Some(3), Some(5)));
        let at_proposal: Vec<_> = state.candidates().iter().map(|it| it.identified_from).collect();
        assert_eq!(at_proposal, [None, Some(1), Some(3)]);
    }

    #[test]
    fn the_state_names_the_last_void_attempt_and_the_results_since_the_profile() {
        let (candidate, rollout, rig) = (0, 0, Some(2));
        let proposed = Entry::Proposed {
            candidate,
            purpose: Purpose::Initial,
            point: Vec::new(),
            pending: Vec::new(),
            policy_of: None,
        };
        let void = Entry::RolloutVoid { candidate, rollout, attempt: 0, rig };
        let mut state = SessionState::of(&[
            proposed,
            Entry::Trained { candidate, checksum: None },
            void.clone(),
        ])
        .unwrap();
        let first = AttemptId { candidate, rollout, attempt: 0 };
        assert_eq!(state.last_void(), Some(VoidAttempt { attempt: first, rig }));
        // An entry that is refused changes nothing.
        assert!(state.apply(&void).is_err() && state.last_void().is_some());
        state.apply(&Entry::RolloutFinished { candidate, rollout, attempt: 1, rig }).unwrap();
        assert_eq!(state.last_void(), None);
        assert_eq!(state.candidates()[0].all_void(), 1);
        assert_eq!(state.finished_since_profile(), [AttemptId { attempt: 1, ..first }]);
        state.apply(&identified(1, &[])).unwrap();
        assert!(state.finished_since_profile().is_empty());
    }
}
