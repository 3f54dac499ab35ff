//! An independent search: measures how close to its stop an adversary brings the arm of a guarded
//! Qube. A person who knew only the promise of foresight and the public functions wrote it.
//!
//! `cargo run --release --example strangers_adversary -- --searches 20 --first 1 --optimiser both
//! --belief unknown --out FILE`. Each finished search is a line of FILE and is not repeated.
//! `--show SEED` prints the episodes of that seed in FILE tick by tick, and `--near SEED` plays
//! others near the farthest one. Without these options the program fails if the arm reached its
//! stop in an episode for which foresight promises to prevent it.

#[path = "../tests/stranger/mod.rs"]
mod stranger;

use std::fs::OpenOptions;
use std::io::Write;
use std::path::PathBuf;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use anyhow::Context;
use clap::Parser;
use qube_hil::safety::Guard;
use stranger::{
    AdversarySearch, BeliefKind, Effort, Method, MishapKind, Scenario, SearchRecord, summary,
};

/// The adversary's command line.
#[derive(Parser)]
struct Arguments {
    /// Number of seeds that each optimiser searches.
    #[arg(long, default_value_t = 20)]
    searches: u64,
    /// The first seed.
    #[arg(long, default_value_t = 1)]
    first: u64,
    /// Optimiser: ce, cma or both.
    #[arg(long, default_value = "both")]
    optimiser: String,
    /// Belief of the guard: unknown, identified, or precise (identified with a tenth of the
    /// standard errors).
    #[arg(long, default_value = "unknown")]
    belief: String,
    /// Searches only the seeds whose attack has this mishap: clean, lost, lost_twice, stalled,
    /// lost_and_stalled, stop_asked or link_dead.
    #[arg(long)]
    mishap: Option<String>,
    /// Generations of a search.
    #[arg(long, default_value_t = 25)]
    generations: u32,
    /// Episodes of a generation.
    #[arg(long, default_value_t = 64)]
    population: usize,
    /// Searches at a time.
    #[arg(long, default_value_t = 2)]
    threads: usize,
    /// File to which each finished search is appended as one line of JSON.
    #[arg(long)]
    out: PathBuf,
    /// Prints the stored episodes of this seed tick by tick (the farthest, and one for each kind of
    /// false fault), and searches nothing.
    #[arg(long)]
    show: Option<u64>,
    /// Plays 1600 episodes near the farthest one of this seed in FILE, with each of three standard
    /// deviations of the genes, and searches nothing.
    #[arg(long, conflicts_with = "show")]
    near: Option<u64>,
}

