use std::sync::atomic::AtomicBool;

use super::link::gone;
use super::{Interruption, ensure_going};
use crate::clock::{Clock, Nanoseconds};
use crate::device::{Device, LinkFault};
use crate::qube::{CONTROL_PERIOD_NS, Encoder, Encoders, wrap_angle};
use crate::telemetry::CheckResult;

const NAME: &str = "rest";

/// Number of samples in a window, one each control period: 0.6 s, more than one period of the
/// pendulum (0.59 s on an arm at rest).
const WINDOW_SAMPLES: u32 = 60;

/// Largest motion of the arm in a window at rest, counts of a Qube: small compared with the effect
/// of a push.
const ARM_COUNTS: u32 = 8;
/// Largest motion of the pendulum in a window at rest, counts of a Qube: small compared with the
/// effect of a push.
const PENDULUM_COUNTS: u32 = 6;

/// Largest swing of a pendulum that is accepted after [`PATIENCE_NS`] although it does not come to
/// rest, counts of a Qube. On an arm that friction holds, a pendulum with hardly any friction
/// swings for very long; the effect of a push can still be told from so small a swing.
const SWINGING_COUNTS: u32 = 30;
/// Time after which a small swing of the pendulum is accepted, ns: 5 s.
const PATIENCE_NS: Nanoseconds = 5_000_000_000;

/// Largest motion of an arm at rest, in a window between two pushes, counts of a Qube.
const STILL_ARM_COUNTS: u32 = 3;

/// Longest wait, ns: 20 s. A pendulum that was touched needs up to 10 s with the motor off.
const LONGEST_NS: Nanoseconds = 20_000_000_000;

/// Converts counts of a Qube to counts of `encoder` for the same angle, rounded up.
fn of_qube(counts: u32, encoder: Encoder) -> u32 {
    (f64::from(counts) * encoder.counts_per_qube_count()).ceil() as u32
}

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

    fn middle(self) -> f64 {
        0.5 * (f64::from(self.lowest) + f64::from(self.highest))
    }
}

/// The shift of an encoder's angle between two windows.
#[derive(Clone, Copy, Debug)]
pub(super) struct Shift {
    /// Difference between the middles of the two ranges without whole turns, rad. A swing of the
    /// pendulum does not shift the middle.
    pub(super) by_rad: f64,
    /// Width of the later range, rad.
    pub(super) width_rad: f64,
}

/// The ranges of both counts within a window.
#[derive(Clone, Copy)]
pub(super) struct Window {
    arm: Span,
    pendulum: Span,
}

impl Window {
    /// Takes a sample each control period until the window is full; `None` if `end_ns` comes first.
    fn sample(
        device: &mut dyn Device,
        clock: &dyn Clock,
        stop: &AtomicBool,
        port: &str,
        end_ns: Nanoseconds,
    ) -> Result<Option<Self>, Interruption> {
        let mut deadline_ns = clock.now_ns();
        let mut window: Option<Self> = None;
        let mut samples = 0;
        while samples < WINDOW_SAMPLES {
            if clock.now_ns() > end_ns {
                return Ok(None);
            }
            ensure_going(stop)?;
            deadline_ns = (deadline_ns + CONTROL_PERIOD_NS).max(clock.now_ns());
            clock.sleep_until(deadline_ns);
            match device.sample(deadline_ns + CONTROL_PERIOD_NS) {
                Ok(sample) => {
                    let (theta_counts, alpha_counts) = (sample.theta_counts, sample.alpha_counts);
                    window = Some(match window {
                        None => {
                            Self { arm: Span::of(theta_counts), pendulum: Span::of(alpha_counts) }
                        }
                        Some(Self { arm, pendulum }) => Self {
                            arm: arm.with(theta_counts),
                            pendulum: pendulum.with(alpha_counts),
                        },
                    });
                    samples += 1;
                }
                Err(LinkFault::Gone) => return Err(gone(port)),
                Err(_) => {}
            }
        }
        Ok(window)
    }

