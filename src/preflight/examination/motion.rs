use std::sync::atomic::AtomicBool;

use super::{Examination, ExaminationSettings, Interruption, ensure_going, rest};
use crate::clock::Clock;
use crate::control::{Nudge, NudgeResponse, drive};
use crate::device::Device;
use crate::estimation::Calibration;
use crate::telemetry::{CheckResult, Ending, Fault};

/// Voltages that are tried until the arm moves: 0.11 V is what a good one needs, and 0.65 V is
/// reported of a stiff one.
const PUSHES_V: [f64; 3] = [0.5, 1.0, 1.5];

/// A pendulum that swung at least this far has answered, rad: twice what it may swing at rest.
const ANSWERED_RAD: f64 = 0.04;

/// Below this no current flows through the motor, A. At 1.5 V an arm that is held draws 0.18 A.
const NO_CURRENT_A: f64 = 0.02;

const STALL: &str = "stall";
const ARM: &str = "arm";
const PENDULUM: &str = "pendulum";
const MOTOR_SIGN: &str = "motor-sign";
const PENDULUM_SIGN: &str = "pendulum-sign";

/// Says of each check with a motion that it was not done.
pub(super) fn skip(found: &mut Examination, why: &str) {
    skip_these(found, &[STALL, ARM, PENDULUM, MOTOR_SIGN, PENDULUM_SIGN], why);
}

fn skip_these(found: &mut Examination, names: &[&str], why: &str) {
    found.results.extend(names.iter().map(|name| CheckResult::skipped(name, why)));
}

/// A fault that ended a push: nothing else can be judged then.
fn give_up(found: &mut Examination, fault: Fault) {
    let cure = match fault {
        Fault::Amplifier | Fault::StallError => {
            "switch the Qube's power off and on, clear the way of the arm, then check again"
        }
        _ => "check the cable and close what else keeps this computer busy, then check again",
    };
    let value = format!("a fault ended the push: {fault}");
    found.results.push(CheckResult::fail(STALL, value, cure));
    skip_these(found, &[ARM, PENDULUM, MOTOR_SIGN, PENDULUM_SIGN], "not after a fault");
}

/// Pushes the arm a little and judges what arm and pendulum did.
pub(super) fn check(
    device: &mut dyn Device,
    clock: &dyn Clock,
    stop: &AtomicBool,
    settings: &ExaminationSettings,
    found: &mut Examination,
) -> Result<(), Interruption> {
    let mut signs = settings.signs;
    let port = &settings.identity.port;
    let mut seen = match push(device, clock, stop, signs, port)? {
        Ok(seen) => seen,
        Err(fault) => {
            give_up(found, fault);
            return Ok(());
        }
    };
    if settings.learn_signs
        && let Some(right) = right_signs(signs, &seen).filter(|right| *right != signs)
    {
        // What was concluded is put to the test before it counts.
        signs = right;
        rest::wait(device, clock, stop, port)?;
        match push(device, clock, stop, signs, port)? {
            Ok(again) => seen = again,
            Err(fault) => {
                give_up(found, fault);
                return Ok(());
            }
        }
    }
    found.results.extend(judge(&seen, signs, signs != settings.signs));
    found.signs = signs;
    Ok(())
}

/// Pushes harder and harder until something moves. The inner error is a fault that ended it.
fn push(
    device: &mut dyn Device,
    clock: &dyn Clock,
    stop: &AtomicBool,
    signs: Calibration,
    port: &str,
) -> Result<Result<NudgeResponse, Fault>, Interruption> {
    let mut seen = NudgeResponse::default();
    for push_v in PUSHES_V {
        ensure_going(stop)?;
        device.hello()?;
        let mut nudge = Nudge::new(signs, push_v);
        let report = drive(device, clock, &mut nudge, None, stop)?;
        match report.outcome.ending {
            Ending::Fault(Fault::LinkGone) => return Err(super::link::gone(port)),
            Ending::Fault(fault) => return Ok(Err(fault)),
            Ending::Stopped => return Err(Interruption::Stopped),
            Ending::Completed | Ending::LeftBox(_) => {}
        }
        seen = nudge.response();
        if seen.arm_moved() || seen.alpha_rad.abs() >= ANSWERED_RAD {
            break;
        }
    }
    Ok(Ok(seen))
}

