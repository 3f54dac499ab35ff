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
            if arm.width() <= ARM_COUNTS && pendulum.width() <= PENDULUM_COUNTS {
                let waited_s = waited_ns as f64 * 1e-9;
                return Ok(CheckResult::pass(NAME, format!("hangs still after {waited_s:.1} s")));
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
