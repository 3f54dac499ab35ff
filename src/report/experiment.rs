//! The report on an experiment.

use super::ReportError;
use super::chart::{Axis, Chart, Mark, Series, Style};
use super::densities::{density_chart, words};
use super::draws::{DRAWS_IN_WORDS, QuantityDraws};
use super::headline::{compared, headlines, methods_headline};
use super::page::{Cell, Page};
use super::provenance::add_provenance;
use super::returns::{CandidateReturns, returns_chart};
use super::rollout::{RolloutView, add_player, behaviour_words, first_upper};
use crate::experiment::statistics::mean_and_deviation;
use crate::experiment::{
    Comparison, ExperimentSettings, MethodResult, MethodResults, RecipeResult, Results,
    SearchReturns,
};
use crate::qube::{DomainParameter, MAX_STEPS, PlantModel, Quantity};
use crate::scoring::Behaviour;
use crate::scoring::criterion::{POLICY_SHARE, SUCCESS_RETURN};
use crate::simulation::DomainDistribution;

/// Rollouts of an experiment that a page shows, each with its name, such as
/// `nominal on lab, policy 3`.
pub type NamedRollouts = Vec<(String, RolloutView)>;

/// The HTML page of an experiment that compares recipes, or methods at fixed budgets.
/// `distributions` are the recipes' distributions of simulations, each with its recipe's name;
/// `rollouts` are examples; `commands` are pairs of a purpose and a command that repeats a part of
/// the experiment.
///
/// # Errors
/// The data of the figures cannot be written.
pub fn recipes_page(
    settings: &ExperimentSettings,
    results: &Results,
    distributions: &[(String, DomainDistribution)],
    searches: &SearchReturns,
    rollouts: NamedRollouts,
    commands: &[(String, String)],
) -> Result<String, ReportError> {
    let mut page = Page::new(format!("Experiment {}", settings.name));
    for headline in headlines(settings, results) {
        page.outcome(&headline);
    }
    page.paragraph(&format!(
        "A policy succeeds when its mean return is at least {SUCCESS_RETURN:.0} and at least {:.0} % of its rollouts balance to the end.",
        100.0 * POLICY_SHARE
    ));
    let mut plants: Vec<&str> = Vec::new();
    for recipe in &results.recipes {
        if !plants.contains(&recipe.plant.as_str()) {
            plants.push(&recipe.plant);
        }
    }
    let comparisons = results.comparisons();
    let kind = compared(settings);
    for plant in plants {
        let recipes: Vec<&RecipeResult> =
            results.recipes.iter().filter(|it| it.plant == plant).collect();
        page.section(&format!("On {plant}"));
        add_returns(&mut page, kind, &recipes);
        add_behaviours(&mut page, kind, &recipes);
        let of_plant: Vec<&Comparison> =
            comparisons.iter().filter(|it| it.plant == plant).collect();
        add_comparisons(&mut page, kind, &of_plant);
    }
    add_distributions(&mut page, distributions, settings.plant());
    add_searches(&mut page, searches);
    let first = rollouts.first().map(|(name, view)| (name.clone(), view.header.clone()));
    add_examples(&mut page, kind, rollouts);
    let first = first.as_ref().map(|(name, header)| (name.as_str(), header));
    add_provenance(&mut page, first, commands);
    Ok(page.finish()?)
}

/// The HTML page of an experiment that compares methods up to their first success. `commands` are
/// pairs of a purpose and a command that repeats a part of the experiment.
///
/// # Errors
/// The data of the figures cannot be written.
pub fn methods_page(
    name: &str,
    results: &MethodResults,
    commands: &[(String, String)],
) -> Result<String, ReportError> {
    let mut page = Page::new(format!("Experiment {name}"));
    page.outcome(&methods_headline(&results.methods));
    page.section(&format!("{} on {}", results.recipe, results.plant));
    add_methods(&mut page, results);
    page.chart(
        "Repetitions whose recommendation succeeds",
        "A line ends at the method's budget. A line that ends below 1 has repetitions that never succeeded.",
        success_chart(results),
    );
    add_provenance(&mut page, None, commands);
    Ok(page.finish()?)
}