    /// Shifts of arm and pendulum from an earlier window to this one.
    pub(super) fn shifts_from(&self, earlier: &Self, encoders: Encoders) -> (Shift, Shift) {
        let shift = |now: Span, then: Span, encoder: Encoder| Shift {
            by_rad: wrap_angle((now.middle() - then.middle()) * encoder.rad_per_count()),
            width_rad: f64::from(now.width()) * encoder.rad_per_count(),
        };
        (
            shift(self.arm, earlier.arm, encoders.theta),
            shift(self.pendulum, earlier.pendulum, encoders.alpha),
        )
    }
}

/// Samples a window with the motor off; `None` if too few samples come.
pub(super) fn window(
    device: &mut dyn Device,
    clock: &dyn Clock,
    stop: &AtomicBool,
    port: &str,
) -> Result<Option<Window>, Interruption> {
    Window::sample(device, clock, stop, port, clock.now_ns() + LONGEST_NS)
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
    encoder: Encoder,
) -> Result<(), Interruption> {
    let still_counts = of_qube(STILL_ARM_COUNTS, encoder);
    let end_ns = clock.now_ns() + LONGEST_NS;
    while let Some(Window { arm, .. }) = Window::sample(device, clock, stop, port, end_ns)? {
        if arm.width() <= still_counts {
            break;
        }
    }
    Ok(())
}

/// Waits, with the motor off, until arm and pendulum are at rest, so that the effect of a push
/// shows. After [`PATIENCE_NS`] a small swing of the pendulum passes too; after [`LONGEST_NS`] the
/// check fails.
pub(super) fn wait(
    device: &mut dyn Device,
    clock: &dyn Clock,
    stop: &AtomicBool,
    port: &str,
    encoders: Encoders,
) -> Result<CheckResult, Interruption> {
    let arm_counts = of_qube(ARM_COUNTS, encoders.theta);
    let [pendulum_counts, swinging_counts] =
        [PENDULUM_COUNTS, SWINGING_COUNTS].map(|counts| of_qube(counts, encoders.alpha));
    let start_ns = clock.now_ns();
    let end_ns = start_ns + LONGEST_NS;
    let mut width_rad = None;
    while let Some(Window { arm, pendulum }) = Window::sample(device, clock, stop, port, end_ns)? {
        let waited_ns = clock.now_ns() - start_ns;
        let waited_s = waited_ns as f64 * 1e-9;
        if arm.width() <= arm_counts && pendulum.width() <= pendulum_counts {
            return Ok(CheckResult::pass(NAME, format!("hangs still after {waited_s:.1} s")));
        }
        let is_little = pendulum.width() <= swinging_counts;
        if arm.width() <= arm_counts && is_little && waited_ns >= PATIENCE_NS {
            let value =
                format!("the arm rests, the pendulum swings a little after {waited_s:.1} s");
            return Ok(CheckResult::pass(NAME, value));
        }
        width_rad = Some(f64::from(pendulum.width()) * encoders.alpha.rad_per_count());
    }
    let value = match width_rad {
        Some(width_rad) => {
            format!("arm or pendulum still moves, the pendulum by {width_rad:.2} rad")
        }
        None => "hardly any sample came".to_owned(),
    };
    let remedy = "hold the pendulum until it hangs still, then check again";
    Ok(CheckResult::fail(NAME, value, remedy))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clock::VirtualClock;
    use crate::device::SerialLink;
    use crate::device::emulator::EmulatorSettings;
    use crate::qube::State;

    #[test]
    fn rest_is_the_same_swing_for_every_encoder() {
        for counts in [1000, 2048, 1 << 18] {
            let encoder = Encoder::try_from(counts).unwrap();
            let encoders = Encoders { theta: encoder, alpha: encoder };
            for (alpha, hangs_still) in [(0.005, true), (0.06, false)] {
                let clock = VirtualClock::default();
                let start = Some(State { alpha, ..State::default() });
                let settings = EmulatorSettings { start, encoders, ..EmulatorSettings::default() };
                let mut board = SerialLink::in_process(settings, clock.clone());
                board.hello().unwrap();
                let stop = AtomicBool::new(false);
                let result = wait(&mut board, &clock, &stop, "here", encoders).unwrap();
                let at_once = result.value == "hangs still after 0.6 s";
                assert_eq!(at_once, hangs_still, "{counts} counts, {alpha} rad: {result:?}");
            }
        }
    }
}
