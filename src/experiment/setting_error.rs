use thiserror::Error;

use super::Method;
use crate::session::{EmulatedQubeError, SettingError};
use crate::simulation::Model;

/// The first setting of an experiment that is refused.
#[derive(Debug, Error)]
pub enum ExperimentSettingError {
    /// A number is out of its range.
    #[error(transparent)]
    OutOfRange(#[from] SettingError),
    /// There is no recipe or no plant.
    #[error("an experiment needs at least one recipe and one plant")]
    Empty,
    /// A name cannot be the name of a folder.
    #[error(
        "{kind}: {name:?} is not a valid name: use 1 to 60 characters of a-z A-Z 0-9 - _ . + %, and no dot at the beginning"
    )]
    Name {
        /// Setting with the name.
        kind: &'static str,
        /// The name.
        name: String,
    },
    /// Two recipes or two plants have the same name.
    #[error("{kind}: two are called {name}: give each a name of its own")]
    SameName {
        /// `recipes` or `plants`.
        kind: &'static str,
        /// The name.
        name: String,
    },
    /// The names of two recipes or of two plants differ in case only.
    #[error(
        "{kind}: {name} and {other} would be one folder where case does not count: give each a name of its own"
    )]
    SameFolder {
        /// `recipes` or `plants`.
        kind: &'static str,
        /// Name of the first.
        name: String,
        /// Name of the second.
        other: String,
    },
    /// Recipes are for different plants.
    #[error(
        "recipe {recipe}: it is for the plant {plant} and the first one for {first}: compare recipes on one plant"
    )]
    OtherPlant {
        /// Name of the recipe.
        recipe: String,
        /// Name of its plant.
        plant: String,
        /// Name of the first recipe's plant.
        first: String,
    },
    /// A limit of a recipe is refused.
    #[error("recipe {recipe}: {source}")]
    Recipe {
        /// Name of the recipe.
        recipe: String,
        /// The refused limit.
        source: SettingError,
    },
    /// A recipe identifies the Qube.
    #[error(
        "recipe {recipe}: an experiment's searches identify no Qube: leave the table settings.identification out"
    )]
    Identifies {
        /// Name of the recipe.
        recipe: String,
    },
    /// A number of an emulated plant is out of its range.
    #[error("plant {plant}: {source}")]
    Plant {
        /// Name of the plant.
        plant: String,
        /// Number that is out of its range.
        source: EmulatedQubeError,
    },
    /// The variation of a plant is out of its range.
    #[error("plant {plant}: {source}")]
    Vary {
        /// Name of the plant.
        plant: String,
        /// The variation and its range.
        source: SettingError,
    },
    /// Recipes home a real Qube in different ways.
    #[error(
        "recipe {recipe}: its settings.homing differ from those of recipe {first}, and a real Qube is homed once for all \
         recipes: give all of them the same homing, or compare them in experiments of their own"
    )]
    Homing {
        /// Name of the recipe.
        recipe: String,
        /// Name of the first recipe.
        first: String,
    },
    /// Methods are compared, and there is not exactly one recipe.
    #[error("methods are compared on one model: give one model or recipe")]
    SeveralModels,
    /// A method searches psi, and the recipe's model has none.
    #[error(
        "{method} searches psi, and the model {} has none: give one of {}", model.name(), Model::searched_names()
    )]
    NoPsi {
        /// Method that searches.
        method: Method,
        /// Model of the recipe.
        model: Model,
    },
    /// Methods are compared on several plants, without budgets.
    #[error("methods are compared on one plant: give one plant, or budgets")]
    SeveralPlants,
    /// No method is named.
    #[error("strategies: name at least one method to compare")]
    NoMethod,
    /// A method is named twice.
    #[error("strategies: {0} is there twice: name it once")]
    MethodTwice(Method),
    /// The budgets do not rise, or are too large.
    #[error("budgets: give numbers of real rollouts up to 1000, each larger than the one before")]
    Budgets,
    /// No budget is large enough for a method's first recommendation.
    #[error(
        "budgets: {method} needs at least {least} real rollout{} for its first recommendation, and the largest budget is \
         {largest}: give a budget of {least} or more too, or leave {method} out", if *least == 1 { "" } else { "s" }
    )]
    NoRecommendation {
        /// The method.
        method: Method,
        /// Number of real rollouts before its first recommendation.
        least: u32,
        /// Largest budget.
        largest: u32,
    },
    /// A method can be compared only at fixed budgets, and there are none.
    #[error("{method} {}: give budgets to compare it", why_budgets(*method))]
    NeedsBudgets {
        /// The method.
        method: Method,
    },
}

fn why_budgets(method: Method) -> &'static str {
    match method.needs_no_rollouts() {
        true => "takes no real rollouts",
        false => "makes all its policies from one training",
    }
}
