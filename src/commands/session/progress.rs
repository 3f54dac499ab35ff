use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use crate::commands::command_hints;
use crate::commands::screen::{Progress, in_words};
use crate::commands::stop::Stop;
use crate::commands::training_pace::TrainingPace;
use crate::commands::training_progress::name_of_training;
use crate::commands::warn_without_realtime;
use crate::device::Identity;
use crate::learning::TrainUpdate;
use crate::rig::Rig;
use crate::scoring::{QuietnessFigures, Verdict};
use crate::session::{CandidateCounts, Purpose, SessionError, SessionEvent, SessionSettings};
use crate::telemetry::Ending;

/// Phase of a session while it opens its rig, as the screen names it.
const OPENING: &str = "opening the Qube, checking and homing it";
/// Phase of a session while it drives a Qube, as the screen names it.
const ROLLOUTS: &str = "rollouts on the Qube";

/// The display of a running session: a line for each finished piece of work, and the state of the
/// work on the screen.
pub struct SessionProgress {
    progress: Progress,
    /// Beginning of each line: the name of the rig among several; empty for the only rig.
    prefix: String,
    stop: Arc<AtomicBool>,
    /// Number of all candidates, as far as it is known, from which the time left is estimated. A
    /// copy of the best candidate's policy is not counted before it is proposed.
    candidates: u32,
    /// True while the session has yet to propose a copy of the best candidate's policy.
    copy_to_come: bool,
    /// True if the session ends with a policy that is trained on the nominal Qube, for comparison.
    has_baseline: bool,
    /// Largest number of candidates around the identified Qube; `None` if the session identifies
    /// none.
    around: Option<u32>,
    /// Number of updates of one training.
    updates: u32,
    /// Number of trainings of each candidate; 1 unless the session identifies its Qube.
    trainings: u32,
    /// Number of rollouts that verify a policy.
    verification_rollouts: u32,
    pace: TrainingPace,
    /// Returns of each candidate's rollouts, and how many of them balanced.
    returns: BTreeMap<u32, (Vec<f64>, u32)>,
    /// Rigs that were opened, by number; `None` stands for the only rig.
    connected: BTreeSet<Option<u32>>,
}

impl SessionProgress {
    /// A display for a session with these settings.
    pub fn new(settings: &SessionSettings, progress: &Progress, stop: &Stop) -> Self {
        let extent = &settings.extent;
        let searched = extent.initial_candidates + extent.iterations;
        let candidates = match &settings.identification {
            // Repeated excitations and further verifications are not included: each proposal
            // corrects the number.
            Some(plan) => plan.excitations + plan.candidates + 1,
            None => searched + 1,
        } + u32::from(extent.baseline);
        let updates = settings.training.updates;
        let trainings = settings.identification.map_or(1, |plan| plan.trainings.max(1));
        progress.update(|state| state.phase = OPENING.into());
        Self {
            progress: progress.clone(),
            prefix: String::new(),
            stop: Arc::clone(&stop.flag),
            candidates,
            copy_to_come: extent.verifies_incumbent,
            has_baseline: extent.baseline,
            around: settings.identification.map(|plan| plan.candidates),
            updates,
            trainings,
            verification_rollouts: extent.verification_rollouts,
            pace: TrainingPace::new(updates.saturating_mul(trainings)),
            returns: BTreeMap::new(),
            connected: BTreeSet::new(),
        }
    }

    /// Begins each line with the rig's name.
    pub fn of_rig(self, name: &str) -> Self {
        Self { prefix: format!("{name}: "), ..self }
    }

    /// Time left until the last training ends; `None` before the second update, and once all
    /// candidates are trained.
    pub fn time_left(&self) -> Option<Duration> {
        self.pace.time_left(self.candidates, Instant::now())
    }

