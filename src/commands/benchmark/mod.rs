//! Compares the search strategies on synthetic objectives.

mod parallel;

use std::num::NonZeroUsize;
use std::path::PathBuf;

use clap::ValueEnum;
use serde_json::{Value, json};

use super::destination::OutputFolder;
use super::exit::Failure;
use super::output::Output;
use super::printable::print_message;
use crate::charts::{noise_svg, regret_svg};
use crate::search::benchmark::{
    Objective, RegretCurve, SearchVariant, TwoHumped, VariantResult, simple_regret,
};
use crate::search::{BayRnSettings, StrategyKind};
use crate::storage::{MachineDisk, write_whole};

/// Compare the search strategies on synthetic objectives
///
/// `regret`: the maximum minus the best value so far, after each evaluation, on objectives of 2 to
/// 16 dimensions without noise. `noise`: expected return of the recommended point when a rollout
/// either balances (500) or falls (50), without and with trainings that differ. Tables go to
/// stdout; pictures, tables and all numbers to --out.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    qube-hil benchmark regret\n  \
    qube-hil benchmark regret --repetitions 5 --evaluations 20    # a quick comparison, one minute\n  \
    qube-hil benchmark noise --repetitions 400 --threads 8")]
pub struct Arguments {
    /// Suite to run
    #[arg(value_enum)]
    suite: Suite,

    /// Repetitions, each with its own seed [default: 50 for `regret`, 200 for `noise`]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    repetitions: Option<u32>,

    /// Evaluations of each search, for `regret`
    #[arg(long, value_name = "N", default_value_t = 60, value_parser = clap::value_parser!(u32).range(1..=1000))]
    evaluations: u32,

    /// Number of points that are still to be evaluated when the next one is proposed, for `regret`
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u32).range(0..=1000))]
    pending: u32,

    /// Seed from which every random number follows
    #[arg(long, default_value_t = 0)]
    seed: u64,

    /// Threads to use [default: all processors]; the results are the same
    #[arg(long, value_name = "N")]
    threads: Option<NonZeroUsize>,

    /// Folder for pictures, tables and numbers; created if it does not exist
    #[arg(long, value_name = "DIR", default_value = "benchmark")]
    out: PathBuf,

    /// Replace the results of an earlier run
    #[arg(long)]
    force: bool,
}

/// The suites of comparisons.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Suite {
    /// Strategies, by simple regret: the maximum minus the best value so far
    Regret,
    /// Search variants, by the expected return under bimodal noise
    Noise,
}

/// Runs one suite.
pub fn run(arguments: &Arguments, output: &Output) -> Result<(), Failure> {
    let _place = OutputFolder::of_option("--out", &arguments.out)?;
    let numbers = arguments.out.join(match arguments.suite {
        Suite::Regret => "regret.json",
        Suite::Noise => "noise.json",
    });
    if numbers.exists() && !arguments.force {
        return Err(Failure::usage(format!(
            "{} exists already: name another folder with --out, or replace the results with --force",
            numbers.display()
        )));
    }
    match arguments.suite {
        Suite::Regret => regret(arguments, output),
        Suite::Noise => noise(arguments, output),
    }
}

impl Arguments {
    fn repetitions(&self, usual: usize) -> usize {
        self.repetitions.map_or(usual, |it| it as usize)
    }

    fn threads(&self) -> usize {
        let all = std::thread::available_parallelism();
        self.threads.or(all.ok()).map_or(1, NonZeroUsize::get)
    }

    fn write(&self, name: &str, contents: &str) -> Result<(), Failure> {
        let path = self.out.join(name);
        write_whole(&MachineDisk, &path, contents.as_bytes()).map_err(Failure::failed)?;
        print_message(&format!("wrote {}", path.display()));
        Ok(())
    }

    /// Prints the results of a suite, then writes them beside its picture. `pictured` says whether
    /// the whole picture is written. The first failure is returned after every file was tried.
    fn finish(
        &self,
        suite: &str,
        pictured: Result<(), Failure>,
        text: &str,
        value: &Value,
        output: &Output,
    ) -> Result<(), Failure> {
        output.print(text, value);
        let numbers = self.write(&format!("{suite}.json"), &value.to_string());
        let table = self.write(&format!("{suite}.txt"), text);
        pictured.and(numbers).and(table)
    }
}

