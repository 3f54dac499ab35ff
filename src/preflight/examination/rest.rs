use std::sync::atomic::AtomicBool;

use super::link::gone;
use super::{Interruption, ensure_going};
use crate::clock::{Clock, Nanoseconds};
use crate::device::{Device, LinkFault};
use crate::qube::{CONTROL_PERIOD_NS, Encoder};
use crate::telemetry::CheckResult;

const NAME: &str = "rest";

/// Number of samples in a window, one each control period: 0.6 s, more than one period of the
/// pendulum (0.59 s on an arm at rest).
const WINDOW_SAMPLES: u32 = 60;

/// Largest motion of the arm, and of the pendulum, in a window at rest, counts: small compared with
/// the effect of a push.
const ARM_COUNTS: u32 = 8;
const PENDULUM_COUNTS: u32 = 6;

/// Largest swing of a pendulum that is accepted after [`PATIENCE_NS`] although it does not come to
/// rest, counts. On an arm that friction holds, a pendulum with hardly any friction swings for very
/// long; the effect of a push can still be told from so small a swing.
const SWINGING_COUNTS: u32 = 30;
/// Time after which a small swing of the pendulum is accepted, ns: 5 s.
const PATIENCE_NS: Nanoseconds = 5_000_000_000;

/// Largest motion of an arm at rest, in a window between two pushes, counts.
const STILL_ARM_COUNTS: u32 = 3;

/// Longest wait, ns: 20 s. A pendulum that was touched needs up to 10 s with the motor off.
const LONGEST_NS: Nanoseconds = 20_000_000_000;

/// The range of an encoder's count within a window.
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

/// Waits between two pushes, with the motor off, until the arm is at rest, but no longer than
/// [`LONGEST_NS`]; an arm that still moves then is no error. The evaluation of a push separates the
/// pendulum's own swing from the effect of the push, but cannot separate the motion of an arm that
/// the pendulum moves.
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

/// Waits, with the motor off, until arm and pendulum are at rest, so that the effect of a push
/// shows. The check fails after [`LONGEST_NS`].
pub(super) fn wait(
    device: &mut dyn Device,
    clock: &dyn Clock,
    stop: &AtomicBool,
    port: &str,
    encoder: Encoder,
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
            width_rad = Some(f64::from(pendulum.width()) * encoder.rad_per_count());
            (spans, samples) = (None, 0);
        }
        if waited_ns > LONGEST_NS {
            let value = match width_rad {
                Some(width_rad) => {
                    format!("arm or pendulum still moves, the pendulum by {width_rad:.2} rad")
                }
                None => "hardly any sample came".to_owned(),
            };
            let remedy = "hold the pendulum until it hangs still, then check again";
            return Ok(CheckResult::fail(NAME, value, remedy));
        }
    }
}
