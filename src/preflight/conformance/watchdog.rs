use firmware_protocol::{
    DeviceState, NO_ACT_US, RefusalReason, Reply, Request, SampleReply, StatusBits, WATCHDOG_MS,
    WATCHDOG_POLL_MS,
};

use super::{Deviation, Speaker, ensure};

const WATCHDOG_US: u32 = WATCHDOG_MS as u32 * 1000;
const LATEST_US: u32 = (WATCHDOG_MS + WATCHDOG_POLL_MS) as u32 * 1000;

/// Pause between the samples that show when the watchdog trips, ns: 1 ms.
const PAUSE_NS: u64 = 1_000_000;

/// Repeats an action until the watchdog has tripped, and fails unless that happens 50 ms after
/// `fed_us` and at most one poll of the watchdog later. All times are by the device's clock.
pub(super) fn trips_while(
    speaker: &mut Speaker<'_>,
    fed_us: u32,
    mut meanwhile: impl FnMut(&mut Speaker<'_>) -> Result<(), Deviation>,
) -> Result<(), Deviation> {
    loop {
        let sample = speaker.sample()?;
        let elapsed_us = sample.device_time_us.wrapping_sub(fed_us);
        if sample.status.has(StatusBits::WATCHDOG_TRIPPED) {
            ensure!(elapsed_us >= WATCHDOG_US, "it tripped after {elapsed_us} us already");
            ensure!(
                !sample.status.has(StatusBits::ARMED) && sample.applied_mv == 0,
                "it tripped, but the motor is not off: {sample:?}"
            );
            return Ok(());
        }
        // A reading may be slightly older than its request, and so from before `fed_us`; the
        // difference then wraps round to a huge number.
        ensure!(
            elapsed_us <= LATEST_US || elapsed_us > u32::MAX / 2,
            "it has not tripped after {elapsed_us} us"
        );
        meanwhile(speaker)?;
        speaker.wait_ns(PAUSE_NS);
    }
}

/// Acts, and returns the time of the act by the device's clock, us.
pub(super) fn act_timed(speaker: &mut Speaker<'_>, voltage_mv: i16) -> Result<u32, Deviation> {
    let before: SampleReply = speaker.sample_armed()?;
    speaker.act(voltage_mv)?;
    let after = speaker.sample_armed()?;
    ensure!(after.sample_to_act_us != NO_ACT_US, "an act did not show in the next sample");
    Ok(before.device_time_us.wrapping_add(u32::from(after.sample_to_act_us)))
}

pub(super) fn on_time(speaker: &mut Speaker<'_>) -> Result<(), Deviation> {
    speaker.arm()?;
    let acted_us = act_timed(speaker, 500)?;
    trips_while(speaker, acted_us, |_| Ok(()))
}

pub(super) fn after_arm(speaker: &mut Speaker<'_>) -> Result<(), Deviation> {
    let (armed_us, _) = speaker.arm()?;
    trips_while(speaker, armed_us, |_| Ok(()))
}

pub(super) fn not_fed_by_refused(speaker: &mut Speaker<'_>) -> Result<(), Deviation> {
    speaker.arm()?;
    let acted_us = act_timed(speaker, 500)?;
    trips_while(speaker, acted_us, |speaker| {
        match speaker.ask(speaker.act_request(6000))? {
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

pub(super) fn fed(speaker: &mut Speaker<'_>) -> Result<(), Deviation> {
    let (armed_us, _) = speaker.arm()?;
    speaker.sample_armed()?;
    loop {
        speaker.act(0)?;
        let sample = speaker.sample_armed()?;
        if sample.device_time_us.wrapping_sub(armed_us) > 4 * WATCHDOG_US
            && sample.device_time_us.wrapping_sub(armed_us) < u32::MAX / 2
        {
            return Ok(());
        }
        speaker.wait_ns(10 * PAUSE_NS);
    }
}

pub(super) fn latch(speaker: &mut Speaker<'_>) -> Result<(), Deviation> {
    let (armed_us, nonce) = speaker.arm()?;
    trips_while(speaker, armed_us, |_| Ok(()))?;
    let tripped = "after its watchdog";
    for request in [speaker.act_request(500), Request::Arm { nonce }] {
        match speaker.ask(request)? {
            Reply::Refusal { reason: RefusalReason::WatchdogTripped, .. } => {}
            other => ensure!(false, "{request:?} {tripped} was answered with {other:?}"),
        }
    }
    match speaker.ask(Request::Disarm)? {
        Reply::Disarm(reply) if reply.state == DeviceState::Tripped && reply.nonce == 0 => {}
        other => ensure!(false, "Disarm {tripped} was answered with {other:?}"),
    }
    let nonce = speaker.greet()?.nonce;
    let greeted = speaker.sample()?;
    ensure!(
        greeted.status.has(StatusBits::WATCHDOG_TRIPPED) && greeted.applied_mv == 0,
        "a hello alone already hides that the watchdog tripped"
    );
    speaker.arm_with(nonce)?;
    speaker.sample_armed()?;
    Ok(())
}
