//! Computes the next step of a session from its settings and the ledger's state alone, so that a
//! session that was killed at any instant continues exactly where it stopped.

use super::{Candidate, Extent, Identification, IdentificationSettings, Purpose, SessionState};

/// The numbers of a session's candidates: so far and at most.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CandidateCounts {
    /// Number of candidates of the search so far: initial points, and points that it has proposed.
    pub searched: u32,
    /// Largest number of candidates of the search.
    pub most_searched: u32,
    /// Number of all candidates at the end of the session; `None` if the session identifies its
    /// Qube, because the search may then end early and verify more than one policy.
    pub total: Option<u32>,
}

/// A step of the session.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Step {
    /// Propose new candidates.
    Propose {
        /// Number of candidates to propose.
        count: u32,
        /// Reason of the proposal.
        purpose: Purpose,
    },
    /// Identify the Qube: first from the recordings of its excitations, and again at the end from
    /// all recordings except the baseline's.
    Identify,
    /// Decide how the search around the identified Qube continues: with another candidate, with the
    /// verification of the best one, or not at all.
    Decide,
    /// Train the policies of these candidates; the trainings do not depend on each other.
    Train {
        /// Numbers of the candidates.
        candidates: Vec<u32>,
    },
    /// Run one rollout.
    Rollout {
        /// Number of the candidate.
        candidate: u32,
        /// Number of the rollout.
        rollout: u32,
        /// Number of the attempt, from 0.
        attempt: u32,
    },
    /// Give this rollout up on its rig: more of its attempts were void than `repetitions` allows.
    /// The session stops or, if other rigs share it, goes on without the rig. A process that
    /// resumes the stopped session repeats the rollout as often again.
    GiveUp {
        /// Number of the candidate.
        candidate: u32,
        /// Number of the rollout.
        rollout: u32,
    },
    /// Nothing is left to do.
    Done,
}

/// The next step of a session in this state. A session with `identification` first identifies its
/// Qube. If the identification fails, the session continues as if it had no `identification`.
#[must_use]
pub fn next_step(
    state: &SessionState,
    extent: &Extent,
    identification: Option<&IdentificationSettings>,
) -> Step {
    if trains_ahead(state, extent, identification) {
        return next_step_ahead(state, extent);
    }
    let missing = |purpose, wanted: u32| state.missing(purpose, wanted);
    let identifies = identifying(state, identification);
    // All initial points are proposed in one step, so that their policies can be trained at the
    // same time on all cores. Excitations are proposed one by one, because each is chosen by the
    // recordings of the earlier excitations.
    let together = match identifies {
        Some(_) => None,
        None => missing(Purpose::Initial, extent.initial_candidates),
    };
    if let Some(step) = together.or_else(|| unfinished(state, extent, identifies)) {
        return step;
    }
    let searched = match (identifies, state.identification(), state.gain_at_end()) {
        (Some(plan), Identification::None, _) => {
            let excite = missing(Purpose::Excitation, plan.excitations)
                .map(|_| Step::Propose { count: 1, purpose: Purpose::Excitation });
            excite.or(Some(Step::Identify))
        }
        (Some(_), _, None) => Some(Step::Decide),
        (Some(_), _, Some(_)) => {
            let is_due = !state.verification_is_used() && state.count_of(Purpose::Baseline) == 0;
            is_due.then_some(Step::Identify)
        }
        (None, ..) => (state.count_of(Purpose::Search) < extent.iterations)
            .then_some(Step::Propose { count: 1, purpose: Purpose::Search })
            .or_else(|| missing(Purpose::Verification, 1))
            .or_else(|| missing(Purpose::Incumbent, u32::from(extent.verifies_incumbent))),
    };
    searched
        .or_else(|| missing(Purpose::Baseline, u32::from(extent.baseline)))
        .unwrap_or(Step::Done)
}

/// Returns whether the session trains policies while earlier ones run on the Qube.
#[must_use]
pub fn trains_ahead(
    state: &SessionState,
    extent: &Extent,
    identification: Option<&IdentificationSettings>,
) -> bool {
    extent.pending > 0 && identifying(state, identification).is_none()
}

/// The settings of the identification; `None` if the session has none or its identification has
/// failed.
pub(super) fn identifying<'a>(
    state: &SessionState,
    identification: Option<&'a IdentificationSettings>,
) -> Option<&'a IdentificationSettings> {
    identification.filter(|_| !matches!(state.identification(), Identification::Refused(_)))
}