/// Adds the table of the real rollouts that each method needs.
fn add_methods(page: &mut Page, results: &MethodResults) {
    let rows: Vec<Vec<Cell>> = results
        .methods
        .iter()
        .map(|it| {
            let interval = it.reached_interval();
            let within = |share| {
                it.rollouts_within_which(share)
                    .map_or("–".to_owned(), |rollouts| rollouts.to_string())
            };
            vec![
                it.method.name().into(),
                Cell::Number(it.repetitions.len().to_string()),
                Cell::Number(it.reached().to_string()),
                Cell::Number(format!(
                    "{:.0} to {:.0} %",
                    100.0 * interval.lower,
                    100.0 * interval.upper
                )),
                Cell::Number(within(0.5)),
                Cell::Number(within(0.9)),
            ]
        })
        .collect();
    let heads = [
        "method",
        "repetitions",
        "succeeded",
        "95 % interval",
        "rollouts for half of them",
        "rollouts for nine of ten",
    ];
    page.table(&heads, &rows, None);
}

/// The share of repetitions that have succeeded over the number of real rollouts, as a step line
/// for each method.
fn success_chart(results: &MethodResults) -> Chart {
    let last = results.methods.iter().filter_map(MethodResult::budget).max().unwrap_or(1);
    let mut xs: Vec<f64> = results
        .methods
        .iter()
        .flat_map(|it| it.corners().into_iter().map(|(at, _)| at))
        .chain([1.0, f64::from(last)])
        .collect();
    xs.retain(|at| *at >= 1.0);
    xs.sort_by(f64::total_cmp);
    xs.dedup();
    let mut series = Vec::new();
    for (index, method) in results.methods.iter().enumerate() {
        let corners = method.corners();
        let end = method.budget().map_or(0.0, f64::from);
        let share = |at: f64| {
            corners.iter().filter(|corner| corner.0 <= at).map(|corner| corner.1).next_back()
        };
        let values = xs.iter().map(|at| if *at <= end { share(*at).or(Some(0.0)) } else { None });
        series.push(Series::new(method.method.name(), Style::Steps, index, values));
    }
    Chart {
        x: Axis::new("real rollouts", ""),
        y: Axis::new("share of repetitions", ""),
        xs,
        series,
        logarithmic: true,
        y_range: Some([0.0, 1.05]),
        ..Chart::default()
    }
}

/// Adds the table of returns and successes of each recipe or method, and the figure of its
/// policies' returns; `kind` is `recipe` or `method`.
fn add_returns(page: &mut Page, kind: &str, recipes: &[&RecipeResult]) {
    let rows: Vec<Vec<Cell>> = recipes
        .iter()
        .map(|recipe| {
            let (simulated, real) = (recipe.simulated(), recipe.real());
            let [returns, success] = [recipe.return_interval(), recipe.success_interval()];
            let quietness = recipe.quietness().figures();
            let some = |text: String| {
                Cell::Number(if recipe.policies.is_empty() { "–".into() } else { text })
            };
            let spread = |returns: (f64, f64)| {
                Cell::Number(mean_and_deviation(returns, 0).unwrap_or("–".into()))
            };
            vec![
                recipe.recipe.as_str().into(),
                Cell::Number(recipe.policies.len().to_string()),
                spread(simulated),
                spread(real),
                match returns.lower.is_finite() && returns.upper.is_finite() {
                    true => some(format!("{:.0} to {:.0}", returns.lower, returns.upper)),
                    // Void rollouts have no return.
                    false => Cell::Number("–".into()),
                },
                some(format!("{} of {}", recipe.successes(), recipe.policies.len())),
                some(format!("{:.0} to {:.0} %", 100.0 * success.lower, 100.0 * success.upper)),
                Cell::number(quietness.as_ref().map(|it| it.change_v), 2),
                Cell::number(quietness.as_ref().map(|it| it.copper_loss_w), 2),
            ]
        })
        .collect();
    let heads = [
        kind,
        "policies",
        "return in simulation",
        "return on the plant",
        "95 % interval of its mean",
        "succeed",
        "95 % interval",
        "voltage change, V a tick",
        "copper loss, W",
    ];
    page.table(&heads, &rows, None);
    page.paragraph("Means ± standard deviations over policies.");
    if recipes.iter().any(|recipe| !recipe.policies.is_empty()) {
        let note = "A dot is the mean of a policy's rollouts.";
        page.chart("Return of each policy", note, policies_chart(kind, recipes));
    }
}

