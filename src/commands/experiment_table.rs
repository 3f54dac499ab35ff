use std::fmt::Write;

use serde_json::{Map, Value, json};

use crate::experiment::{Behaviour, RecipeResult, Results};

/// Columns of a name.
const NAME: usize = 20;

/// For people, 80 columns wide: a block for each plant.
pub fn table(results: &Results) -> String {
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
        let _ = writeln!(
            text,
            "\n{:NAME$} {:>8} {:>6} {:>9} {:>10} {:>6} {:>6}",
            "rollouts, %", "stood", "late", "left box", "chattered", "fell", "fault"
        );
        for recipe in &recipes {
            let share = |behaviour| 100.0 * recipe.share(behaviour);
            let [stood, late, left, chattered, fell, fault] = Behaviour::ALL.map(share);
            let _ = writeln!(
                text,
                "{:NAME$} {stood:8.0} {late:6.0} {left:9.0} {chattered:10.0} {fell:6.0} {fault:6.0}",
                short(&recipe.recipe)
            );
        }
    }
    text
}

fn line(recipe: &RecipeResult) -> String {
    let spread = |(mean, deviation): (f64, f64)| match recipe.policies.len() {
        0 => "-".into(),
        1 => format!("{mean:.1}"),
        _ => format!("{mean:.1} ± {deviation:5.1}"),
    };
    let returns = recipe.return_interval();
    let success = recipe.success_interval();
    let succeed = format!("{}/{}", recipe.successes(), recipe.policies.len());
    let from_to = |lower: f64, upper: f64| match recipe.policies.is_empty() {
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

/// For scripts.
pub fn value(results: &Results) -> Value {
    let models: Vec<Value> = results.recipes.iter().map(model).collect();
    json!({ "models": models })
}

fn model(recipe: &RecipeResult) -> Value {
    let (simulated, real) = (recipe.simulated(), recipe.real());
    let shares: Map<String, Value> = Behaviour::ALL
        .into_iter()
        .map(|behaviour| (behaviour.name().to_owned(), json!(recipe.share(behaviour))))
        .collect();
    json!({
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
        "psi": recipe.psi,
    })
}

/// A line for each policy on each plant.
pub fn csv(results: &Results) -> String {
    let mut text = String::from("recipe,plant,policy,simulated_return,mean_return,succeeds");
    for behaviour in Behaviour::ALL {
        let _ = write!(text, ",{}", behaviour.name());
    }
    text.push('\n');
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
            text.push('\n');
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiment::{PolicyResult, RolloutResult};

    fn results(policies: u32) -> Results {
        let rollout = |return_, behaviour| RolloutResult { return_: Some(return_), behaviour };
        let policies = (0..policies).map(|number| PolicyResult {
            number,
            simulated_return: 555.4 + f64::from(number % 3),
            rollouts: vec![rollout(541.2, Behaviour::Stood), rollout(0.4, Behaviour::LeftBox)],
        });
        Results {
            recipes: vec![RecipeResult {
                recipe: "nominal-handcrafted-with-a-long-name".into(),
                plant: "lab".into(),
                psi: Default::default(),
                policies: policies.collect(),
            }],
        }
    }

    #[test]
    fn the_table_fits_a_terminal() {
        for policies in [0, 1, 20, 1000] {
            for line in table(&results(policies)).lines() {
                assert!(line.chars().count() <= 80, "{line}");
            }
        }
    }

    #[test]
    fn the_csv_has_a_line_for_each_policy() {
        let csv = csv(&results(3));
        let fields = |line: &str| line.split(',').count();
        let lines: Vec<&str> = csv.lines().collect();
        assert_eq!(lines.len(), 4);
        assert!(lines.iter().all(|line| fields(line) == fields(lines[0])));
        assert!(lines[1].ends_with("270.800,false,1,0,1,0,0,0"), "{}", lines[1]);
    }
}
