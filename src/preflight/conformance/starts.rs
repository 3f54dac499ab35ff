use firmware_protocol::{
    PROTOCOL_VERSION, QUBE_MODULE_ID, RefusalReason, Reply, Request, SampleReply, StatusBits,
};

use super::{Deviation, TestHost, ensure};

/// Largest motion of arm and pendulum between two samples of these checks, at 0 V, counts: a sixth
/// of a revolution. A reset of the counters is a larger jump, unless they happen to be near 0.
const MOST_COUNTS: u32 = 341;

pub(super) fn module_id(test_host: &mut TestHost<'_>) -> Result<(), Deviation> {
    let reply = test_host.greet()?;
    if reply.module_id == QUBE_MODULE_ID {
        test_host.sample()?;
        return Ok(());
    }
    ensure!(reply.nonce != 0, "without a Qube the device gives no nonce");
    test_host.refused(Request::Sample, RefusalReason::QubeAbsent)?;
    test_host.refused(Request::Arm { nonce: reply.nonce }, RefusalReason::QubeAbsent)?;
    match test_host.ask(Request::Disarm)? {
        Reply::Disarm(disarm) if disarm.nonce == reply.nonce => Ok(()),
        other => Err(Deviation::Wrong(format!(
            "an arm refused for its Qube should leave the nonce valid, but Disarm was answered with \
             {other:?}"
        ))),
    }
}

pub(super) fn boot_id(test_host: &mut TestHost<'_>) -> Result<(), Deviation> {
    let first = test_host.greet()?.boot_id;
    for version in [PROTOCOL_VERSION, PROTOCOL_VERSION + 1, PROTOCOL_VERSION] {
        let boot_id = test_host.greet_as(version)?.boot_id;
        ensure!(boot_id == first, "the boot id {first} became {boot_id} without a restart");
    }
    test_host.arm()?;
    let boot_id = test_host.greet()?.boot_id;
    ensure!(boot_id == first, "the boot id {first} became {boot_id} by an arm");
    Ok(())
}

fn jump(before: &SampleReply, after: &SampleReply) -> u32 {
    let of = |before: i32, after: i32| after.wrapping_sub(before).unsigned_abs();
    of(before.theta_counts, after.theta_counts).max(of(before.alpha_counts, after.alpha_counts))
}

pub(super) fn counts_continue(test_host: &mut TestHost<'_>) -> Result<(), Deviation> {
    test_host.greet()?;
    let mut before = test_host.sample()?;
    for step in ["a hello", "an arm", "a disarm", "a hello of another version"] {
        match step {
            "an arm" => {
                test_host.arm()?;
            }
            "a disarm" => {
                test_host.ask(Request::Disarm)?;
            }
            "a hello" => {
                test_host.greet()?;
            }
            _ => {
                test_host.greet_as(PROTOCOL_VERSION + 1)?;
                test_host.greet()?;
            }
        }
        let after = test_host.sample()?;
        let counts = jump(&before, &after);
        ensure!(counts <= MOST_COUNTS, "counts jumped by {counts} at {step}");
        before = after;
    }
    Ok(())
}

pub(super) fn last_act_before_arm(test_host: &mut TestHost<'_>) -> Result<(), Deviation> {
    test_host.greet()?;
    for again in [false, true] {
        let greeted = test_host.sample()?;
        ensure!(
            greeted.last_act_sequence == 0,
            "after a hello and before an arm the last act is {}",
            greeted.last_act_sequence
        );
        if again {
            break;
        }
        let nonce = test_host.greet()?.nonce;
        test_host.arm_with(nonce)?;
        let armed = test_host.sample_armed()?;
        ensure!(armed.last_act_sequence != 0, "after an arm the last act is 0");
        test_host.act(0)?;
        test_host.sample_armed()?;
        test_host.greet()?;
    }
    Ok(())
}

pub(super) fn arm_clears_stall(test_host: &mut TestHost<'_>) -> Result<(), Deviation> {
    test_host.arm()?;
    let first = test_host.sample()?;
    if first.status.has(StatusBits::WATCHDOG_TRIPPED) {
        return Err(Deviation::Disturbed);
    }
    ensure!(
        !first.status.has(StatusBits::STALL_ERROR),
        "the first sample after an arm shows a stall error: {first:?}"
    );
    Ok(())
}
