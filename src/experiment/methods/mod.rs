//! Comparison of methods: methods × repetitions. The result is a table of the real rollouts that
//! each method needs until a recommendation succeeds.
//!
//! A [`Method`] makes policies: it searches for psi, or trains around the Qube that recordings
//! identify, or follows a method from the literature (`rivals`), or trains in the distribution
//! `robust` without any real rollout. After each candidate or recording the method has a
//! recommendation: its result if it were stopped there. Policies that are trained by a
//! recommendation score it. The first recommendation that succeeds ends the run; the rollouts for
//! the scores are not counted.
//!
//! With budgets in the settings, recommendations are scored after fixed numbers of real rollouts
//! instead, on every plant, and a success ends nothing (`budgets`).
//!
//! Reading order: [`MethodSettings`]; `follow` runs one [`Repetition`]; `search`, `identified`
//! and `rivals` give the recommendations of a method; `score` scores them; [`MethodResults`]
//! summarises.

mod budgets;
mod follow;
mod identified;
mod method;
mod recordings;
mod repetition;
mod results;
mod rivals;
mod run;
#[cfg(test)]
mod samples;
mod score;
mod search;
mod settings;

pub use budgets::ALL_PLANTS;
pub(super) use budgets::Trial;
pub(super) use follow::Followed;
pub use method::Method;
pub use repetition::{
    RecommendationOutcome, RecommendationResult, RecommendationScore, Repetition, RepetitionId,
};
pub use results::{MethodResult, MethodResults};
pub use rivals::RivalSettings;
pub(super) use run::Access;
pub use settings::{MethodSettings, RepetitionSeeds};
