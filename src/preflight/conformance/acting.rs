use firmware_protocol::scaling::{MAX_VOLTAGE_MV, motor_counts, motor_voltage_mv};
use firmware_protocol::{NO_ACT_US, RefusalReason};

use super::{Deviation, TestHost, ensure};
use crate::clock::Nanoseconds;

/// Voltages of up to 1 V, mV. 12 and 13 mV lie on both sides of half a step of the motor's
/// resolution (24.02 mV), so they show how the device rounds.
const VOLTAGES_MV: [i16; 8] = [1000, -1000, 12, 13, -13, 500, -500, 0];

/// Wait between two acts on one sample, ns: many times the time of a frame, and short enough that
/// the second act is fresh.
const BETWEEN_ACTS_NS: Nanoseconds = 5_000_000;

/// Number of tries of [`first_act_time`]: a link that is late once makes one of them fail.
const TRIES: u32 = 5;

pub(super) fn unarmed(test_host: &mut TestHost<'_>) -> Result<(), Deviation> {
    test_host.greet()?;
    test_host.sample()?;
    test_host.refused(test_host.act_request(500), RefusalReason::NotArmed)?;
    let sample = test_host.sample()?;
    ensure!(sample.applied_mv == 0, "a motor that is off has {} mV", sample.applied_mv);
    ensure!(sample.sample_to_act_us == NO_ACT_US, "the device reports an act that it has refused");
    Ok(())
}

pub(super) fn act(test_host: &mut TestHost<'_>) -> Result<(), Deviation> {
    test_host.arm()?;
    let mut before = test_host.sample_armed()?;
    ensure!(
        before.sample_to_act_us == NO_ACT_US,
        "the device reports an act although there was none"
    );
    for voltage_mv in VOLTAGES_MV {
        let sequence = test_host.act(voltage_mv)?;
        // The next sample must name the second act on the same sample.
        let newer = test_host.act(voltage_mv)?;
        let after = test_host.sample_armed()?;
        let expected_mv = motor_voltage_mv(motor_counts(voltage_mv));
        ensure!(
            after.applied_mv == expected_mv,
            "after an act of {voltage_mv} mV the device reports {} mV instead of {expected_mv} mV",
            after.applied_mv
        );
        ensure!(
            after.last_act_sequence == newer,
            "the last act has the sequence number {newer} and the one before it {sequence}, but the sample names {}",
            after.last_act_sequence
        );
        ensure!(
            after.sample_to_act_us != NO_ACT_US,
            "the device reports no act although there were two"
        );
        let between_us = after.device_time_us.wrapping_sub(before.device_time_us);
        ensure!(
            u32::from(after.sample_to_act_us) <= between_us,
            "sample to act took {} us of {between_us} us between two samples",
            after.sample_to_act_us
        );
        before = after;
    }
    let idle = test_host.sample_armed()?;
    ensure!(
        idle.sample_to_act_us == NO_ACT_US,
        "the device reports an act although there was none"
    );
    Ok(())
}

pub(super) fn first_act_time(test_host: &mut TestHost<'_>) -> Result<(), Deviation> {
    test_host.arm()?;
    let mut before = test_host.sample_armed()?;
    let mut reported = (0, 0);
    for _ in 0..TRIES {
        test_host.act(0)?;
        test_host.wait_ns(BETWEEN_ACTS_NS);
        test_host.act(0)?;
        let after = test_host.sample_armed()?;
        let between_us = after.device_time_us.wrapping_sub(before.device_time_us);
        reported = (after.sample_to_act_us, between_us);
        // The second act came at the end of the time between the samples, and the first one before
        // the wait; half of the wait is left to the link.
        let latest_us = u64::from(between_us).saturating_sub(BETWEEN_ACTS_NS / 2000);
        if u64::from(after.sample_to_act_us) <= latest_us {
            return Ok(());
        }
        before = after;
    }
    let (sample_to_act_us, between_us) = reported;
    Err(Deviation::Wrong(format!(
        "sample to act took {sample_to_act_us} us of {between_us} us between two samples, although the second act \
         came {} us after the first",
        BETWEEN_ACTS_NS / 1000
    )))
}

pub(super) fn out_of_range(test_host: &mut TestHost<'_>) -> Result<(), Deviation> {
    test_host.arm()?;
    test_host.sample_armed()?;
    let valid = test_host.act(500)?;
    for voltage_mv in [MAX_VOLTAGE_MV + 1, -MAX_VOLTAGE_MV - 1, i16::MAX, i16::MIN] {
        test_host.refused(test_host.act_request(voltage_mv), RefusalReason::VoltageOutOfRange)?;
    }
    let sample = test_host.sample_armed()?;
    ensure!(
        sample.applied_mv == motor_voltage_mv(motor_counts(500))
            && sample.last_act_sequence == valid,
        "a refused act changed something: {sample:?}"
    );
    Ok(())
}

pub(super) fn replayed(test_host: &mut TestHost<'_>) -> Result<(), Deviation> {
    test_host.arm()?;
    test_host.sample_armed()?;
    let old = test_host.act(500)?;
    let newest = test_host.act(250)?;
    let replay = test_host.act_request(500);
    for sequence in [old, newest, old.wrapping_sub(1), newest.wrapping_add(0x8000)] {
        test_host.send_bytes(replay.encode(sequence).as_bytes())?;
        test_host.refusal_of(
            sequence,
            replay.message_type(),
            "a replayed Act",
            RefusalReason::StaleSequence,
        )?;
    }
    let sample = test_host.sample_armed()?;
    ensure!(
        sample.applied_mv == motor_voltage_mv(motor_counts(250))
            && sample.last_act_sequence == newest,
        "a replayed act changed something: {sample:?}"
    );
    Ok(())
}

pub(super) fn sequence_wrap(test_host: &mut TestHost<'_>) -> Result<(), Deviation> {
    test_host.set_sequence(u16::MAX - 5);
    test_host.arm()?;
    test_host.sample_armed()?;
    for _ in 0..4 {
        let sequence = test_host.act(0)?;
        let sample = test_host.sample_armed()?;
        ensure!(
            sample.last_act_sequence == sequence,
            "act {sequence} was not accepted after {}",
            sample.last_act_sequence
        );
    }
    Ok(())
}
