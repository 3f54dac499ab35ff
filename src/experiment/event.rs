use super::{Made, RecommendationResult, Repetition, RolloutResult};
use crate::learning::TrainUpdate;
use crate::session::SessionEvent;

/// An event of a running experiment, from any thread.
pub enum ExperimentEvent<'a> {
    /// An event of a session that searches for psi.
    Search {
        /// Name of the search: a recipe, or a method with the number of a repetition.
        name: &'a str,
        /// Event of the session.
        progress: &'a SessionEvent<'a>,
    },
    /// A training of a policy has done one more update.
    Training {
        /// Name of the recipe.
        recipe: &'a str,
        /// Number of the policy.
        policy: u32,
        /// Number of this training among the competing trainings of the policy.
        training: u32,
        /// The update.
        update: &'a TrainUpdate,
    },
    /// A policy is on disk.
    Trained {
        /// Name of the recipe.
        recipe: &'a str,
        /// Number of the policy.
        policy: u32,
        /// Best return in training; `None` if the policy was on disk.
        best_return: Option<f64>,
    },
    /// A policy has completed all its rollouts on a plant.
    Ran {
        /// Name of the recipe; at fixed budgets the method and its budget, such as `posterior 2`.
        recipe: &'a str,
        /// Number of the policy; at fixed budgets the number of the repetition.
        policy: u32,
        /// Name of the plant.
        plant: &'a str,
        /// Results of the rollouts.
        results: &'a [RolloutResult],
        /// Time of the last training or rollout for the results.
        made: Made,
    },
    /// A recommendation has been scored, or the method gave a reason for having none.
    Scored {
        /// Repetition of the method.
        repetition: &'a Repetition,
        /// Result of the scoring.
        recommendation: &'a RecommendationResult,
    },
    /// A method that identifies the Qube does not use one of its recordings.
    LeftOut {
        /// Name of the method with the number of the repetition.
        name: &'a str,
        /// Name of the recording, and the reason why it is left out.
        recording: &'a str,
    },
    /// Budgets have no score of their own: they allow no recommendation, or only the recommendation
    /// that the budget before them had.
    NotScored {
        /// Number of these budgets.
        budgets: usize,
        /// Time of the score at the nearest budget that has one; [`Made::Earlier`] if no budget has
        /// one.
        made: Made,
    },
    /// A repetition of a method has ended.
    Over {
        /// Repetition with all its recommendations.
        repetition: &'a Repetition,
        /// Time of the last score; [`Made::Earlier`] without any.
        made: Made,
    },
}

/// Receives the events of an experiment.
pub(super) type OnEvent<'a> = dyn Fn(ExperimentEvent) + Sync + 'a;
