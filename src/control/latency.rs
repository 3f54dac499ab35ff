use hdrhistogram::Histogram;

use crate::telemetry::LatencySummary;

/// Largest latency that is resolved, ns; larger ones count as this one.
const LARGEST_NS: u64 = 10_000_000_000;

/// Histogram of one kind of latency. Recording into it does not allocate.
#[derive(Clone, Debug)]
pub struct LatencyHistogram {
    nanoseconds: Histogram<u64>,
}

impl LatencyHistogram {
    /// An empty histogram with two significant digits.
    #[must_use]
    pub fn new() -> Self {
        let nanoseconds =
            Histogram::new_with_bounds(1, LARGEST_NS, 2).expect("constant bounds are valid");
        Self { nanoseconds }
    }

    /// Adds one latency in ns.
    pub fn record(&mut self, latency_ns: u64) {
        self.nanoseconds.saturating_record(latency_ns);
    }

    /// Percentiles in microseconds; all 0 if nothing was recorded.
    #[must_use]
    pub fn summary(&self) -> LatencySummary {
        let microseconds = |quantile| self.nanoseconds.value_at_quantile(quantile) as f64 / 1000.0;
        LatencySummary {
            p50: microseconds(0.5),
            p99: microseconds(0.99),
            p999: microseconds(0.999),
            max: self.nanoseconds.max() as f64 / 1000.0,
        }
    }
}

impl Default for LatencyHistogram {
    fn default() -> Self {
        Self::new()
    }
}
