use std::fmt::Write;

use serde_json::{Map, Value, json};

use super::comparison_table;
use crate::experiment::statistics::mean_and_deviation;
use crate::experiment::{RecipeResult, Results};
use crate::scoring::{Behaviour, Quietness};

/// Width of the column of names, characters; longer names are cut.
const NAME: usize = 20;

/// Returns the table for people, up to 80 columns wide: a block for each plant.
pub fn table(results: &Results) -> String {
    let comparisons = results.comparisons();
    let mut text = String::new();
    let mut plants: Vec<&str> = Vec::new();
    for recipe in &results.recipes {
        if !plants.contains(&recipe.plant.as_str()) {
            plants.push(&recipe.plant);
        }
    }
    for plant in plants {
        let recipes: Vec<_> = results.recipes.iter().filter(|it| it.plant == plant).collect();
        let title = format!("on {plant}");
        let _ = writeln!(
            text,
            "\n{title:NAME$} {:>13} {:>13} {:>11} {:>10} {:>8}",
            "simulation", "real return", "95 %", "succeed", "95 %"
        );
        for recipe in &recipes {
            let _ = writeln!(text, "{}", line(recipe));
        }
        for recipe in recipes.iter().filter(|it| it.fallbacks() > 0) {
            let _ = writeln!(
                text,
                "{}: {} of {} repetitions fell back to robust",
                short(&recipe.recipe),
                recipe.fallbacks(),
                recipe.policies.len()
            );
        }
        let _ = writeln!(
            text,
            "\n{:NAME$} {:>8} {:>6} {:>9} {:>10} {:>6} {:>6}",
            "rollouts, %", "balanced", "late", "left box", "chattered", "fell", "fault"
        );
        for recipe in &recipes {
            let share = |behaviour| match recipe.policies.is_empty() {
                true => "-".into(),
                false => format!("{:.0}", 100.0 * recipe.share(behaviour)),
            };
            let [balanced, late, left, chattered, fell, fault]: [String; 6] =
                Behaviour::ALL.map(share);
            let _ = writeln!(
                text,
                "{:NAME$} {balanced:>8} {late:>6} {left:>9} {chattered:>10} {fell:>6} {fault:>6}",
                short(&recipe.recipe)
            );
        }
        let _ = writeln!(
            text,
            "\n{:NAME$} {:>11} {:>14} {:>10} {:>14}",
            "balancing", "V a tick", "sign changes/s", "V rms", "copper loss, W"
        );
        for recipe in &recipes {
            let _ = writeln!(
                text,
                "{:NAME$} {}",
                short(&recipe.recipe),
                quietness_columns(&recipe.quietness())
            );
        }
        text.push_str(&comparison_table::table(&comparisons, plant));
    }
    text
}

/// Returns the quietness of a recipe's policies, in the columns of the table.
fn quietness_columns(quietness: &Quietness) -> String {
    let columns = match quietness.figures() {
        None => ["-"; 4].map(String::from),
        Some(figures) => [
            format!("{:.2}", figures.change_v),
            format!("{:.1}", figures.sign_changes_per_s),
            format!("{:.2}", figures.rms_v),
            format!("{:.2}", figures.copper_loss_w),
        ],
    };
    let [change, signs, rms, loss] = columns;
    format!("{change:>11} {signs:>14} {rms:>10} {loss:>14}")
}

fn line(recipe: &RecipeResult) -> String {
    // Policies whose rollouts are all void have no return.
    let spread = |returns: (f64, f64)| mean_and_deviation(returns, 5).unwrap_or("-".into());
    let returns = recipe.return_interval();
    let success = recipe.success_interval();
    let succeed = format!("{}/{}", recipe.successes(), recipe.policies.len());
    let from_to = |lower: f64, upper: f64| match recipe.policies.is_empty() || lower.is_nan() {
        true => "-".into(),
        false => format!("{lower:.0} to {upper:.0}"),
    };
    let (simulated, real) = (spread(recipe.simulated()), spread(recipe.real()));
    let return_interval = from_to(returns.lower, returns.upper);
    let success_interval = from_to(100.0 * success.lower, 100.0 * success.upper);
    format!(
        "{:NAME$} {simulated:>13} {real:>13} {return_interval:>11} {succeed:>10} {success_interval:>8}",
        short(&recipe.recipe),
    )
}

fn short(name: &str) -> &str {
    name.get(..NAME).unwrap_or(name)
}

/// Returns the results as JSON, for scripts.
pub fn value(results: &Results) -> Value {
    let models: Vec<Value> = results.recipes.iter().map(model).collect();
    json!({ "models": models, "comparisons": results.comparisons() })
}

