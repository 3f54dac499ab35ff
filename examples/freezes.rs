//! Measures how soon a frozen arm encoder is found during a rollout, and how wrong the zero is
//! where the freeze is not found: `cargo run --release --example freezes -- [SEEDS [FIRST_SEED]]`.
//!
//! Each seed gives a healthy rollout, in which a fault is a false alarm, and three rollouts in
//! which the encoder freezes while the policy runs: for good, with its tachometer at 0 or at its
//! last value, and for 500 ms in which counts are lost.

#[path = "../tests/harmless/mod.rs"]
mod harmless;

use harmless::freezes::{Freeze, KINDS, freezes, policies, qubes};
use qube_hil::device::emulator::EmulatorSettings;
use qube_hil::telemetry::Ending;

/// Median, 90 % quantile and maximum of the times, ms; `-` without any time.
fn quantiles(found_ms: &mut [f64]) -> String {
    found_ms.sort_by(f64::total_cmp);
    let last = found_ms.len().saturating_sub(1) as f64;
    let texts = [0.5, 0.9, 1.0].map(|share| {
        found_ms
            .get((share * last).round() as usize)
            .map_or_else(|| "-".to_owned(), |ms| format!("{ms:.0}"))
    });
    texts.join(", ")
}

/// The cells of a row of the table from the fourth on: the rollouts with one kind of freeze.
fn row(frozen: &[Freeze]) -> String {
    let mut found_ms: Vec<f64> = frozen.iter().filter_map(Freeze::found_ms).collect();
    let soon = found_ms.iter().filter(|ms| **ms <= 300.0).count();
    let wrong = frozen.iter().filter(|freeze| freeze.counts_wrongly()).count();
    let otherwise = frozen.iter().filter(|freeze| freeze.is_named_otherwise()).count();
    let off_rad = frozen
        .iter()
        .filter(|freeze| freeze.found_ms().is_none())
        .fold(0.0, |largest: f64, freeze| largest.max(freeze.outcome.zero_off_rad));
    let (freezes, found) = (frozen.len(), found_ms.len());
    let quantiles = quantiles(&mut found_ms);
    format!("{freezes} | {found} | {soon} | {quantiles} | {wrong} | {off_rad:.2} | {otherwise} |")
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let number = |index: usize, default: u64| {
        arguments.get(index).map_or(default, |text| text.parse().expect("a number is given"))
    };
    let (seeds, first_seed) = (number(0, 20), number(1, 0));
    println!(
        "| Qube | policy | fault | freezes | found | of them within 300 ms | ms: median, 90 %, longest | results with the zero off by more than 0.05 rad | largest error of theta in a result, rad | ended by another fault |\n| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |"
    );
    for (qube, settings) in qubes() {
        for (name, policy) in policies() {
            let mut frozen: [Vec<Freeze>; KINDS.len()] = Default::default();
            let (mut healthy, mut false_alarms, mut missing) = (0, 0, 0);
            for seed in first_seed..first_seed + seeds {
                let settings = EmulatorSettings { seed, ..settings };
                let Some((outcome, freezes)) = freezes(settings, &policy) else { continue };
                healthy += 1;
                false_alarms += u32::from(matches!(outcome.ending, Ending::Fault(_)));
                for (row, freeze) in frozen.iter_mut().zip(freezes) {
                    missing += u32::from(freeze.is_none());
                    row.extend(freeze);
                }
            }
            for ((kind, _), frozen) in KINDS.iter().zip(&frozen) {
                println!("| {qube} | {name} | {kind} | {}", row(frozen));
            }
            eprintln!(
                "{qube}, {name}: {false_alarms} false alarms in {healthy} healthy rollouts of \
                 {seeds} seeds; {missing} rollouts with a freeze could not be made"
            );
        }
    }
}