/// The next step of a search that makes proposals while the returns of earlier candidates are
/// awaited.
///
/// A proposal is due as soon as no more than `extent.pending` candidates lack returns, and comes
/// before the next rollout. The data of a proposal therefore do not depend on how long trainings
/// take, and at that moment every candidate has either all of its rollouts or none. The training of
/// a candidate begins with its proposal. `Step::Train` only means that the first unfinished
/// candidate cannot run before its policy is trained.
fn next_step_ahead(state: &SessionState, extent: &Extent) -> Step {
    if let Some(step) = state.missing(Purpose::Initial, extent.initial_candidates) {
        return step;
    }
    let awaited = state.awaited(extent.rollouts).count() as u32;
    if state.count_of(Purpose::Search) < extent.iterations && awaited <= extent.pending {
        return Step::Propose { count: 1, purpose: Purpose::Search };
    }
    if awaited == 0 {
        // The incumbent comes first: its policy exists and can run while the policy of the
        // recommendation is trained.
        let last = [
            (Purpose::Incumbent, extent.verifies_incumbent),
            (Purpose::Verification, true),
            (Purpose::Baseline, extent.baseline),
        ];
        let missing =
            last.into_iter().find_map(|(purpose, wanted)| state.missing(purpose, wanted.into()));
        if let Some(step) = missing {
            return step;
        }
    }
    state.candidates().iter().find_map(|it| lacking(it, extent, None)).unwrap_or(Step::Done)
}

/// The training of all candidates without a policy, or else the next rollout of the first
/// unfinished candidate, which is given up after too many faults; `None` if all candidates are
/// finished.
fn unfinished(
    state: &SessionState,
    extent: &Extent,
    identifies: Option<&IdentificationSettings>,
) -> Option<Step> {
    let candidates = state.candidates();
    let untrained: Vec<u32> =
        candidates.iter().filter(|it| !it.trained).map(|it| it.number).collect();
    if !untrained.is_empty() {
        return Some(Step::Train { candidates: untrained });
    }
    candidates.iter().find_map(|it| lacking(it, extent, identifies))
}

/// The next step of a candidate: its training, its next rollout, or giving this rollout up after
/// too many void attempts. `None` if the candidate is finished.
fn lacking(
    it: &Candidate,
    extent: &Extent,
    identifies: Option<&IdentificationSettings>,
) -> Option<Step> {
    let wanted = wanted_rollouts(it.purpose, extent, identifies);
    let (candidate, rollout, attempt) = (it.number, it.finished.len() as u32, it.void);
    let given_up = attempt - it.void_before > extent.repetitions;
    if !it.trained {
        return Some(Step::Train { candidates: vec![candidate] });
    }
    (rollout < wanted).then_some(if given_up {
        Step::GiveUp { candidate, rollout }
    } else {
        Step::Rollout { candidate, rollout, attempt }
    })
}

/// Number of rollouts of a candidate with this purpose.
pub(super) fn wanted_rollouts(
    purpose: Purpose,
    extent: &Extent,
    identifies: Option<&IdentificationSettings>,
) -> u32 {
    match (purpose, identifies) {
        (Purpose::Excitation | Purpose::Baseline, _) => 1,
        (Purpose::Verification | Purpose::Incumbent, _) => extent.verification_rollouts,
        (Purpose::Initial | Purpose::Search, Some(plan)) => plan.rollouts,
        (Purpose::Initial | Purpose::Search, None) => extent.rollouts,
    }
}

impl SessionState {
    /// The numbers of the session's candidates: so far and at most.
    #[must_use]
    pub fn candidate_counts(
        &self,
        extent: &Extent,
        identification: Option<&IdentificationSettings>,
    ) -> CandidateCounts {
        let searched = self.count_of(Purpose::Initial) + self.count_of(Purpose::Search);
        if let Some(plan) = identifying(self, identification) {
            return CandidateCounts { searched, most_searched: plan.candidates, total: None };
        }
        let most_searched = extent.initial_candidates + extent.iterations;
        let last = 1 + u32::from(extent.verifies_incumbent) + u32::from(extent.baseline);
        let total = Some(self.count_of(Purpose::Excitation) + most_searched + last);
        CandidateCounts { searched, most_searched, total }
    }

