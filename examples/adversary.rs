//! Searches for the worst adversary of the guard; `scripts/adversary` runs it over 10^6 episodes.
//!
//! ```text
//! cargo run --release --example adversary -- [SEARCHES [OPTIONS]]
//! ```
//!
//! SEARCHES is 100 by default. OPTIONS are, in this order, `SPREAD DELAY_MS CORNER foresight|box
//! FIRST`; the last ones may be left out. SPREAD is the largest relative deviation of the Qubes'
//! parameters, DELAY_MS the longest time from a sample to its act, CORNER the corner of the
//! estimator's filter, rad/s, and FIRST the first seed. The exit code is 1 if an arm reached its
//! stop or a voltage was above 5 V.

#[path = "../tests/adversary/mod.rs"]
mod adversary;

use adversary::episode::{Domain, PROMISED};
use adversary::search::{Worst, search};
use qube_hil::qube::HARD_STOP_RAD;
use qube_hil::safety::SafetyBox;

/// Number of generations of a search.
const GENERATIONS: u32 = 25;

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let number = |index: usize, default: f64| {
        arguments.get(index).map_or(default, |text| text.parse().expect("a number is given"))
    };
    let domain = Domain {
        spread: number(1, PROMISED.spread),
        longest_delay_s: number(2, 1e3 * PROMISED.longest_delay_s) * 1e-3,
        corner_rad_s: number(3, PROMISED.corner_rad_s),
        safety_box: match arguments.get(4).map(String::as_str) {
            Some("box") => SafetyBox::THESIS,
            None | Some("foresight") => SafetyBox::GUARDED,
            Some(other) => panic!("{other:?} is no guard: give box or foresight"),
        },
        ..PROMISED
    };
    let searches = number(0, 100.0) as u64;
    let first_seed = number(5, 0.0) as u64;
    let threads = std::thread::available_parallelism().map_or(1, usize::from) as u64;
    let mut results: Vec<(u64, Worst)> = std::thread::scope(|scope| {
        let workers: Vec<_> = (0..threads)
            .map(|thread| {
                scope.spawn(move || {
                    (thread..searches)
                        .step_by(threads as usize)
                        .map(|number| number + first_seed)
                        .map(|seed| (seed, search(&domain, seed, GENERATIONS)))
                        .collect::<Vec<_>>()
                })
            })
            .collect();
        workers.into_iter().flat_map(|worker| worker.join().expect("no thread panics")).collect()
    });
    results
        .sort_by(|one, other| other.1.episode.farthest_rad.total_cmp(&one.1.episode.farthest_rad));
    let episodes: u64 = results.iter().map(|(_, worst)| u64::from(worst.episodes)).sum();
    let hits =
        results.iter().filter(|(_, worst)| worst.episode.farthest_rad >= HARD_STOP_RAD).count();
    let false_faults: u64 = results.iter().map(|(_, worst)| u64::from(worst.false_faults)).sum();
    let largest_mv = results.iter().map(|(_, worst)| worst.largest_mv).max().unwrap_or(0);
    for (seed, worst) in results.iter().take(5) {
        println!(
            "search {seed}: {:.3} rad at {:.2} s, {:?} in tick {}, delays of seed {}, genes {:.2?}",
            worst.episode.farthest_rad,
            worst.episode.farthest_at_s,
            worst.episode.ending,
            worst.episode.last_tick,
            worst.seed,
            worst.genes
        );
    }
    println!(
        "{episodes} episodes in {searches} searches; spread {}, delay {} ms, corner {} rad/s, {:?}",
        domain.spread,
        1e3 * domain.longest_delay_s,
        domain.corner_rad_s,
        domain.safety_box.guard
    );
    println!(
        "farthest {:.3} rad of {HARD_STOP_RAD}; {hits} searches reached it; largest {largest_mv} mV; {false_faults} \
         episodes ended by a fault",
        results.first().map_or(0.0, |(_, worst)| worst.episode.farthest_rad)
    );
    let failed = hits > 0 || largest_mv > 5000;
    std::process::exit(i32::from(failed));
}
