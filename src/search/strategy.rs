use serde::{Deserialize, Serialize};

use super::{Observation, SearchError};

/// A strategy that searches for the point with the highest return.
///
/// Its proposals depend on its settings, its seed, the data and the pending points alone. A resumed
/// session therefore continues as if it had not been interrupted, and only data and pending points
/// have to be stored. The data must be in the order in which the points were proposed.
pub trait Strategy: Send {
    /// Proposes `count` points to evaluate next, in the box's units. `pending` are the points that
    /// were proposed after the points of the data and whose returns are not known yet.
    ///
    /// # Errors
    /// A point of the data or a pending point lies outside the box, a candidate has no return or
    /// one that is not finite, or the data cannot be fitted.
    fn propose(
        &self,
        data: &[Observation],
        pending: &[Vec<f64>],
        count: usize,
    ) -> Result<Vec<Vec<f64>>, SearchError>;

    /// Recommends the point with the highest expected return.
    ///
    /// # Errors
    /// The data is empty, or [`Strategy::propose`] would fail on it.
    fn recommend(&self, data: &[Observation]) -> Result<Recommendation, SearchError>;
}

/// The recommendation of a strategy.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Recommendation {
    /// Recommended point in the box's units; it need not have been evaluated.
    pub point: Vec<f64>,
    /// Return expected at the point.
    pub expected_return: f64,
    /// Standard deviation of the expected return; `None` if it is unknown.
    pub standard_deviation: Option<f64>,
    /// Index in the data of the evaluated candidate with the highest expected return.
    pub best_evaluated: usize,
}
