//! Tests whether the watchdog of the vendor's library really switches the motor off. Without this
//! test the only evidence is the library's own report.
//!
//! The test pushes the arm for 50 ms to and fro under the program's control. Then it pushes once
//! more each way with a single act, after which it sends nothing. A watchdog that works ends such a
//! push after 50 ms, and the arm turns about as far as before. A motor that stays on turns the arm
//! several times as far, until the test switches it off after 0.3 s. Before this test, arm and
//! pendulum were seen at rest or nearly so, and the motor has had no more than 48 mV.

use super::examined_device::ExaminedDevice;
use super::{Interruption, rest};
use crate::clock::Nanoseconds;
use crate::device::LinkFault;
use crate::qube::{CONTROL_PERIOD_NS, Encoder};
use crate::safety::clamp_to_mv;
use crate::telemetry::CheckResult;

pub(super) const NAME: &str = "watchdog-motor";

/// Increment of the push, V, as in the pushes that find the signs.
const STEP_V: f64 = 0.25;

/// Number of increments, as in the pushes that find the signs.
const STEPS: u32 = 11;

/// Length of a push in control periods: the watchdog's 50 ms.
const PUSH_PERIODS: u32 = 5;

/// Number of control periods for which the arm is observed, 0.3 s. In this time a motor that stays
/// on turns the arm more than three times as far as a push does: at a constant acceleration a, an
/// arm that is driven for 0.3 s turns by 0.045 s^2 a, and one that is driven for 0.05 s and then
/// coasts without friction, by 0.014 s^2 a.
const OBSERVED_PERIODS: u32 = 30;

/// Least travel of a push, counts. From this travel on, an arm that turns three times as far
/// exceeds [`LONGEST_FACTOR`] times the travel plus [`LONGEST_MORE_COUNTS`].
const LEAST_COUNTS: u32 = 20;

/// Longest travel of an arm whose motor went off, as a multiple of the travel of a controlled push.
/// A disabled motor may coast more freely than a motor at 0 V.
const LONGEST_FACTOR: u32 = 2;

/// Counts that are added to [`LONGEST_FACTOR`] times the travel of a controlled push.
const LONGEST_MORE_COUNTS: u32 = 10;

/// Number of samples or acts that may be lost within a push under the program's control.
const MAX_LOST: u32 = 2;

/// Largest number of attempts at one push. An attempt that loses too many samples or acts is
/// repeated.
const MAX_ATTEMPTS: u32 = 5;

/// Time after which a sample counts as lost, ns.
const PATIENCE_NS: Nanoseconds = 8_000_000;

const REMEDY: &str = "do not run anything with it: this motor stays on if the program dies. Install the vendor's \
                    present package, then check again";

/// Pushes the arm under the program's control and with the watchdog alone, and compares how far the
/// arm turns.
pub(super) fn check(
    examined: &mut ExaminedDevice<'_>,
    encoder: Encoder,
) -> Result<CheckResult, Interruption> {
    for step in 1..=STEPS {
        let push_v = STEP_V * f64::from(step);
        let mut pushed = [0; 2];
        for (counts, direction) in pushed.iter_mut().zip([1.0, -1.0]) {
            *counts =
                repeated(examined, encoder, |examined| supervised(examined, direction * push_v))?;
        }
        if pushed.iter().any(|counts| *counts < LEAST_COUNTS) {
            continue;
        }
        let mut silent = [0; 2];
        for (counts, direction) in silent.iter_mut().zip([1.0, -1.0]) {
            *counts =
                repeated(examined, encoder, |examined| unsupervised(examined, direction * push_v))?;
        }
        return Ok(verdict(push_v, pushed, silent));
    }
    let most_v = STEP_V * f64::from(STEPS);
    Ok(CheckResult::fail(
        NAME,
        format!("{most_v} V for 0.05 s do not move the arm, so the watchdog could not be tested"),
        "make sure that the Qube is switched on and the arm turns freely, then check again",
    ))
}

fn verdict(push_v: f64, pushed: [u32; 2], silent: [u32; 2]) -> CheckResult {
    let [forth, back] = silent;
    let [pushed_forth, pushed_back] = pushed;
    let value = format!(
        "{push_v:.2} V for 0.05 s turn the arm by {pushed_forth} and {pushed_back} counts; without a further command, \
         by {forth} and {back} in 0.3 s"
    );
    let longest = |counts: u32| LONGEST_FACTOR * counts + LONGEST_MORE_COUNTS;
    if silent.iter().zip(pushed).all(|(counts, pushed)| *counts <= longest(pushed)) {
        CheckResult::pass(NAME, format!("the motor goes off: {value}"))
    } else {
        CheckResult::fail(NAME, format!("the motor stays on: {value}"), REMEDY)
    }
}