/// The mean return of each policy as a dot, the policies of a recipe or method side by side, with
/// their mean.
fn policies_chart(kind: &str, recipes: &[&RecipeResult]) -> Chart {
    let mut places: Vec<(f64, [Option<f64>; 2])> = Vec::new();
    for (index, recipe) in recipes.iter().enumerate() {
        let returns = recipe.returns();
        let spread = 0.5 / returns.len().max(1) as f64;
        let middle = (returns.len().max(1) - 1) as f64 / 2.0;
        for (policy, return_) in returns.iter().enumerate() {
            places.push((index as f64 + spread * (policy as f64 - middle), [Some(*return_), None]));
        }
        if !returns.is_empty() {
            places.push((index as f64, [None, Some(recipe.real().0)]));
        }
    }
    places.sort_by(|one, other| one.0.total_cmp(&other.0));
    let mut marks =
        vec![Mark::horizontal(SUCCESS_RETURN, format!("success from {SUCCESS_RETURN:.0}"))];
    marks.extend(
        recipes
            .iter()
            .enumerate()
            .map(|(index, recipe)| Mark::vertical(index as f64 - 0.45, recipe.recipe.as_str())),
    );
    Chart {
        x: Axis::new(format!("{kind}, in the order of the table"), ""),
        y: Axis::new("mean return of a policy", ""),
        xs: places.iter().map(|place| place.0).collect(),
        series: vec![
            Series::new("policy", Style::Dots, 0, places.iter().map(|place| place.1[0])),
            Series::new(
                format!("mean of the {kind}"),
                Style::Dots,
                1,
                places.iter().map(|place| place.1[1]),
            ),
        ],
        marks,
        whole: true,
        x_range: Some([-0.5, recipes.len() as f64 - 0.5]),
        y_range: Some([0.0, 1.04 * MAX_STEPS as f64]),
        ..Chart::default()
    }
}

fn add_behaviours(page: &mut Page, kind: &str, recipes: &[&RecipeResult]) {
    let rows: Vec<Vec<Cell>> = recipes
        .iter()
        .filter(|recipe| !recipe.policies.is_empty())
        .map(|recipe| {
            let shares =
                Behaviour::ALL.map(|it| Cell::Number(format!("{:.0} %", 100.0 * recipe.share(it))));
            [Cell::from(recipe.recipe.as_str())].into_iter().chain(shares).collect()
        })
        .collect();
    if rows.is_empty() {
        return;
    }
    page.heading("How the rollouts ended");
    let heads: Vec<&str> = [kind].into_iter().chain(Behaviour::ALL.map(behaviour_words)).collect();
    page.table(&heads, &rows, None);
}

fn add_comparisons(page: &mut Page, kind: &str, comparisons: &[&Comparison]) {
    if comparisons.is_empty() {
        return;
    }
    page.heading(&format!("{}s in pairs", first_upper(kind)));
    page.paragraph(
        "The differences are over pairs of policies of equal number, which have equal seeds. Their p-values are \
         McNemar's exact test and a permutation test, corrected by Holm for the number of comparisons on the plant \
         at the same number of real rollouts. The last column is the share of \
         the pairs in which the second's return is higher; ties count half.",
    );
    let finite = |value: f64, text: String| {
        Cell::Number(if value.is_finite() { text } else { "–".into() })
    };
    let p = |value: f64| {
        Cell::Number(if value < 0.001 { "< 0.001".into() } else { format!("{value:.3}") })
    };
    let rows: Vec<Vec<Cell>> = comparisons
        .iter()
        .map(|it| {
            vec![
                it.first.as_str().into(),
                it.second.as_str().into(),
                Cell::Number(format!("{:+.0} %", 100.0 * it.success_difference)),
                p(it.success_p),
                finite(it.return_difference, format!("{:+.1}", it.return_difference)),
                p(it.return_p),
                finite(it.superiority, format!("{:.0} %", 100.0 * it.superiority)),
            ]
        })
        .collect();
    let heads = [
        "first",
        "second",
        "success, second − first",
        "p",
        "return, second − first",
        "p",
        "second is higher",
    ];
    page.table(&heads, &rows, None);
}

fn add_distributions(
    page: &mut Page,
    distributions: &[(String, DomainDistribution)],
    plant: &PlantModel,
) {
    let charts = distribution_charts(distributions, plant);
    if charts.is_empty() {
        return;
    }
    page.section("Distributions of simulations");
    page.paragraph(&format!(
        "Like the thesis's figure 5.2; the curves are smoothed from {DRAWS_IN_WORDS} draws of each distribution. A recipe without \
         spread has no curve."
    ));
    page.grid(|page| {
        for (quantity, chart) in charts {
            page.chart(&first_upper(&words(quantity)), "", chart);
        }
    });
}

