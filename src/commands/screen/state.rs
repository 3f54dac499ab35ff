//! The state of the work that the screen shows, without the current rollout.

use std::collections::{BTreeMap, VecDeque};
use std::time::{Duration, Instant};

/// The effect of a stop while a Qube is driven.
pub const STOP_EFFECT: &str = "the arm is braked and the state is kept";

/// Largest number of messages that are kept and printed at the end.
const KEPT: usize = 10_000;

/// A training under way.
#[derive(Clone, Debug)]
pub struct Training {
    /// Name, such as `candidate 3`.
    pub name: String,
    /// Number of updates in all.
    pub updates: u32,
    /// Mean return after each update so far.
    pub returns: Vec<f64>,
    /// Time of the first update.
    pub began: Instant,
}

impl Training {
    /// Returns the best mean return so far; `None` before the first update.
    pub fn best(&self) -> Option<f64> {
        self.returns.iter().copied().max_by(f64::total_cmp)
    }

    /// Returns the time left if the other updates take as long as the finished ones; `None` before
    /// the second update.
    pub fn left(&self, now: Instant) -> Option<Duration> {
        let done = u32::try_from(self.returns.len()).unwrap_or(u32::MAX);
        let each = now.saturating_duration_since(self.began).checked_div(done.saturating_sub(1))?;
        Some(each * self.updates.saturating_sub(done))
    }
}

/// A pause that the operator requested.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Pause {
    /// No pause.
    #[default]
    No,
    /// A pause after the present rollout, or after the next one if none runs.
    Asked,
    /// A pause now: the work waits.
    Now,
}

/// A window over the screen.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Overlay {
    /// No window.
    #[default]
    None,
    /// The help: keys and symbols.
    Help,
    /// The question whether to stop.
    Quit,
    /// A question of the program, which waits for a key as its answer.
    Question(String),
}

/// The state of the screen.
#[derive(Clone, Debug)]
pub struct ScreenState {
    /// Command and folder.
    pub title: String,
    /// Time at which the command began.
    pub began: Instant,
    /// The present work, such as `candidate 3 (4 of 12): proposed by the search`.
    pub work: String,
    /// The phase of the present work, such as `training in simulation`.
    pub phase: String,
    /// Number of finished pieces of work, and of all pieces or the most that there may be; `None`
    /// before the number is known.
    pub done: Option<(u64, u64)>,
    /// True if the work may end before all pieces are done.
    pub may_end_early: bool,
    /// Expected end of all work; `None` if it is not known.
    pub ends: Option<Instant>,
    /// The best result so far, in words; empty before a result.
    pub best: String,
    /// Trainings under way. A key is the name of the recipe or search (empty if there is only one),
    /// the number of the trained candidate or policy, and the number of its training.
    pub trainings: BTreeMap<(String, u32, u32), Training>,
    /// Address of the live view; empty without one.
    pub live: String,
    /// True if rollouts are shown.
    pub has_rollouts: bool,
    /// True if trainings are shown.
    pub has_trainings: bool,
    /// True if the operator can request a pause between rollouts.
    pub can_pause: bool,
    /// Effect of a stop in one sentence.
    pub stop_effect: &'static str,
    /// Pause that the operator requested.
    pub pause: Pause,
    /// True if a stop was requested.
    pub is_stopping: bool,
    /// Window over the rest of the screen.
    pub overlay: Overlay,
    /// Messages, the oldest first.
    pub messages: VecDeque<String>,
}

impl ScreenState {
    /// Returns the state at the beginning.
    pub fn new(title: String, began: Instant) -> Self {
        Self {
            title,
            began,
            work: String::new(),
            phase: String::new(),
            done: None,
            may_end_early: false,
            ends: None,
            best: String::new(),
            trainings: BTreeMap::new(),
            live: String::new(),
            has_rollouts: true,
            has_trainings: true,
            can_pause: true,
            stop_effect: STOP_EFFECT,
            pause: Pause::No,
            is_stopping: false,
            overlay: Overlay::None,
            messages: VecDeque::new(),
        }
    }

    /// Adds each line of a text that is not blank as a message; beyond `KEPT` the oldest message is
    /// dropped.
    pub fn add_message(&mut self, text: &str) {
        for line in text.lines().filter(|line| !line.trim().is_empty()) {
            if self.messages.len() == KEPT {
                self.messages.pop_front();
            }
            self.messages.push_back(line.to_owned());
        }
    }

    /// Adds an update of a training.
    pub fn add_update(
        &mut self,
        key: (String, u32, u32),
        name: &str,
        updates: u32,
        mean_return: f64,
    ) {
        let training = self.trainings.entry(key).or_insert_with(|| Training {
            name: name.to_owned(),
            updates,
            returns: Vec::new(),
            began: Instant::now(),
        });
        training.returns.push(mean_return);
    }

    /// Sets the expected end to this time from now; `None` means that it is not known.
    pub fn expect_end(&mut self, left: Option<Duration>) {
        self.ends = left.map(|left| Instant::now() + left);
    }
}

/// Returns the time that `to_do` more pieces of work take if each takes as long as, on average, the
/// `done` pieces that this process has finished in the time `elapsed`. A piece under way counts as
/// a fraction. `None` before any work is done, and for 1e9 s (30 years) or more.
pub fn time_left(elapsed: Duration, done: f64, to_do: f64) -> Option<Duration> {
    let left_s = elapsed.as_secs_f64() / done * to_do.max(0.0);
    let is_known = done > 0.0 && left_s.is_finite() && left_s < 1e9;
    is_known.then(|| Duration::from_secs_f64(left_s))
}

/// Returns the end of a line of progress with the time that is left, such as `; about 4 min left`;
/// empty if the time is not known.
pub fn left_in_words(left: Option<Duration>) -> String {
    left.map_or(String::new(), |left| format!("; about {} left", in_words(left)))
}

/// Returns a time in the words of a clock: `45 s`, `4 min`, `2 h 05 min`.
pub fn in_words(time: Duration) -> String {
    let seconds = time.as_secs();
    match seconds {
        0..120 => format!("{seconds} s"),
        120..7200 => format!("{} min", seconds / 60),
        _ => format!("{} h {:02} min", seconds / 3600, seconds / 60 % 60),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_written_in_seconds_minutes_or_hours() {
        let words = [0, 119, 120, 7199, 7200, 90_061].map(|s| in_words(Duration::from_secs(s)));
        assert_eq!(words, ["0 s", "119 s", "2 min", "119 min", "2 h 00 min", "25 h 01 min"]);
    }

    #[test]
    fn each_line_is_a_message_and_the_oldest_is_dropped_first() {
        let mut state = ScreenState::new("test".into(), Instant::now());
        state.add_message("one\n\ntwo\n");
        assert_eq!(state.messages, ["one", "two"]);
        for number in 0..KEPT {
            state.add_message(&number.to_string());
        }
        assert_eq!((state.messages.len(), state.messages[0].as_str()), (KEPT, "0"));
    }

    #[test]
    fn a_training_has_a_best_return_and_a_time_left() {
        let began = Instant::now();
        let returns = vec![10.0, 30.0, 20.0];
        let training = Training { name: "t".into(), updates: 11, returns, began };
        assert_eq!(training.best(), Some(30.0));
        assert_eq!(training.left(began + Duration::from_secs(4)), Some(Duration::from_secs(16)));
        let first = Training { returns: vec![1.0], ..training };
        assert_eq!(first.left(began), None);
    }
}
