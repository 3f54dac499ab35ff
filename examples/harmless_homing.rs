//! Simulates starts of a Qube, healthy ones and others with one fault each, and prints the arm's
//! speed at its stops; `scripts/harmless-homing` runs 10^4 of them. Fails if a stop is touched
//! faster than promised, except with `far`, for which nothing is promised.
//!
//! `cargo run --release --example harmless_homing -- SEEDS [FIRST_SEED [list [CASES [far]]]]` runs
//! each case with SEEDS seeds (10 by default). `list` also prints each start whose fault was
//! named wrongly or not at all, that hit a stop too fast, or that gave a false result. CASES holds
//! the names of the only cases to run, with commas between them (`all` for all); `far` draws Qubes
//! whose masses, lengths and motor constants are up to 20 % off nominal, instead of Qubes near
//! `lab`.

#[path = "../tests/harmless/mod.rs"]
mod harmless;

use harmless::case::{Case, Qubes, Start};
use harmless::table::Row;
use harmless::trial::{Trial, play};

/// The cases with these names, which have commas between them.
fn cases_of(names: &str) -> Vec<Case> {
    let case_of = |name: &str| Case::ALL.into_iter().find(|case| format!("{case:?}") == name);
    names
        .split(',')
        .map(|name| case_of(name).unwrap_or_else(|| panic!("there is no case {name:?}")))
        .collect()
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let number = |index: usize, default: u64| {
        arguments.get(index).map_or(default, |text| text.parse().expect("a number is given"))
    };
    let (seeds, first_seed) = (number(0, 10), number(1, 0));
    let lists = arguments.get(2).is_some_and(|text| text == "list");
    let threads = std::thread::available_parallelism().map_or(1, usize::from) as u64;
    let mut harmless = true;
    println!("{}", Row::HEAD);
    let names = arguments.get(3).filter(|names| *names != "all");
    let cases = names.map_or_else(|| Case::ALL.to_vec(), |names| cases_of(names));
    let qubes = match arguments.get(4).map(String::as_str) {
        None => Qubes::Near,
        Some("far") => Qubes::Far,
        Some(other) => panic!("there are no Qubes {other:?}; name `far`, or nothing"),
    };
    for case in cases {
        let mut trials: Vec<(Start, Trial)> = std::thread::scope(|scope| {
            let workers: Vec<_> = (0..threads)
                .map(|thread| {
                    scope.spawn(move || {
                        (first_seed + thread..first_seed + seeds)
                            .step_by(threads as usize)
                            .map(|seed| Start::new(case, seed, qubes))
                            .map(|start| (start, play(&start)))
                            .collect::<Vec<_>>()
                    })
                })
                .collect();
            workers
                .into_iter()
                .flat_map(|worker| worker.join().expect("no thread panics"))
                .collect()
        });
        trials.sort_by_key(|(start, _)| start.seed);
        let row = Row::of(case, &trials);
        println!("{row}");
        if lists {
            for (start, trial) in trials.iter().filter(|(start, trial)| trial.falls_short(start)) {
                println!(
                    "    seed {} fault {:?} at {:.2} s in {:?}: {:?}, off after {:.2} s, homed {:?}, contacts {:.2} {:.2} (off {:.2}), false results {}",
                    start.seed,
                    start.settings.fault,
                    start.fault_onset_s,
                    trial.struck_in,
                    trial.ending,
                    trial.off_after_s,
                    trial.homed_after_s,
                    trial.contact_before_policy_rad_s,
                    trial.rollout_contact_rad_s,
                    trial.contact_off_rad_s,
                    trial.false_results
                );
                if qubes == Qubes::Far {
                    println!("        on {:?}", start.settings.model);
                }
            }
        }
        // So far from nominal nothing is promised.
        harmless &= row.harmless || qubes == Qubes::Far;
    }
    assert!(harmless, "a stop was touched faster than allowed: see the column \"too fast\"");
}
