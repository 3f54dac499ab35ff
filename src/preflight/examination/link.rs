use std::sync::atomic::AtomicBool;

use super::{Interruption, ensure_going};
use crate::clock::{Clock, Nanoseconds};
use crate::control::{LatencyHistogram, SAMPLE_TIMEOUT_NS};
use crate::device::{Device, DeviceError, Identity, LinkFault};
use crate::preflight::latency_timer::{latency_timer_cure, latency_timer_ms};
use crate::telemetry::{CheckResult, LatencySummary};

/// Samples that are asked for, back to back ...
const SAMPLES: u32 = 1000;

/// ... but no longer than this.
const LONGEST_NS: Nanoseconds = 3_000_000_000;

/// A sample that takes longer than this is counted as lost.
const PATIENCE_NS: Nanoseconds = 50_000_000;

/// Round trips of samples, from the request to the whole answer, by the computer's clock.
pub(super) struct RoundTrips {
    asked: u32,
    lost: u32,
    summary_us: LatencySummary,
    /// Where the arm was before anything moved it.
    pub(super) theta_counts: Option<i32>,
}

pub(super) fn identity(identity: &Identity) -> CheckResult {
    // A Qube that does not answer with its module id, or speaks another protocol, got no further
    // than the hello.
    CheckResult::pass(
        "identity",
        format!(
            "{} {}, firmware {}, protocol {}, at {}",
            identity.kind,
            identity.serial,
            identity.firmware_version,
            identity.protocol_version,
            identity.port
        ),
    )
}

pub(super) fn measure(
    device: &mut dyn Device,
    clock: &dyn Clock,
    stop: &AtomicBool,
    port: &str,
) -> Result<RoundTrips, Interruption> {
    // What a tick will see, which is on an awake processor.
    let _awake = clock.stay_awake();
    let mut round_trips = LatencyHistogram::new();
    let (mut asked, mut lost, mut theta_counts) = (0, 0, None);
    let end_ns = clock.now_ns() + LONGEST_NS;
    while asked < SAMPLES && clock.now_ns() < end_ns {
        ensure_going(stop)?;
        asked += 1;
        let asked_ns = clock.now_ns();
        match device.sample(asked_ns + PATIENCE_NS) {
            Ok(sample) => theta_counts = theta_counts.or(Some(sample.theta_counts)),
            Err(LinkFault::Gone) => return Err(gone(port)),
            Err(_) => lost += 1,
        }
        round_trips.record(clock.now_ns() - asked_ns);
    }
    Ok(RoundTrips { asked, lost, summary_us: round_trips.summary(), theta_counts })
}

/// The end of an examination by a cable that was pulled.
pub(super) fn gone(port: &str) -> Interruption {
    DeviceError::Link { port: port.to_owned(), fault: LinkFault::Gone }.into()
}

/// The driver's setting, and whether it counts: in the low-latency mode that this program asks for
/// the driver takes 1 ms whatever is set, but not every driver knows that mode.
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
            latency_timer_cure(port),
        ),
    }
}

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
    let most_us = SAMPLE_TIMEOUT_NS as f64 * 1e-3;
    if summary_us.p99 <= most_us && *lost * 100 <= *asked {
        return CheckResult::pass(NAME, value);
    }
    let cure = match latency_timer_ms(port) {
        Some(timer_ms) if timer_ms > 1 => latency_timer_cure(port),
        _ => format!(
            "99 of 100 samples must take less than {:.0} ms. Close what else keeps this computer \
             busy, plug the board in without a hub, and see qube-hil doctor",
            ms(most_us)
        ),
    };
    CheckResult::fail(NAME, value, cure)
}
