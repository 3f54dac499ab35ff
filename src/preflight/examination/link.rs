use super::Interruption;
use super::examined_device::ExaminedDevice;
use crate::clock::Nanoseconds;
use crate::control::{LONGEST_SAMPLE_TIMEOUT_NS, LatencyHistogram, SAMPLE_TIMEOUT_NS};
use crate::device::Identity;
use crate::preflight::latency_timer::{latency_timer_ms, latency_timer_remedy};
use crate::telemetry::{CheckResult, Hint, LatencySummary, MeasuredLink};

/// Number of samples for the check of the link in an examination.
pub(super) const SAMPLES: u32 = 600;

/// Number of samples for a measurement of the link without an examination.
pub(super) const FEW_SAMPLES: u32 = 200;

/// Longest time for all samples together, ns: 5 s.
const LONGEST_NS: Nanoseconds = 5_000_000_000;

/// Longest pause between two samples, ns; each pause is another fraction of it. Ticks come at any
/// phase of a USB bridge that hands bytes over by a timer (every 4.096 ms in a genuine Uno). With
/// equal pauses, the requests would all meet the bridge at the same phase.
const LONGEST_PAUSE_NS: f64 = 4_500_000.0;

/// Fractional part of the golden ratio: its multiples modulo 1 fill the unit interval evenly.
const GOLDEN_SHARE: f64 = 0.618_033_988_749_895;

/// Margin of a tick's longest wait over the time in which 99 of 100 samples arrive, ns.
const MARGIN_NS: f64 = 500_000.0;

/// Time after which a sample counts as lost, ns.
const PATIENCE_NS: Nanoseconds = 50_000_000;

/// The round trips of samples, from the request to the complete answer, by the computer's clock. A
/// lost sample counts with the time until it was given up.
pub(super) struct RoundTrips {
    asked: u32,
    lost: u32,
    summary_us: LatencySummary,
    /// Count of the arm before anything moved it.
    pub(super) theta_counts: Option<i32>,
    /// True if the board reports that it has an emergency-stop switch.
    has_stop_switch: bool,
}

/// Reports which device answered, and whether it has an emergency-stop switch.
pub(super) fn identity(identity: &Identity, round_trips: &RoundTrips) -> CheckResult {
    // The check always passes: a device without a Qube's module id, or with another protocol, has
    // failed at the hello already.
    let protocol = match identity.protocol_version {
        0 => "the vendor's library".to_owned(),
        version => format!("protocol {version}"),
    };
    CheckResult::pass(
        "identity",
        format!(
            "{} {}, firmware {}, {protocol}, at {}, {} emergency-stop switch",
            identity.kind,
            identity.serial,
            identity.firmware_version,
            identity.port,
            if round_trips.has_stop_switch { "with an" } else { "no" }
        ),
    )
}

/// Measures the round trips of this many samples, or of as many as fit into [`LONGEST_NS`].
pub(super) fn measure(
    examined: &mut ExaminedDevice<'_>,
    samples: u32,
) -> Result<RoundTrips, Interruption> {
    let clock = examined.clock;
    // The processor is kept awake for the measurement, as it is for the ticks.
    let _awake = clock.stay_awake();
    let mut round_trips = LatencyHistogram::new();
    let (mut asked, mut lost, mut theta_counts) = (0, 0, None);
    let mut has_stop_switch = false;
    let end_ns = clock.now_ns() + LONGEST_NS;
    while asked < samples && clock.now_ns() < end_ns {
        examined.ensure_going()?;
        asked += 1;
        let share = (f64::from(asked) * GOLDEN_SHARE).fract();
        clock.sleep_until(clock.now_ns() + (share * LONGEST_PAUSE_NS) as Nanoseconds);
        let asked_ns = clock.now_ns();
        match examined.device.sample(asked_ns + PATIENCE_NS) {
            Ok(sample) => {
                theta_counts = theta_counts.or(Some(sample.theta_counts));
                has_stop_switch = sample.status.stop_switch_fitted;
            }
            Err(fault) => {
                examined.lost(fault)?;
                lost += 1;
            }
        }
        round_trips.record(clock.now_ns() - asked_ns);
    }
    let summary_us = round_trips.summary();
    Ok(RoundTrips { asked, lost, summary_us, theta_counts, has_stop_switch })
}

impl RoundTrips {
    /// The measured link, with a tick's longest wait for a sample: the time in which 99 of 100
    /// samples arrive plus a margin, within the limits of the control loop.
    pub(super) fn link(&self) -> MeasuredLink {
        let needed_ns = self.summary_us.p99 * 1e3 + MARGIN_NS;
        let most_ns = LONGEST_SAMPLE_TIMEOUT_NS as f64;
        let sample_time_ns = needed_ns.clamp(SAMPLE_TIMEOUT_NS as f64, most_ns);
        MeasuredLink {
            round_trip_us: self.summary_us,
            lost: self.lost,
            sample_time_us: (sample_time_ns * 1e-3).ceil() as u32,
        }
    }

