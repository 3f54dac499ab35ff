use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use crate::commands::screen::{Progress, ScreenState, left_in_words, time_left};
use crate::commands::stop::Stop;
use crate::commands::training_progress::name_of_training;
use crate::experiment::{
    ExperimentEvent, ExperimentSettings, Made, Recipe, RecommendationOutcome, RecommendationResult,
    RecommendationScore, Repetition,
};
use crate::learning::TrainUpdate;
use crate::scoring::Behaviour;
use crate::session::SessionEvent;

/// Ending of a name under which the trainings of a search are shown.
const SEARCH: &str = " (search)";

/// The display of a running experiment: a line for each finished piece of work, and on the screen
/// the number of policies, searches or scores that are done.
pub struct ExperimentProgress {
    progress: Progress,
    stop: Arc<AtomicBool>,
    began: Instant,
    count: u64,
    done: AtomicU64,
    /// Number of the finished pieces of work that were on disk before this process began. The time
    /// left is estimated without them, because their time is not known.
    found: AtomicU64,
    updates: UpdatesOfTrainings,
    /// Number of competing trainings of each policy.
    trainings: u32,
    /// The best mean return of a policy on a plant so far.
    best: Mutex<Option<f64>>,
}

/// The number of updates of the trainings of an experiment.
struct UpdatesOfTrainings {
    by_recipe: BTreeMap<String, u32>,
    /// Number for every other name, such as a method's: the number of the first recipe.
    of_first_recipe: u32,
}

/// A training that the display shows.
struct ShownTraining<'a> {
    /// Recipe, or search.
    group: &'a str,
    /// `policy` or `candidate`.
    item: &'static str,
    /// Number of the policy or candidate.
    number: u32,
    /// Number of the training among those that compete.
    training: u32,
}

impl ExperimentProgress {
    /// Makes a display for an experiment with these settings.
    pub fn new(settings: &ExperimentSettings, progress: &Progress, stop: &Stop) -> Self {
        let (count, item) = match &settings.methods {
            Some(it) if it.has_budgets() => {
                let rows = settings.plants.len() * it.methods.len() * it.budgets.len();
                (rows as u64 * u64::from(it.repetitions), "scores")
            }
            Some(it) => (it.methods.len() as u64 * u64::from(it.repetitions), "searches"),
            None => {
                let series = settings.recipes.len() * settings.plants.len();
                (series as u64 * u64::from(settings.policies), "policies")
            }
        };
        progress.update(|state| {
            state.work = format!("{count} {item}");
            state.phase = "training and rollouts".into();
            state.done = Some((0, count));
        });
        let updates = |recipe: &Recipe| recipe.settings.training.updates;
        let by_recipe = settings.recipes.iter().map(|it| (it.name.clone(), updates(it))).collect();
        Self {
            progress: progress.clone(),
            stop: Arc::clone(&stop.flag),
            began: Instant::now(),
            count,
            done: AtomicU64::new(0),
            found: AtomicU64::new(0),
            updates: UpdatesOfTrainings {
                by_recipe,
                of_first_recipe: settings.recipes.first().map_or(0, updates),
            },
            trainings: settings.methods.as_ref().map_or(1, |methods| methods.trainings),
            best: Mutex::new(None),
        }
    }

    /// Shows one event.
    pub fn update(&self, event: &ExperimentEvent) {
        match event {
            ExperimentEvent::Search { name, progress } => self.searching(name, progress),
            ExperimentEvent::Training { recipe, policy, training, update } => {
                let (number, training) = (*policy, *training);
                let shown = ShownTraining { group: recipe, item: "policy", number, training };
                self.training(&shown, update);
            }
            ExperimentEvent::Trained { recipe, policy, best_return } => {
                self.trained(recipe, *policy);
                if let Some(best_return) = best_return {
                    self.line(format!(
                        "{recipe} {policy}: trained, earns {best_return:.0} in its simulations"
                    ));
                }
            }
            ExperimentEvent::Ran { recipe, policy, plant, results, made } => {
                let count = |kind| results.iter().filter(|it| it.behaviour == kind).count();
                let kinds: Vec<String> = Behaviour::ALL
                    .into_iter()
                    .filter(|&kind| count(kind) > 0)
                    .map(|kind| format!("{} {}", count(kind), behaviour_in_words(kind)))
                    .collect();
                let returns: Vec<f64> = results.iter().filter_map(|it| it.return_).collect();
                let kinds = kinds.join(", ");
                let outcome = if returns.is_empty() {
                    "no return".to_owned()
                } else {
                    let mean = returns.iter().sum::<f64>() / returns.len() as f64;
                    self.show_if_best(mean, &format!("{recipe}, policy {policy} on {plant}"));
                    format!("mean return {mean:.0}")
                };
                self.count_finished(1, *made);
                let progress = self.done_in_words();
                self.line(format!("{recipe} {policy} on {plant}: {outcome}; {kinds} ({progress})"));
                self.progress.wait_while_paused(&self.stop);
            }
            ExperimentEvent::Scored { repetition, recommendation } => {
                self.scored(repetition, recommendation);
            }
            ExperimentEvent::LeftOut { name, recording } => {
                self.line(format!("{name} does not use {recording}"));
            }
            ExperimentEvent::Over { made, .. } => self.count_finished(1, *made),
            ExperimentEvent::NotScored { budgets, made } => {
                self.count_finished(*budgets as u64, *made);
            }
        }
    }

