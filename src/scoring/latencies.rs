use crate::telemetry::{LatencySummary, TickRecord};

/// The timing of many ticks, of one rollout or of many.
#[derive(Clone, Debug, Default)]
pub struct Latencies {
    lateness_us: Vec<f64>,
    sample_to_act_us: Vec<f64>,
    missed_deadlines: u64,
}

impl Latencies {
    /// Adds the ticks of one recording.
    pub fn add(&mut self, ticks: &[TickRecord]) {
        for tick in ticks {
            self.lateness_us.push(tick.lateness_ns as f64 / 1000.0);
            self.sample_to_act_us
                .extend(tick.measurement.and_then(|sample| sample.sample_to_act_us).map(f64::from));
            self.missed_deadlines += u64::from(tick.missed_deadlines());
        }
    }

    /// Number of ticks that were skipped, late by more than a period, or without a valid sample.
    #[must_use]
    pub fn missed_deadlines(&self) -> u64 {
        self.missed_deadlines
    }

    /// Number of ticks counted.
    #[must_use]
    pub fn ticks(&self) -> usize {
        self.lateness_us.len()
    }

    /// Histogram of the lateness of wake-ups, us: for each of these bounds, in rising order, the
    /// number of wake-ups that were at most this late and later than the bound before. The last
    /// number also counts every wake-up that was later than the last bound.
    #[must_use]
    pub fn lateness_counts(&self, bounds_us: &[f64]) -> Vec<u64> {
        let mut counts = vec![0; bounds_us.len()];
        for lateness_us in &self.lateness_us {
            let bound = bounds_us.partition_point(|bound| bound < lateness_us);
            if let Some(count) = counts.get_mut(bound.min(bounds_us.len().saturating_sub(1))) {
                *count += 1;
            }
        }
        counts
    }

    /// Percentiles of the lateness of wake-ups, us.
    #[must_use]
    pub fn lateness_us(&self) -> LatencySummary {
        summary(&self.lateness_us)
    }

    /// Percentiles of the time from sample to act, us, by the device's clock.
    #[must_use]
    pub fn sample_to_act_us(&self) -> LatencySummary {
        summary(&self.sample_to_act_us)
    }
}

/// Percentiles by nearest rank; zeros without values.
fn summary(values: &[f64]) -> LatencySummary {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let rank = |fraction: f64| {
        let rank = (fraction * sorted.len() as f64).ceil() as usize;
        sorted.get(rank.saturating_sub(1)).copied().unwrap_or(0.0)
    };
    LatencySummary { p50: rank(0.5), p99: rank(0.99), p999: rank(0.999), max: rank(1.0) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_values_that_occurred() {
        let values: Vec<f64> = (1..=1000).rev().map(f64::from).collect();
        let expected = LatencySummary { p50: 500.0, p99: 990.0, p999: 999.0, max: 1000.0 };
        assert_eq!(summary(&values), expected);
        assert_eq!(summary(&[]), LatencySummary::default());
    }

    #[test]
    fn every_wake_up_is_counted_once() {
        let mut latencies = Latencies::default();
        let late = |lateness_ns| TickRecord { lateness_ns, ..TickRecord::default() };
        latencies.add(&[late(0), late(10_000), late(10_001), late(99_000_000)]);
        assert_eq!(latencies.lateness_counts(&[10.0, 20.0, 30.0]), [2, 1, 1]);
        assert!(latencies.lateness_counts(&[]).is_empty());
    }

    #[test]
    fn the_missed_deadlines_of_all_ticks_add_up() {
        let mut latencies = Latencies::default();
        let sampled = TickRecord { measurement: Some(Default::default()), ..TickRecord::default() };
        latencies.add(&[
            sampled,
            TickRecord { skipped_periods: 2, ..sampled },
            TickRecord { measurement: None, ..sampled },
        ]);
        assert_eq!(latencies.missed_deadlines(), 3);
        assert_eq!(latencies.ticks(), 3);
    }
}