    /// Shows one event.
    pub fn update(&mut self, event: &SessionEvent) {
        match event {
            SessionEvent::Proposed { candidate, purpose, counts } => {
                self.show_proposal(*candidate, *purpose, counts);
            }
            SessionEvent::Training { candidate, training, update } => {
                self.show_training(*candidate, *training, update);
            }
            SessionEvent::Trained { candidate, best_return } => {
                self.show_trained(*candidate, *best_return);
            }
            SessionEvent::FirstMotion { is_examined: false, .. } => {}
            SessionEvent::FirstMotion { rig, is_acknowledged, .. } => {
                let hint = if *is_acknowledged { "" } else { " (--skip-check leaves the check out)" };
                let on = of_rig(*rig);
                self.line(format!("{on}first the Qube is checked and homed{hint}"));
            }
            SessionEvent::Connected { rig, opened } => self.connected(*rig, opened),
            SessionEvent::Identified { recordings, missing_effects } => {
                self.progress.update(|state| state.phase = "planning".into());
                self.line(identified(*recordings, missing_effects));
            }
            SessionEvent::RecordingLeftOut { candidate, rollout, reason } => self.line(format!(
                "candidate {candidate}, rollout {rollout}: the identification leaves the recording out: {reason}"
            )),
            SessionEvent::ExcitationRepeated(reason) => {
                self.line(format!("{reason}. Another recording is made"));
            }
            SessionEvent::NotIdentified(reason) => self.line(format!(
                "not identified: {reason}. The search continues as for an unknown Qube"
            )),
            SessionEvent::RefitFailed { recordings, reason } => {
                self.line(refit_failed(*recordings, reason));
            }
            SessionEvent::NotUpdated(reason) => {
                self.line(format!("the verification leaves the profile as it is: {reason}"));
            }
            SessionEvent::SearchContinues { expected_gain, source, smallest_gain } => {
                let gain = source.words(*expected_gain);
                self.line(format!("{gain}; the search ends below {smallest_gain:.1}"));
            }
            SessionEvent::TooLoud(QuietnessFigures { change_v, sign_changes_per_s, .. }) => {
                self.line(format!(
                    "the verified policy buzzes ({change_v:.2} V a tick, {sign_changes_per_s:.0} sign \
                     changes/s), so the search continues"
                ));
            }
            SessionEvent::SearchEnded { .. } if self.around == Some(1) => {
                self.line("the only candidate has run".into());
            }
            SessionEvent::SearchEnded { expected_gain, source } => {
                self.line(format!("the search ends; {}", source.words(*expected_gain)));
            }
            SessionEvent::EndedEarly(SessionError::Stopped) => {}
            SessionEvent::EndedEarly(error) => {
                self.line(format!("its session ends, and the others continue: {error}"));
            }
            SessionEvent::Drift { rig, drift: Ok(drift) } => {
                self.line(of_rig(*rig) + &command_hints::drift(drift));
            }
            SessionEvent::Drift { rig, drift: Err(unfit) } => self.line(format!(
                "{}the rig's drift cannot be estimated from the first rollouts: {unfit}",
                of_rig(*rig)
            )),
            SessionEvent::RigTakenOut { rig, reason } => self.line(format!(
                "rig {rig} is taken out, and the others make its rollouts: {reason}"
            )),
            SessionEvent::RolloutBegins { .. } => {
                self.progress.update(|state| state.phase = ROLLOUTS.into());
            }
            SessionEvent::Rollout { candidate, purpose, rollout, attempt, rig, verdict } => {
                let on_rig = rig.map_or(String::new(), |rig| format!(" on rig {rig}"));
                let again =
                    if *attempt > 0 { format!(" (try {})", attempt + 1) } else { String::new() };
                let place = self.place(*purpose, *rollout);
                let name =
                    format!("candidate {candidate}, rollout {rollout}{place}{on_rig}{again}");
                self.rollout(*candidate, *purpose, &name, verdict);
            }
        }
    }

    /// Shows a new candidate, and the time that is left.
    fn show_proposal(&mut self, candidate: u32, purpose: Purpose, counts: &CandidateCounts) {
        let description = match purpose {
            Purpose::Excitation => "a recording that identifies the Qube",
            Purpose::Baseline => "a policy trained on the nominal Qube, for comparison",
            Purpose::Initial => "an initial point",
            Purpose::Search => "proposed by the search",
            Purpose::Verification => "the search's recommendation, to be verified",
            Purpose::Incumbent => "the best candidate's policy, to be verified too",
        };
        let to_come = counts.most_searched.saturating_sub(counts.searched);
        let last = candidate + 1 + to_come + u32::from(self.has_baseline);
        if matches!(purpose, Purpose::Excitation | Purpose::Incumbent) {
            self.pace.needs_no_training(candidate);
        }
        self.copy_to_come &= purpose != Purpose::Incumbent;
        self.candidates = counts.total.map_or(last, |total| total - u32::from(self.copy_to_come));
        let text = proposed(candidate, purpose, description, counts);
        self.proposed(candidate, purpose, &text, counts);
        self.line(text + &until_last_training(self.time_left(), purpose, counts));
    }

    /// Shows an update of a training.
    fn show_training(&mut self, candidate: u32, training: u32, update: &TrainUpdate) {
        self.pace.update(candidate, Instant::now());
        let left = self.time_left();
        let name = name_of_training(&format!("candidate {candidate}"), training, self.trainings);
        self.progress.update(|state| {
            state.phase = "training in simulation".into();
            let key = (String::new(), candidate, training);
            state.add_update(key, &name, self.updates, update.mean_return);
            state.expect_end(left);
        });
    }

