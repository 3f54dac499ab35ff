//! The sentences at the top of an experiment's page: which recipe or method has the largest mean
//! return, or which method needs the fewest real rollouts.

use crate::experiment::{
    ALL_PLANTS, ExperimentSettings, MethodResult, MethodSettings, RecipeResult, RepetitionSeeds,
    Results,
};
use crate::qube::MAX_STEPS;

/// The methods that are compared at fixed budgets; `None` for any other experiment.
fn methods_at_budgets(settings: &ExperimentSettings) -> Option<&MethodSettings> {
    settings.methods.as_ref().filter(|it| it.has_budgets())
}

/// The word for the entries that the experiment compares: `method` at fixed budgets, or `recipe`.
pub fn compared(settings: &ExperimentSettings) -> &'static str {
    if methods_at_budgets(settings).is_some() { "method" } else { "recipe" }
}

/// The sentences about the largest mean return: one for each plant, or one for all plants together
/// if methods are compared at fixed budgets with seeds of each plant's own.
pub fn headlines(settings: &ExperimentSettings, results: &Results) -> Vec<String> {
    let pools = methods_at_budgets(settings).is_some_and(|methods| {
        settings.plants.len() > 1 && methods.seeds == RepetitionSeeds::OfEachPlant
    });
    let plants: Vec<&str> = if pools {
        vec![ALL_PLANTS]
    } else {
        settings.plants.iter().map(|plant| plant.name.as_str()).collect()
    };
    plants.into_iter().map(|plant| headline(settings, results, plant)).collect()
}

/// The sentence about the largest mean return on a plant, or on [`ALL_PLANTS`], among the recipes
/// or methods that have all their policies. Methods are compared at the largest budget that one of
/// them has completed.
fn headline(settings: &ExperimentSettings, results: &Results, plant: &str) -> String {
    let kind = compared(settings);
    let (needed, all) = match methods_at_budgets(settings) {
        Some(methods) => {
            let plants = if plant == ALL_PLANTS { settings.plants.len() } else { 1 };
            (plants * methods.repetitions as usize, methods.methods.len())
        }
        None => (settings.policies as usize, settings.recipes.len()),
    };
    // A recipe whose rollouts are all void has no mean return.
    let is_complete = |it: &&RecipeResult| it.policies.len() >= needed && it.real().0.is_finite();
    let complete = || results.recipes.iter().filter(|it| it.plant == plant).filter(is_complete);
    let budget = complete().filter_map(|it| it.budget).max();
    let rows: Vec<&RecipeResult> = complete().filter(|it| it.budget == budget).collect();
    let best = rows.iter().max_by(|one, other| one.real().0.total_cmp(&other.real().0));
    let Some(best) = best else {
        return format!("On {plant}, no {kind} has completed all its policies yet.");
    };
    let after = match budget {
        None => String::new(),
        Some(0) => ", without a real rollout".into(),
        Some(1) => ", after 1 real rollout".into(),
        Some(budget) => format!(", after {budget} real rollouts"),
    };
    let name = budget.and_then(|budget| best.recipe.strip_suffix(&format!(" {budget}")));
    let name = name.unwrap_or(&best.recipe);
    let (article, among) = match rows.len() {
        1 => ("a", String::new()),
        count => ("the largest", format!(" of {count} {kind}s")),
    };
    let interval = best.return_interval();
    let (successes, policies) = (best.successes(), best.policies.len());
    let of_policies = match policies {
        1 if successes == 1 => "its only policy succeeds".into(),
        1 => "its only policy does not succeed".into(),
        _ => format!("{successes} of its {policies} policies succeed"),
    };
    let mut sentence = format!(
        "On {plant}{after}, the {kind} {name} has {article} mean return{among}: {:.1} of at most {MAX_STEPS} (95 % \
         interval {:.0} to {:.0}); {of_policies}.",
        best.real().0,
        interval.lower,
        interval.upper
    );
    if rows.len() < all {
        let have = if rows.len() == 1 { "has" } else { "have" };
        sentence.push_str(&format!(
            " Only {} of {all} {kind}s {have} the returns of all policies there.",
            rows.len()
        ));
    }
    sentence
}

