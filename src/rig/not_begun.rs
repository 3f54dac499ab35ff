use super::RigError;

/// Number of rollouts in a row that may fail to begin, because of the link or because counts have
/// moved; the next failure ends the work.
const MAX_NOT_BEGUN: u32 = 3;

/// Counter of the rollouts of a rig that failed to begin, in a row. It limits how often such a
/// rollout is repeated.
#[derive(Debug, Default)]
pub struct NotBegun {
    in_a_row: u32,
}

impl NotBegun {
    /// Returns whether a rollout that ended with this error may be repeated, and counts each
    /// repetition. A rollout may be repeated if it did not begin ([`RigError::NotBegun`]) and at
    /// most two rollouts in a row before it did not begin either.
    pub fn may_repeat(&mut self, error: &RigError) -> bool {
        let may_repeat =
            matches!(error, RigError::NotBegun { .. }) && self.in_a_row < MAX_NOT_BEGUN;
        self.in_a_row += u32::from(may_repeat);
        may_repeat
    }

    /// Starts the count anew after a rollout that began.
    pub fn reset(&mut self) {
        self.in_a_row = 0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::{ControlError, Moved};

    #[test]
    fn three_rollouts_in_a_row_that_did_not_begin_may_be_repeated() {
        let moved = RigError::from(ControlError::Moved(Moved::Jumped));
        let mut not_begun = NotBegun::default();
        let mut may_repeat = || [(); 5].map(|()| not_begun.may_repeat(&moved));
        assert_eq!(may_repeat(), [true, true, true, false, false]);
        not_begun.reset();
        assert!(not_begun.may_repeat(&moved));
    }

    #[test]
    fn other_errors_are_neither_repeated_nor_counted() {
        let mut not_begun = NotBegun::default();
        for _ in 0..5 {
            assert!(!not_begun.may_repeat(&RigError::Stopped { during: "homing" }));
        }
        assert_eq!(not_begun.in_a_row, 0);
    }
}
