use thiserror::Error;

use crate::surrogate::SurrogateError;

/// Why a strategy cannot say what to try next, or what is best.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum SearchError {
    /// A candidate without a single return.
    #[error("candidate {index} has no return: leave it out until it was evaluated")]
    NoReturns {
        /// Which candidate, from 0.
        index: usize,
    },
    /// A return that is NaN or infinite.
    #[error(
        "return {rollout} of candidate {index} is {value}: leave that rollout out or repeat it"
    )]
    ReturnNotFinite {
        /// Which candidate, from 0.
        index: usize,
        /// Which of its returns, from 0.
        rollout: usize,
        /// The value.
        value: f64,
    },
    /// Asked for the best of nothing.
    #[error("no candidate was evaluated yet, so there is no best one")]
    NothingEvaluated,
    /// A name that is no strategy's.
    #[error("there is no strategy {name:?}: choose one of {known}")]
    UnknownStrategy {
        /// What was asked for.
        name: String,
        /// What there is.
        known: String,
    },
    /// A setting that makes no sense.
    #[error("bad search settings: {reason}")]
    BadSettings {
        /// What is wrong with it.
        reason: String,
    },
    /// The surrogate said no: a point outside the box, bounds that are none, data that cannot be
    /// fitted.
    #[error(transparent)]
    Surrogate(#[from] SurrogateError),
}
