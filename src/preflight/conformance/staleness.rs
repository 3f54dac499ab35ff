use firmware_protocol::scaling::{motor_counts, motor_voltage_mv};
use firmware_protocol::{MAX_SAMPLE_AGE_US, NO_ACT_US, RefusalReason, Reply, Request};

use super::watchdog::{act_timed, trips_while};
use super::{Deviation, Speaker, ensure};

/// Margin of a wait over the largest accepted age of a sample, us. It can be small: the wait begins
/// when the answer has arrived, and the reading is up to 5 ms older than its answer.
const BEYOND_US: u64 = 500;

fn act_on(sampled_at_us: u32) -> Request {
    Request::Act { voltage_mv: 500, sampled_at_us }
}

pub(super) fn refused(speaker: &mut Speaker<'_>) -> Result<(), Deviation> {
    let stale = RefusalReason::StaleSample;
    speaker.greet()?;
    let before_hello_us = speaker.sample()?.device_time_us;
    speaker.arm()?;
    speaker.refused(act_on(before_hello_us), stale)?;

    let older_us = speaker.sample_armed()?.device_time_us;
    let last = speaker.sample_armed()?;
    let last_us = last.device_time_us;
    let never_given = [last_us.wrapping_sub(1), last_us.wrapping_add(1), !last_us];
    let in_the_future = last_us.wrapping_add(1_000_000);
    for sampled_at_us in never_given.into_iter().chain([in_the_future, older_us]) {
        speaker.refused(act_on(sampled_at_us), stale)?;
    }
    let accepted = speaker.act(250)?;
    let before = speaker.sample_armed()?;
    ensure!(
        before.last_act_sequence == accepted,
        "an act on the last sample was not accepted: {before:?}"
    );

    speaker.wait_ns((u64::from(MAX_SAMPLE_AGE_US) + BEYOND_US) * 1000);
    speaker.refused(act_on(before.device_time_us), stale)?;
    let after = speaker.sample_armed()?;
    ensure!(
        after.applied_mv == motor_voltage_mv(motor_counts(250))
            && after.last_act_sequence == accepted
            && after.sample_to_act_us == NO_ACT_US,
        "a refused act changed something: {after:?}"
    );
    Ok(())
}

pub(super) fn does_not_feed(speaker: &mut Speaker<'_>) -> Result<(), Deviation> {
    speaker.arm()?;
    let old_us = speaker.sample_armed()?.device_time_us;
    let acted_us = act_timed(speaker, 250)?;
    trips_while(speaker, acted_us, |speaker| match speaker.ask(act_on(old_us))? {
        // Once the watchdog has tripped, the device refuses for that reason instead; both reasons
        // are right here.
        Reply::Refusal {
            reason: RefusalReason::StaleSample | RefusalReason::WatchdogTripped,
            ..
        } => Ok(()),
        other => {
            Err(Deviation::Wrong(format!("an act on an old sample was answered with {other:?}")))
        }
    })
}