fn model(recipe: &RecipeResult) -> Value {
    let (simulated, real) = (recipe.simulated(), recipe.real());
    let shares: Map<String, Value> = Behaviour::ALL
        .into_iter()
        .map(|behaviour| (behaviour.name().to_owned(), json!(recipe.share(behaviour))))
        .collect();
    let mut model = json!({
        "model": recipe.recipe,
        "plant": recipe.plant,
        "policies": recipe.policies.len(),
        "sim_mean": simulated.0,
        "sim_std": simulated.1,
        "mean_return": real.0,
        "std_return": real.1,
        "mean_return_interval": recipe.return_interval(),
        "success_rate": recipe.success_rate(),
        "success_interval": recipe.success_interval(),
        "rollouts": shares,
        "balancing": recipe.quietness().figures(),
        "psi": recipe.psi,
    });
    if recipe.budget.is_some() {
        model["fell_back_to_robust"] = json!(recipe.fallbacks());
    }
    model
}

/// First columns of the CSV file, by which it is recognised.
pub const CSV_BEGINS: &str = "recipe,plant,policy,";

/// Returns the results as CSV, with a line for each policy on each plant.
pub fn csv(results: &Results) -> String {
    let mut text = format!("{CSV_BEGINS}simulated_return,mean_return,succeeds");
    for behaviour in Behaviour::ALL {
        let _ = write!(text, ",{}", behaviour.name());
    }
    text.push_str(",change_v,sign_changes_per_s,rms_v,copper_loss_w,fell_back_to_robust\n");
    for recipe in &results.recipes {
        for policy in &recipe.policies {
            let mean = policy.mean_return().map_or(String::new(), |mean| format!("{mean:.3}"));
            let _ = write!(
                text,
                "{},{},{},{:.3},{mean},{}",
                recipe.recipe,
                recipe.plant,
                policy.number,
                policy.simulated_return,
                policy.succeeds()
            );
            for behaviour in Behaviour::ALL {
                let _ = write!(text, ",{}", policy.count(behaviour));
            }
            let _ = match policy.quietness().figures() {
                None => write!(text, ",,,,"),
                Some(figures) => write!(
                    text,
                    ",{:.4},{:.3},{:.4},{:.4}",
                    figures.change_v,
                    figures.sign_changes_per_s,
                    figures.rms_v,
                    figures.copper_loss_w
                ),
            };
            let _ = writeln!(text, ",{}", policy.fallback.is_some());
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiment::{PolicyResult, RolloutResult};

    fn results(policies: u32) -> Results {
        let quietness = Quietness::NONE;
        let rollout =
            |return_, behaviour| RolloutResult { return_: Some(return_), behaviour, quietness };
        let policies = (0..policies).map(|number| PolicyResult {
            number,
            simulated_return: 555.4 + f64::from(number % 3),
            rollouts: vec![rollout(541.2, Behaviour::Balanced), rollout(0.4, Behaviour::LeftBox)],
            recordings: Default::default(),
            fallback: (number % 5 == 1).then(|| "no recording shows a motion".into()),
        });
        Results {
            recipes: vec![RecipeResult {
                recipe: "nominal-handcrafted-with-a-long-name".into(),
                budget: None,
                plant: "lab".into(),
                psi: Default::default(),
                policies: policies.collect(),
            }],
        }
    }

    #[test]
    fn the_table_fits_a_terminal() {
        for policies in [0, 1, 20, 1000] {
            let table = table(&results(policies));
            for line in table.lines() {
                assert!(line.chars().count() <= 80, "{line}");
            }
            assert!(!table.contains("NaN"), "{table}");
        }
    }

    #[test]
    fn the_csv_has_a_line_for_each_policy() {
        let csv = csv(&results(3));
        let fields = |line: &str| line.split(',').count();
        let lines: Vec<&str> = csv.lines().collect();
        assert_eq!(lines.len(), 4);
        assert!(lines.iter().all(|line| fields(line) == fields(lines[0])));
        assert!(lines[1].ends_with("270.800,false,1,0,1,0,0,0,,,,,false"), "{}", lines[1]);
        assert!(lines[2].ends_with(",true"), "{}", lines[2]);
    }

    #[test]
    fn repetitions_without_a_recommendation_are_counted() {
        let mut results = results(20);
        results.recipes[0].budget = Some(2);
        let table = table(&results);
        let line = "nominal-handcrafted-: 4 of 20 repetitions fell back to robust";
        assert!(table.lines().any(|it| it == line), "{table}");
        assert_eq!(value(&results)["models"][0]["fell_back_to_robust"], 4);
        results.recipes[0].budget = None;
        assert_eq!(value(&results)["models"][0].get("fell_back_to_robust"), None);
    }
}
