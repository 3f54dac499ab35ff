use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Instant;

use super::screen::Progress;
use super::stop::Stop;
use crate::experiment::{
    ExperimentEvent, ExperimentSettings, RecommendationResult, Repetition, Score,
};
use crate::scoring::Behaviour;
use crate::session::SessionEvent;

/// The display of a running experiment: a line for each finished piece of work, and on the screen how many of the
/// policies, searches or scores are done.
pub struct ExperimentProgress {
    progress: Progress,
    stop: Arc<AtomicBool>,
    began: Instant,
    count: u64,
    done: AtomicU64,
}

impl ExperimentProgress {
    /// A display for an experiment of this extent.
    pub fn new(settings: &ExperimentSettings, progress: &Progress, stop: &Stop) -> Self {
        let (count, what) = match &settings.strategies {
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
            state.work = format!("{count} {what}");
            state.phase = "training and rollouts".into();
            state.done = Some((0, count));
        });
        Self {
            progress: progress.clone(),
            stop: Arc::clone(&stop.flag),
            began: Instant::now(),
            count,
            done: AtomicU64::new(0),
        }
    }

    /// Shows one event.
    pub fn tell(&self, news: &ExperimentEvent) {
        match news {
            ExperimentEvent::Search { name, progress } => self.searching(name, progress),
            ExperimentEvent::Trained { recipe, policy, best_return: Some(best_return) } => {
                self.line(format!("{recipe} {policy}: trained, {best_return:.0} in simulation"));
            }
            ExperimentEvent::Trained { .. } => {}
            ExperimentEvent::Ran { recipe, policy, plant, results } => {
                let count = |kind| results.iter().filter(|it| it.behaviour == kind).count();
                let kinds: Vec<String> = Behaviour::ALL
                    .into_iter()
                    .filter(|&kind| count(kind) > 0)
                    .map(|kind| format!("{} {}", count(kind), kind.name().replace('_', " ")))
                    .collect();
                let returns: Vec<f64> = results.iter().filter_map(|it| it.return_).collect();
                let mean = returns.iter().sum::<f64>() / returns.len().max(1) as f64;
                let kinds = kinds.join(", ");
                self.line(format!("{recipe} {policy} on {plant}: mean return {mean:.0}; {kinds}"));
                self.one_more();
                self.progress.wait_while_paused(&self.stop);
            }
            ExperimentEvent::Scored { repetition, recommendation } => {
                self.scored(repetition, recommendation);
            }
            ExperimentEvent::Over { .. } => self.one_more(),
        }
    }

    /// Counts one more finished piece of work.
    fn one_more(&self) {
        let done = self.done.fetch_add(1, Ordering::Relaxed) + 1;
        let count = self.count;
        self.progress.update(|state| {
            state.done = Some((done, count));
            state.expect_end(self.began.elapsed(), done as f64, count.saturating_sub(done) as f64);
        });
    }

    fn scored(&self, repetition: &Repetition, recommendation: &RecommendationResult) {
        let what = match &recommendation.score {
            Ok(Score { balanced, ran }) => {
                let word = if recommendation.succeeds { "succeeds" } else { "does not succeed" };
                format!("the recommendation {word}, {balanced} of {ran} scored rollouts balanced")
            }
            Err(reason) => format!("no recommendation: {reason}"),
        };
        let rollouts = recommendation.real_rollouts;
        self.line(format!("{}, {rollouts} real rollouts: {what}", repetition.name()));
    }

    fn searching(&self, name: &str, progress: &SessionEvent) {
        match progress {
            SessionEvent::Proposed { candidate, .. } => {
                self.line(format!("{name}: the search proposes candidate {candidate}"));
            }
            SessionEvent::Training { candidate, update, .. } => {
                let done = update.update + 1;
                self.progress.update(|state| {
                    state.phase = format!("{name}: candidate {candidate}, update {done}");
                });
            }
            SessionEvent::Rollout { candidate, rollout, verdict, .. } => {
                let return_ = verdict.return_().map_or("void".into(), |it| format!("{it:.0}"));
                self.line(format!("{name}: candidate {candidate}, rollout {rollout}: {return_}"));
                self.progress.wait_while_paused(&self.stop);
            }
            SessionEvent::Trained { .. }
            | SessionEvent::Connected(_)
            | SessionEvent::Drift(_)
            | SessionEvent::Identified { .. }
            | SessionEvent::ExcitesAgain(_)
            | SessionEvent::NotIdentified(_)
            | SessionEvent::GoesOn { .. }
            | SessionEvent::Settled { .. } => {}
        }
    }

    fn line(&self, text: String) {
        self.progress.line(&text);
    }
}
