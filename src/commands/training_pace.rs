use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use super::screen::time_left;

/// The pace at which a session trains its candidates, from which its time left is estimated.
///
/// Only the trainings of this process, or of its workers, count. Proposals do not: several
/// candidates may be proposed at once, and an excitation takes less time.
pub struct TrainingPace {
    /// Number of updates of a candidate, over all its trainings.
    updates: u32,
    /// Time of the first update, and the number of its candidate.
    began: Option<(Instant, u32)>,
    /// Number of candidates whose trainings have ended since this process began.
    trained: u32,
    /// Updates so far of each candidate that is in training.
    in_training: BTreeMap<u32, u32>,
    /// Numbers of candidates that need no training.
    untrained: BTreeSet<u32>,
}

impl TrainingPace {
    /// The pace before the first training. Each candidate has this number of updates.
    pub fn new(updates: u32) -> Self {
        Self {
            updates,
            began: None,
            trained: 0,
            in_training: BTreeMap::new(),
            untrained: BTreeSet::new(),
        }
    }

    /// Counts one more update of a candidate. The first update of all only starts the clock.
    pub fn update(&mut self, candidate: u32, now: Instant) {
        match self.began {
            None => self.began = Some((now, candidate)),
            Some(_) => *self.in_training.entry(candidate).or_default() += 1,
        }
    }

    /// Ends the trainings of a candidate.
    pub fn trained(&mut self, candidate: u32) {
        self.in_training.remove(&candidate);
        self.trained += 1;
    }

    /// Leaves a candidate out of the trainings to come: it is an excitation, or a copy of another
    /// candidate's policy.
    pub fn needs_no_training(&mut self, candidate: u32) {
        self.untrained.insert(candidate);
    }

    /// Time left for a session of this number of candidates; `None` before the second update, and
    /// once all candidates are trained, because the trainings do not show how long the remaining
    /// rollouts take.
    pub fn time_left(&self, candidates: u32, now: Instant) -> Option<Duration> {
        let (began, first) = self.began?;
        // A training that failed and began again makes more updates than planned; it counts at most
        // as one candidate.
        let part = |updates: &u32| f64::from((*updates).min(self.updates));
        let parts = self.in_training.values().map(part).sum::<f64>();
        let done = f64::from(self.trained) + parts / f64::from(self.updates.max(1));
        let untrained = self.untrained.range(first..candidates.max(first)).count();
        let to_do = f64::from(candidates.saturating_sub(first)) - untrained as f64 - done;
        if to_do <= 0.0 {
            return None;
        }
        time_left(now.saturating_duration_since(began), done, to_do)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_time_left_covers_the_candidates_to_come() {
        let began = Instant::now();
        let after_s = |seconds| began + Duration::from_secs(seconds);
        let mut pace = TrainingPace::new(10);
        assert_eq!(pace.time_left(12, began), None, "nothing is known yet");
        // Candidate 0 is an excitation; 1 and 2 are trained at once.
        pace.update(1, began);
        assert_eq!(pace.time_left(12, began), None);
        for number in [1, 1, 1, 1, 1, 2, 2, 2, 2, 2] {
            pace.update(number, began);
        }
        assert_eq!(pace.time_left(12, after_s(30)), Some(Duration::from_secs(300)));
        pace.trained(1);
        pace.trained(2);
        assert_eq!(pace.time_left(12, after_s(60)), Some(Duration::from_secs(270)));
        // Candidate 3 is a copy, and the others have not begun; none of them shows how long a
        // training takes.
        pace.needs_no_training(0);
        pace.needs_no_training(3);
        assert_eq!(pace.time_left(12, after_s(60)), Some(Duration::from_secs(240)));
        for _ in 0..30 {
            pace.update(4, after_s(60));
        }
        assert_eq!(pace.time_left(12, after_s(90)), Some(Duration::from_secs(210)));
        pace.trained(4);
        assert_eq!(pace.time_left(5, after_s(90)), None, "only copies and rollouts are left");
    }
}