    /// Shows the end of a candidate's trainings.
    fn show_trained(&mut self, candidate: u32, best_return: f64) {
        self.progress.update(|state| {
            state.trainings.retain(|(_, number, _), _| *number != candidate);
            state.phase = if self.is_connected() { ROLLOUTS } else { OPENING }.into();
        });
        self.pace.trained(candidate);
        self.line(format!(
            "candidate {candidate}: trained, earns {best_return:.0} in its simulations"
        ));
    }

    /// Shows that a rig is open; its identity only the first time.
    fn connected(&mut self, rig: Option<u32>, opened: &Rig) {
        if self.connected.insert(rig) {
            let Identity { kind, serial, port, .. } = opened.identity();
            let on = of_rig(rig);
            self.line(format!("{on}connected to {kind} {serial} at {port}; the arm is homed"));
            warn_without_realtime(opened.realtime());
        }
        self.progress.update(|state| state.phase = ROLLOUTS.into());
    }

    /// The place of a rollout among the rollouts that verify a policy, from 1; empty for another
    /// rollout.
    fn place(&self, purpose: Purpose, rollout: u32) -> String {
        match purpose.verifies() {
            true => format!(" ({} of {})", rollout + 1, self.verification_rollouts),
            false => String::new(),
        }
    }

    /// Shows the outcome of a rollout.
    fn rollout(&mut self, candidate: u32, purpose: Purpose, name: &str, verdict: &Verdict) {
        // The rollouts of an excitation are recordings and no attempts to balance.
        let is_excitation = purpose == Purpose::Excitation;
        match verdict {
            Verdict::Result { .. } if is_excitation => self.line(format!("{name}: recorded")),
            verdict => self.line(format!("{name}: {}", describe(verdict))),
        }
        if let Verdict::Result { outcome, .. } = verdict
            && let Ending::LeftBox(limit) = outcome.ending
            && self.around.is_none()
            && let Some(hint) = command_hints::after_limit(limit)
        {
            self.line(hint.into());
        }
        if let Verdict::Result { return_, success, .. } = verdict
            && !is_excitation
        {
            self.returned(candidate, *return_, *success);
        }
        self.progress.wait_while_paused(&self.stop);
    }

    fn is_connected(&self) -> bool {
        !self.connected.is_empty()
    }

    /// Shows a new candidate on the screen.
    fn proposed(&mut self, candidate: u32, purpose: Purpose, work: &str, counts: &CandidateCounts) {
        let done = match counts.total {
            Some(total) => (candidate, total),
            None => (counts.searched - u32::from(purpose.is_searched()), counts.most_searched),
        };
        self.progress.update(|state| {
            work.clone_into(&mut state.work);
            state.phase = match (purpose == Purpose::Excitation, self.is_connected()) {
                (true, false) => OPENING.into(),
                (true, true) => ROLLOUTS.into(),
                (false, _) => "preparing the training".into(),
            };
            state.may_end_early = counts.total.is_none();
            state.done = Some((done.0.into(), done.1.into()));
            state.expect_end(self.time_left());
        });
    }

    /// Shows the best candidate after one more rollout.
    fn returned(&mut self, candidate: u32, return_: f64, success: bool) {
        let (returns, successes) = self.returns.entry(candidate).or_default();
        returns.push(return_);
        *successes += u32::from(success);
        let best = best(&self.returns);
        self.progress.update(|state| state.best = best);
    }

    fn line(&self, text: String) {
        self.progress.line(&format!("{}{text}", self.prefix));
    }
}

/// The candidate with the largest mean return, in words; empty without a candidate.
fn best(candidates: &BTreeMap<u32, (Vec<f64>, u32)>) -> String {
    let mean = |returns: &[f64]| returns.iter().sum::<f64>() / returns.len().max(1) as f64;
    let best = candidates.iter().max_by(|a, b| mean(&a.1.0).total_cmp(&mean(&b.1.0)));
    best.map_or(String::new(), |(candidate, (returns, successes))| {
        format!(
            "best so far: candidate {candidate} with a return of {:.0}; {successes} of {} rollouts balance",
            mean(returns),
            returns.len()
        )
    })
}

/// The beginning of a line about one rig of several that share a session; empty for the only rig.
fn of_rig(rig: Option<u32>) -> String {
    rig.map_or(String::new(), |rig| format!("rig {rig}: "))
}

/// The outcome of a successful identification as a sentence.
pub fn identified(recordings: u32, missing_effects: &[String]) -> String {
    let from =
        if recordings == 1 { "1 recording".into() } else { format!("{recordings} recordings") };
    let but = if missing_effects.is_empty() {
        String::new()
    } else {
        format!(" except for {}", missing_effects.join("; "))
    };
    format!("identified from {from}: the model describes this Qube{but}")
}