/// Pushes once and returns the arm's travel, counts. A push that the computer or the link has
/// disturbed is repeated. The function waits for the arm to rest after each push.
fn repeated(
    examined: &mut ExaminedDevice<'_>,
    encoder: Encoder,
    push: impl Fn(&mut ExaminedDevice<'_>) -> Result<Option<i32>, LinkFault>,
) -> Result<u32, Interruption> {
    for _ in 0..MAX_ATTEMPTS {
        examined.ensure_going()?;
        examined.device.hello()?;
        examined.device.arm()?;
        let from = push(examined);
        // The hello switches the motor off even if the push failed, and clears an expired watchdog.
        examined.device.hello()?;
        let Ok(from) = from else { return Err(examined.link_fault(LinkFault::Gone)) };
        let to = sampled(examined);
        rest::wait_for_the_arm(examined, encoder)?;
        if let (Some(from), Some(to)) = (from, to) {
            return Ok(to.wrapping_sub(from).unsigned_abs());
        }
    }
    Err(examined.link_fault(LinkFault::Timeout))
}

/// Pushes for 50 ms and holds 0 V for the rest of the 0.3 s. Returns the arm's count before the
/// push; `None` if more than [`MAX_LOST`] samples or acts were lost.
///
/// # Errors
/// The port is gone.
fn supervised(examined: &mut ExaminedDevice<'_>, push_v: f64) -> Result<Option<i32>, LinkFault> {
    let clock = examined.clock;
    let push_mv = clamp_to_mv(push_v, push_v.abs()).unwrap_or(0);
    let (mut first, mut lost) = (None, 0);
    let mut deadline_ns = clock.now_ns();
    for period in 0..OBSERVED_PERIODS {
        let voltage_mv = if period < PUSH_PERIODS { push_mv } else { 0 };
        match acted(examined, voltage_mv) {
            Ok(count) => first = first.or(Some(count)),
            Err(LinkFault::Gone) => return Err(LinkFault::Gone),
            Err(_) => lost += 1,
        }
        deadline_ns += CONTROL_PERIOD_NS;
        clock.sleep_until(deadline_ns);
    }
    Ok(first.filter(|_| lost <= MAX_LOST))
}

/// Sends one act and then nothing for the rest of the 0.3 s. Returns the arm's count before the
/// push; `None` if the sample or the act was lost.
///
/// # Errors
/// The port is gone.
fn unsupervised(examined: &mut ExaminedDevice<'_>, push_v: f64) -> Result<Option<i32>, LinkFault> {
    let clock = examined.clock;
    let push_mv = clamp_to_mv(push_v, push_v.abs()).unwrap_or(0);
    let begin_ns = clock.now_ns();
    let first = match acted(examined, push_mv) {
        Ok(count) => count,
        Err(LinkFault::Gone) => return Err(LinkFault::Gone),
        Err(_) => return Ok(None),
    };
    clock.sleep_until(begin_ns + u64::from(OBSERVED_PERIODS) * CONTROL_PERIOD_NS);
    Ok(Some(first))
}

/// Requests a sample and answers it with a voltage; returns the arm's count in the sample.
fn acted(examined: &mut ExaminedDevice<'_>, voltage_mv: i16) -> Result<i32, LinkFault> {
    let sample = examined.device.sample(examined.clock.now_ns() + PATIENCE_NS)?;
    examined.device.act(voltage_mv, sample.device_time_us)?;
    Ok(sample.theta_counts)
}

fn sampled(examined: &mut ExaminedDevice<'_>) -> Option<i32> {
    let deadline_ns = examined.clock.now_ns() + PATIENCE_NS;
    examined.device.sample(deadline_ns).ok().map(|sample| sample.theta_counts)
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicBool;

    use super::*;
    use crate::clock::VirtualClock;
    use crate::device::SerialLink;
    use crate::device::emulator::EmulatorSettings;

    #[test]
    fn a_board_whose_watchdog_works_passes() {
        let clock = VirtualClock::default();
        let mut board = SerialLink::in_process(EmulatorSettings::default(), clock.clone());
        let stop = AtomicBool::new(false);
        let mut examined =
            ExaminedDevice { device: &mut board, clock: &clock, stop: &stop, port: "here" };
        let result = check(&mut examined, Encoder::QUBE).unwrap();
        assert!(!result.failed(), "{result:?}");
        assert!(result.value.starts_with("the motor goes off"), "{result:?}");
    }

    #[test]
    fn an_arm_that_turns_on_and_on_in_either_direction_is_a_motor_that_stays_on() {
        assert!(!verdict(0.5, [24, 26], [30, 33]).failed());
        assert!(!verdict(0.5, [24, 26], [58, 62]).failed());
        for silent in [[59, 30], [30, 63], [90, 95]] {
            let result = verdict(0.5, [24, 26], silent);
            assert!(result.failed() && result.remedy.unwrap().contains("do not run anything"));
        }
    }
}
