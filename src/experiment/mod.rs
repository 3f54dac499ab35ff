//! Which recipe makes policies that work on this Qube? Recipes × seeds × rollouts, to a table.
//!
//! A [`Recipe`] is a named set of simulations, training, estimator and guard; an experiment trains
//! so many policies by each, evaluates them afresh in their own simulations, and runs each so many
//! times on one or more plants (emulated, in virtual time, on all cores) or on a device. For the
//! optimised recipes a session looks for psi first.
//!
//! [`StrategySettings`] ask something else of one of them: how many real rollouts it takes until the answer
//! of a search succeeds.
//!
//! May import `session` and what that assembles. Reading order: [`ExperimentSettings`],
//! [`Experiment`] does the work and can be stopped and gone on with, [`Results`] reads what it came
//! to from policies and recordings, which are all that is stored.

mod behaviour;
mod error;
mod figures;
mod folder;
mod plant;
mod queue;
mod recipe;
mod results;
mod rollouts;
mod search;
mod series;
mod settings;
pub mod statistics;
mod strategies;
mod work;

pub use behaviour::Behaviour;
pub use error::ExperimentError;
pub use figures::{densities_svg, searches_svg};
pub use folder::{ExperimentFolder, PolicyFolders};
pub use plant::Plant;
pub use recipe::{Recipe, RecipeModel};
pub use results::{PolicyResult, RecipeResult, Results};
pub use rollouts::RolloutResult;
pub use settings::ExperimentSettings;
pub use strategies::{
    AnswerResult, Contender, Judgement, Repetition, StrategyResult, StrategyResults,
    StrategySettings, strategies_svg,
};
pub use work::{Experiment, News};
