//! Chooses the points of candidates in the space of psi from the returns so far.

use super::Session;
use crate::search::{Observation, SearchError};
use crate::session::{Candidate, Entry, Purpose, ScoredCandidate, SessionError, SessionEvent};

/// A candidate that is to be proposed.
pub(super) struct Proposal {
    purpose: Purpose,
    point: Vec<f64>,
    /// Number of the candidate whose policy it runs again, if it does.
    policy_of: Option<u32>,
}

impl Proposal {
    /// A candidate with a policy of its own.
    pub(super) fn of(purpose: Purpose, point: Vec<f64>) -> Self {
        Self { purpose, point, policy_of: None }
    }

    /// A candidate that runs the incumbent's policy again.
    pub(super) fn again(incumbent: &Candidate) -> Self {
        let (point, policy_of) = (incumbent.point.clone(), Some(incumbent.number));
        Self { purpose: Purpose::Incumbent, point, policy_of }
    }
}

impl Session {
    /// Proposes `count` candidates for this purpose: chooses their points, which are empty for an
    /// excitation and the baseline, and enters them into the ledger. For the purposes
    /// `Verification` and `Incumbent` it proposes one candidate, whatever `count` is.
    pub(super) fn propose(
        &mut self,
        count: u32,
        purpose: Purpose,
        on_event: &mut dyn FnMut(SessionEvent),
    ) -> Result<(), SessionError> {
        let strategy = self.settings.search()?;
        let mut pending = Vec::new();
        let chosen: Vec<Vec<f64>> = match purpose {
            Purpose::Initial => {
                // All initial points are computed on each call, and those already proposed are
                // skipped, so that a crash between two of them changes nothing.
                let all = self.settings.extent.initial_candidates;
                let points = strategy.propose(&[], &[], all as usize)?;
                points.into_iter().skip((all - count) as usize).collect()
            }
            Purpose::Search => {
                let data = self.observations()?;
                let awaited = self.ledger.state().awaited(self.settings.extent.rollouts);
                let (numbers, points): (Vec<u32>, Vec<Vec<f64>>) =
                    awaited.map(|it| (it.number, it.point.clone())).unzip();
                pending = numbers;
                strategy.propose(&data, &points, count as usize)?
            }
            Purpose::Excitation | Purpose::Baseline => vec![Vec::new(); count as usize],
            Purpose::Verification => vec![strategy.recommend(&self.observations()?)?.point],
            Purpose::Incumbent => {
                let again = Proposal::again(&self.incumbent()?);
                return self.append_proposal(again, on_event);
            }
        };
        for point in chosen {
            let proposal = Proposal::of(purpose, point);
            self.append_proposal_beside(pending.clone(), proposal, on_event)?;
        }
        Ok(())
    }

    pub(super) fn append_proposal(
        &mut self,
        proposal: Proposal,
        on_event: &mut dyn FnMut(SessionEvent),
    ) -> Result<(), SessionError> {
        self.append_proposal_beside(Vec::new(), proposal, on_event)
    }

    fn append_proposal_beside(
        &mut self,
        pending: Vec<u32>,
        proposal: Proposal,
        on_event: &mut dyn FnMut(SessionEvent),
    ) -> Result<(), SessionError> {
        let Proposal { purpose, point, policy_of } = proposal;
        let candidate = self.ledger.state().candidates().len() as u32;
        self.ledger.append(Entry::Proposed { candidate, purpose, point, pending, policy_of })?;
        let settings = &self.settings;
        let counts = self
            .ledger
            .state()
            .candidate_counts(&settings.extent, settings.identification.as_ref());
        on_event(SessionEvent::Proposed { candidate, purpose, counts });
        Ok(())
    }

    /// The surrogate's data set, computed from ledger and recordings and stored nowhere. Candidates
    /// whose policies were trained without psi are not in it.
    pub(super) fn observations(&mut self) -> Result<Vec<Observation>, SessionError> {
        let informing = self.searched()?.filter(ScoredCandidate::informs_search);
        Ok(informing.map(|it| it.observation()).collect())
    }

    /// The points of the searched candidates whose policy was trained without psi, except the point
    /// exactly as identified. The search learns nothing from them and does not propose them again.
    pub(super) fn points_without_observation(&mut self) -> Result<Vec<Vec<f64>>, SessionError> {
        let as_identified = self.settings.psi.as_identified();
        let without_psi = self.searched()?.filter(|it| it.model_without_psi.is_some());
        let points = without_psi.map(|it| it.candidate.point);
        Ok(points.filter(|point| *point != as_identified).collect())
    }

    /// The searched candidate with the highest mean return; in a tie, the last proposed candidate.
    pub(super) fn incumbent(&mut self) -> Result<Candidate, SessionError> {
        self.searched()?
            .filter_map(|it| Some((it.mean_return()?, it.candidate)))
            .max_by(|(one, _), (other, _)| one.total_cmp(other))
            .map(|(_, candidate)| candidate)
            .ok_or(SearchError::NothingEvaluated.into())
    }
}