/// The signs under which the arm follows the voltage and the pendulum lags behind the arm, from what
/// was seen under others. Turning all three round describes the same machine in a mirror; of the two
/// answers this is the one that changes less. None where something did not move.
fn right_signs(signs: Calibration, seen: &NudgeResponse) -> Option<Calibration> {
    if !seen.arm_moved() || seen.alpha_rad.abs() < ANSWERED_RAD {
        return None;
    }
    let follows = seen.theta_rad * seen.voltage_v > 0.0;
    let lags = seen.alpha_rad * seen.theta_rad < 0.0;
    let (theta, alpha, voltage) = match (follows, lags) {
        (true, true) => (false, false, false),
        (true, false) => (false, true, false),
        (false, true) => (false, false, true),
        (false, false) => (true, false, false),
    };
    Some(Calibration {
        theta_inverted: signs.theta_inverted ^ theta,
        alpha_inverted: signs.alpha_inverted ^ alpha,
        voltage_inverted: signs.voltage_inverted ^ voltage,
        ..signs
    })
}

fn judge(seen: &NudgeResponse, signs: Calibration, are_new: bool) -> Vec<CheckResult> {
    let NudgeResponse { voltage_v, theta_rad, alpha_rad, current_a } = *seen;
    let current_ma = current_a * 1e3;
    let arm_moved = seen.arm_moved();
    let pendulum_moved = alpha_rad.abs() >= ANSWERED_RAD;
    let mut results = Vec::new();

    results.push(if arm_moved || pendulum_moved {
        let value = format!("no stall reported; {current_ma:.0} mA moved the arm");
        CheckResult::pass(STALL, value)
    } else if current_a < NO_CURRENT_A {
        CheckResult::fail(
            STALL,
            format!("no motion, and only {current_ma:.0} mA flow at {:.1} V", voltage_v.abs()),
            "switch the Qube's power on; then look at the motor's cable",
        )
    } else {
        CheckResult::fail(
            STALL,
            format!("{current_ma:.0} mA flow at {:.1} V and nothing moves", voltage_v.abs()),
            "something holds the arm: clear its way. If it moves freely by hand, the arm encoder's \
             cable is loose",
        )
    });

    results.push(if arm_moved {
        CheckResult::pass(ARM, format!("its encoder lives: {:+.3} rad", theta_rad))
    } else if pendulum_moved {
        CheckResult::fail(
            ARM,
            "the pendulum swung, but the arm's count stayed where it was",
            "plug in the arm encoder's cable (encoder 0)",
        )
    } else {
        CheckResult::skipped(ARM, "nothing moved")
    });

    results.push(if pendulum_moved {
        CheckResult::pass(PENDULUM, format!("its encoder lives: {:+.3} rad", alpha_rad))
    } else if arm_moved {
        CheckResult::fail(
            PENDULUM,
            format!("the arm went {theta_rad:+.3} rad, the pendulum's count {alpha_rad:+.3} rad"),
            "plug in the pendulum encoder's cable (encoder 1), and see that the pendulum swings \
             freely",
        )
    } else {
        CheckResult::skipped(PENDULUM, "nothing moved")
    });

    let Some(right) = right_signs(signs, seen) else {
        for name in [MOTOR_SIGN, PENDULUM_SIGN] {
            results.push(CheckResult::skipped(name, "needs both encoders"));
        }
        return results;
    };
    let note = if are_new { " (with the signs that were found)" } else { "" };
    let cure =
        || format!("qube-hil check --write, or by hand in qube.toml: {}", changed(signs, right));
    let motor = format!("{voltage_v:+.1} V turns the arm by {theta_rad:+.3} rad{note}");
    results.push(if theta_rad * voltage_v > 0.0 {
        CheckResult::pass(MOTOR_SIGN, motor)
    } else {
        CheckResult::fail(MOTOR_SIGN, motor, cure())
    });
    let pendulum = format!("arm {theta_rad:+.3} rad, pendulum {alpha_rad:+.3} rad{note}");
    results.push(if alpha_rad * theta_rad < 0.0 {
        CheckResult::pass(PENDULUM_SIGN, pendulum + ": it lags")
    } else {
        CheckResult::fail(PENDULUM_SIGN, pendulum + ": it should lag", cure())
    });
    results
}

/// The entries of `[signs]` that differ.
fn changed(signs: Calibration, right: Calibration) -> String {
    [
        ("theta_inverted", signs.theta_inverted, right.theta_inverted),
        ("alpha_inverted", signs.alpha_inverted, right.alpha_inverted),
        ("voltage_inverted", signs.voltage_inverted, right.voltage_inverted),
    ]
    .iter()
    .filter(|(_, is, should)| is != should)
    .map(|(name, _, should)| format!("{name} = {should}"))
    .collect::<Vec<_>>()
    .join(", ")
}