fn main() -> anyhow::Result<()> {
    let arguments = Arguments::parse();
    let known = match arguments.belief.as_str() {
        "unknown" => BeliefKind::Unknown,
        "identified" => BeliefKind::Identified,
        "precise" => BeliefKind::Precise,
        _ => anyhow::bail!("--belief: give unknown, identified or precise"),
    };
    let methods = match arguments.optimiser.as_str() {
        "ce" => vec![Method::Ce],
        "cma" => vec![Method::Cma],
        "both" => vec![Method::Ce, Method::Cma],
        _ => anyhow::bail!("--optimiser: give ce, cma or both"),
    };
    let mishap: Option<MishapKind> = arguments
        .mishap
        .map(|name| serde_json::from_value(name.into()).context("--mishap"))
        .transpose()?;
    let is_wanted =
        |seed: &u64| mishap.is_none_or(|mishap| Scenario::new(*seed, known).mishap == mishap);
    let searches: Vec<AdversarySearch> = (arguments.first..arguments.first + arguments.searches)
        .filter(is_wanted)
        .flat_map(|seed| methods.iter().map(move |&method| (seed, method)))
        .map(|(seed, method)| AdversarySearch { seed, known, method, guard: Guard::Foresight })
        .collect();
    anyhow::ensure!(!searches.is_empty(), "no search: none of these seeds has this mishap");
    let effort = Effort { generations: arguments.generations, population: arguments.population };
    let done = read(&arguments.out)?;
    let record_of =
        |search: &AdversarySearch| done.iter().find(|record| is_of(record, search, &effort));
    if let Some(seed) = arguments.show.or(arguments.near) {
        let searches = methods.iter().map(|&method| AdversarySearch {
            seed,
            known,
            method,
            guard: Guard::Foresight,
        });
        let mut found = 0;
        for search in searches {
            if let Some(record) = record_of(&search) {
                if arguments.show.is_some() {
                    print_record(&search, record);
                } else {
                    play_near(&search, record);
                }
                found += 1;
            }
        }
        anyhow::ensure!(found > 0, "{}: no search of seed {seed}", arguments.out.display());
        return Ok(());
    }

    let missing: Vec<&AdversarySearch> =
        searches.iter().filter(|search| record_of(search).is_none()).collect();
    let mut file = OpenOptions::new().create(true).append(true).open(&arguments.out)?;
    if std::fs::read(&arguments.out)?.last().is_some_and(|last| *last != b'\n') {
        // Ends the line in which an earlier run was killed.
        writeln!(file)?;
    }
    let file = Mutex::new(file);
    let next = AtomicUsize::new(0);
    let work = || -> anyhow::Result<()> {
        while let Some(search) = missing.get(next.fetch_add(1, Ordering::Relaxed)) {
            let record = search.run(effort);
            let line = serde_json::to_string(&record)?;
            let mut file = file.lock().map_err(|_| anyhow::anyhow!("another thread has failed"))?;
            writeln!(file, "{line}")?;
            eprintln!(
                "seed {} {:?}: {} hits, farthest {:.4} rad",
                search.seed, search.method, record.hits, record.farthest_rad
            );
        }
        Ok(())
    };
    std::thread::scope(|scope| {
        let threads: Vec<_> = (0..arguments.threads).map(|_| scope.spawn(work)).collect();
        threads.into_iter().try_for_each(|thread| {
            thread.join().map_err(|_| anyhow::anyhow!("a search panicked"))?
        })
    })?;

    let mut records = read(&arguments.out)?;
    records.retain(|record| searches.iter().any(|search| is_of(record, search, &effort)));
    anyhow::ensure!(
        records.len() == searches.len(),
        "{} holds {} of the {} searches",
        arguments.out.display(),
        records.len(),
        searches.len()
    );
    print!("{}", summary(&records));
    let promised = records.iter().filter(|record| record.scenario.mishap.is_promised());
    let hits: u64 = promised.map(|record| record.hits).sum();
    anyhow::ensure!(hits == 0, "{hits} episodes within the promise reached the stop");
    Ok(())
}

/// Returns whether the record is of this search with as many episodes as this effort has.
fn is_of(record: &SearchRecord, search: &AdversarySearch, effort: &Effort) -> bool {
    let scenario = &record.scenario;
    let episodes = u64::from(effort.generations) * effort.population as u64;
    scenario.seed == search.seed
        && scenario.known == search.known
        && record.method == search.method
        && record.episodes == episodes
}

/// Reads the searches of a file: none if the file does not exist. A line that cannot be parsed,
/// such as a truncated one, is skipped.
fn read(path: &PathBuf) -> anyhow::Result<Vec<SearchRecord>> {
    if !path.exists() {
        return Ok(Vec::new());
    }
    let text = std::fs::read_to_string(path)?;
    Ok(text.lines().filter_map(|line| serde_json::from_str(line).ok()).collect())
}

/// Prints the stored episodes of a search: the farthest, then one for each kind of false fault.
fn print_record(search: &AdversarySearch, record: &SearchRecord) {
    let faults = record.kept_faults.values();
    for found in record.farthest.iter().chain(faults) {
        let trace = search.show(&record.scenario, &found.genes);
        println!("{:?} {}", record.method, trace.told);
        for line in &trace.lines {
            println!("{line}");
        }
        println!("{:?}\nas recorded: {}\n", trace.outcome, trace.outcome == found.outcome);
    }
}

/// Plays episodes near the farthest one of a record and prints how many of them reach the stop.
fn play_near(search: &AdversarySearch, record: &SearchRecord) {
    let Some(found) = &record.farthest else { return };
    for spread in [0.01, 0.03, 0.1] {
        let near = search.play_near(&record.scenario, &found.genes, spread, 1600);
        println!(
            "seed {} {:?}, genes with a deviation of {spread}: {} of {} episodes reach the stop, farthest \
             {:.4} rad",
            search.seed, search.method, near.hits, near.episodes, near.farthest_rad
        );
    }
}
