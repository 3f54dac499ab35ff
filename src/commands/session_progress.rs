use std::collections::BTreeMap;
use std::time::Duration;

use indicatif::{ProgressBar, ProgressStyle};

use super::printable::printable;
use super::warn_without_realtime;
use crate::session::{Purpose, SessionEvent, SessionSettings, Verdict};
use crate::telemetry::Ending;

/// The display on stderr of a running session: a line for each finished piece of work, and one live line
/// for training.
pub struct SessionProgress {
    bar: ProgressBar,
    last_candidate: u32,
    /// Best return so far of each candidate in training, and its update.
    training: BTreeMap<u32, (u32, f64)>,
    connected: bool,
}

impl SessionProgress {
    /// A display for a session of this extent.
    pub fn new(settings: &SessionSettings) -> Self {
        let bar = ProgressBar::new_spinner();
        if let Ok(style) = ProgressStyle::with_template("{spinner} {msg}") {
            bar.set_style(style);
        }
        bar.enable_steady_tick(Duration::from_millis(120));
        let extent = &settings.extent;
        let searched = extent.initial_candidates + extent.iterations;
        let last_candidate = searched + u32::from(extent.verifies_incumbent);
        Self { bar, last_candidate, training: BTreeMap::new(), connected: false }
    }

    /// Shows one event.
    pub fn tell(&mut self, news: &SessionEvent) {
        match news {
            SessionEvent::Proposed { candidate, purpose } => {
                let why = match purpose {
                    Purpose::Initial => "an initial point",
                    Purpose::Search => "proposed by the search",
                    Purpose::Verification => "the search's recommendation, to be verified",
                    Purpose::Incumbent => "the best candidate's policy, to be verified too",
                };
                self.line(format!("candidate {candidate} of {}: {why}", self.last_candidate));
            }
            SessionEvent::Training { candidate, update } => {
                let best = self.training.entry(*candidate).or_insert((0, f64::MIN));
                *best = (update.update + 1, best.1.max(update.mean_return));
                let each: Vec<String> = self
                    .training
                    .iter()
                    .map(|(candidate, (update, best))| {
                        format!("{candidate} (update {update}, best {best:.0})")
                    })
                    .collect();
                self.bar.set_message(format!("training candidate {}", each.join(", ")));
            }
            SessionEvent::Trained { candidate, best_return } => {
                self.training.remove(candidate);
                self.bar.set_message("");
                if let Some(best_return) = best_return {
                    self.line(format!(
                        "candidate {candidate}: trained, earns {best_return:.0} in its simulations"
                    ));
                }
            }
            SessionEvent::Connected(rig) => {
                if !self.connected {
                    let identity = rig.identity();
                    self.line(format!(
                        "connected to {} {} at {}; the arm is homed",
                        identity.kind, identity.serial, identity.port
                    ));
                    self.bar.suspend(|| warn_without_realtime(rig.realtime()));
                }
                self.connected = true;
            }
            SessionEvent::Drift(Ok(drift)) => self.line(drift.to_string()),
            SessionEvent::Drift(Err(unfit)) => self
                .line(format!("the first rollouts say nothing of how the rig is today: {unfit}")),
            SessionEvent::Rollout { candidate, rollout, attempt, verdict } => {
                let again =
                    if *attempt > 0 { format!(" (try {})", attempt + 1) } else { String::new() };
                let came_to = describe(verdict);
                self.line(format!("candidate {candidate}, rollout {rollout}{again}: {came_to}"));
            }
        }
    }

    /// Clears the live line.
    pub fn finish(&self) {
        self.bar.finish_and_clear();
    }

    fn line(&self, text: String) {
        // A bar without a terminal is hidden and would swallow the line.
        let text = printable(&text);
        if self.bar.is_hidden() { eprintln!("{text}") } else { self.bar.println(text) }
    }
}

/// A verdict in words.
fn describe(verdict: &Verdict) -> String {
    match verdict {
        Verdict::Void { reason } => format!("void: {reason}"),
        Verdict::Unfinished => "stopped".into(),
        Verdict::Result { return_, success, outcome } => match outcome.ending {
            Ending::LeftBox(limit) => {
                format!("{return_:.0}, left the box by {limit} after {} steps", outcome.steps)
            }
            _ if *success => format!("{return_:.0}, balances"),
            _ => format!("{return_:.0}, does not balance"),
        },
    }
}
