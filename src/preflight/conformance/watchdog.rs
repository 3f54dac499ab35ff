use firmware_protocol::{
    DeviceState, NO_ACT_US, RefusalReason, Reply, Request, SampleReply, StatusBits, WATCHDOG_MS,
    WATCHDOG_POLL_MS,
};

use super::{Deviation, TestHost, ensure};
use crate::clock::Nanoseconds;

const WATCHDOG_US: u32 = WATCHDOG_MS as u32 * 1000;
const LATEST_US: u32 = (WATCHDOG_MS + WATCHDOG_POLL_MS) as u32 * 1000;

/// Pause between the samples that show when the watchdog trips, ns: 1 ms.
const PAUSE_NS: u64 = 1_000_000;

/// Longest time that a check waits for the device's clock, ns by the computer's clock: 5 s. If the
/// device's clock then shows less than 0.5 s, it stands still or runs backwards.
const LONGEST_NS: Nanoseconds = 5_000_000_000;

/// Fails if [`LONGEST_NS`] had passed since `begin_ns` when a sample was requested at `asked_ns`. A
/// check that continues until the device's clock reaches a time calls this function after each
/// sample. Otherwise a clock that stands still would keep the check from ending, with the motor on.
fn ensure_clock_runs(begin_ns: Nanoseconds, asked_ns: Nanoseconds) -> Result<(), Deviation> {
    ensure!(
        asked_ns - begin_ns < LONGEST_NS,
        "the device's clock stands still or runs backwards: it shows less than 0.5 s after {} s",
        LONGEST_NS / 1_000_000_000
    );
    Ok(())
}

/// Repeats an action until the watchdog has tripped. Fails if the watchdog trips less than 50 ms
/// after `fed_us`, if a sample more than 55 ms after `fed_us` shows that it has not tripped (5 ms
/// are one poll of the watchdog), or if the motor is not off after the trip. `fed_us` is the time
/// of the last arm or act. All times are by the device's clock, which must run.
pub(super) fn trips_while(
    test_host: &mut TestHost<'_>,
    fed_us: u32,
    mut meanwhile: impl FnMut(&mut TestHost<'_>) -> Result<(), Deviation>,
) -> Result<(), Deviation> {
    let begin_ns = test_host.now_ns();
    loop {
        let asked_ns = test_host.now_ns();
        let sample = test_host.sample()?;
        let elapsed_us = sample.device_time_us.wrapping_sub(fed_us);
        if sample.status.has(StatusBits::WATCHDOG_TRIPPED) {
            ensure!(elapsed_us >= WATCHDOG_US, "the watchdog tripped early, after {elapsed_us} us");
            ensure!(
                !sample.status.has(StatusBits::ARMED) && sample.applied_mv == 0,
                "the watchdog tripped, but the motor is not off: {sample:?}"
            );
            return Ok(());
        }
        // A reading may be slightly older than its request, and so from before `fed_us`; the
        // difference then wraps to a number near the largest one.
        ensure!(
            elapsed_us <= LATEST_US || elapsed_us > u32::MAX / 2,
            "the watchdog has not tripped after {elapsed_us} us"
        );
        ensure_clock_runs(begin_ns, asked_ns)?;
        meanwhile(test_host)?;
        test_host.wait_ns(PAUSE_NS);
    }
}

/// Sends an act, and returns the time of the act by the device's clock, us.
pub(super) fn act_timed(test_host: &mut TestHost<'_>, voltage_mv: i16) -> Result<u32, Deviation> {
    let before: SampleReply = test_host.sample_armed()?;
    test_host.act(voltage_mv)?;
    let after = test_host.sample_armed()?;
    ensure!(after.sample_to_act_us != NO_ACT_US, "an act did not show in the next sample");
    Ok(before.device_time_us.wrapping_add(u32::from(after.sample_to_act_us)))
}

pub(super) fn on_time(test_host: &mut TestHost<'_>) -> Result<(), Deviation> {
    test_host.arm()?;
    let acted_us = act_timed(test_host, 500)?;
    trips_while(test_host, acted_us, |_| Ok(()))
}

pub(super) fn after_arm(test_host: &mut TestHost<'_>) -> Result<(), Deviation> {
    let (armed_us, _) = test_host.arm()?;
    trips_while(test_host, armed_us, |_| Ok(()))
}

pub(super) fn not_fed_by_refused(test_host: &mut TestHost<'_>) -> Result<(), Deviation> {
    test_host.arm()?;
    let acted_us = act_timed(test_host, 500)?;
    trips_while(test_host, acted_us, |test_host| {
        match test_host.ask(test_host.act_request(6000))? {
            // Once the watchdog has tripped, the device refuses for that reason instead; both
            // reasons are right here.
            Reply::Refusal {
                reason: RefusalReason::VoltageOutOfRange | RefusalReason::WatchdogTripped,
                ..
            } => Ok(()),
            other => {
                Err(Deviation::Wrong(format!("an act of 6000 mV was answered with {other:?}")))
            }
        }
    })
}

pub(super) fn fed(test_host: &mut TestHost<'_>) -> Result<(), Deviation> {
    let (armed_us, _) = test_host.arm()?;
    test_host.sample_armed()?;
    let begin_ns = test_host.now_ns();
    loop {
        test_host.act(0)?;
        let asked_ns = test_host.now_ns();
        let sample = test_host.sample_armed()?;
        if sample.device_time_us.wrapping_sub(armed_us) > 4 * WATCHDOG_US
            && sample.device_time_us.wrapping_sub(armed_us) < u32::MAX / 2
        {
            return Ok(());
        }
        ensure_clock_runs(begin_ns, asked_ns)?;
        test_host.wait_ns(10 * PAUSE_NS);
    }
}

pub(super) fn latch(test_host: &mut TestHost<'_>) -> Result<(), Deviation> {
    let (armed_us, nonce) = test_host.arm()?;
    trips_while(test_host, armed_us, |_| Ok(()))?;
    let tripped = "after the watchdog tripped";
    for request in [test_host.act_request(500), Request::Arm { nonce }] {
        match test_host.ask(request)? {
            Reply::Refusal { reason: RefusalReason::WatchdogTripped, .. } => {}
            other => ensure!(false, "{request:?} {tripped} was answered with {other:?}"),
        }
    }
    match test_host.ask(Request::Disarm)? {
        Reply::Disarm(reply) if reply.state == DeviceState::Tripped && reply.nonce == 0 => {}
        other => ensure!(false, "Disarm {tripped} was answered with {other:?}"),
    }
    let nonce = test_host.greet()?.nonce;
    let greeted = test_host.sample()?;
    ensure!(
        greeted.status.has(StatusBits::WATCHDOG_TRIPPED) && greeted.applied_mv == 0,
        "after a hello alone, the device hides that its watchdog tripped, or its motor is on"
    );
    test_host.arm_with(nonce)?;
    test_host.sample_armed()?;
    Ok(())
}
