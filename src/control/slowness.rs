//! Detects a program that is too slow for its control period. The loop skips whole periods that
//! have passed, so each deadline by itself is met nearly in time. Only the skipped periods show
//! that the policy did not get its 100 decisions a second; the return then does not measure the
//! policy.

/// Share of the control periods that may be skipped, which allows for single stalls of a busy
/// computer.
const ALLOWED_SHARE: f64 = 0.05;

/// Number of skipped periods beyond the allowed share above which the program is too slow.
const MOST_PERIODS: f64 = 10.0;

/// Counts the control periods that the program has skipped beyond the allowed share.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct SlownessWatch {
    beyond: f64,
}

impl SlownessWatch {
    /// Takes the number of periods skipped before this tick; returns whether the program has
    /// skipped too many.
    pub fn is_too_slow(&mut self, skipped_periods: u32) -> bool {
        let allowed = ALLOWED_SHARE * (1.0 + f64::from(skipped_periods));
        self.beyond = (self.beyond + f64::from(skipped_periods) - allowed).max(0.0);
        self.beyond > MOST_PERIODS
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The first tick with an alarm when every `ticks`-th tick skips `periods`.
    fn alarm(ticks: u32, periods: u32) -> Option<u32> {
        let mut watch = SlownessWatch::default();
        (0..100_000)
            .find(|tick| watch.is_too_slow(if tick % ticks == ticks - 1 { periods } else { 0 }))
    }

    #[test]
    fn decisions_that_take_longer_than_a_period_are_found_within_a_second() {
        // 15 ms and 12 ms a decision: every other tick and every fifth tick skips a period.
        assert_eq!(alarm(2, 1), Some(23));
        assert_eq!(alarm(5, 1), Some(69));
    }

    #[test]
    fn single_stalls_are_no_fault() {
        assert_eq!(alarm(25, 1), None);
        // Three lost periods every second.
        assert_eq!(alarm(100, 3), None);
    }
}
