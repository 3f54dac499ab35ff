use std::time::Duration;

use indicatif::{ProgressBar, ProgressStyle};

use super::printable::printable;
use crate::experiment::{AnswerResult, Behaviour, ExperimentSettings, Judgement, News, Repetition};
use crate::session::Progress;

/// What the operator sees on stderr while an experiment runs: a line for each thing that is
/// finished, and a bar over policies or searches.
pub struct ExperimentProgress {
    bar: ProgressBar,
}

impl ExperimentProgress {
    /// For an experiment of this extent.
    pub fn new(settings: &ExperimentSettings) -> Self {
        let (count, what) = match &settings.strategies {
            Some(it) => (it.contenders.len() as u64 * u64::from(it.repetitions), "searches"),
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

    /// Shows one piece of news.
    pub fn tell(&self, news: &News) {
        match news {
            News::Search { name, progress } => self.searching(name, progress),
            News::Trained { recipe, policy, best_return: Some(best_return) } => {
                self.line(format!("{recipe} {policy}: trained, {best_return:.0} in simulation"));
            }
            News::Trained { .. } => {}
            News::Ran { recipe, policy, plant, results } => {
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
            News::Judged { repetition, answer } => self.judged(repetition, answer),
            News::Over { .. } => self.bar.inc(1),
        }
    }

    fn judged(&self, repetition: &Repetition, answer: &AnswerResult) {
        let what = match &answer.judgement {
            Ok(judgement) => {
                let Judgement { stood, ran } = judgement;
                let word = if answer.succeeds { "succeeds" } else { "does not succeed" };
                format!("the answer {word}, {stood} of {ran} judges' rollouts stood")
            }
            Err(reason) => format!("no answer: {reason}"),
        };
        let rollouts = answer.real_rollouts;
        self.line(format!("{}, {rollouts} real rollouts: {what}", repetition.name()));
    }

    fn searching(&self, name: &str, progress: &Progress) {
        match progress {
            Progress::Proposed { candidate, .. } => {
                self.line(format!("{name}: the search proposes candidate {candidate}"));
            }
            Progress::Training { candidate, update } => {
                let done = update.update + 1;
                self.bar.set_message(format!("{name}: candidate {candidate}, update {done}"));
            }
            Progress::Rollout { candidate, rollout, verdict, .. } => {
                let return_ = verdict.return_().map_or("void".into(), |it| format!("{it:.0}"));
                self.line(format!("{name}: candidate {candidate}, rollout {rollout}: {return_}"));
            }
            Progress::Trained { .. } | Progress::Connected(_) | Progress::Drift(_) => {}
        }
    }

    /// Clears the bar.
    pub fn finish(&self) {
        self.bar.finish_and_clear();
    }

    fn line(&self, text: String) {
        // Without a terminal the bar is hidden and would swallow the line.
        let text = printable(&text);
        if self.bar.is_hidden() { eprintln!("{text}") } else { self.bar.println(text) }
    }
}
