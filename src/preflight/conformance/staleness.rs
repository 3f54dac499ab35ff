use firmware_protocol::scaling::{motor_counts, motor_voltage_mv};
use firmware_protocol::{MAX_SAMPLE_AGE_US, NO_ACT_US, RefusalReason, Reply, Request};

use super::watchdog::{act_timed, trips_while};
use super::{Deviation, TestHost, ensure};

/// Margin of a wait over the largest accepted age of a sample, us. It can be small: the wait begins
/// when the answer has arrived, and the reading is up to 5 ms older than its answer.
const AGE_MARGIN_US: u64 = 500;

fn act_on(sampled_at_us: u32) -> Request {
    Request::Act { voltage_mv: 500, sampled_at_us }
}

pub(super) fn refused(test_host: &mut TestHost<'_>) -> Result<(), Deviation> {
    let stale = RefusalReason::StaleSample;
    test_host.greet()?;
    let before_hello_us = test_host.sample()?.device_time_us;
    test_host.arm()?;
    test_host.refused(act_on(before_hello_us), stale)?;

    let older_us = test_host.sample_armed()?.device_time_us;
    let last = test_host.sample_armed()?;
    let last_us = last.device_time_us;
    let never_given = [last_us.wrapping_sub(1), last_us.wrapping_add(1), !last_us];
    let in_the_future = last_us.wrapping_add(1_000_000);
    for sampled_at_us in never_given.into_iter().chain([in_the_future, older_us]) {
        test_host.refused(act_on(sampled_at_us), stale)?;
    }
    let accepted = test_host.act(250)?;
    let before = test_host.sample_armed()?;
    ensure!(
        before.last_act_sequence == accepted,
        "an act on the last sample was not accepted: {before:?}"
    );

    test_host.wait_ns((u64::from(MAX_SAMPLE_AGE_US) + AGE_MARGIN_US) * 1000);
    test_host.refused(act_on(before.device_time_us), stale)?;
    let after = test_host.sample_armed()?;
    ensure!(
        after.applied_mv == motor_voltage_mv(motor_counts(250))
            && after.last_act_sequence == accepted
            && after.sample_to_act_us == NO_ACT_US,
        "a refused act changed something: {after:?}"
    );
    Ok(())
}

pub(super) fn does_not_feed(test_host: &mut TestHost<'_>) -> Result<(), Deviation> {
    test_host.arm()?;
    let old_us = test_host.sample_armed()?.device_time_us;
    let acted_us = act_timed(test_host, 250)?;
    trips_while(test_host, acted_us, |test_host| match test_host.ask(act_on(old_us))? {
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