/// The sentence about the methods that need the fewest real rollouts until their recommendations
/// succeed. Methods are compared only after equally many repetitions of each.
pub fn methods_headline(methods: &[MethodResult]) -> String {
    let counts = || methods.iter().map(|it| it.repetitions.len());
    let (fewest, most) = (counts().min().unwrap_or(0), counts().max().unwrap_or(0));
    if most == 0 {
        return "No repetition is over yet.".into();
    }
    if fewest < most {
        return format!(
            "The methods cannot be compared yet: between {fewest} and {most} repetitions of each are over."
        );
    }
    let after = match most {
        1 => "After 1 repetition".to_owned(),
        count => format!("After {count} repetitions"),
    };
    let needed = || methods.iter().filter_map(|it| Some((it.rollouts_within_which(0.9)?, it)));
    let Some(rollouts) = needed().map(|(rollouts, _)| rollouts).min() else {
        return format!(
            "{after} of each method, none has recommended simulations whose policies succeed in nine of ten \
             repetitions."
        );
    };
    let best = needed().filter(|it| it.0 == rollouts).map(|(_, it)| it.method.name());
    let best: Vec<&str> = best.collect();
    let succeed = "nine of ten repetitions recommend simulations whose policies succeed";
    let count = methods.len();
    match &best[..] {
        [only] if count == 1 => {
            format!(
                "{after} of the only method, {only}: within {rollouts} real rollouts, {succeed}."
            )
        }
        [best] => format!(
            "{after} of each of {count} methods, {best} needs the fewest real rollouts: within {rollouts} of them, \
             {succeed}."
        ),
        tied => format!(
            "{after} of each of {count} methods, these need equally many real rollouts, and no other needs fewer: \
             {}; within {rollouts} of them, {succeed}.",
            tied.join(", ")
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiment::{
        Method, Plant, PolicyResult, Recipe, RecommendationOutcome, RecommendationResult,
        RecommendationScore, Repetition, RepetitionId, RivalSettings, RolloutResult,
    };
    use crate::scoring::{Behaviour, Quietness};
    use crate::session::SessionSettings;
    use crate::simulation::Model;

    /// The settings of two recipes with two policies each, on these plants.
    fn settings(plants: &[&str]) -> ExperimentSettings {
        let plant =
            |name: &&str| Plant { name: (*name).into(), emulated: Default::default(), vary: 0.0 };
        let recipe = |model| Recipe::of(model, &SessionSettings::quick());
        ExperimentSettings {
            name: "table".into(),
            seed: 7,
            policies: 2,
            rollouts: 1,
            simulated_starts: 1,
            guard_profile: None,
            plants: plants.iter().map(plant).collect(),
            recipes: vec![recipe(Model::Nominal), recipe(Model::Robust)],
            methods: None,
        }
    }

    /// A row with one policy for each of these returns.
    fn row(name: &str, plant: &str, budget: Option<u32>, returns: &[f64]) -> RecipeResult {
        let policy = |(number, return_): (u32, &f64)| PolicyResult {
            number,
            simulated_return: 500.0,
            rollouts: vec![RolloutResult {
                return_: Some(*return_),
                behaviour: Behaviour::Balanced,
                quietness: Quietness::NONE,
            }],
            recordings: Default::default(),
            fallback: None,
        };
        RecipeResult {
            recipe: name.into(),
            budget,
            plant: plant.into(),
            psi: Default::default(),
            policies: (0..).zip(returns).map(policy).collect(),
        }
    }

    /// The result of a method whose repetitions succeed after these numbers of rollouts, or never.
    fn method(method: Method, needed: &[Option<u32>]) -> MethodResult {
        let recommendation = |real_rollouts: u32| RecommendationResult {
            real_rollouts,
            outcome: RecommendationOutcome::Scored(RecommendationScore { balanced: 2, ran: 2 }),
            succeeds: true,
        };
        let repetition = |(number, needed): (u32, &Option<u32>)| Repetition {
            id: RepetitionId { method, number },
            recommendations: needed.iter().map(|needed| recommendation(*needed)).collect(),
            is_over: true,
            budget: 125,
        };
        MethodResult { method, repetitions: (0..).zip(needed).map(repetition).collect() }
    }

    #[test]
    fn methods_are_compared_after_equally_many_repetitions_of_each() {
        let robust = |needed: &[Option<u32>]| method(Method::Robust, needed);
        let identify = |needed: &[Option<u32>]| method(Method::Identify, needed);
        let told = methods_headline;
        assert_eq!(told(&[robust(&[]), identify(&[])]), "No repetition is over yet.");
        let early = told(&[robust(&[Some(5)]), identify(&[])]);
        assert!(early.ends_with("between 0 and 1 repetitions of each are over."), "{early}");
        let never = told(&[robust(&[None]), identify(&[None])]);
        assert!(never.starts_with("After 1 repetition of each method, none has"), "{never}");
        let only = told(&[robust(&[Some(5), Some(7)])]);
        let words = "After 2 repetitions of the only method, robust: within 7 real rollouts, nine";
        assert!(only.starts_with(words), "{only}");
        let best = told(&[robust(&[Some(5)]), identify(&[Some(3)])]);
        let words = "After 1 repetition of each of 2 methods, identify needs the fewest";
        assert!(best.starts_with(words) && best.contains("within 3 of them"), "{best}");
        let tied = told(&[robust(&[Some(5)]), identify(&[Some(5)])]);
        assert!(tied.contains("fewer: robust, identify; within 5 of them"), "{tied}");
    }

    #[test]
    fn the_headline_of_each_plant_is_about_complete_recipes_and_has_the_interval() {
        let settings = settings(&["lab", "furuta"]);
        let recipes = vec![
            row("nominal", "lab", None, &[100.0, 300.0]),
            row("robust", "lab", None, &[590.0]),
            row("nominal", "furuta", None, &[500.0, 100.0]),
            row("robust", "furuta", None, &[500.0, 520.0]),
        ];
        let told = headlines(&settings, &Results { recipes });
        assert_eq!(told.len(), 2, "{told:?}");
        assert!(told[0].starts_with("On lab, the recipe nominal has a mean return: 200.0 of"));
        assert!(
            told[0].ends_with(
                "0 of its 2 policies succeed. Only 1 of 2 recipes has the returns of all policies there."
            )
        );
        assert!(told[1].starts_with(
            "On furuta, the recipe robust has the largest mean return of 2 recipes: 510.0"
        ));
        assert!(
            told[1].contains("(95 % interval ")
                && told[1].ends_with("2 of its 2 policies succeed.")
        );
        let none = headlines(&settings, &Results { recipes: Vec::new() });
        assert_eq!(none[0], "On lab, no recipe has completed all its policies yet.");
    }

    #[test]
    fn the_headline_of_methods_is_about_all_plants_at_the_largest_complete_budget() {
        let methods = MethodSettings {
            methods: vec![Method::Posterior, Method::Robust],
            repetitions: 1,
            recordings: 6,
            spread: 0.1,
            budgets: vec![2, 5],
            trainings: 1,
            seeds: RepetitionSeeds::OfEachPlant,
            rivals: RivalSettings::default(),
        };
        let mut settings =
            ExperimentSettings { methods: Some(methods), ..settings(&["lab", "furuta"]) };
        let recipes = vec![
            row("posterior 2", "lab", Some(2), &[590.0]),
            row("posterior 5", "lab", Some(5), &[500.0]),
            row("posterior 2", ALL_PLANTS, Some(2), &[590.0, 580.0]),
            row("robust 2", ALL_PLANTS, Some(2), &[400.0, 300.0]),
            row("posterior 5", ALL_PLANTS, Some(5), &[500.0, 540.0]),
            row("robust 5", ALL_PLANTS, Some(5), &[600.0]),
        ];
        let results = Results { recipes };
        let told = headlines(&settings, &results);
        assert_eq!(told.len(), 1, "{told:?}");
        let words =
            "On all plants, after 5 real rollouts, the method posterior has a mean return: 520.0";
        assert!(told[0].starts_with(words), "{told:?}");
        if let Some(methods) = &mut settings.methods {
            methods.seeds = RepetitionSeeds::SameOnAllPlants;
        }
        let told = headlines(&settings, &results);
        assert_eq!(told.len(), 2, "{told:?}");
        assert!(told[0].contains("its only policy succeeds. Only 1 of 2 methods has"), "{told:?}");
    }
}
