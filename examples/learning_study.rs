//! Trains one policy for each of many seeds and prints the returns: the tables of docs/learning.md.
//!
//! ```text
//! cargo run --release --example learning_study -- MODEL PRESET SEEDS [SETTING=VALUE ...]
//! cargo run --release --example learning_study -- nominal thesis 20
//! cargo run --release --example learning_study -- nominal thesis 4 smallest_log_std=-10.0
//! cargo run --release --example learning_study -- handcrafted thesis 20 --against adam_epsilon_beside_root=true
//! cargo run --release --example learning_study -- specialists quick 60
//! ```
//!
//! SEEDS is a number, or a range such as `5..10`. MODEL is `nominal`, `handcrafted`, `robust`, or
//! `specialists`: for each seed one Qube is drawn from `handcrafted`, and a policy is trained for
//! that Qube alone. If no such specialist reaches a return, a policy for all of the Qubes cannot be
//! expected to reach it. PRESET is `thesis`, `quick` or `robust`; settings are those of
//! `TrainSettings`. With `--against` each seed is trained a second time, with the settings after
//! `--against` in addition. The two trainings of a seed are a pair, and the program prints the
//! mean difference of the pairs.
//!
//! The columns: `fresh` and `fresh final` are the mean returns of the best and of the final policy
//! from 1000 new starts; `best` and `final` are the returns of the same policies in training;
//! `to 540` is the time until the return first reached 540, and `s` the duration of the training,
//! both in s.

use std::sync::atomic::AtomicBool;
use std::time::Instant;

use anyhow::Context;
use qube_hil::learning::{Preset, TrainSettings, evaluate_on_new_starts, train};
use qube_hil::policy::Network;
use qube_hil::simulation::{DomainDistribution, Family, Trajectory};

/// Number of new starts of the evaluation after training.
const FRESH_STARTS: usize = 1000;
/// Seed of the new starts, and of the Qubes of `specialists`.
const FRESH_SEED: u64 = 1_000_003;

fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [model, preset, seeds, settings @ ..] = arguments.as_slice() else {
        anyhow::bail!(
            "usage: learning_study MODEL PRESET SEEDS [SETTING=VALUE ...] [--against SETTING=VALUE ...]"
        );
    };
    let (settings, other) = match settings.iter().position(|argument| argument == "--against") {
        None => (with_settings(preset, settings)?, None),
        Some(place) => {
            let (own, against) = (&settings[..place], &settings[place + 1..]);
            let both = [own, against].concat();
            (with_settings(preset, own)?, Some(with_settings(preset, &both)?))
        }
    };
    let seeds = match seeds.split_once("..") {
        Some((first, end)) => first.parse()?..end.parse()?,
        None => 0..seeds.parse::<u64>()?,
    };
    println!(
        "{:>5} {:>8} {:>11} {:>8} {:>8} {:>8} {:>7}",
        "seed", "fresh", "fresh final", "best", "final", "to 540", "s"
    );
    let (mut rows, mut others) = (Vec::<Row>::new(), Vec::<Row>::new());
    for seed in seeds {
        let distribution = match model.as_str() {
            "nominal" => DomainDistribution::nominal(),
            "handcrafted" => DomainDistribution::handcrafted(Family::Normal),
            "robust" => DomainDistribution::robust(),
            "specialists" => one_of_handcrafted(seed),
            other => anyhow::bail!("{other} is not nominal, handcrafted, robust or specialists"),
        };
        rows.push(trained(&distribution, &settings, seed)?);
        if let Some(other) = &other {
            others.push(trained(&distribution, other, seed)?);
        }
    }
    summarise(&rows);
    if other.is_some() {
        println!("against:");
        summarise(&others);
        compare(&rows, &others);
    }
    Ok(())
}