    /// The step that proposes candidates until there are `wanted` with this purpose; `None` if
    /// there are as many already.
    fn missing(&self, purpose: Purpose, wanted: u32) -> Option<Step> {
        let count = wanted.saturating_sub(self.count_of(purpose));
        (count > 0).then_some(Step::Propose { count, purpose })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::MAX_STEPS;
    use crate::session::Entry;

    fn next_step_after(entries: &[Entry], extent: &Extent) -> Step {
        next_step(&SessionState::of(entries).unwrap(), extent, None)
    }

    const EXTENT: Extent = Extent {
        initial_candidates: 3,
        iterations: 2,
        rollouts: 2,
        verification_rollouts: 4,
        verifies_incumbent: true,
        steps: MAX_STEPS as u32,
        repetitions: 3,
        baseline: false,
        pending: 0,
    };

    fn awaited(entries: &[Entry], extent: &Extent) -> Vec<u32> {
        let state = SessionState::of(entries).unwrap();
        state.awaited(extent.rollouts).map(|it| it.number).collect()
    }

    fn session(fault_every: u32) -> Vec<Entry> {
        session_of(&EXTENT, fault_every)
    }

    /// Carries out every step of a session and returns the ledger; every `fault_every`-th rollout
    /// is ended by a fault.
    fn session_of(extent: &Extent, fault_every: u32) -> Vec<Entry> {
        let mut entries: Vec<Entry> = Vec::new();
        let mut tries = 0;
        loop {
            match next_step_after(&entries, extent) {
                Step::Propose { count, purpose } => {
                    for _ in 0..count {
                        let candidate =
                            SessionState::of(&entries).unwrap().candidates().len() as u32;
                        let pending = match purpose {
                            Purpose::Search => awaited(&entries, extent),
                            _ => Vec::new(),
                        };
                        entries.push(Entry::Proposed {
                            candidate,
                            purpose,
                            point: vec![0.0],
                            pending,
                            policy_of: None,
                        });
                    }
                }
                Step::Train { candidates } => {
                    entries.extend(
                        candidates
                            .into_iter()
                            .map(|candidate| Entry::Trained { candidate, checksum: None }),
                    );
                }
                Step::Rollout { candidate, rollout, attempt } => {
                    tries += 1;
                    entries.push(if tries % fault_every == 0 {
                        Entry::RolloutVoid { candidate, rollout, attempt, rig: None }
                    } else {
                        Entry::RolloutFinished { candidate, rollout, attempt, rig: None }
                    });
                }
                Step::GiveUp { .. } => panic!("the session gives a rollout up"),
                Step::Identify | Step::Decide => panic!("the session identifies a Qube"),
                Step::Done => return entries,
            }
        }
    }

    #[test]
    fn every_candidate_gets_its_rollouts_and_the_recommendation_is_verified_last() {
        for fault_every in [2, 5, 1000] {
            let state = SessionState::of(&session(fault_every)).unwrap();
            let candidates = state.candidates();
            assert_eq!(candidates.len(), 7);
            assert!(candidates[..5].iter().all(|it| it.finished.len() == 2));
            assert_eq!(candidates[5].purpose, Purpose::Verification);
            assert_eq!(candidates[6].purpose, Purpose::Incumbent);
            assert!(candidates[5..].iter().all(|it| it.finished.len() == 4));
        }
    }

    #[test]
    fn a_session_that_verifies_no_incumbent_ends_with_the_recommendation() {
        let old: Extent = toml::from_str("initial_candidates = 3\niterations = 2").unwrap();
        assert!(!old.verifies_incumbent);
        let whole = session(1000);
        let incumbent = |entry: &Entry| matches!(entry, Entry::Proposed { candidate: 6, .. });
        let until = whole.iter().position(incumbent).unwrap();
        assert_eq!(
            next_step_after(&whole[..until], &EXTENT),
            Step::Propose { count: 1, purpose: Purpose::Incumbent }
        );
        let without = Extent { verifies_incumbent: false, ..EXTENT };
        assert_eq!(next_step_after(&whole[..until], &without), Step::Done);
    }

    #[test]
    fn a_search_that_awaits_returns_proposes_before_the_next_rollout() {
        for pending in [1, 2, 5] {
            let extent = Extent { iterations: 4, pending, baseline: true, ..EXTENT };
            let entries = session_of(&extent, 1000);
            for (index, entry) in entries.iter().enumerate() {
                let Entry::Proposed { candidate, purpose: Purpose::Search, pending, .. } = entry
                else {
                    continue;
                };
                // No more candidates than allowed lack returns, and none has only some of its
                // rollouts.
                let expected: Vec<u32> =
                    (candidate.saturating_sub(extent.pending)..*candidate).collect();
                assert_eq!(*pending, expected, "pending {}", extent.pending);
                let state = SessionState::of(&entries[..index]).unwrap();
                assert!(state.searched().all(|it| [0, 2].contains(&it.finished.len())));
            }
            let state = SessionState::of(&entries).unwrap();
            let purposes: Vec<Purpose> = state.candidates().iter().map(|it| it.purpose).collect();
            assert_eq!(
                purposes[7..],
                [Purpose::Incumbent, Purpose::Verification, Purpose::Baseline]
            );
            let rollouts: Vec<usize> =
                state.candidates().iter().map(|it| it.finished.len()).collect();
            assert_eq!(rollouts, [2, 2, 2, 2, 2, 2, 2, 4, 4, 1]);
            // The recommendation is proposed before the incumbent runs, so that it trains
            // meanwhile.
            let proposed = |it: &Entry| matches!(it, Entry::Proposed { candidate: 8, .. });
            let runs = |it: &Entry| matches!(it, Entry::RolloutFinished { candidate: 7, .. });
            assert!(entries.iter().position(proposed) < entries.iter().position(runs));
        }
    }

    #[test]
    fn a_search_around_an_identified_qube_awaits_no_returns() {
        let extent = Extent { pending: 2, ..EXTENT };
        let mut entries = finished(0, Purpose::Excitation, 1);
        let ahead = |entries: &[Entry]| {
            trains_ahead(&SessionState::of(entries).unwrap(), &extent, Some(&IDENTIFIED))
        };
        assert!(!ahead(&entries));
        assert_eq!(
            next_around(&entries, &extent),
            Step::Propose { count: 1, purpose: Purpose::Excitation }
        );
        entries.push(Entry::NotIdentified { reason: "it does not fit".into() });
        assert!(ahead(&entries));
        assert_eq!(
            next_around(&entries, &extent),
            Step::Propose { count: 3, purpose: Purpose::Initial }
        );
    }

    #[test]
    fn each_prefix_of_a_ledger_leads_to_the_same_next_entry() {
        for pending in [0, 1, 3] {
            let extent = Extent { pending, ..EXTENT };
            check_each_prefix(&extent);
        }
    }

    fn check_each_prefix(extent: &Extent) {
        let whole = session_of(extent, 1000);
        for length in 0..whole.len() {
            let next = next_step_after(&whole[..length], extent);
            let (candidate, ok) = match (&whole[length], next) {
                (Entry::Proposed { purpose, .. }, Step::Propose { purpose: wanted, .. }) => {
                    (0, *purpose == wanted)
                }
                (Entry::Trained { candidate, .. }, Step::Train { candidates }) => {
                    (*candidate, candidates[0] == *candidate)
                }
                (
                    Entry::RolloutFinished { candidate, rollout, .. },
                    Step::Rollout { candidate: next_candidate, rollout: next_rollout, .. },
                ) => (*candidate, *candidate == next_candidate && *rollout == next_rollout),
                _ => (0, false),
            };
            assert!(ok, "after {length} entries, candidate {candidate}");
        }
    }

    #[test]
    fn four_faults_of_one_rollout_end_the_session() {
        let mut entries = session(1000)[..6].to_vec();
        let (candidate, rollout) = (0, 0);
        for attempt in 0..4 {
            let step = next_step_after(&entries, &EXTENT);
            assert_eq!(step, Step::Rollout { candidate, rollout, attempt });
            entries.push(Entry::RolloutVoid { candidate, rollout, attempt, rig: None });
        }
        assert_eq!(next_step_after(&entries, &EXTENT), Step::GiveUp { candidate, rollout });

        // Attempts before a rig was taken out do not count against the other rigs.
        entries.push(Entry::RigTakenOut { rig: 1, reason: "it rests".into() });
        for attempt in 4..8 {
            let step = next_step_after(&entries, &EXTENT);
            assert_eq!(step, Step::Rollout { candidate, rollout, attempt });
            entries.push(Entry::RolloutVoid { candidate, rollout, attempt, rig: Some(2) });
        }
        assert_eq!(next_step_after(&entries, &EXTENT), Step::GiveUp { candidate, rollout });
        entries.push(Entry::RigTakenOut { rig: 1, reason: "again".into() });
        assert!(SessionState::of(&entries).is_err());
    }

    const IDENTIFIED: IdentificationSettings =
        IdentificationSettings { excitations: 2, candidates: 4, ..IdentificationSettings::DEFAULT };

    fn next_around(entries: &[Entry], extent: &Extent) -> Step {
        next_step(&SessionState::of(entries).unwrap(), extent, Some(&IDENTIFIED))
    }

    fn proposed(candidate: u32, purpose: Purpose) -> Entry {
        let (point, pending) = (Vec::new(), Vec::new());
        Entry::Proposed { candidate, purpose, point, pending, policy_of: None }
    }

    /// The ledger's entries of a candidate that has finished this number of rollouts.
    fn finished(candidate: u32, purpose: Purpose, rollouts: u32) -> Vec<Entry> {
        let finished =
            |rollout| Entry::RolloutFinished { candidate, rollout, attempt: 0, rig: None };
        let mut entries =
            vec![proposed(candidate, purpose), Entry::Trained { candidate, checksum: None }];
        entries.extend((0..rollouts).map(finished));
        entries
    }

    #[test]
    fn a_qube_is_excited_and_identified_before_the_search() {
        let extent = Extent { baseline: true, ..EXTENT };
        let next = |entries: &[Entry]| next_around(entries, &extent);
        // The second excitation is chosen by the recording of the first.
        let excite = Step::Propose { count: 1, purpose: Purpose::Excitation };
        assert_eq!(next(&[]), excite);
        let mut entries = vec![proposed(0, Purpose::Excitation)];
        assert_eq!(next(&entries), Step::Train { candidates: vec![0] });
        entries = finished(0, Purpose::Excitation, 1);
        assert_eq!(next(&entries), excite);
        entries.extend(finished(1, Purpose::Excitation, 1));
        assert_eq!(next(&entries), Step::Identify);

        let mut refused = entries.clone();
        refused.push(Entry::NotIdentified { reason: "it does not fit".into() });
        assert_eq!(next(&refused), Step::Propose { count: 3, purpose: Purpose::Initial });

        let found = |recordings| Entry::Identified {
            recordings,
            verdict: "fits".into(),
            missing_effects: Vec::new(),
            checksum: String::new(),
        };
        entries.push(found(2));
        assert_eq!(next(&entries), Step::Decide);
        entries.extend(finished(2, Purpose::Initial, IDENTIFIED.rollouts));
        assert_eq!(next(&entries), Step::Decide);
        entries.push(found(3));
        assert_eq!(next(&entries), Step::Decide, "a better profile changes no plan");
        entries.extend(finished(3, Purpose::Incumbent, extent.verification_rollouts));
        assert_eq!(next(&entries), Step::Decide);
        entries.push(Entry::SearchEnded { expected_gain: 0.5 });
        assert_eq!(next(&entries), Step::Identify, "the verification is data, too");
        let mut unchanged = entries.clone();
        unchanged.push(Entry::NotUpdated {
            recordings: None,
            reason: "no rollout can be fitted".into(),
        });
        let baseline = Step::Propose { count: 1, purpose: Purpose::Baseline };
        assert_eq!(next(&unchanged), baseline);
        entries.push(found(8));
        assert_eq!(next(&entries), baseline);
        entries.extend(finished(4, Purpose::Baseline, 1));
        assert_eq!(next(&entries), Step::Done);
    }

    #[test]
    fn further_verifications_exceed_no_number_that_is_announced() {
        let of = |entries: &[Entry]| {
            SessionState::of(entries).unwrap().candidate_counts(&EXTENT, Some(&IDENTIFIED))
        };
        let mut entries = finished(0, Purpose::Excitation, 1);
        for round in 0..IDENTIFIED.candidates {
            entries.extend(finished(1 + 2 * round, Purpose::Search, IDENTIFIED.rollouts));
            entries.extend(finished(2 + 2 * round, Purpose::Incumbent, 1));
            let most = IDENTIFIED.candidates;
            let counts = CandidateCounts { searched: 1 + round, most_searched: most, total: None };
            assert_eq!(of(&entries), counts);
        }
        // The search treats a Qube that could not be identified as an unknown one.
        let refused = Entry::NotIdentified { reason: "it does not fit".into() };
        let mut entries = finished(0, Purpose::Excitation, 1);
        entries.extend(finished(1, Purpose::Excitation, 1));
        entries.push(refused);
        let counts = CandidateCounts { searched: 0, most_searched: 5, total: Some(2 + 5 + 2) };
        assert_eq!(of(&entries), counts);
    }
}
