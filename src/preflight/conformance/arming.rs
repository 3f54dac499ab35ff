use firmware_protocol::{DeviceState, DisarmReply, RefusalReason, Reply, Request, StatusBits};

use super::{Deviation, Speaker, ensure};

fn disarm(speaker: &mut Speaker<'_>) -> Result<DisarmReply, Deviation> {
    match speaker.ask(Request::Disarm)? {
        Reply::Disarm(reply) if reply.state == DeviceState::Tripped => Err(Deviation::Disturbed),
        Reply::Disarm(reply) => Ok(reply),
        other => Err(Deviation::Wrong(format!("Disarm was answered with {other:?}"))),
    }
}

pub(super) fn arm(speaker: &mut Speaker<'_>) -> Result<(), Deviation> {
    let (_, nonce) = speaker.arm()?;
    let armed = speaker.sample_armed()?;
    ensure!(armed.applied_mv == 0, "arming put {} mV at the motor", armed.applied_mv);
    let reply = disarm(speaker)?;
    ensure!(reply.state == DeviceState::Greeted, "after a disarm it is {:?}", reply.state);
    ensure!(reply.nonce != 0 && reply.nonce != nonce, "a disarm gave the nonce {}", reply.nonce);
    let off = speaker.sample()?;
    ensure!(!off.status.has(StatusBits::ARMED), "it is armed after a disarm");
    let again = disarm(speaker)?;
    ensure!(again.nonce == reply.nonce, "a second disarm changed the nonce");
    speaker.arm_with(reply.nonce)?;
    Ok(())
}

pub(super) fn wrong_nonce(speaker: &mut Speaker<'_>) -> Result<(), Deviation> {
    let nonce = speaker.greet()?.nonce;
    for wrong in [0, nonce ^ 1, nonce.swap_bytes() ^ 0x55, u32::MAX ^ nonce] {
        speaker.refused(Request::Arm { nonce: wrong }, RefusalReason::WrongNonce)?;
    }
    ensure!(!speaker.sample()?.status.has(StatusBits::ARMED), "a wrong nonce armed it");
    speaker.arm_with(nonce)?;
    Ok(())
}

pub(super) fn replayed_arm(speaker: &mut Speaker<'_>) -> Result<(), Deviation> {
    let nonce = speaker.greet()?.nonce;
    let sequence = speaker.next_sequence();
    let arm = Request::Arm { nonce };
    speaker.send_bytes(arm.encode(sequence).as_bytes())?;
    speaker.reply_to(sequence, "Arm")?;
    disarm(speaker)?;
    speaker.send_bytes(arm.encode(sequence).as_bytes())?;
    speaker.refusal_of(
        sequence,
        arm.message_type(),
        "a replayed Arm",
        RefusalReason::WrongNonce,
    )?;
    speaker.greet()?;
    speaker.refused(arm, RefusalReason::WrongNonce)
}

pub(super) fn arm_twice(speaker: &mut Speaker<'_>) -> Result<(), Deviation> {
    let (armed_us, nonce) = speaker.arm()?;
    let again = Request::Arm { nonce };
    speaker.refused(again, RefusalReason::AlreadyArmed)?;
    super::watchdog::trips_while(speaker, armed_us, |speaker| {
        // Once the watchdog has tripped, the device refuses for that reason instead; both reasons
        // are right here.
        match speaker.ask(again)? {
            Reply::Refusal {
                reason: RefusalReason::AlreadyArmed | RefusalReason::WatchdogTripped,
                ..
            } => Ok(()),
            other => Err(Deviation::Wrong(format!("a second Arm was answered with {other:?}"))),
        }
    })
}

pub(super) fn hello_disarms(speaker: &mut Speaker<'_>) -> Result<(), Deviation> {
    speaker.arm()?;
    speaker.sample_armed()?;
    speaker.act(500)?;
    speaker.sample_armed()?;
    speaker.greet()?;
    let off = speaker.sample()?;
    ensure!(
        !off.status.has(StatusBits::ARMED) && off.applied_mv == 0,
        "after a hello it is still driving: {off:?}"
    );
    speaker.refused(speaker.act_request(500), RefusalReason::NotArmed)
}