    /// Counts more finished pieces of work.
    fn count_finished(&self, pieces: u64, made: Made) {
        if made == Made::Earlier {
            self.found.fetch_add(pieces, Ordering::Relaxed);
        }
        self.done.fetch_add(pieces, Ordering::Relaxed);
        self.progress.update(|state| self.expect_end(state));
    }

    /// Returns the number of pieces of work that are done, the number of all, and the time left, if
    /// it can be estimated, such as `3 of 20; about 2 min left`.
    fn done_in_words(&self) -> String {
        let [done, found] = [&self.done, &self.found].map(|count| count.load(Ordering::Relaxed));
        let (made, to_do) = (done.saturating_sub(found), self.count.saturating_sub(done));
        let left = time_left(self.began.elapsed(), made as f64, to_do as f64);
        let left = left_in_words(left.filter(|_| to_do > 0));
        format!("{done} of {}{left}", self.count)
    }

    /// Shows the expected end of the experiment, estimated from the time that the work of this
    /// process took. A training in progress counts by its share of updates, but not within a
    /// search, which has many trainings.
    fn expect_end(&self, state: &mut ScreenState) {
        let done = self.done.load(Ordering::Relaxed);
        state.done = Some((done, self.count));
        let parts = state.trainings.iter().map(|((group, ..), training)| match group {
            group if group.ends_with(SEARCH) => 0.0,
            _ => (training.returns.len() as f64 / f64::from(training.updates.max(1))).min(1.0),
        });
        let found = self.found.load(Ordering::Relaxed).min(done);
        let (made, to_do) = ((done - found) as f64, (self.count - done.min(self.count)) as f64);
        let parts: f64 = parts.sum();
        state.expect_end(time_left(self.began.elapsed(), made + parts, to_do - parts));
    }

    /// Shows an update of a training.
    fn training(&self, shown: &ShownTraining, update: &TrainUpdate) {
        let ShownTraining { group, item, number, training } = *shown;
        let recipe = group.strip_suffix(SEARCH).unwrap_or(group);
        let UpdatesOfTrainings { by_recipe, of_first_recipe } = &self.updates;
        let updates = *by_recipe.get(recipe).unwrap_or(of_first_recipe);
        let name =
            name_of_training(&format!("{recipe}: {item} {number}"), training, self.trainings);
        self.progress.update(|state| {
            let key = (group.to_owned(), number, training);
            state.add_update(key, &name, updates, update.mean_return);
            self.expect_end(state);
        });
    }

    /// Removes the learning curves of a policy or candidate whose trainings are finished.
    fn trained(&self, group: &str, number: u32) {
        self.progress.update(|state| {
            state.trainings.retain(|(of, it, _), _| of != group || *it != number);
        });
    }

    /// Shows a mean return if it is the best so far; `of` names the policy.
    fn show_if_best(&self, mean: f64, of: &str) {
        let mut best = self.best.lock().unwrap_or_else(PoisonError::into_inner);
        if mean.is_finite() && best.is_none_or(|best| mean > best) {
            *best = Some(mean);
            let outcome = format!("best so far: {of} with a mean return of {mean:.0}");
            self.progress.update(|state| state.best = outcome);
        }
    }

    fn scored(&self, repetition: &Repetition, recommendation: &RecommendationResult) {
        let item = match &recommendation.outcome {
            RecommendationOutcome::Scored(RecommendationScore { balanced, ran }) => {
                let word = if recommendation.succeeds { "succeeds" } else { "does not succeed" };
                format!("the recommendation {word}, {balanced} of {ran} scored rollouts balanced")
            }
            RecommendationOutcome::Refused(reason) => format!("no recommendation: {reason}"),
        };
        let rollouts = recommendation.real_rollouts;
        self.line(format!("{}, {rollouts} real rollouts: {item}", repetition.id.name()));
    }

