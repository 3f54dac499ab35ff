use super::Interruption;
use super::examined_device::ExaminedDevice;
use crate::clock::Nanoseconds;
use crate::control::CountRange;
use crate::qube::{CONTROL_PERIOD_NS, Encoder, Encoders, wrap_angle};
use crate::telemetry::CheckResult;

const NAME: &str = "rest";

/// Number of samples in a window, one each control period: 0.6 s, more than one period of the
/// pendulum (0.59 s on an arm at rest).
const WINDOW_SAMPLES: u32 = 60;

/// Largest motion of the arm in a window at rest, counts of a Qube: small compared with the effect
/// of a push.
const ARM_COUNTS: f64 = 8.0;
/// Largest motion of the pendulum in a window at rest, counts of a Qube: small compared with the
/// effect of a push.
const PENDULUM_COUNTS: f64 = 6.0;

/// Largest swing of a pendulum that is accepted after [`PATIENCE_NS`] although it does not come to
/// rest, counts of a Qube. On an arm that friction holds, a pendulum with hardly any friction
/// swings for very long; the effect of a push can be distinguished from such a small swing.
const SWINGING_COUNTS: f64 = 30.0;
/// Time after which a small swing of the pendulum is accepted, ns: 5 s.
const PATIENCE_NS: Nanoseconds = 5_000_000_000;

/// Largest motion of an arm at rest, in a window between two pushes, counts of a Qube.
const STILL_ARM_COUNTS: f64 = 3.0;

/// Longest wait, ns: 20 s. A pendulum that was touched needs up to 10 s with the motor off.
const LONGEST_NS: Nanoseconds = 20_000_000_000;

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
    arm: CountRange,
    pendulum: CountRange,
}

impl Window {
    /// Takes a sample each control period until the window is full; `None` if `end_ns` comes first.
    fn sample(
        examined: &mut ExaminedDevice<'_>,
        end_ns: Nanoseconds,
    ) -> Result<Option<Self>, Interruption> {
        let clock = examined.clock;
        let mut deadline_ns = clock.now_ns();
        let mut window: Option<Self> = None;
        let mut samples = 0;
        while samples < WINDOW_SAMPLES {
            if clock.now_ns() > end_ns {
                return Ok(None);
            }
            examined.ensure_going()?;
            deadline_ns = (deadline_ns + CONTROL_PERIOD_NS).max(clock.now_ns());
            clock.sleep_until(deadline_ns);
            match examined.device.sample(deadline_ns + CONTROL_PERIOD_NS) {
                Ok(sample) => {
                    let (theta_counts, alpha_counts) = (sample.theta_counts, sample.alpha_counts);
                    window = Some(match window {
                        None => Self {
                            arm: CountRange::at(theta_counts),
                            pendulum: CountRange::at(alpha_counts),
                        },
                        Some(Self { arm, pendulum }) => Self {
                            arm: arm.with(theta_counts),
                            pendulum: pendulum.with(alpha_counts),
                        },
                    });
                    samples += 1;
                }
                Err(fault) => examined.lost(fault)?,
            }
        }
        Ok(window)
    }

    /// Shifts of arm and pendulum from an earlier window to this one.
    pub(super) fn shifts_from(&self, earlier: &Self, encoders: Encoders) -> (Shift, Shift) {
        let shift = |now: CountRange, then: CountRange, encoder: Encoder| Shift {
            by_rad: wrap_angle(now.shift_from(then) * encoder.rad_per_count()),
            width_rad: f64::from(now.width()) * encoder.rad_per_count(),
        };
        (
            shift(self.arm, earlier.arm, encoders.theta),
            shift(self.pendulum, earlier.pendulum, encoders.alpha),
        )
    }
}

/// Samples a window with the motor off; `None` if too few samples come.
pub(super) fn window(examined: &mut ExaminedDevice<'_>) -> Result<Option<Window>, Interruption> {
    let end_ns = examined.clock.now_ns() + LONGEST_NS;
    Window::sample(examined, end_ns)
}

/// Waits between two pushes, with the motor off, until the arm is at rest, but no longer than
/// [`LONGEST_NS`]; an arm that still moves then is no error. The evaluation of a push separates the
/// pendulum's own swing from the effect of the push, but cannot separate the motion of an arm that
/// the pendulum moves.
pub(super) fn wait_for_the_arm(
    examined: &mut ExaminedDevice<'_>,
    encoder: Encoder,
) -> Result<(), Interruption> {
    let still_counts = encoder.covering_qube_counts(STILL_ARM_COUNTS);
    let end_ns = examined.clock.now_ns() + LONGEST_NS;
    while let Some(Window { arm, .. }) = Window::sample(examined, end_ns)? {
        if arm.width() <= still_counts {
            break;
        }
    }
    Ok(())
}

