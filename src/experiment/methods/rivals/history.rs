use super::belief::RivalBelief;
use super::rival::{Data, Rival, RivalInput};
use crate::learning::{TrainError, TrainSettings};
use crate::qube::MAX_HISTORY;

/// A rival that trains one policy for all Qubes of the prior. The policy observes as many of its
/// last commands as an observation holds, so that it can tell the Qubes apart while it acts. The
/// method takes no real rollout.
pub struct LongHistory;

impl Rival for LongHistory {
    fn data(&self) -> Data {
        Data::None
    }

    fn update(&self, given: &RivalInput) -> Result<RivalBelief, TrainError> {
        Ok(given.before.clone())
    }

    fn shape_training(&self, training: &mut TrainSettings) {
        training.simulation.history = MAX_HISTORY;
    }
}
