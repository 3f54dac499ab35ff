use std::time::Duration;

use indicatif::{ProgressBar, ProgressStyle};

use super::printable::printable;
use crate::experiment::{
    ExperimentEvent, ExperimentSettings, RecommendationResult, Repetition, Score,
};
use crate::scoring::Behaviour;
use crate::session::SessionEvent;

/// The display on stderr of a running experiment: a line for each finished piece of work, and a bar over
/// policies or searches.
pub struct ExperimentProgress {
    bar: ProgressBar,
}

impl ExperimentProgress {
    /// A display for an experiment of this extent.
    pub fn new(settings: &ExperimentSettings) -> Self {
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
        let bar = ProgressBar::new(count);
        let template = format!("{{bar:30}} {{pos}} of {{len}} {what}, {{eta}} left  {{msg}}");
        if let Ok(style) = ProgressStyle::with_template(&template) {
            bar.set_style(style);
        }
        bar.enable_steady_tick(Duration::from_millis(200));
        Self { bar }
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
                self.bar.inc(1);
            }
            ExperimentEvent::Scored { repetition, recommendation } => {
                self.scored(repetition, recommendation);
            }
            ExperimentEvent::Over { .. } => self.bar.inc(1),
        }
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
                self.bar.set_message(format!("{name}: candidate {candidate}, update {done}"));
            }
            SessionEvent::Rollout { candidate, rollout, verdict, .. } => {
                let return_ = verdict.return_().map_or("void".into(), |it| format!("{it:.0}"));
                self.line(format!("{name}: candidate {candidate}, rollout {rollout}: {return_}"));
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

    /// Clears the bar.
    pub fn finish(&self) {
        self.bar.finish_and_clear();
    }

    fn line(&self, text: String) {
        // A bar without a terminal is hidden and would swallow the line.
        let text = printable(&text);
        if self.bar.is_hidden() { eprintln!("{text}") } else { self.bar.println(text) }
    }
}
