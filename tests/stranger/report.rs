use std::collections::BTreeMap;
use std::fmt::Write;

use serde::{Deserialize, Serialize};

use super::episode::Outcome;
use super::optimiser::Method;
use super::scenario::Scenario;

/// An episode that is kept: its genes repeat it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Found {
    pub genes: Vec<f64>,
    pub outcome: Outcome,
}

/// The result of a search: a line of the example's output file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SearchRecord {
    pub method: Method,
    pub scenario: Scenario,
    pub genes: usize,
    pub episodes: u64,
    pub hits: u64,
    /// Hits before which nothing went wrong: no sample lost, no act late, no stop requested.
    #[serde(default)]
    pub clean_hits: u64,
    pub farthest_rad: f64,
    /// Number of rollouts with each ending.
    pub endings: BTreeMap<String, u64>,
    /// Number of episodes with each fault of a healthy Qube on a working link.
    pub false_faults: BTreeMap<String, u64>,
    pub farthest: Option<Found>,
    pub kept_hits: Vec<Found>,
    /// One episode for each false fault.
    pub kept_faults: BTreeMap<String, Found>,
}

/// The results of many searches, as text.
pub fn summary(records: &[SearchRecord]) -> String {
    let mut text = String::new();
    let total = |of: fn(&SearchRecord) -> u64| records.iter().map(of).sum::<u64>();
    let farthest = records.iter().map(|record| record.farthest_rad).fold(0.0, f64::max);
    let _ = writeln!(
        text,
        "{} searches, {} episodes, {} hits in {} searches, {} of them clean, \
         farthest {farthest:.4} rad",
        records.len(),
        total(|record| record.episodes),
        total(|record| record.hits),
        records.iter().filter(|record| record.hits > 0).count(),
        total(|record| record.clean_hits),
    );
    let promised = || records.iter().filter(|record| record.scenario.mishap.is_promised());
    let _ = writeln!(
        text,
        "within the promise: {} searches, {} episodes, {} hits, farthest {:.4} rad",
        promised().count(),
        promised().map(|record| record.episodes).sum::<u64>(),
        promised().map(|record| record.hits).sum::<u64>(),
        promised().map(|record| record.farthest_rad).fold(0.0, f64::max),
    );
    let counts = |of: fn(&SearchRecord) -> &BTreeMap<String, u64>| {
        let mut counts = BTreeMap::<String, u64>::new();
        for (name, count) in records.iter().flat_map(of) {
            *counts.entry(name.clone()).or_default() += count;
        }
        counts
    };
    let _ = writeln!(text, "endings: {:?}", counts(|record| &record.endings));
    let _ = writeln!(text, "false faults: {:?}", counts(|record| &record.false_faults));
    by(records, &mut text, |record| format!("moves {:?}", record.scenario.moves));
    by(records, &mut text, |record| format!("mishap {:?}", record.scenario.mishap));
    by(records, &mut text, |record| format!("start {:?}", record.scenario.start));
    by(records, &mut text, |record| format!("seen {:?}", record.scenario.seen));
    by(records, &mut text, |record| format!("method {:?}", record.method));
    let mut worst: Vec<&SearchRecord> = records.iter().collect();
    worst.sort_by(|one, other| {
        (other.hits, other.farthest_rad)
            .partial_cmp(&(one.hits, one.farthest_rad))
            .unwrap_or(std::cmp::Ordering::Equal)
    });
    for record in worst.into_iter().take(5) {
        let outcome = record.farthest.as_ref().map(|found| &found.outcome);
        let _ = writeln!(
            text,
            "worst: seed {} {:?} {:?} {:?} {:?} {:?} strikes {} steps {}: {} hits, {outcome:?}",
            record.scenario.seed,
            record.method,
            record.scenario.moves,
            record.scenario.mishap,
            record.scenario.start,
            record.scenario.seen,
            record.scenario.strikes,
            record.scenario.steps,
            record.hits,
        );
    }
    text
}

/// Appends a line for each kind: its number of searches, its hits and its farthest angle.
fn by(records: &[SearchRecord], text: &mut String, kind: impl Fn(&SearchRecord) -> String) {
    let mut kinds = BTreeMap::<String, (u64, u64, f64)>::new();
    for record in records {
        let entry = kinds.entry(kind(record)).or_default();
        *entry = (entry.0 + 1, entry.1 + record.hits, entry.2.max(record.farthest_rad));
    }
    for (kind, (searches, hits, farthest)) in kinds {
        let _ = writeln!(text, "{kind}: {searches} searches, {hits} hits, farthest {farthest:.4}");
    }
}
