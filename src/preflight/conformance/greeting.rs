use firmware_protocol::{PROTOCOL_VERSION, QUBE_MODULE_ID, RefusalReason, Request, StatusBits};

use super::{Deviation, TestHost, ensure};

/// Tolerance between the device's and the computer's clock beyond 1 % of the time, us: the age of a
/// sample and the time on the wire.
const SLACK_US: u64 = 6_000;

pub(super) fn hello(test_host: &mut TestHost<'_>) -> Result<(), Deviation> {
    let reply = test_host.greet()?;
    ensure!(
        reply.protocol_version == PROTOCOL_VERSION,
        "the device has another protocol version: {reply:?}"
    );
    ensure!(
        reply.module_id == QUBE_MODULE_ID,
        "its Qube has the module id 0x{:04x} instead of 0x{QUBE_MODULE_ID:04x}",
        reply.module_id
    );
    ensure!(reply.nonce != 0, "the nonce of the device is 0");
    Ok(())
}

pub(super) fn fresh_nonce(test_host: &mut TestHost<'_>) -> Result<(), Deviation> {
    let mut last = test_host.greet()?.nonce;
    for _ in 0..20 {
        let nonce = test_host.greet()?.nonce;
        ensure!(nonce != 0 && nonce != last, "the nonce {nonce} came after {last}");
        last = nonce;
    }
    Ok(())
}

pub(super) fn version_mismatch(test_host: &mut TestHost<'_>) -> Result<(), Deviation> {
    let valid = test_host.greet()?.nonce;
    for version in [0, PROTOCOL_VERSION - 1, PROTOCOL_VERSION + 1, u16::MAX] {
        let reply = test_host.greet_as(version)?;
        ensure!(
            reply.protocol_version == PROTOCOL_VERSION,
            "the device names another protocol version: {reply:?}"
        );
        ensure!(reply.nonce == 0, "the device gave a nonce to a host of version {version}");
        for request in [Request::Sample, Request::Arm { nonce: valid }, test_host.act_request(0)] {
            test_host.refused(request, RefusalReason::NotGreeted)?;
        }
    }
    Ok(())
}

pub(super) fn sample(test_host: &mut TestHost<'_>) -> Result<(), Deviation> {
    test_host.greet()?;
    let mut last = test_host.sample()?;
    ensure!(!last.status.has(StatusBits::ARMED), "a hello armed the device");
    ensure!(last.applied_mv == 0, "a motor that is off has {} mV", last.applied_mv);
    for _ in 0..20 {
        let sample = test_host.sample()?;
        let elapsed_us = sample.device_time_us.wrapping_sub(last.device_time_us);
        ensure!(elapsed_us != 0, "the device gave the sample of {} us twice", last.device_time_us);
        ensure!(
            elapsed_us < 1 << 31,
            "the device's clock went back by {} us",
            elapsed_us.wrapping_neg()
        );
        ensure!(
            !sample.status.has(StatusBits::RESERVED),
            "reserved bits are set: {:08b}",
            sample.status.0
        );
        ensure!(
            sample.sample_to_act_us == 0xFFFF,
            "the device reports an act although there was none"
        );
        last = sample;
    }
    Ok(())
}

pub(super) fn device_clock(test_host: &mut TestHost<'_>) -> Result<(), Deviation> {
    test_host.greet()?;
    let first_asked_ns = test_host.now_ns();
    let first = test_host.sample()?;
    let first_answered_ns = test_host.now_ns();
    test_host.wait_ns(500_000_000);
    let second_asked_ns = test_host.now_ns();
    let second = test_host.sample()?;
    let second_answered_ns = test_host.now_ns();

    let elapsed_us = u64::from(second.device_time_us.wrapping_sub(first.device_time_us));
    let least_us = (second_asked_ns - first_answered_ns) / 1000 * 99 / 100 - SLACK_US;
    let most_us = (second_answered_ns - first_asked_ns) / 1000 * 101 / 100 + SLACK_US;
    ensure!(
        (least_us..=most_us).contains(&elapsed_us),
        "the device's clock advanced by {elapsed_us} us instead of {least_us} to {most_us} us"
    );
    Ok(())
}
