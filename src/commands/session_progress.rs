use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

use super::command_hints;
use super::printable::printable;
use super::warn_without_realtime;
use crate::scoring::Verdict;
use crate::session::{Purpose, SessionEvent, SessionSettings};
use crate::telemetry::Ending;

/// The display on stderr of a running session: a line for each finished piece of work, and one live line
/// for training.
pub struct SessionProgress {
    bar: ProgressBar,
    candidates: u32,
    /// Whether the session may end with fewer candidates.
    may_end_early: bool,
    /// The excitations, whose rollouts are recordings and no attempts to balance.
    excitations: Vec<u32>,
    updates: u32,
    /// When this process proposed its first candidate, and that candidate's number.
    began: Option<(Instant, u32)>,
    /// The candidates in training, each with the number of its training.
    training: BTreeMap<(u32, u32), InTraining>,
    connected: bool,
}

/// The progress of a training.
struct InTraining {
    /// When its first update was done.
    began: Instant,
    updates: u32,
    best_return: f64,
}

impl InTraining {
    /// Describes the training, of which there are `updates` updates.
    fn told(&self, candidate: u32, updates: u32) -> String {
        let Self { began, updates: done, best_return } = self;
        let each = began.elapsed().checked_div(done - 1).unwrap_or_default();
        let left_s = (each * updates.saturating_sub(*done)).as_secs();
        format!("{candidate} (update {done} of {updates}, best {best_return:.0}, {left_s} s left)")
    }
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
        let candidates = match &settings.identification {
            // The excitations, the largest number of candidates, and the verification of the last.
            Some(plan) => plan.excitations + plan.candidates + 1,
            None => searched + 1 + u32::from(extent.verifies_incumbent),
        } + u32::from(extent.baseline);
        let updates = settings.training.updates;
        Self {
            bar,
            candidates,
            may_end_early: settings.identification.is_some(),
            excitations: Vec::new(),
            updates,
            began: None,
            training: BTreeMap::new(),
            connected: false,
        }
    }

    /// Largest number of candidates.
    pub fn candidates(&self) -> u32 {
        self.candidates
    }

    /// Shows one event.
    pub fn tell(&mut self, news: &SessionEvent) {
        match news {
            SessionEvent::Proposed { candidate, purpose } => {
                let why = match purpose {
                    Purpose::Excitation => "a recording that identifies the Qube",
                    Purpose::Baseline => "a policy trained on the nominal Qube, for comparison",
                    Purpose::Initial => "an initial point",
                    Purpose::Search => "proposed by the search",
                    Purpose::Verification => "the search's recommendation, to be verified",
                    Purpose::Incumbent => "the best candidate's policy, to be verified too",
                };
                let (began, first) = *self.began.get_or_insert((Instant::now(), *candidate));
                let done = candidate.saturating_sub(first);
                if *purpose == Purpose::Excitation {
                    self.excitations.push(*candidate);
                }
                if self.may_end_early {
                    let most = self.candidates;
                    self.line(format!("candidate {candidate} (of at most {most}): {why}"));
                } else {
                    let left = time_left(began.elapsed(), done, self.candidates - candidate);
                    self.line(proposed(*candidate, self.candidates, why) + &left);
                }
            }
            SessionEvent::Training { candidate, training, update } => {
                let it = self.training.entry((*candidate, *training)).or_insert_with(|| InTraining {
                    began: Instant::now(),
                    updates: 0,
                    best_return: f64::MIN,
                });
                it.updates += 1;
                it.best_return = it.best_return.max(update.mean_return);
                let each: Vec<String> = self
                    .training
                    .iter()
                    .map(|((number, _), it)| it.told(*number, self.updates))
                    .collect();
                self.bar.set_message(format!("training candidate {}", each.join(", ")));
            }
            SessionEvent::Trained { candidate, best_return } => {
                self.training.retain(|(number, _), _| number != candidate);
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
            SessionEvent::Identified { recordings, doubts } => {
                self.line(identified(*recordings, doubts));
            }
            SessionEvent::ExcitesAgain(reason) => {
                self.line(format!("{reason}. Another recording is made"));
            }
            SessionEvent::NotIdentified(reason) => self.line(format!(
                "not identified: {reason}. The search goes on as for an unknown Qube"
            )),
            SessionEvent::GoesOn { expected_gain, enough } => self.line(format!(
                "one more candidate is expected to gain {expected_gain:.1}; the search ends below {enough:.1}"
            )),
            SessionEvent::Settled { expected_gain } => self.line(format!(
                "the search ends: one more candidate is expected to gain {expected_gain:.1}"
            )),
            SessionEvent::Drift(Ok(drift)) => self.line(command_hints::drift(drift)),
            SessionEvent::Drift(Err(unfit)) => self
                .line(format!("the first rollouts say nothing of how the rig is today: {unfit}")),
            SessionEvent::Rollout { candidate, rollout, attempt, verdict } => {
                let again =
                    if *attempt > 0 { format!(" (try {})", attempt + 1) } else { String::new() };
                let came_to = match verdict {
                    Verdict::Result { .. } if self.excitations.contains(candidate) => "recorded".into(),
                    verdict => describe(verdict),
                };
                self.line(format!("candidate {candidate}, rollout {rollout}{again}: {came_to}"));
                if let Verdict::Result { outcome, .. } = verdict
                    && let Ending::LeftBox(limit) = outcome.ending
                    && let Some(hint) = command_hints::after_limit(limit)
                {
                    self.line(hint.into());
                }
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

/// The outcome of an identification as a sentence.
pub fn identified(recordings: u32, doubts: &[String]) -> String {
    let from =
        if recordings == 1 { "1 recording".into() } else { format!("{recordings} recordings") };
    let but =
        if doubts.is_empty() { String::new() } else { format!(" but for {}", doubts.join("; ")) };
    format!("identified from {from}: the model describes this Qube{but}")
}

/// Numbers count from 0, as the candidates' folders do.
fn proposed(candidate: u32, candidates: u32, why: &str) -> String {
    format!("candidate {candidate} ({} of {candidates}): {why}", candidate + 1)
}

/// The time left for the whole session, from the time that the candidates done by this process took; empty
/// before the first is done.
fn time_left(elapsed: Duration, done: u32, to_do: u32) -> String {
    let Some(each) = elapsed.checked_div(done) else { return String::new() };
    let left_s = (each * to_do).as_secs();
    if left_s < 120 {
        format!("; about {left_s} s left in all")
    } else {
        format!("; about {} min left in all", left_s / 60)
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_last_candidate_is_the_last_of_all() {
        let settings = SessionSettings::quick();
        let progress = SessionProgress::new(&settings);
        assert_eq!(progress.candidates, 12);
        assert_eq!(proposed(11, 12, "the last"), "candidate 11 (12 of 12): the last");
    }

    #[test]
    fn the_time_left_is_that_of_the_candidates_to_come() {
        let seconds = Duration::from_secs;
        assert_eq!(time_left(seconds(5), 0, 12), "", "nothing is known yet");
        assert_eq!(time_left(seconds(30), 3, 9), "; about 90 s left in all");
        assert_eq!(time_left(seconds(600), 2, 10), "; about 50 min left in all");
    }

    #[test]
    fn a_training_tells_its_total_and_the_time_left() {
        let it = InTraining { began: Instant::now(), updates: 103, best_return: 412.3 };
        assert_eq!(it.told(3, 120), "3 (update 103 of 120, best 412, 0 s left)");
        let first = InTraining { updates: 1, ..it };
        assert!(first.told(0, 120).contains("update 1 of 120"));
    }
}
