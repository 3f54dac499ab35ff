use std::time::{Duration, Instant};

use super::screen::{Progress, in_words, time_left};
use crate::learning::TrainUpdate;

/// Largest number of lines that a training without a screen writes.
const LINES: u32 = 10;

/// The name of one of the competing trainings of a policy or a candidate; `training` counts from 0.
/// A training beyond the expected number has no total.
pub fn name_of_training(trained: &str, training: u32, expected: u32) -> String {
    match training + 1 {
        1 if expected <= 1 => trained.to_owned(),
        number if number > expected => format!("{trained}, training {number}"),
        number => format!("{trained}, training {number} of {expected}"),
    }
}

/// The display of a single training: a curve on the screen, or at most ten lines.
pub struct TrainingDisplay {
    progress: Progress,
    updates: u32,
    best_return: f64,
    /// Number of the first update of this process, and the time when it was done.
    first: Option<(u32, Instant)>,
}

impl TrainingDisplay {
    /// A display of a training with this number of updates. `has_checkpoint` says whether a stopped
    /// training can be resumed.
    pub fn new(updates: u32, has_checkpoint: bool, progress: &Progress) -> Self {
        progress.update(|state| {
            state.has_rollouts = false;
            state.can_pause = false;
            state.stop_effect = match has_checkpoint {
                true => "the checkpoint is kept, and the same command continues from it",
                false => "nothing is written (--checkpoint would keep the training)",
            };
            state.work = "one policy".into();
            state.phase = "training in simulation".into();
            state.done = Some((0, updates.into()));
        });
        Self { progress: progress.clone(), updates, best_return: f64::NEG_INFINITY, first: None }
    }

    /// Shows one more update.
    pub fn update(&mut self, update: &TrainUpdate) {
        let (done, all) = (update.update + 1, self.updates);
        self.best_return = self.best_return.max(update.mean_return);
        let best_return = self.best_return;
        // The clock starts when the first update of this process is done. That update does not
        // count, and neither do those before a checkpoint.
        let (first, began) = *self.first.get_or_insert_with(|| (update.update, Instant::now()));
        let timed = update.update.saturating_sub(first);
        let left = time_left(began.elapsed(), timed.into(), all.saturating_sub(done).into());
        if !self.progress.has_screen()
            && let Some(line) = line_after(done, all, best_return, left)
        {
            self.progress.line(&line);
        }
        self.progress.update(|state| {
            state.add_update((String::new(), 0, 0), "the policy", all, update.mean_return);
            state.done = Some((done.into(), all.into()));
            state.expect_end(left);
            state.best = format!("best return so far: {best_return:.0}");
        });
    }
}

/// The line of progress after an update; `None` for an update without a line, because a training
/// writes at most [`LINES`] lines.
fn line_after(done: u32, all: u32, best_return: f64, left: Option<Duration>) -> Option<String> {
    if (done * LINES) % all >= LINES {
        return None;
    }
    let left = left.map_or(String::new(), |left| format!(", {} left", in_words(left)));
    Some(format!("update {done} of {all}, best return {best_return:.1}{left}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_training_without_a_screen_prints_its_total_and_its_time_left_in_ten_lines() {
        let line = |done| line_after(done, 25, 123.4, Some(Duration::from_secs(90)));
        let lines: Vec<String> = (1..=25).filter_map(line).collect();
        assert_eq!(lines.len(), 10, "{lines:?}");
        assert_eq!(lines[0], "update 3 of 25, best return 123.4, 90 s left");
        assert!(lines[9].starts_with("update 25 of 25"), "{lines:?}");
        assert_eq!(line_after(1, 2, 7.0, None).as_deref(), Some("update 1 of 2, best return 7.0"));
    }

    #[test]
    fn competing_trainings_are_numbered_from_one() {
        assert_eq!(name_of_training("candidate 1", 0, 1), "candidate 1");
        let names = [0, 1, 2].map(|training| name_of_training("candidate 1", training, 2));
        let expected = ["training 1 of 2", "training 2 of 2", "training 3"];
        assert_eq!(names, expected.map(|it| format!("candidate 1, {it}")));
    }
}
