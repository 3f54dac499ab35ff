//! Comparison of methods: strategies × repetitions, to a table of the real rollouts until a recommendation
//! succeeds.
//!
//! A [`Method`] is a strategy that searches for psi, or one that takes recordings instead and trains around the Qube
//! that they identify. After each candidate or recording it has a recommendation:
//! its result if it were stopped there. Recommendations are scored apart from the search, by separate
//! policies whose rollouts do not count, until one succeeds.
//!
//! With budgets in the settings, recommendations are scored after fixed numbers of real rollouts instead, on every
//! plant, and none stops the comparison (`budgets`).
//!
//! Reading order: [`StrategySettings`]; `follow` runs one [`Repetition`]; `search` and `identified` give
//! its recommendations; `score` scores them; [`StrategyResults`] summarises.

mod budgets;
mod follow;
mod identified;
mod method;
mod recordings;
mod repetition;
mod results;
mod rivals;
mod run;
mod score;
mod search;
mod settings;

pub use budgets::ALL_PLANTS;
pub(super) use budgets::Trial;
pub use method::Method;
pub use repetition::{RecommendationResult, Repetition};
pub use results::{StrategyResult, StrategyResults};
pub(super) use run::Access;
pub use score::Score;
pub use settings::StrategySettings;