/// Trains one policy, evaluates it, and prints its row.
fn trained(
    distribution: &DomainDistribution,
    settings: &TrainSettings,
    seed: u64,
) -> anyhow::Result<Row> {
    let started = Instant::now();
    let mut to_540_s = f64::NAN;
    let stop = AtomicBool::new(false);
    let trained = train(distribution, settings, seed, None, &stop, |update| {
        if update.mean_return >= 540.0 {
            to_540_s = to_540_s.min(started.elapsed().as_secs_f64());
        }
    })?;
    let seconds = started.elapsed().as_secs_f64();
    let fresh_return = |network: &Network| {
        let (simulation, seed) = (&settings.simulation, FRESH_SEED);
        evaluate_on_new_starts(network, distribution, simulation, seed, FRESH_STARTS).mean_return()
    };
    let (fresh, fresh_final) =
        (fresh_return(&trained.network), fresh_return(&trained.final_network));
    let (best, last) = (trained.best_return, trained.final_return);
    println!(
        "{seed:5} {fresh:8.2} {fresh_final:11.2} {best:8.2} {last:8.2} {to_540_s:8.2} {seconds:7.2}"
    );
    Ok(Row { fresh, fresh_final, to_540_s })
}

/// Prints the mean of the pairs' differences: the second training of each seed minus the first.
fn compare(rows: &[Row], others: &[Row]) {
    let differences: Vec<f64> =
        rows.iter().zip(others).map(|(row, other)| other.fresh - row.fresh).collect();
    let count = differences.len() as f64;
    let mean = differences.iter().sum::<f64>() / count;
    let squares: f64 = differences.iter().map(|gain| (gain - mean) * (gain - mean)).sum();
    let standard_error = (squares / (count - 1.0) / count).sqrt();
    let higher = differences.iter().filter(|gain| **gain > 0.0).count();
    println!(
        "in pairs: the other earns {mean:+.2} more, standard error {standard_error:.2}; more in {higher} of {count}"
    );
}

/// The preset with some settings replaced, by the names and in the syntax of a TOML file.
fn with_settings(preset: &str, replaced: &[String]) -> anyhow::Result<TrainSettings> {
    let named = Preset::NAMED.into_iter().find(|it| it.name() == preset);
    let named = named.with_context(|| format!("{preset} is not thesis, quick or robust"))?;
    let mut table = toml::Table::try_from(named.settings_or(TrainSettings::default()))?;
    table.extend(replaced.join("\n").parse::<toml::Table>()?);
    Ok(table.try_into()?)
}

/// The distribution that contains only the Qube of this number, drawn from `handcrafted`.
fn one_of_handcrafted(number: u64) -> DomainDistribution {
    let handcrafted = DomainDistribution::handcrafted(Family::Normal);
    DomainDistribution::constant(&Trajectory::draw(&handcrafted, FRESH_SEED, number).model)
}

/// The result of one training. Both returns come from new starts, because the return by which the
/// best policy was chosen during training is too favourable.
struct Row {
    fresh: f64,
    fresh_final: f64,
    to_540_s: f64,
}

/// Prints mean, standard deviation and minimum of the best policies' returns from new starts, the
/// number of final policies that earn at most 5 less than the best one of the same training, and
/// the median time until a return of 540.
fn summarise(rows: &[Row]) {
    let count = rows.len() as f64;
    let mean = rows.iter().map(|row| row.fresh).sum::<f64>() / count;
    let squares: f64 = rows.iter().map(|row| (row.fresh - mean) * (row.fresh - mean)).sum();
    let deviation = (squares / (count - 1.0)).sqrt();
    let smallest = rows.iter().map(|row| row.fresh).fold(f64::INFINITY, f64::min);
    println!("fresh: mean {mean:.2}, standard deviation {deviation:.2}, smallest {smallest:.2}");
    let steady = rows.iter().filter(|row| row.fresh - row.fresh_final <= 5.0).count();
    println!("final within 5 of the best: {steady} of {}", rows.len());
    let mut to_540_s: Vec<f64> =
        rows.iter().map(|row| row.to_540_s).filter(|time_s| time_s.is_finite()).collect();
    to_540_s.sort_by(f64::total_cmp);
    if let Some(median) = to_540_s.get(to_540_s.len() / 2) {
        println!("540 reached by {} of {}, median {median:.2} s", to_540_s.len(), rows.len());
    }
}