fn regret(arguments: &Arguments, output: &Output) -> Result<(), Failure> {
    let (repetitions, evaluations) = (arguments.repetitions(50), arguments.evaluations as usize);
    let (settings, pending) = (BayRnSettings::default(), arguments.pending as usize);
    let mut text = format!(
        "simple regret after {evaluations} evaluations, {repetitions} repetitions: median [quartiles]\n"
    );
    if pending > 0 {
        text += &format!(
            "each point was proposed before the {pending} points before it were evaluated\n"
        );
    }
    let mut curves: Vec<RegretCurve> = Vec::new();
    let mut pictured = Ok(());
    for objective in Objective::ALL {
        text += &format!("\n{} ({} dimensions)\n", objective.name(), objective.dimensions());
        for strategy in StrategyKind::ALL {
            let title = format!("{} {}", objective.name(), strategy);
            let found = parallel::map(repetitions, arguments.threads(), &title, |repetition| {
                let seed = arguments.seed.wrapping_add(repetition as u64);
                simple_regret(objective, strategy, &settings, evaluations, pending, seed)
            });
            let found: Vec<Vec<f64>> =
                found.into_iter().collect::<Result<_, _>>().map_err(Failure::failed)?;
            let curve = RegretCurve::new(objective, strategy, &found);
            if let Some(last) = curve.regret.last() {
                text += &format!(
                    "  {:8} {:>10.3e}  [{:.3e}, {:.3e}]\n",
                    strategy.name(),
                    last.median,
                    last.lower,
                    last.upper
                );
            }
            curves.push(curve);
        }
        // The picture shows the results so far, so that a long run can be watched.
        let svg = regret_svg(&curves).map_err(Failure::failed);
        pictured = svg.and_then(|svg| arguments.write("regret.svg", &svg));
    }
    let value = json!({ "regret": curves });
    arguments.finish("regret", pictured, &text, &value, output)
}

fn noise(arguments: &Arguments, output: &Output) -> Result<(), Failure> {
    let repetitions = arguments.repetitions(200);
    if repetitions < 2 {
        return Err(Failure::usage("--repetitions 1 gives no interval: give at least 2"));
    }
    let mut text = format!(
        "expected return of the point found, {repetitions} repetitions: mean ± 95 % interval\n"
    );
    let (mut results, mut tables) = (Vec::new(), Vec::new());
    let mut pictured = Ok(());
    let alike = [TwoHumped::THESIS, TwoHumped::NOISY];
    let problems = alike.into_iter().chain(alike.map(TwoHumped::with_differing_trainings));
    for problem in problems {
        let table = noise_table(arguments, problem, repetitions)?;
        text += &format!(
            "\n{} dimensions, {} candidates x {} rollouts{}\n",
            problem.dimensions,
            problem.candidates,
            problem.rollouts,
            trainings_of(problem)
        );
        for row in &table {
            text += &format!(
                "  {:45} {:6.1} ± {:4.1}   gain over plain {:+6.1} ± {:4.1}\n",
                row.variant.description(),
                row.expected_return.mean,
                row.expected_return.half_width,
                row.gain_over_plain.mean,
                row.gain_over_plain.half_width,
            );
        }
        results.push(json!({ "problem": problem, "methods": table }));
        let title = format!(
            "{} dimensions, {} candidates with {} rollouts each{}",
            problem.dimensions,
            problem.candidates,
            problem.rollouts,
            trainings_of(problem)
        );
        tables.push((title, table));
        // The picture shows the results so far, so that a long run can be watched.
        let svg = noise_svg(&tables).map_err(Failure::failed);
        pictured = svg.and_then(|svg| arguments.write("noise.svg", &svg));
    }
    let value = json!({ "repetitions": repetitions, "noise": results });
    arguments.finish("noise", pictured, &text, &value, output)
}

/// Returns the part of a problem's title that describes its trainings; empty if the trainings do
/// not differ.
fn trainings_of(problem: TwoHumped) -> String {
    match problem.rollout_correlation {
        0.0 => String::new(),
        correlation => format!(", whose results correlate by {correlation} within a training"),
    }
}

fn noise_table(
    arguments: &Arguments,
    problem: TwoHumped,
    repetitions: usize,
) -> Result<Vec<VariantResult>, Failure> {
    let mut found = Vec::new();
    for variant in SearchVariant::ALL {
        let title = variant.description();
        let returns = parallel::map(repetitions, arguments.threads(), title, |repetition| {
            problem.search(variant, arguments.seed.wrapping_add(repetition as u64))
        });
        found.push(returns.into_iter().collect::<Result<Vec<f64>, _>>().map_err(Failure::failed)?);
    }
    Ok(VariantResult::table(&found))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_other_files_are_written_if_one_cannot_be() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join("regret.json")).unwrap();
        let arguments = Arguments {
            suite: Suite::Regret,
            repetitions: None,
            evaluations: 1,
            pending: 0,
            seed: 0,
            threads: None,
            out: folder.path().to_owned(),
            force: false,
        };
        let finish = |pictured| {
            let output = Output::new(true);
            arguments.finish("regret", pictured, "a table", &json!({}), &output).unwrap_err()
        };
        assert!(finish(Ok(())).cause().contains("regret.json"));
        let table = std::fs::read_to_string(folder.path().join("regret.txt")).unwrap();
        assert_eq!(table, "a table");
        assert_eq!(finish(Err(Failure::failed("no picture"))).cause(), "no picture");
    }
}
