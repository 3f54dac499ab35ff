use thiserror::Error;

use crate::surrogate::SurrogateError;

/// The reason why a strategy cannot be built, or cannot propose or recommend a point.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum SearchError {
    /// A candidate has no return.
    #[error("candidate {index} has no return: leave it out until it has been evaluated")]
    NoReturns {
        /// Index of the candidate, from 0.
        index: usize,
    },
    /// A return is NaN or infinite.
    #[error(
        "return {rollout} of candidate {index} is {value}: leave that rollout out or repeat it"
    )]
    ReturnNotFinite {
        /// Index of the candidate, from 0.
        index: usize,
        /// Index of the return, from 0.
        rollout: usize,
        /// The value.
        value: f64,
    },
    /// A recommendation needs at least one evaluated candidate.
    #[error("no candidate has been evaluated yet, so there is no best one: evaluate one first")]
    NothingEvaluated,
    /// No strategy has the name that was given.
    #[error("there is no strategy {name:?}: choose one of {known}")]
    UnknownStrategy {
        /// Name given.
        name: String,
        /// Names of the strategies.
        known: String,
    },
    /// A setting is out of range.
    #[error("bad search settings: {reason}")]
    BadSettings {
        /// Reason why it is refused.
        reason: String,
    },
    /// The surrogate refused the box or the data, or could not be fitted.
    #[error(transparent)]
    Surrogate(#[from] SurrogateError),
}
