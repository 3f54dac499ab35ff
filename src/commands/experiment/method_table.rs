use std::fmt::Write;

use serde_json::{Value, json};

use crate::experiment::{
    MethodResult, MethodResults, RecommendationOutcome, RecommendationResult, RecommendationScore,
    Repetition,
};

/// Width of the column of the methods' names, characters.
const NAMES: usize = 13;

/// Returns the table for people: a line of at most 80 columns for each method, then the reasons why
/// recommendations could not be scored.
pub fn table(results: &MethodResults) -> String {
    let mut text = format!(
        "\nreal rollouts until the recommendation succeeds, {} on {}\n\n{:NAMES$} {:>8} {:>11} {:>8} {:>8} {:>8} {:>8}\n",
        results.recipe,
        results.plant,
        "method",
        "reached",
        "95 %",
        "quarter",
        "median",
        "three q.",
        "scored"
    );
    for method in &results.methods {
        let _ = writeln!(text, "{}", line(method));
    }
    for method in &results.methods {
        let recommendations = method.repetitions.iter().flat_map(|it| &it.recommendations);
        let mut reasons: Vec<&str> =
            recommendations.filter_map(|it| it.outcome.refusal()).collect();
        reasons.sort_unstable();
        reasons.dedup();
        for reason in reasons {
            let _ = writeln!(text, "{}: {reason}", method.method);
        }
    }
    text
}

fn line(method: &MethodResult) -> String {
    let within = |share| match (method.budget(), method.rollouts_within_which(share)) {
        (None, _) => "-".into(),
        (_, Some(rollouts)) => rollouts.to_string(),
        (Some(budget), None) => format!("> {budget}"),
    };
    let over = method.repetitions.len();
    let interval = method.reached_interval();
    let share = match over {
        0 => "-".into(),
        _ => format!("{:.0} to {:.0}", 100.0 * interval.lower, 100.0 * interval.upper),
    };
    let reached = format!("{}/{over}", method.reached());
    format!(
        "{:NAMES$} {reached:>8} {share:>11} {:>8} {:>8} {:>8} {:>8}",
        method.method.name(),
        within(0.25),
        within(0.5),
        within(0.75),
        method.scored()
    )
}

/// Returns the results as JSON, for scripts.
pub fn value(results: &MethodResults) -> Value {
    let method = |method: &MethodResult| {
        let needed = method.repetitions.iter().map(Repetition::succeeded_after);
        json!({
            "strategy": method.method.name(),
            "repetitions": method.repetitions.len(),
            "reached": method.reached(),
            "reached_interval": method.reached_interval(),
            "real_rollouts": needed.collect::<Vec<_>>(),
            "quarter": method.rollouts_within_which(0.25),
            "median": method.rollouts_within_which(0.5),
            "three_quarters": method.rollouts_within_which(0.75),
            "budget": method.budget(),
            "answers_judged": method.scored(),
        })
    };
    json!({
        "recipe": results.recipe,
        "plant": results.plant,
        "strategies": results.methods.iter().map(method).collect::<Vec<_>>(),
    })
}

/// First columns of the CSV file, by which it is recognised.
pub const CSV_BEGINS: &str = "strategy,repetition,budget,";

/// Returns the results as CSV, with a line for each recommendation. `refused` is the reason why a
/// recommendation could not be scored.
pub fn csv(results: &MethodResults) -> String {
    let mut text = format!("{CSV_BEGINS}real_rollouts,judges_stood,judges_ran,succeeds,refused\n");
    for method in &results.methods {
        for repetition in &method.repetitions {
            for recommendation in &repetition.recommendations {
                let RecommendationResult { real_rollouts, outcome, succeeds } = recommendation;
                let (balanced, ran, refused) = match outcome {
                    RecommendationOutcome::Scored(RecommendationScore { balanced, ran }) => {
                        (*balanced, *ran, String::new())
                    }
                    RecommendationOutcome::Refused(reason) => {
                        (0, 0, format!("\"{}\"", reason.replace('"', "'")))
                    }
                };
                let _ = writeln!(
                    text,
                    "{},{},{},{real_rollouts},{balanced},{ran},{succeeds},{refused}",
                    method.method, repetition.id.number, repetition.budget
                );
            }
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiment::{Method, RepetitionId};

    fn results(repetitions: u32) -> MethodResults {
        let repetition = |number| Repetition {
            id: RepetitionId { method: Method::Identify, number },
            recommendations: vec![
                RecommendationResult {
                    real_rollouts: 1,
                    outcome: RecommendationOutcome::Refused("recording 0: it is \"short\"".into()),
                    succeeds: false,
                },
                RecommendationResult {
                    real_rollouts: 2,
                    outcome: RecommendationOutcome::Scored(RecommendationScore {
                        balanced: 18,
                        ran: 19,
                    }),
                    succeeds: number % 2 == 0,
                },
            ],
            is_over: true,
            budget: 125_000,
        };
        let method = MethodResult {
            method: Method::Identify,
            repetitions: (0..repetitions).map(repetition).collect(),
        };
        MethodResults { recipe: "opt-nominal".into(), plant: "lab".into(), methods: vec![method] }
    }

    #[test]
    fn the_table_fits_a_terminal_and_names_methods_that_never_succeeded() {
        for repetitions in [0, 1, 9, 1000] {
            let table = table(&results(repetitions));
            assert!(table.lines().all(|line| line.chars().count() <= 80), "{table}");
            assert!(!table.contains("NaN"), "{table}");
        }
        let mut longest_name = results(1);
        longest_name.methods[0].method = Method::IdentifyMean;
        let columns = super::table(&longest_name);
        let lengths: Vec<usize> = columns.lines().skip(3).take(2).map(str::len).collect();
        assert_eq!(lengths[0], lengths[1], "{columns}");
        let table = table(&results(10));
        assert!(table.contains("5/10") && table.contains("> 125000"), "{table}");
        assert_eq!(table.matches("it is \"short\"").count(), 1, "{table}");
        assert_eq!(value(&results(2))["strategies"][0]["real_rollouts"][1], Value::Null);
    }

    #[test]
    fn the_csv_has_a_line_for_each_recommendation() {
        let csv = csv(&results(2));
        let lines: Vec<&str> = csv.lines().collect();
        assert_eq!(lines.len(), 5);
        assert_eq!(lines[2], "identify,0,125000,2,18,19,true,");
        assert!(lines[1].ends_with(",0,0,false,\"recording 0: it is 'short'\""), "{}", lines[1]);
        let fields = |line: &str| line.split(',').count();
        assert!(lines.iter().all(|line| fields(line) == fields(lines[0])));
    }
}
