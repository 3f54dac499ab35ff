use firmware_protocol::{RefusalReason, WATCHDOG_MS, WATCHDOG_POLL_MS};

use super::Interruption;
use super::examined_device::ExaminedDevice;
use crate::clock::Nanoseconds;
use crate::control::{VOLTAGE_TOLERANCE_MV, reported_fault};
use crate::device::DeviceError;
use crate::qube::applied_voltage_mv;
use crate::safety::clamp_to_mv;
use crate::telemetry::{CheckResult, Fault, Hint};

pub(super) const NAME: &str = "watchdog";

/// Voltage of the test, V: two steps of the amplifier. The device's report shows it, and it hardly
/// moves the arm.
const VOLTAGE_V: f64 = 0.048;

/// Pause between two samples, ns. Samples do not feed the watchdog.
const PAUSE_NS: Nanoseconds = 1_000_000;

/// Time after which a sample counts as lost, ns.
const PATIENCE_NS: Nanoseconds = 20_000_000;

/// Longest observation of one attempt, ns; an attempt is this long only if samples are lost.
const LONGEST_NS: Nanoseconds = 500_000_000;

/// Largest number of attempts: computer or link may be too slow to see the motor on.
const ATTEMPTS: u32 = 20;

/// Earliest expiry of any watchdog after the last act, us.
const WATCHDOG_US: u64 = WATCHDOG_MS as u64 * 1000;
/// Latest expiry of a board's watchdog after the last act, us.
const LATEST_US: u64 = (WATCHDOG_MS + WATCHDOG_POLL_MS) as u64 * 1000;

/// Latest expiry of the vendor library's watchdog after the last act, us; the vendor does not
/// publish its resolution.
const LIBRARY_LATEST_US: u64 = 100_000;

const LIBRARY_REMEDY: &str =
    "do not run anything with it: install the vendor's present package, then check again";

const REMEDY: &str = "do not run anything with it: flash the firmware of this release, then check that the board conforms to the protocol";

/// Largest age of a sample when it is requested, us.
const SAMPLE_AGE_US: u64 = 5_000;

/// The result of the test of the watchdog.
pub(super) struct WatchdogTest {
    pub result: CheckResult,
    /// Time from the act until the watchdog had expired, ms; `None` if the test failed.
    pub expired_ms: Option<f64>,
    /// The fault that the device reported, if it switched the motor off before the watchdog could.
    pub fault: Option<Fault>,
}

impl WatchdogTest {
    fn failed(value: impl Into<String>, remedy: &str) -> Self {
        Self { result: CheckResult::fail(NAME, value, remedy), expired_ms: None, fault: None }
    }
}

/// Arms the device, sends one act with a small voltage and then only requests samples: the motor
/// must go off by the watchdog. For a board, the device's own report and clock decide. A device
/// without a clock only reports that its watchdog has expired, and the time is by the computer's
/// clock.
pub(super) fn check(examined: &mut ExaminedDevice<'_>) -> Result<WatchdogTest, Interruption> {
    for _ in 0..ATTEMPTS {
        examined.ensure_going()?;
        examined.device.hello()?;
        match examined.device.arm() {
            Ok(()) => {}
            Err(DeviceError::Refused { reason, .. }) => {
                let remedy = if reason == RefusalReason::EmergencyStop {
                    "make sure that nobody is near the arm and close the switch, then check again"
                } else {
                    "switch the Qube's power off and on, then check again"
                };
                let value = format!("the device refuses to be armed: {}", reason.describe());
                return Ok(WatchdogTest::failed(value, remedy));
            }
            Err(error) => return Err(error.into()),
        }
        if let Some(result) = try_once(examined)? {
            return Ok(result);
        }
    }
    Ok(WatchdogTest::failed(
        "computer or link was too slow to see the motor on before the watchdog switched it off",
        "close other programs that keep this computer busy, and plug the board in without a hub, \
         then check again",
    ))
}

/// Makes one attempt; `Ok(None)` if the computer or the link was too slow.
fn try_once(examined: &mut ExaminedDevice<'_>) -> Result<Option<WatchdogTest>, Interruption> {
    let clock = examined.clock;
    let is_board = examined.device.has_device_clock();
    let (latest_us, remedy, hint) = if is_board {
        (LATEST_US, REMEDY, Some(Hint::TestConformance))
    } else {
        (LIBRARY_LATEST_US, LIBRARY_REMEDY, None)
    };
    let failed = |value: String| {
        let result = CheckResult::fail(NAME, value, remedy).with_hint(hint);
        Ok(Some(WatchdogTest { result, expired_ms: None, fault: None }))
    };
    let Some(before) = examined.sample_within(PATIENCE_NS)? else { return Ok(None) };
    let voltage_mv = clamp_to_mv(VOLTAGE_V, VOLTAGE_V).unwrap_or(0);
    match examined.device.act(voltage_mv, before.device_time_us) {
        Ok(()) => {}
        Err(fault) => {
            examined.lost(fault)?;
            return Ok(None);
        }
    }
    let Some(on) = examined.sample_within(PATIENCE_NS)? else { return Ok(None) };
    let Some(sample_to_act_us) = on.sample_to_act_us.filter(|_| on.status.armed) else {
        return Ok(None);
    };
    let sent_mv = i32::from(applied_voltage_mv(voltage_mv));
    let off_mv = (i32::from(on.applied_mv) - sent_mv).abs();
    // Rounding alone might explain 0 mV.
    if on.applied_mv == 0 || off_mv > VOLTAGE_TOLERANCE_MV {
        return failed(format!(
            "{voltage_mv} mV were sent and the device reports {} mV at the motor",
            on.applied_mv
        ));
    }
    let acted_us = before.device_time_us + u64::from(sample_to_act_us);
    let end_ns = clock.now_ns() + LONGEST_NS;
    while clock.now_ns() < end_ns {
        examined.ensure_going()?;
        clock.sleep_until(clock.now_ns() + PAUSE_NS);
        let Some(later) = examined.sample_within(PATIENCE_NS)? else { continue };
        let elapsed_us = later.device_time_us.saturating_sub(acted_us);
        let is_off = !later.status.armed && later.applied_mv == 0;
        let ms = elapsed_us as f64 * 1e-3;
        if later.status.watchdog_tripped && is_off {
            if elapsed_us + SAMPLE_AGE_US < WATCHDOG_US {
                return failed(format!("off after {ms:.1} ms already"));
            }
            // Samples were lost meanwhile, so that nothing shows when the motor went off.
            if elapsed_us > latest_us + SAMPLE_AGE_US {
                return Ok(None);
            }
            let value = if is_board {
                format!("motor off {ms:.1} ms after the last act")
            } else {
                format!("the library reports it expired {ms:.1} ms after the last act")
            };
            let result = CheckResult::pass(NAME, value);
            return Ok(Some(WatchdogTest { result, expired_ms: Some(ms), fault: None }));
        }
        if is_off {
            let Some(fault) = reported_fault(&later.status) else { return Ok(None) };
            let value = format!("the motor went off before the watchdog could act: {fault}");
            let remedy = format!("{} Then check again", fault.operator_step());
            let result = CheckResult::fail(NAME, value, remedy);
            return Ok(Some(WatchdogTest { result, expired_ms: None, fault: Some(fault) }));
        }
        if elapsed_us > latest_us + SAMPLE_AGE_US {
            // The motor does not stay on after this failure: it has 48 mV, and the hello that ends
            // the examination switches it off.
            return failed(format!("motor still on {ms:.1} ms after the last act"));
        }
    }
    Ok(None)
}