    fn searching(&self, name: &str, progress: &SessionEvent) {
        match progress {
            SessionEvent::Proposed { candidate, .. } => {
                self.line(format!("{name}: the search proposes candidate {candidate}"));
            }
            SessionEvent::Training { candidate, training, update } => {
                let group = &format!("{name}{SEARCH}");
                let (number, training) = (*candidate, *training);
                let shown = ShownTraining { group, item: "candidate", number, training };
                self.training(&shown, update);
            }
            SessionEvent::Trained { candidate, .. } => {
                self.trained(&format!("{name}{SEARCH}"), *candidate);
            }
            SessionEvent::Rollout { candidate, rollout, verdict, .. } => {
                let return_ = verdict.return_().map_or("void".into(), |it| format!("{it:.0}"));
                self.line(format!("{name}: candidate {candidate}, rollout {rollout}: {return_}"));
                self.progress.wait_while_paused(&self.stop);
            }
            SessionEvent::FirstMotion { .. }
            | SessionEvent::Connected { .. }
            | SessionEvent::RolloutBegins { .. }
            | SessionEvent::Drift { .. }
            | SessionEvent::RigTakenOut { .. }
            | SessionEvent::Identified { .. }
            | SessionEvent::RecordingLeftOut { .. }
            | SessionEvent::ExcitationRepeated(_)
            | SessionEvent::NotIdentified(_)
            | SessionEvent::RefitFailed { .. }
            | SessionEvent::NotUpdated(_)
            | SessionEvent::SearchContinues { .. }
            | SessionEvent::TooLoud(_)
            | SessionEvent::SearchEnded { .. }
            | SessionEvent::EndedEarly(_) => {}
        }
    }

    fn line(&self, text: String) {
        self.progress.line(&text);
    }
}

/// Returns a behaviour in the words of a line.
fn behaviour_in_words(behaviour: Behaviour) -> &'static str {
    match behaviour {
        Behaviour::Balanced => "balanced",
        Behaviour::BalancedLate => "balanced late",
        Behaviour::LeftBox => "left the box or were ended by the guard",
        Behaviour::Chattered => "chattered",
        Behaviour::Fell => "fell",
        Behaviour::Fault => "void",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiment::RolloutResult;
    use crate::scoring::Quietness;
    use crate::session::SessionSettings;
    use crate::simulation::Model;

    #[test]
    fn work_that_was_on_disk_has_no_effect_on_the_time_left() {
        let recipe = Recipe::of(Model::Nominal, &SessionSettings::thesis());
        let plant = crate::experiment::Plant {
            name: "lab".into(),
            emulated: Default::default(),
            vary: 0.0,
        };
        let settings = ExperimentSettings {
            name: "table".into(),
            seed: 7,
            policies: 20,
            rollouts: 1,
            simulated_starts: 1,
            guard_profile: None,
            plants: vec![plant],
            recipes: vec![recipe],
            methods: None,
        };
        let ran = |progress: &ExperimentProgress, policy, made| {
            let results = [RolloutResult {
                return_: Some(500.0),
                behaviour: Behaviour::Balanced,
                quietness: Quietness::NONE,
            }];
            let (recipe, plant) = ("nominal", "lab");
            let results = &results;
            progress.update(&ExperimentEvent::Ran { recipe, policy, plant, results, made });
        };
        let mut progress = ExperimentProgress::new(&settings, &Progress::lines(), &Stop::default());
        progress.began -= std::time::Duration::from_secs(100);
        let mut state = ScreenState::new("test".into(), Instant::now());
        (0..15).for_each(|policy| ran(&progress, policy, Made::Earlier));
        progress.expect_end(&mut state);
        assert_eq!((state.done, state.ends), (Some((15, 20)), None));
        ran(&progress, 15, Made::Now);
        progress.expect_end(&mut state);
        // One policy took 100 s, and four are left.
        let left = state.ends.unwrap().saturating_duration_since(Instant::now()).as_secs_f64();
        assert!((395.0..410.0).contains(&left), "{left}");
        progress.update(&ExperimentEvent::NotScored { budgets: 2, made: Made::Earlier });
        progress.expect_end(&mut state);
        assert_eq!(state.done, Some((18, 20)));
    }
}
