use std::collections::BTreeMap;

use qube_hil::safety::Guard;
use qube_hil::telemetry::TickSettings;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

use super::beliefs::BeliefKind;
use super::episode::{Outcome, Trace, gene_count, play, settings, show};
use super::genes::normal;
use super::optimiser::Method;
use super::report::{Found, SearchRecord};
use super::scenario::Scenario;

/// Extent of a search.
#[derive(Clone, Copy, Debug)]
pub struct Effort {
    pub generations: u32,
    pub population: usize,
}

/// Number of hits whose genes a record keeps, in addition to the farthest episode and to one
/// episode for each kind of false fault.
const KEPT_HITS: usize = 3;

/// A search: seed, belief, optimiser, guard and its [`Effort`] determine the result completely.
#[derive(Clone, Copy, Debug)]
pub struct AdversarySearch {
    pub seed: u64,
    pub known: BeliefKind,
    pub method: Method,
    pub guard: Guard,
}

impl AdversarySearch {
    /// Searches within the scenario of the seed.
    pub fn run(&self, effort: Effort) -> SearchRecord {
        self.run_scenario(Scenario::new(self.seed, self.known), effort)
    }

    /// Searches within a given scenario.
    pub fn run_scenario(&self, scenario: Scenario, effort: Effort) -> SearchRecord {
        let settings = settings(&scenario, self.guard);
        let genes = gene_count(&scenario);
        let mut optimiser = self.method.optimiser(genes);
        let mut random = ChaCha8Rng::seed_from_u64(self.seed);
        random.set_stream(1 + self.method as u64);
        let mut record = SearchRecord::new(self.method, scenario, genes);
        for _ in 0..effort.generations {
            let asked = optimiser.ask(effort.population, &mut random);
            let mut played: Vec<(Vec<f64>, Outcome)> = asked
                .into_iter()
                .map(|genes| {
                    let outcome = play(&record.scenario, &settings, &genes);
                    (genes, outcome)
                })
                .collect();
            for (genes, outcome) in &played {
                record.count(genes, outcome, KEPT_HITS);
            }
            played.sort_by(|(_, one), (_, other)| other.score.total_cmp(&one.score));
            let best_first: Vec<Vec<f64>> = played.into_iter().map(|(genes, _)| genes).collect();
            optimiser.tell(&best_first);
        }
        record
    }

    /// Plays episodes near one of a record: each gene differs by a normal number times `spread`. A
    /// search that finds nothing after the guard has changed may have searched elsewhere; these
    /// episodes lie where an earlier search found something.
    #[allow(dead_code, reason = "the tests play single episodes alone")]
    pub fn play_near(
        &self,
        scenario: &Scenario,
        genes: &[f64],
        spread: f64,
        episodes: u32,
    ) -> SearchRecord {
        let settings = settings(scenario, self.guard);
        let mut random = ChaCha8Rng::seed_from_u64(self.seed);
        random.set_stream(100 + self.method as u64);
        let mut record = SearchRecord::new(self.method, scenario.clone(), genes.len());
        for _ in 0..episodes {
            let near: Vec<f64> =
                genes.iter().map(|gene| gene + spread * normal(&mut random)).collect();
            let outcome = play(scenario, &settings, &near);
            record.count(&near, &outcome, KEPT_HITS);
        }
        record
    }

    /// Plays the episode of these genes with the search's settings as changed by `change`.
    #[allow(dead_code, reason = "the example plays by the search's settings alone")]
    pub fn play_by(
        &self,
        scenario: &Scenario,
        genes: &[f64],
        change: impl FnOnce(&mut TickSettings),
    ) -> Outcome {
        let mut settings = settings(scenario, self.guard);
        change(&mut settings);
        play(scenario, &settings, genes)
    }

    /// Repeats an episode of a record, with a line for each tick.
    pub fn show(&self, scenario: &Scenario, genes: &[f64]) -> Trace {
        show(scenario, &settings(scenario, self.guard), genes)
    }
}

impl SearchRecord {
    fn new(method: Method, scenario: Scenario, genes: usize) -> Self {
        Self {
            method,
            scenario,
            genes,
            episodes: 0,
            hits: 0,
            clean_hits: 0,
            farthest_rad: 0.0,
            endings: BTreeMap::new(),
            false_faults: BTreeMap::new(),
            farthest: None,
            kept_hits: Vec::new(),
            kept_faults: BTreeMap::new(),
        }
    }

    fn count(&mut self, genes: &[f64], outcome: &Outcome, keep: usize) {
        let found = || Found { genes: genes.to_vec(), outcome: outcome.clone() };
        self.episodes += 1;
        for ending in &outcome.endings {
            *self.endings.entry(format!("{ending:?}")).or_default() += 1;
        }
        if let Some(fault) = outcome.false_fault(self.scenario.mishap) {
            let name = format!("{fault:?}");
            self.kept_faults.entry(name.clone()).or_insert_with(found);
            *self.false_faults.entry(name).or_default() += 1;
        }
        if outcome.is_hit() {
            self.hits += 1;
            self.clean_hits += u64::from(!outcome.went_wrong);
            if self.kept_hits.len() < keep {
                self.kept_hits.push(found());
            }
        }
        let key = |outcome: &Outcome| (outcome.farthest_rad, outcome.hit_rad_s.unwrap_or(0.0));
        let farther = self.farthest.as_ref().is_none_or(|it| key(outcome) > key(&it.outcome));
        if farther {
            self.farthest_rad = outcome.farthest_rad;
            self.farthest = Some(found());
        }
    }
}
