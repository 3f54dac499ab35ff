//! Experiments: recipes × seeds × rollouts, to a table that shows which recipe makes policies that work on
//! a Qube.
//!
//! A [`Recipe`] names simulations, training, estimator and guard. An experiment trains several policies
//! with each recipe, evaluates them from fresh starts in their own simulations, and runs each several times
//! on one or more plants (emulated, in virtual time, on all cores) or on a device. For optimised recipes a
//! session first searches for psi.
//!
//! [`StrategySettings`] select another experiment: the number of real rollouts until a search's
//! recommendation succeeds.
//!
//! The room may import `session`, `rig`, `scoring`, `recording`, `jobs`, `learning`, `simulation`, `search`,
//! `identification`, `replay`, `policy`, `telemetry`, `storage`, `qube` and `elementary`. Reading order: [`ExperimentSettings`],
//! then [`Experiment`], which does the work and can be interrupted and resumed, then [`Results`], which are
//! computed from policies and recordings; nothing else is stored.

mod comparison;
mod error;
mod folder;
mod plant;
mod queue;
mod recipe;
mod results;
mod rollouts;
mod seal;
mod search;
mod series;
mod settings;
pub mod statistics;
mod strategies;
mod work;

pub use comparison::Comparison;
pub use error::ExperimentError;
pub use folder::{ExperimentFolder, PolicyFolders};
pub use plant::Plant;
pub use recipe::Recipe;
pub use results::{PolicyResult, RecipeResult, Results};
pub use rollouts::RolloutResult;
pub use settings::ExperimentSettings;
pub use strategies::{
    ALL_PLANTS, Method, RecommendationResult, Repetition, Score, StrategyResult, StrategyResults,
    StrategySettings,
};
pub use work::{Experiment, ExperimentEvent, SearchReturns, TrainingProgress};
