use std::sync::atomic::AtomicBool;

use super::link::gone;
use super::{Interruption, ensure_going};
use crate::clock::{Clock, Nanoseconds};
use crate::device::{Device, LinkFault};
use crate::qube::{CONTROL_PERIOD_NS, RAD_PER_COUNT};
use crate::telemetry::CheckResult;

const NAME: &str = "rest";

/// Samples over which counts are watched: more than one swing of the pendulum (0.53 s).
const WINDOW_SAMPLES: u32 = 60;

/// So far the arm may creep in that time, and the pendulum swing: a small part of what a push does.
const ARM_COUNTS: u32 = 8;
const PENDULUM_COUNTS: u32 = 6;

/// A pendulum that does not come to rest may swing so far: on an arm that friction holds, one without
/// friction of its own swings on and on, and what a push adds is still told from that.
const SWINGING_COUNTS: u32 = 30;
const PATIENCE_NS: Nanoseconds = 5_000_000_000;

/// An arm that moves over no more than this in one swing of the pendulum is at rest between pushes.
const STILL_ARM_COUNTS: u32 = 3;

/// How long it may take: a pendulum that was touched needs up to 10 s with the motor off.
const LONGEST_NS: Nanoseconds = 20_000_000_000;

/// Lowest and highest of a counter.
#[derive(Clone, Copy)]
struct Span {
    lowest: i32,
    highest: i32,
}

impl Span {
    fn of(count: i32) -> Self {
        Self { lowest: count, highest: count }
    }

    fn with(self, count: i32) -> Self {
        Self { lowest: self.lowest.min(count), highest: self.highest.max(count) }
    }

    fn width(self) -> u32 {
        self.highest.abs_diff(self.lowest)
    }
}

/// Waits, the motor off, until the arm stands still between two pushes, or for as long as the pendulum
/// may need: what it swings is told from what a push adds, an arm that it moves is not.
pub(super) fn wait_for_the_arm(
    device: &mut dyn Device,
    clock: &dyn Clock,
    stop: &AtomicBool,
    port: &str,
) -> Result<(), Interruption> {
    let end_ns = clock.now_ns() + LONGEST_NS;
    let mut deadline_ns = clock.now_ns();
    let mut span: Option<Span> = None;
    let mut samples = 0;
    while clock.now_ns() < end_ns {
        ensure_going(stop)?;
        deadline_ns = (deadline_ns + CONTROL_PERIOD_NS).max(clock.now_ns());
        clock.sleep_until(deadline_ns);
        match device.sample(deadline_ns + CONTROL_PERIOD_NS) {
            Ok(sample) => {
                let count = sample.theta_counts;
                span = Some(span.unwrap_or(Span::of(count)).with(count));
                samples += 1;
            }
            Err(LinkFault::Gone) => return Err(gone(port)),
            Err(_) => {}
        }
        if let Some(arm) = span.filter(|_| samples >= WINDOW_SAMPLES) {
            if arm.width() <= STILL_ARM_COUNTS {
                return Ok(());
            }
            (span, samples) = (None, 0);
        }
    }
    Ok(())
}

/// Waits, the motor off, until arm and pendulum hang still: else a push would show nothing.
pub(super) fn wait(
    device: &mut dyn Device,
    clock: &dyn Clock,
    stop: &AtomicBool,
    port: &str,
) -> Result<CheckResult, Interruption> {
    let start_ns = clock.now_ns();
    let mut deadline_ns = start_ns;
    let mut spans: Option<(Span, Span)> = None;
    let mut samples = 0;
    let mut width_rad = None;
    loop {
        ensure_going(stop)?;
        deadline_ns = (deadline_ns + CONTROL_PERIOD_NS).max(clock.now_ns());
        clock.sleep_until(deadline_ns);
        match device.sample(deadline_ns + CONTROL_PERIOD_NS) {
            Ok(sample) => {
                let (arm, pendulum) =
                    spans.unwrap_or((Span::of(sample.theta_counts), Span::of(sample.alpha_counts)));
                spans = Some((arm.with(sample.theta_counts), pendulum.with(sample.alpha_counts)));
                samples += 1;
            }
            Err(LinkFault::Gone) => return Err(gone(port)),
            Err(_) => {}
        }
        let waited_ns = clock.now_ns() - start_ns;
        if let Some((arm, pendulum)) = spans.filter(|_| samples >= WINDOW_SAMPLES) {
            let waited_s = waited_ns as f64 * 1e-9;
            if arm.width() <= ARM_COUNTS && pendulum.width() <= PENDULUM_COUNTS {
                return Ok(CheckResult::pass(NAME, format!("hangs still after {waited_s:.1} s")));
            }
            let is_little = pendulum.width() <= SWINGING_COUNTS;
            if arm.width() <= ARM_COUNTS && is_little && waited_ns >= PATIENCE_NS {
                let value =
                    format!("the arm rests, the pendulum swings a little after {waited_s:.1} s");
                return Ok(CheckResult::pass(NAME, value));
            }
            width_rad = Some(f64::from(pendulum.width()) * RAD_PER_COUNT);
            (spans, samples) = (None, 0);
        }
        if waited_ns > LONGEST_NS {
            let value = match width_rad {
                Some(width_rad) => {
                    format!("arm or pendulum still moves, the latter over {width_rad:.2} rad")
                }
                None => "hardly any sample came".to_owned(),
            };
            let cure = "hold the pendulum until it hangs still, then check again";
            return Ok(CheckResult::fail(NAME, value, cure));
        }
    }
}
