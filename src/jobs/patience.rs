use std::time::{Duration, Instant};

/// Longest time for which operations on a folder may fail, because file servers are restarted now
/// and then.
pub(super) const FOLDER_PATIENCE: Duration = Duration::from_secs(60);

/// The patience with an operation that fails. It lasts for a time from the first failure since the
/// last success.
#[derive(Debug)]
pub(super) struct Patience {
    longest: Duration,
    failing_since: Option<Instant>,
}

impl Patience {
    /// Patience that lasts for the time `longest`.
    pub fn new(longest: Duration) -> Self {
        Self { longest, failing_since: None }
    }

    /// Returns whether an operation that has just failed is to be tried again.
    pub fn lasts(&mut self) -> bool {
        self.failing_since.get_or_insert_with(Instant::now).elapsed() < self.longest
    }

    /// Records that an operation has succeeded.
    pub fn renew(&mut self) {
        self.failing_since = None;
    }

    /// Moves the first failure into the past by this time.
    #[cfg(test)]
    pub fn age(&mut self, time: Duration) {
        self.failing_since = self.failing_since.map(|since| since - time);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn patience_lasts_for_its_time_from_the_first_failure_since_the_last_success() {
        let second = Duration::from_secs(1);
        let mut patience = Patience::new(600 * second);
        assert!(patience.lasts());
        patience.age(601 * second);
        assert!(!patience.lasts());
        patience.renew();
        assert!(patience.lasts());
        assert!(!Patience::new(Duration::ZERO).lasts());
    }
}