/// Waits, with the motor off, until arm and pendulum are at rest, so that the effect of a push
/// shows. After [`PATIENCE_NS`] a small swing of the pendulum is accepted, too; after
/// [`LONGEST_NS`] the check fails.
pub(super) fn wait(
    examined: &mut ExaminedDevice<'_>,
    encoders: Encoders,
) -> Result<CheckResult, Interruption> {
    let arm_counts = encoders.theta.covering_qube_counts(ARM_COUNTS);
    let [pendulum_counts, swinging_counts] = [PENDULUM_COUNTS, SWINGING_COUNTS]
        .map(|counts| encoders.alpha.covering_qube_counts(counts));
    let clock = examined.clock;
    let start_ns = clock.now_ns();
    let end_ns = start_ns + LONGEST_NS;
    let mut moved = None;
    while let Some(Window { arm, pendulum }) = Window::sample(examined, end_ns)? {
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
        let arm_rad = f64::from(arm.width()) * encoders.theta.rad_per_count();
        let pendulum_rad = f64::from(pendulum.width()) * encoders.alpha.rad_per_count();
        moved = Some((arm_rad, pendulum_rad, arm.width() > arm_counts));
    }
    Ok(match moved {
        Some((arm_rad, pendulum_rad, arm_moves)) => CheckResult::fail(
            NAME,
            format!(
                "within 0.6 s the arm still moves by {arm_rad:.3} rad, the pendulum by {pendulum_rad:.3} rad"
            ),
            if arm_moves {
                "take your hands off the arm and let the pendulum hang still; if the arm's angle goes on moving while \
                 the arm stands still, check its encoder, its cable and its plug, then check again"
            } else {
                "hold the pendulum until it hangs still, then check again"
            },
        ),
        None => CheckResult::fail(
            NAME,
            "hardly any sample came",
            "close other programs that keep this computer busy, try another cable or USB port \
             without a hub, then check again",
        ),
    })
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicBool;

    use super::*;
    use crate::clock::{Clock, VirtualClock};
    use crate::device::emulator::EmulatorSettings;
    use crate::device::{Device, DeviceError, Identity, LinkFault, SerialLink};
    use crate::qube::{Measurement, State};

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
                let mut examined =
                    ExaminedDevice { device: &mut board, clock: &clock, stop: &stop, port: "here" };
                let result = wait(&mut examined, encoders).unwrap();
                let at_once = result.value == "hangs still after 0.6 s";
                assert_eq!(at_once, hangs_still, "{counts} counts, {alpha} rad: {result:?}");
            }
        }
    }

    /// A device whose samples a function gives by their number.
    struct Sampled<F>(VirtualClock, u32, F);

    impl<F: Fn(u32) -> Result<Measurement, LinkFault> + Send> Device for Sampled<F> {
        fn hello(&mut self) -> Result<Identity, DeviceError> {
            unreachable!("the wait sends no hello")
        }

        fn arm(&mut self) -> Result<(), DeviceError> {
            unreachable!("the wait arms no device")
        }

        fn sample(&mut self, deadline_ns: Nanoseconds) -> Result<Measurement, LinkFault> {
            self.1 += 1;
            let answer = (self.2)(self.1);
            if answer == Err(LinkFault::Timeout) {
                self.0.sleep_until(deadline_ns);
            }
            answer
        }

        fn act(&mut self, _voltage_mv: i16, _sampled_at_us: u64) -> Result<(), LinkFault> {
            unreachable!("the wait sends no act")
        }

        fn disarm(&mut self) -> Result<(), DeviceError> {
            Ok(())
        }
    }

    /// The result of the wait for such a device, and the duration of the wait, s.
    fn waited(
        samples: impl Fn(u32) -> Result<Measurement, LinkFault> + Send,
    ) -> (Result<CheckResult, Interruption>, f64) {
        let clock = VirtualClock::default();
        let mut device = Sampled(clock.clone(), 0, samples);
        let stop = AtomicBool::new(false);
        let mut examined =
            ExaminedDevice { device: &mut device, clock: &clock, stop: &stop, port: "here" };
        let result = wait(&mut examined, Encoders::QUBE);
        (result, clock.now_ns() as f64 * 1e-9)
    }

    #[test]
    fn the_remedy_names_the_part_that_moves() {
        let remedy_of = |moving: fn(i32) -> Measurement| {
            let (result, _) = waited(move |number| Ok(moving(number as i32)));
            result.unwrap().remedy.unwrap()
        };
        let arm = remedy_of(|number| Measurement { theta_counts: number, ..Default::default() });
        assert!(arm.contains("check its encoder, its cable and its plug"), "{arm}");
        let pendulum = remedy_of(|number| {
            let alpha_counts = if number % 60 < 30 { 300 } else { -300 };
            Measurement { alpha_counts, ..Default::default() }
        });
        assert!(pendulum.starts_with("hold the pendulum"), "{pendulum}");
    }

    #[test]
    fn a_board_that_restarts_and_a_qube_that_goes_off_end_the_wait_at_once() {
        for fault in [LinkFault::Gone, LinkFault::Restarted, LinkFault::QubeOff] {
            let (ended, after_s) =
                waited(|number| if number < 5 { Ok(Measurement::default()) } else { Err(fault) });
            assert!(matches!(ended, Err(Interruption::Device(_))), "{fault}: {ended:?}");
            assert!(after_s < 0.1, "{fault}: {after_s} s");
        }
        let (silent, after_s) = waited(|_| Err(LinkFault::Timeout));
        let remedy = silent.unwrap().remedy.unwrap();
        assert!(after_s > 19.0 && remedy.contains("cable"), "{remedy}");
    }

    #[test]
    fn a_count_that_passes_its_largest_value_is_at_rest() {
        let flicker = |number: u32| i32::MAX.wrapping_add((number % 2) as i32);
        let (rested, _) = waited(|number| {
            let (theta_counts, alpha_counts) = (flicker(number), flicker(number));
            Ok(Measurement { theta_counts, alpha_counts, ..Measurement::default() })
        });
        assert!(!rested.unwrap().failed());
        let window = |counts: i32| {
            let range = CountRange::at(counts).with(counts.wrapping_add(2));
            Window { arm: range, pendulum: range }
        };
        let (arm, _) = window(i32::MIN).shifts_from(&window(i32::MAX - 9), Encoders::QUBE);
        assert!((arm.by_rad - 10.0 * Encoder::QUBE.rad_per_count()).abs() < 1e-12, "{arm:?}");
    }
}
