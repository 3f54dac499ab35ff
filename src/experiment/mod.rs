//! Experiments: recipes × seeds × rollouts. The result is a table that shows which recipe makes
//! policies that work on a Qube.
//!
//! A [`Recipe`] names simulations, training, estimator and guard. An experiment trains several
//! policies with each recipe, evaluates them from fresh starts in the recipe's simulations, and
//! runs each policy several times on one or more plants (emulated, in virtual time, on all cores)
//! or on a device. For optimised recipes a session first searches for psi.
//!
//! With [`MethodSettings`], an experiment compares methods instead of recipes: it counts the real
//! rollouts until a method's recommendation succeeds, or scores the recommendations at fixed
//! budgets.
//!
//! The room may import `session`, `rig`, `scoring`, `recording`, `jobs`, `learning`, `simulation`,
//! `search`, `identification`, `replay`, `policy`, `telemetry`, `storage`, `qube` and `elementary`.
//! Reading order: [`ExperimentSettings`], then [`Experiment`], which does the work and can be
//! interrupted and resumed, then [`Results`], which are computed from policies and recordings and
//! never stored.

mod board;
mod comparison;
mod error;
mod event;
mod folder;
mod irreplaceable;
mod local_work;
mod made;
mod methods;
mod opened;
mod plant;
mod queue;
mod recipe;
mod results;
mod rollouts;
mod seal;
mod search;
mod series;
mod setting_error;
mod settings;
pub mod statistics;
mod work;

pub use comparison::Comparison;
pub use error::ExperimentError;
pub use event::ExperimentEvent;
pub use folder::{ExperimentFolder, PolicyFolders};
pub use irreplaceable::is_irreplaceable;
pub use made::Made;
pub use methods::{
    ALL_PLANTS, Method, MethodResult, MethodResults, MethodSettings, RecommendationOutcome,
    RecommendationResult, RecommendationScore, Repetition, RepetitionId, RepetitionSeeds,
    RivalSettings,
};
pub use opened::Experiment;
pub use plant::Plant;
pub use recipe::Recipe;
pub use results::{PolicyResult, RecipeResult, Results};
pub use rollouts::RolloutResult;
pub use setting_error::ExperimentSettingError;
pub use settings::ExperimentSettings;
pub use work::{SearchReturns, TrainingProgress};
