use firmware_protocol::scaling::{motor_counts, motor_voltage_mv};
use firmware_protocol::{EncodedFrame, RefusalReason, Reply, Request, StatusBits};

use super::{Deviation, TestHost, ensure};

const UNKNOWN_TYPES: [u8; 4] = [0x00, 0x06, 0x42, 0x7F];

/// Greets the device, runs an action, and returns the number of frames that the device has dropped
/// during the action.
fn dropped_during(
    test_host: &mut TestHost<'_>,
    action: impl FnOnce(&mut TestHost<'_>) -> Result<(), Deviation>,
) -> Result<u16, Deviation> {
    let before = test_host.greet()?.dropped_frames;
    action(test_host)?;
    Ok(test_host.greet()?.dropped_frames.wrapping_sub(before))
}

pub(super) fn garbage(test_host: &mut TestHost<'_>) -> Result<(), Deviation> {
    let long = [0x5A; 300];
    // Each piece, ended by the first 0 after it, is one frame to drop; the other two zeros end
    // empty frames, which do not count.
    let pieces: [&[u8]; 5] = [b"\x09\x01\x02", b"AT+GMR\r\n", &long, b"\x01", &[0xFF; 31]];
    let dropped = dropped_during(test_host, |test_host| {
        for piece in pieces {
            test_host.send_bytes(piece)?;
            test_host.send_bytes(&[0, 0, 0])?;
            test_host.sample()?;
        }
        Ok(())
    })?;
    ensure!(
        usize::from(dropped) == pieces.len(),
        "{} frames were garbage, but the device counted {dropped}",
        pieces.len()
    );
    Ok(())
}

pub(super) fn flipped_bits(test_host: &mut TestHost<'_>) -> Result<(), Deviation> {
    test_host.arm()?;
    let voltage_mv = 250;
    test_host.sample_armed()?;
    let bits = 8 * (test_host.act_request(1000).encode(0).as_bytes().len() - 1);
    for bit in 0..bits {
        let sequence = test_host.next_sequence();
        let mut broken = test_host.act_request(1000).encode(sequence).as_bytes().to_vec();
        broken[bit / 8] ^= 1 << (bit % 8);
        test_host.send_bytes(&broken)?;
        test_host.act(voltage_mv)?;
        let sample = test_host.sample_armed()?;
        ensure!(
            sample.applied_mv == motor_voltage_mv(motor_counts(voltage_mv)),
            "an act with bit {bit} flipped was carried out: {sample:?}"
        );
    }
    Ok(())
}

pub(super) fn truncated(test_host: &mut TestHost<'_>) -> Result<(), Deviation> {
    let nonce = test_host.greet()?.nonce;
    let sequence = test_host.next_sequence();
    let encoded = Request::Arm { nonce }.encode(sequence);
    let bytes = encoded.as_bytes();
    for length in 1..bytes.len() - 1 {
        // The first frame is cut off by a delimiter, the second one runs into the next frame.
        test_host.send_bytes(&bytes[..length])?;
        test_host.send_bytes(&[0])?;
        let sample = test_host.sample()?;
        ensure!(!sample.status.has(StatusBits::ARMED), "{length} bytes of an Arm armed the device");
        test_host.send_bytes(&bytes[..length])?;
        test_host.send(Request::Sample)?;
        test_host.sample()?;
    }
    Ok(())
}

pub(super) fn unknown(test_host: &mut TestHost<'_>) -> Result<(), Deviation> {
    test_host.greet()?;
    for message_type in UNKNOWN_TYPES {
        let sequence = test_host.next_sequence();
        test_host.send_bytes(EncodedFrame::new(message_type, sequence, &[1, 2]).as_bytes())?;
        let reason = RefusalReason::UnknownType;
        test_host.refusal_of(sequence, message_type, "a request of unknown type", reason)?;
    }
    for (message_type, length) in [(1, 0), (1, 3), (2, 3), (2, 5), (3, 1), (4, 2), (4, 25), (5, 1)]
    {
        let sequence = test_host.next_sequence();
        let frame = EncodedFrame::new(message_type, sequence, &[0; 25][..length]);
        test_host.send_bytes(frame.as_bytes())?;
        let reason = RefusalReason::WrongLength;
        test_host.refusal_of(sequence, message_type, "a request of another length", reason)?;
    }
    Ok(())
}

pub(super) fn reply_types(test_host: &mut TestHost<'_>) -> Result<(), Deviation> {
    let types = [0x80, 0x81, 0x83, 0x8F, 0xFF];
    let dropped = dropped_during(test_host, |test_host| {
        for message_type in types {
            let sequence = test_host.next_sequence();
            test_host.send_bytes(EncodedFrame::new(message_type, sequence, &[4, 2]).as_bytes())?;
            test_host.sample()?;
        }
        Ok(())
    })?;
    ensure!(
        usize::from(dropped) == types.len(),
        "{} frames were replies, but the device counted {dropped}",
        types.len()
    );
    Ok(())
}

pub(super) fn back_to_back(test_host: &mut TestHost<'_>) -> Result<(), Deviation> {
    test_host.greet()?;
    for _ in 0..10 {
        let (first, second) = (test_host.next_sequence(), test_host.next_sequence());
        let mut bytes = Request::Sample.encode(first).as_bytes().to_vec();
        bytes.extend_from_slice(Request::Disarm.encode(second).as_bytes());
        test_host.send_bytes(&bytes)?;
        let sample = test_host.reply_to(first, "Sample")?;
        ensure!(matches!(sample, Reply::Sample(_)), "Sample was answered with {sample:?}");
        let disarm = test_host.reply_to(second, "Disarm")?;
        ensure!(matches!(disarm, Reply::Disarm(_)), "Disarm was answered with {disarm:?}");
    }
    Ok(())
}