/// The outcome of a fit during the search that gave no new profile, as a sentence.
pub fn refit_failed(recordings: u32, reason: &str) -> String {
    format!(
        "a fit to {recordings} recordings gives no new profile, and the last one is doubted: {reason}"
    )
}

/// The line for a new candidate. Its number counts from 0, as its folder's name does. Its place
/// among all candidates, or among the candidates of a search that may end early, counts from 1.
fn proposed(
    candidate: u32,
    purpose: Purpose,
    description: &str,
    counts: &CandidateCounts,
) -> String {
    let CandidateCounts { searched, most_searched, total } = counts;
    match total {
        Some(total) => {
            format!("candidate {candidate} ({} of {total}): {description}", candidate + 1)
        }
        None if purpose.is_searched() => {
            format!("candidate {candidate}: {description}, {searched} of at most {most_searched}")
        }
        None => format!("candidate {candidate}: {description}"),
    }
}

/// End of a proposal's line with the time left until the last training ends; in a search that may
/// end early, the most time that may be left. The text is empty if the time is not known, and in
/// such a search for a candidate that is verified or compared, because it may be the last one.
fn until_last_training(
    left: Option<Duration>,
    purpose: Purpose,
    counts: &CandidateCounts,
) -> String {
    let Some(left) = left.map(in_words) else { return String::new() };
    match counts.total {
        Some(_) => format!("; about {left} until the last training ends"),
        None if !purpose.informs() => String::new(),
        None => format!("; at most about {left} until the last training ends"),
    }
}

/// A verdict in words.
fn describe(verdict: &Verdict) -> String {
    match verdict {
        Verdict::Void { reason } => format!("void: {reason}"),
        Verdict::Unfinished => "stopped".into(),
        Verdict::Result { return_, success, outcome } => match outcome.ending {
            Ending::LeftBox(limit) => {
                format!("{return_:.0}, {limit}, after {} steps", outcome.steps)
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
    fn the_last_candidate_has_the_last_place_of_all() {
        let settings = SessionSettings::quick();
        let progress = SessionProgress::new(&settings, &Progress::lines(), &Stop::default());
        assert_eq!(progress.candidates, 11, "the last of twelve candidates is a copy");
        let counts = CandidateCounts { searched: 10, most_searched: 10, total: Some(12) };
        let line = proposed(11, Purpose::Incumbent, "the last", &counts);
        assert_eq!(line, "candidate 11 (12 of 12): the last");
    }

    #[test]
    fn a_search_that_may_end_early_counts_its_own_candidates() {
        let counts = CandidateCounts { searched: 10, most_searched: 10, total: None };
        let line = |purpose| proposed(13, purpose, "purpose", &counts);
        assert_eq!(line(Purpose::Search), "candidate 13: purpose, 10 of at most 10");
        assert_eq!(line(Purpose::Incumbent), "candidate 13: purpose");
    }

    #[test]
    fn the_time_left_of_a_search_that_may_end_early_is_a_limit() {
        let line = |total, purpose, left| {
            until_last_training(
                left,
                purpose,
                &CandidateCounts { searched: 3, most_searched: 10, total },
            )
        };
        let left = Some(Duration::from_secs(240));
        assert_eq!(
            line(Some(12), Purpose::Search, left),
            "; about 4 min until the last training ends"
        );
        assert_eq!(
            line(None, Purpose::Search, left),
            "; at most about 4 min until the last training ends"
        );
        assert_eq!(line(None, Purpose::Incumbent, left), "");
        assert_eq!(line(None, Purpose::Baseline, left), "");
        assert_eq!(line(None, Purpose::Search, None), "");
    }

    #[test]
    fn a_rollout_that_verifies_a_policy_has_its_place() {
        let settings = SessionSettings::quick();
        let progress = SessionProgress::new(&settings, &Progress::lines(), &Stop::default());
        let last = settings.extent.verification_rollouts - 1;
        assert_eq!(progress.place(Purpose::Incumbent, last), format!(" ({0} of {0})", last + 1));
        assert_eq!(progress.place(Purpose::Search, 0), "");
    }

    #[test]
    fn the_best_candidate_has_the_largest_mean_return() {
        assert_eq!(best(&BTreeMap::new()), "");
        let candidates = BTreeMap::from([
            (0, (vec![500.0, 100.0], 1)),
            (1, (vec![400.0], 1)),
            (2, (vec![20.0], 0)),
        ]);
        let expected = "best so far: candidate 1 with a return of 400; 1 of 1 rollouts balance";
        assert_eq!(best(&candidates), expected);
    }
}