    /// Returns whether 99 of 100 samples arrive within the longest wait that a tick may have, and
    /// no more than 1 in 100 is lost.
    fn is_fast_enough(&self) -> bool {
        let most_us = LONGEST_SAMPLE_TIMEOUT_NS as f64 * 1e-3;
        self.summary_us.p99 <= most_us && self.lost * 100 <= self.asked
    }
}

/// Checks the latency timer of the FTDI driver. When this program opens the port, it requests the
/// low-latency mode, in which the driver uses 1 ms regardless of the setting. Not every driver has
/// that mode, so the round trips decide.
pub(super) fn latency_timer(port: &str, round_trips: &RoundTrips) -> CheckResult {
    const NAME: &str = "latency-timer";
    let p50_ms = round_trips.summary_us.p50 * 1e-3;
    match latency_timer_ms(port) {
        None => CheckResult::skipped(NAME, "no FTDI adapter, so no such timer"),
        Some(timer_ms) if timer_ms <= 1 => CheckResult::pass(NAME, format!("{timer_ms} ms")),
        Some(timer_ms) if p50_ms < f64::from(timer_ms) / 2.0 => CheckResult::pass(
            NAME,
            format!("{timer_ms} ms as set, but the driver's low-latency mode is on"),
        ),
        Some(timer_ms) => CheckResult::fail(
            NAME,
            format!("{timer_ms} ms: the adapter holds each answer back that long"),
            latency_timer_remedy(port),
        ),
    }
}

/// Checks that samples arrive fast enough for the ticks, and that few are lost.
pub(super) fn latency(port: &str, round_trips: &RoundTrips) -> CheckResult {
    const NAME: &str = "latency";
    let RoundTrips { asked, lost, summary_us, .. } = round_trips;
    let ms = |us: f64| us * 1e-3;
    let mut value = format!(
        "sample to answer p50 {:.2}, p99 {:.2}, p99.9 {:.2}, max {:.2} ms of {asked}",
        ms(summary_us.p50),
        ms(summary_us.p99),
        ms(summary_us.p999),
        ms(summary_us.max)
    );
    if *lost > 0 {
        value += &format!(", {lost} lost");
    }
    let usual_us = (SAMPLE_TIMEOUT_NS / 1000) as u32;
    let sample_time_us = round_trips.link().sample_time_us;
    if round_trips.is_fast_enough() {
        if sample_time_us > usual_us {
            value += &format!(
                ": a slow USB bridge, so a tick waits up to {:.1} ms",
                f64::from(sample_time_us) * 1e-3
            );
        }
        return CheckResult::pass(NAME, value);
    }
    if latency_timer_ms(port).is_some_and(|timer_ms| timer_ms > 1) {
        return CheckResult::fail(NAME, value, latency_timer_remedy(port));
    }
    let remedy = format!(
        "99 of 100 samples must take less than {:.1} ms. Close other programs that keep this computer \
         busy, and plug the board in without a hub",
        LONGEST_SAMPLE_TIMEOUT_NS as f64 * 1e-6
    );
    CheckResult::fail(NAME, value, remedy).with_hint(Some(Hint::TestTiming))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn measured(p99_ms: f64, lost: u32) -> RoundTrips {
        let summary_us =
            LatencySummary { p99: p99_ms * 1e3, max: 9e3, ..LatencySummary::default() };
        RoundTrips { asked: 600, lost, summary_us, theta_counts: None, has_stop_switch: false }
    }

    #[test]
    fn a_tick_waits_as_long_as_the_link_needs_and_no_longer_than_its_budget() {
        for (p99_ms, sample_time_us) in
            [(0.9, 6000), (5.4, 6000), (5.9, 6400), (6.6, 7100), (7.9, 8400), (30.0, 8500)]
        {
            assert_eq!(measured(p99_ms, 0).link().sample_time_us, sample_time_us, "{p99_ms} ms");
        }
    }

    #[test]
    fn a_link_that_loses_more_than_one_of_a_hundred_fails_with_a_remedy() {
        for (p99_ms, lost, passes) in
            [(1.0, 0, true), (8.4, 6, true), (8.6, 0, false), (1.0, 7, false)]
        {
            let result = latency("/dev/ttyNOWHERE", &measured(p99_ms, lost));
            assert_eq!(!result.failed(), passes, "{result:?}");
            assert_eq!(result.remedy.is_none(), passes);
        }
        let slow = latency("/dev/ttyNOWHERE", &measured(6.6, 0));
        assert!(
            slow.value.contains("slow USB bridge") && slow.value.contains("7.1 ms"),
            "{slow:?}"
        );
    }
}
