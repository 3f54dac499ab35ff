use firmware_protocol::{DeviceState, DisarmReply, RefusalReason, Reply, Request, StatusBits};

use super::{Deviation, TestHost, ensure};

fn disarm(test_host: &mut TestHost<'_>) -> Result<DisarmReply, Deviation> {
    match test_host.ask(Request::Disarm)? {
        Reply::Disarm(reply) if reply.state == DeviceState::Tripped => Err(Deviation::Disturbed),
        Reply::Disarm(reply) => Ok(reply),
        other => Err(Deviation::Wrong(format!("Disarm was answered with {other:?}"))),
    }
}

pub(super) fn arm(test_host: &mut TestHost<'_>) -> Result<(), Deviation> {
    let (_, nonce) = test_host.arm()?;
    let armed = test_host.sample_armed()?;
    ensure!(armed.applied_mv == 0, "arming put {} mV at the motor", armed.applied_mv);
    let reply = disarm(test_host)?;
    ensure!(reply.state == DeviceState::Greeted, "after a disarm the device is {:?}", reply.state);
    ensure!(reply.nonce != 0 && reply.nonce != nonce, "a disarm gave the nonce {}", reply.nonce);
    let off = test_host.sample()?;
    ensure!(!off.status.has(StatusBits::ARMED), "the device is armed after a disarm");
    let again = disarm(test_host)?;
    ensure!(again.nonce == reply.nonce, "a second disarm changed the nonce");
    test_host.arm_with(reply.nonce)?;
    Ok(())
}

pub(super) fn wrong_nonce(test_host: &mut TestHost<'_>) -> Result<(), Deviation> {
    let nonce = test_host.greet()?.nonce;
    for wrong in [0, nonce ^ 1, nonce.swap_bytes() ^ 0x55, u32::MAX ^ nonce] {
        test_host.refused(Request::Arm { nonce: wrong }, RefusalReason::WrongNonce)?;
    }
    ensure!(!test_host.sample()?.status.has(StatusBits::ARMED), "a wrong nonce armed the device");
    test_host.arm_with(nonce)?;
    Ok(())
}

pub(super) fn replayed_arm(test_host: &mut TestHost<'_>) -> Result<(), Deviation> {
    let nonce = test_host.greet()?.nonce;
    let sequence = test_host.next_sequence();
    let arm = Request::Arm { nonce };
    test_host.send_bytes(arm.encode(sequence).as_bytes())?;
    test_host.reply_to(sequence, "Arm")?;
    disarm(test_host)?;
    test_host.send_bytes(arm.encode(sequence).as_bytes())?;
    test_host.refusal_of(
        sequence,
        arm.message_type(),
        "a replayed Arm",
        RefusalReason::WrongNonce,
    )?;
    test_host.greet()?;
    test_host.refused(arm, RefusalReason::WrongNonce)
}

pub(super) fn arm_twice(test_host: &mut TestHost<'_>) -> Result<(), Deviation> {
    let (armed_us, nonce) = test_host.arm()?;
    let again = Request::Arm { nonce };
    test_host.refused(again, RefusalReason::AlreadyArmed)?;
    super::watchdog::trips_while(test_host, armed_us, |test_host| {
        // Once the watchdog has tripped, the device refuses for that reason instead; both reasons
        // are right here.
        match test_host.ask(again)? {
            Reply::Refusal {
                reason: RefusalReason::AlreadyArmed | RefusalReason::WatchdogTripped,
                ..
            } => Ok(()),
            other => Err(Deviation::Wrong(format!("a second Arm was answered with {other:?}"))),
        }
    })
}

pub(super) fn hello_disarms(test_host: &mut TestHost<'_>) -> Result<(), Deviation> {
    test_host.arm()?;
    test_host.sample_armed()?;
    test_host.act(500)?;
    test_host.sample_armed()?;
    test_host.greet()?;
    let off = test_host.sample()?;
    ensure!(
        !off.status.has(StatusBits::ARMED) && off.applied_mv == 0,
        "after a hello the device still drives the motor: {off:?}"
    );
    test_host.refused(test_host.act_request(500), RefusalReason::NotArmed)
}
