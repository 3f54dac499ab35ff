use std::sync::atomic::{AtomicBool, Ordering};

use super::Diagnosis;
use crate::clock::{Clock, PunctualClock, RealtimeRefusals, enter_realtime};
use crate::control::LatencyHistogram;
use crate::qube::CONTROL_PERIOD_NS;
use crate::telemetry::LatencySummary;

const NAME: &str = "timer";

/// Lateness that 99 of 100 ticks of a quiet computer do not exceed, us. Beyond it, or if a single
/// tick is missed, the diagnosis is [`Advice`](super::Suitability::Advice).
const GOOD_P99_US: f64 = 1_000.0;

/// Lateness beyond which a tick counts as missed, us. If more than 1 tick in 100 is missed, the
/// diagnosis is [`Unfit`](super::Suitability::Unfit): five such ticks in a row make a rollout void.
const PERIOD_US: f64 = CONTROL_PERIOD_NS as f64 * 1e-3;

/// Measures how late a thread with the rights of the control thread wakes up, 100 times a second
/// for this many seconds or until `stop` is set.
pub(super) fn watch(
    seconds: u32,
    stop: &AtomicBool,
) -> std::io::Result<(RealtimeRefusals, Diagnosis)> {
    std::thread::scope(|scope| {
        let watcher = std::thread::Builder::new()
            .name("doctor".into())
            .spawn_scoped(scope, || (enter_realtime(), lateness(seconds, stop)))?;
        let watched = watcher.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic));
        let (realtime, (ticks, lateness_us)) = watched;
        Ok((realtime, diagnosis(ticks, &lateness_us)))
    })
}

fn lateness(seconds: u32, stop: &AtomicBool) -> (u64, LatencySummary) {
    let clock = PunctualClock::new();
    let _awake = clock.stay_awake();
    let mut lateness = LatencyHistogram::new();
    let ticks = u64::from(seconds) * 1_000_000_000 / CONTROL_PERIOD_NS;
    let mut deadline_ns = clock.now_ns();
    let mut done = 0;
    while done < ticks && !stop.load(Ordering::Relaxed) {
        deadline_ns += CONTROL_PERIOD_NS;
        clock.sleep_until(deadline_ns);
        lateness.record(clock.now_ns().saturating_sub(deadline_ns));
        done += 1;
    }
    (done, lateness.summary())
}

fn diagnosis(ticks: u64, lateness_us: &LatencySummary) -> Diagnosis {
    let LatencySummary { p50, p99, p999, max } = *lateness_us;
    let value = format!(
        "late by p50 {p50:.0}, p99 {p99:.0}, p99.9 {p999:.0}, max {max:.0} us in {ticks} ticks at \
         100 Hz"
    );
    let remedy = "close programs that keep this computer busy (uptime shows its load; in a virtual machine: \
                the host's too)";
    if p99 > PERIOD_US {
        Diagnosis::unfit(NAME, value, remedy)
    } else if p99 > GOOD_P99_US || max > PERIOD_US {
        Diagnosis::advice(NAME, value, remedy)
    } else {
        Diagnosis::well(NAME, value)
    }
}

#[cfg(test)]
mod tests {
    use super::super::Suitability;
    use super::*;

    #[test]
    fn the_worst_of_a_hundred_ticks_decides() {
        let summary = |p99, max| LatencySummary { p50: 50.0, p99, p999: max, max };
        for (p99, max, verdict) in [
            (200.0, 900.0, Suitability::Well),
            (2_000.0, 3_000.0, Suitability::Advice),
            (200.0, 14_000.0, Suitability::Advice),
            (11_000.0, 14_000.0, Suitability::Unfit),
        ] {
            assert_eq!(diagnosis(1000, &summary(p99, max)).verdict, verdict);
        }
    }

    #[test]
    fn a_stop_ends_the_measurement() {
        let (_, diagnosis) = watch(1000, &AtomicBool::new(true)).unwrap();
        assert!(diagnosis.value.contains("in 0 ticks"), "{}", diagnosis.value);
    }
}
