use super::belief::Belief;
use super::rival::{Data, Given, Rival};
use crate::learning::{TrainError, TrainSettings};
use crate::qube::MAX_HISTORY;

/// One policy for all Qubes of the prior that observes as many of its last commands as an observation holds, to tell the
/// Qubes apart while it acts. It takes no real rollout.
pub struct LongHistory;

impl Rival for LongHistory {
    fn data(&self) -> Data {
        Data::None
    }

    fn update(&self, given: &Given) -> Result<Belief, TrainError> {
        Ok(given.before.clone())
    }

    fn shape_training(&self, training: &mut TrainSettings) {
        training.simulation.history = MAX_HISTORY;
    }
}
