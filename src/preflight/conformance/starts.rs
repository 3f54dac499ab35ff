use firmware_protocol::{
    PROTOCOL_VERSION, QUBE_MODULE_ID, RefusalReason, Reply, Request, SampleReply, StatusBits,
};

use super::{Deviation, Speaker, ensure};

/// Largest motion of arm and pendulum between two samples of these checks, at 0 V, counts: a sixth
/// of a revolution. A reset of the counters is a larger jump, unless they happen to be near 0.
const MOST_COUNTS: u32 = 341;

pub(super) fn module_id(speaker: &mut Speaker<'_>) -> Result<(), Deviation> {
    let reply = speaker.greet()?;
    if reply.module_id == QUBE_MODULE_ID {
        speaker.sample()?;
        return Ok(());
    }
    ensure!(reply.nonce != 0, "without a Qube it gives no nonce");
    speaker.refused(Request::Sample, RefusalReason::QubeAbsent)?;
    speaker.refused(Request::Arm { nonce: reply.nonce }, RefusalReason::QubeAbsent)?;
    match speaker.ask(Request::Disarm)? {
        Reply::Disarm(disarm) if disarm.nonce == reply.nonce => Ok(()),
        other => Err(Deviation::Wrong(format!(
            "an arm refused for its Qube should leave the nonce valid, but Disarm was answered with \
             {other:?}"
        ))),
    }
}

pub(super) fn boot_id(speaker: &mut Speaker<'_>) -> Result<(), Deviation> {
    let first = speaker.greet()?.boot_id;
    for version in [PROTOCOL_VERSION, PROTOCOL_VERSION + 1, PROTOCOL_VERSION] {
        let boot_id = speaker.greet_as(version)?.boot_id;
        ensure!(boot_id == first, "the boot id {first} became {boot_id} without a restart");
    }
    speaker.arm()?;
    let boot_id = speaker.greet()?.boot_id;
    ensure!(boot_id == first, "the boot id {first} became {boot_id} by an arm");
    Ok(())
}

fn jump(before: &SampleReply, after: &SampleReply) -> u32 {
    let of = |before: i32, after: i32| after.wrapping_sub(before).unsigned_abs();
    of(before.theta_counts, after.theta_counts).max(of(before.alpha_counts, after.alpha_counts))
}

pub(super) fn counts_continue(speaker: &mut Speaker<'_>) -> Result<(), Deviation> {
    speaker.greet()?;
    let mut before = speaker.sample()?;
    for step in ["a hello", "an arm", "a disarm", "a hello of another version"] {
        match step {
            "an arm" => {
                speaker.arm()?;
            }
            "a disarm" => {
                speaker.ask(Request::Disarm)?;
            }
            "a hello" => {
                speaker.greet()?;
            }
            _ => {
                speaker.greet_as(PROTOCOL_VERSION + 1)?;
                speaker.greet()?;
            }
        }
        let after = speaker.sample()?;
        let counts = jump(&before, &after);
        ensure!(counts <= MOST_COUNTS, "counts jumped by {counts} at {step}");
        before = after;
    }
    Ok(())
}

pub(super) fn last_act_before_arm(speaker: &mut Speaker<'_>) -> Result<(), Deviation> {
    speaker.greet()?;
    for again in [false, true] {
        let greeted = speaker.sample()?;
        ensure!(
            greeted.last_act_sequence == 0,
            "after a hello and before an arm the last act is {}",
            greeted.last_act_sequence
        );
        if again {
            break;
        }
        let nonce = speaker.greet()?.nonce;
        speaker.arm_with(nonce)?;
        let armed = speaker.sample_armed()?;
        ensure!(armed.last_act_sequence != 0, "after an arm the last act is 0");
        speaker.act(0)?;
        speaker.sample_armed()?;
        speaker.greet()?;
    }
    Ok(())
}

pub(super) fn arm_clears_stall(speaker: &mut Speaker<'_>) -> Result<(), Deviation> {
    speaker.arm()?;
    let first = speaker.sample()?;
    if first.status.has(StatusBits::WATCHDOG_TRIPPED) {
        return Err(Deviation::Disturbed);
    }
    ensure!(
        !first.status.has(StatusBits::STALL_ERROR),
        "the first sample after an arm shows a stall error: {first:?}"
    );
    Ok(())
}