/// The densities of the masses and lengths in which at least one recipe has spread.
fn distribution_charts(
    distributions: &[(String, DomainDistribution)],
    plant: &PlantModel,
) -> Vec<(Quantity, Chart)> {
    let named = distributions.iter();
    let draws: Vec<_> = named.map(|(name, it)| (name.as_str(), QuantityDraws::of(it))).collect();
    let mut charts = Vec::new();
    for quantity in DomainParameter::MASSES_AND_LENGTHS.map(Quantity::Parameter) {
        let curves: Vec<_> =
            draws.iter().map(|(name, it)| (*name, &it[quantity.index()])).collect();
        if curves.iter().any(|(_, it)| it.has_spread()) {
            let nominal = plant.nominal().get(quantity);
            charts.push((quantity, density_chart(quantity, &curves, nominal)));
        }
    }
    charts
}

fn add_searches(page: &mut Page, searches: &SearchReturns) {
    let searches: Vec<_> =
        searches.iter().filter(|(_, candidates)| !candidates.is_empty()).collect();
    if searches.is_empty() {
        return;
    }
    page.section("Searches");
    page.paragraph("The returns of each candidate in turn; a dot is one rollout.");
    page.grid(|page| {
        for (recipe, candidates) in searches {
            page.chart(recipe, "", search_chart(candidates));
        }
    });
}

fn search_chart(candidates: &[Vec<f64>]) -> Chart {
    let numbered = (0..).zip(candidates).filter(|(_, returns)| !returns.is_empty());
    let candidates: Vec<CandidateReturns> = numbered
        .map(|(number, returns)| CandidateReturns {
            number,
            returns: returns.clone(),
            is_searched: true,
        })
        .collect();
    returns_chart(&candidates, MAX_STEPS as f64, Vec::new())
}

fn add_examples(page: &mut Page, kind: &str, rollouts: NamedRollouts) {
    if rollouts.is_empty() {
        return;
    }
    page.section("Rollouts");
    page.paragraph(&format!(
        "The first rollout of the best and of the worst policy of each {kind} on each plant, for up to 20 of these pairs."
    ));
    let motions = rollouts.into_iter().map(|(name, view)| {
        let outcome = format!("{name}: {}", view.result());
        let sentence = view.sentence();
        view.motion.named(name, outcome, sentence)
    });
    add_player(page, motions.collect(), 0);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiment::{PolicyResult, RolloutResult};
    use crate::scoring::Quietness;
    use crate::simulation::Direction;

    #[test]
    fn a_recipe_whose_rollouts_are_all_void_has_no_interval() {
        let policy = PolicyResult {
            number: 0,
            simulated_return: 500.0,
            rollouts: vec![RolloutResult {
                return_: None,
                behaviour: Behaviour::Balanced,
                quietness: Quietness::NONE,
            }],
            recordings: Default::default(),
            fallback: None,
        };
        let recipe = RecipeResult {
            recipe: "nominal".into(),
            budget: None,
            plant: "lab".into(),
            psi: Default::default(),
            policies: vec![policy],
        };
        let mut page = Page::new("void");
        add_returns(&mut page, "recipe", &[&recipe]);
        let page = page.finish().unwrap();
        assert!(!page.contains("NaN to NaN"));
        assert!(page.contains(&format!("0 of {}", recipe.policies.len())));
    }

    #[test]
    fn the_density_of_a_quantity_includes_joint_deviations() {
        let mass = Quantity::Parameter(DomainParameter::RotaryMass);
        let deviation = 0.1 * PlantModel::QUBE.nominal().get(mass);
        let directions = [Direction::new(&[(mass, deviation)])];
        let charts = |distribution: DomainDistribution| {
            distribution_charts(&[("profile".into(), distribution)], &PlantModel::QUBE)
        };
        assert!(charts(DomainDistribution::nominal()).is_empty());
        let moved = charts(DomainDistribution::nominal().along(&directions));
        assert_eq!(moved.iter().map(|(quantity, _)| *quantity).collect::<Vec<_>>(), [mass]);
        let [low, high] = moved[0].1.x_range.unwrap();
        assert!((high - low) / (2.0 * 3.5 * deviation) > 1.0, "{low} to {high}");
    }
}
