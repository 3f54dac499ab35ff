use std::fmt::Write;

use crate::experiment::Comparison;

/// Width of the column of names, characters; longer names are cut.
const NAMES: usize = 30;

/// Largest number of comparisons that the table shows for a plant; the JSON has all of them.
const SHOWN: usize = 10;

/// Returns the comparisons of recipes on one plant as a table for people, at most 80 columns wide,
/// sorted by the smaller of their two p-values. The text is empty if the plant has no comparison.
pub fn table(comparisons: &[Comparison], plant: &str) -> String {
    let mut comparisons: Vec<_> = comparisons.iter().filter(|it| it.plant == plant).collect();
    if comparisons.is_empty() {
        return String::new();
    }
    let smaller = |it: &Comparison| it.success_p.min(it.return_p);
    comparisons.sort_by(|a, b| smaller(a).total_cmp(&smaller(b)));
    let mut text = format!(
        "\n{:NAMES$} {:>8} {:>7} {:>8} {:>7} {:>9}\n",
        "second - first, paired", "succeed", "p", "return", "p", "higher"
    );
    for it in comparisons.iter().take(SHOWN) {
        let names = format!("{} - {}", it.second, it.first);
        let _ = writeln!(
            text,
            "{names:NAMES$.NAMES$} {:>+6.0} % {:>7} {:>8} {:>7} {:>9}",
            100.0 * it.success_difference,
            p_value(it.success_p),
            if it.return_difference.is_nan() {
                "-".into()
            } else {
                format!("{:+.1}", it.return_difference)
            },
            p_value(it.return_p),
            if it.superiority.is_nan() {
                "-".into()
            } else {
                format!("{:.0} %", 100.0 * it.superiority)
            },
        );
    }
    if comparisons.len() > SHOWN {
        let _ = writeln!(text, "and {} more: --json has all", comparisons.len() - SHOWN);
    }
    text.push_str(&too_few_pairs(&comparisons));
    text
}

/// Returns a line that says that no difference in success can be significant at 5 % with so few
/// pairs; empty if one can.
fn too_few_pairs(comparisons: &[&Comparison]) -> String {
    let smallest = |it: &&Comparison| it.smallest_success_p();
    let Some(best) = comparisons.iter().min_by(|a, b| smallest(a).total_cmp(&smallest(b))) else {
        return String::new();
    };
    if best.smallest_success_p() <= 0.05 {
        return String::new();
    }
    let Comparison { pairs, corrected_for, .. } = best;
    format!(
        "{pairs} pairs cannot show a difference in success at 5 % in {corrected_for} comparisons\n"
    )
}

fn p_value(p: f64) -> String {
    if p < 0.001 { "< 0.001".into() } else { format!("{p:.3}") }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::experiment::{PolicyResult, RecipeResult, Results, RolloutResult};
    use crate::scoring::{Behaviour, Quietness};

    #[test]
    fn two_recipes_give_one_line_of_at_most_80_columns() {
        let recipe = |name: &str, return_: f64, behaviour| RecipeResult {
            recipe: name.into(),
            budget: None,
            plant: "lab".into(),
            psi: BTreeMap::new(),
            policies: (0..10)
                .map(|number| PolicyResult {
                    number,
                    simulated_return: 500.0,
                    rollouts: vec![RolloutResult {
                        return_: Some(return_ + f64::from(number)),
                        behaviour,
                        quietness: Quietness::NONE,
                    }],
                    recordings: Default::default(),
                    fallback: None,
                })
                .collect(),
        };
        let results = Results {
            recipes: vec![
                recipe("nominal", 100.0, Behaviour::Fell),
                recipe("robust", 540.0, Behaviour::Balanced),
            ],
        };
        let comparisons = results.comparisons();
        let text = table(&comparisons, "lab");
        assert!(text.lines().all(|line| line.chars().count() <= 80), "{text}");
        let line = text.lines().nth(2).unwrap();
        assert!(line.starts_with("robust - nominal ") && line.contains("+100 %"), "{text}");
        assert!(line.contains("0.002") && line.contains("+440.0"), "{text}");
        assert_eq!(table(&comparisons, "ideal"), "");
    }
}
