//! Chooses the training that depends on no recording and may begin before the session needs it.

use crate::session::{Identification, IdentificationSettings, Purpose, SessionState};

/// A training that the session may need later; at most one is needed at a time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct EarlyTraining {
    pub(super) kind: EarlyKind,
    /// Number that its candidate is expected to get.
    pub(super) candidate: u32,
    /// True if the training may begin; if false, only a training that has begun goes on.
    pub(super) may_begin: bool,
}

/// The kind of policy of an early training.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum EarlyKind {
    /// The policy for an unidentified Qube, which a questionable identification needs.
    Competitor,
    /// The policy that is trained on the nominal Qube, for comparison.
    Baseline,
}

impl EarlyTraining {
    /// Returns the training that the session may need: the competitor until the identification is
    /// not questionable, or refused, or the first candidate is trained, and the baseline from the
    /// verification of a policy that may be the last one until the baseline is trained or the
    /// search continues.
    pub(super) fn of(
        state: &SessionState,
        plan: &IdentificationSettings,
        has_baseline: bool,
    ) -> Option<Self> {
        let count = state.candidates().len() as u32;
        let first = state.searched().next();
        let (kind, candidate, may_begin) = match (state.identification(), state.candidates().last())
        {
            (Identification::None, _) => (EarlyKind::Competitor, count.max(plan.excitations), true),
            (identification, _)
                if identification.is_questionable() && first.is_none_or(|it| !it.trained) =>
            {
                (EarlyKind::Competitor, first.map_or(count, |it| it.number), false)
            }
            (Identification::Found { .. }, Some(last))
                if has_baseline && last.purpose.verifies() =>
            {
                (EarlyKind::Baseline, count, true)
            }
            (Identification::Found { .. }, Some(last))
                if last.purpose == Purpose::Baseline && !last.trained =>
            {
                (EarlyKind::Baseline, last.number, false)
            }
            (Identification::Found { .. } | Identification::Refused(_), _) => return None,
        };
        Some(Self { kind, candidate, may_begin })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::session::Entry;

    const PLAN: IdentificationSettings =
        IdentificationSettings { excitations: 1, ..IdentificationSettings::DEFAULT };

    fn proposed(candidate: u32, purpose: Purpose) -> Entry {
        let (point, pending) = (Vec::new(), Vec::new());
        Entry::Proposed { candidate, purpose, point, pending, policy_of: None }
    }

    fn identified(missing_effects: &[&str]) -> Entry {
        Entry::Identified {
            recordings: 1,
            verdict: "fits_but".into(),
            missing_effects: missing_effects.iter().map(ToString::to_string).collect(),
            checksum: String::new(),
        }
    }

    fn after(entries: &[Entry]) -> Option<EarlyTraining> {
        EarlyTraining::of(&SessionState::of(entries).unwrap(), &PLAN, true)
    }

    fn competitor(candidate: u32, may_begin: bool) -> Option<EarlyTraining> {
        Some(EarlyTraining { kind: EarlyKind::Competitor, candidate, may_begin })
    }

    #[test]
    fn the_competitor_is_needed_until_the_fit_is_without_doubts_or_its_candidate_is_trained() {
        assert_eq!(after(&[]), competitor(1, true));
        let mut entries = vec![proposed(0, Purpose::Excitation)];
        assert_eq!(after(&entries), competitor(1, true));
        let undoubted = [&entries[..], &[identified(&[])]].concat();
        assert_eq!(after(&undoubted), None);
        let refused = Entry::NotIdentified { reason: "it does not fit".into() };
        assert_eq!(after(&[&entries[..], &[refused]].concat()), None);
        // A repeated excitation takes the number that the first candidate would have had.
        entries.push(proposed(1, Purpose::Excitation));
        assert_eq!(after(&entries), competitor(2, true));
        entries.push(identified(&["play"]));
        assert_eq!(after(&entries), competitor(2, false));
        entries.push(proposed(2, Purpose::Initial));
        assert_eq!(after(&entries), competitor(2, false));
        entries.push(Entry::Trained { candidate: 2, checksum: None });
        assert_eq!(after(&entries), None);
    }

    #[test]
    fn the_baseline_is_needed_from_the_verification_until_it_is_trained_or_the_search_continues() {
        let baseline = |candidate, may_begin| {
            Some(EarlyTraining { kind: EarlyKind::Baseline, candidate, may_begin })
        };
        let mut entries = vec![
            proposed(0, Purpose::Excitation),
            identified(&[]),
            proposed(1, Purpose::Initial),
            proposed(2, Purpose::Incumbent),
        ];
        assert_eq!(after(&entries), baseline(3, true));
        let continued = [&entries[..], &[proposed(3, Purpose::Search)]].concat();
        assert_eq!(after(&continued), None);
        entries.push(proposed(3, Purpose::Baseline));
        assert_eq!(after(&entries), baseline(3, false));
        entries.push(Entry::Trained { candidate: 3, checksum: None });
        assert_eq!(after(&entries), None);
    }
}
