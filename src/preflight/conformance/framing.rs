use firmware_protocol::scaling::{motor_counts, motor_voltage_mv};
use firmware_protocol::{EncodedFrame, RefusalReason, Reply, Request, StatusBits};

use super::{Deviation, Speaker, ensure};

const UNKNOWN_TYPES: [u8; 4] = [0x00, 0x06, 0x42, 0x7F];

/// Greets the device, runs an action, and returns the number of frames that the device has dropped
/// meanwhile.
fn dropped_during(
    speaker: &mut Speaker<'_>,
    happens: impl FnOnce(&mut Speaker<'_>) -> Result<(), Deviation>,
) -> Result<u16, Deviation> {
    let before = speaker.greet()?.dropped_frames;
    happens(speaker)?;
    Ok(speaker.greet()?.dropped_frames.wrapping_sub(before))
}

pub(super) fn garbage(speaker: &mut Speaker<'_>) -> Result<(), Deviation> {
    let long = [0x5A; 300];
    // Each piece, ended by the first 0 after it, is one frame to drop; the other two zeros end
    // empty frames, which do not count.
    let pieces: [&[u8]; 5] = [b"\x09\x01\x02", b"AT+GMR\r\n", &long, b"\x01", &[0xFF; 31]];
    let dropped = dropped_during(speaker, |speaker| {
        for piece in pieces {
            speaker.send_bytes(piece)?;
            speaker.send_bytes(&[0, 0, 0])?;
            speaker.sample()?;
        }
        Ok(())
    })?;
    ensure!(
        usize::from(dropped) == pieces.len(),
        "{} frames were garbage, it counted {dropped}",
        pieces.len()
    );
    Ok(())
}

pub(super) fn flipped_bits(speaker: &mut Speaker<'_>) -> Result<(), Deviation> {
    speaker.arm()?;
    let voltage_mv = 250;
    speaker.sample_armed()?;
    let bits = 8 * (speaker.act_request(1000).encode(0).as_bytes().len() - 1);
    for bit in 0..bits {
        let sequence = speaker.next_sequence();
        let mut broken = speaker.act_request(1000).encode(sequence).as_bytes().to_vec();
        broken[bit / 8] ^= 1 << (bit % 8);
        speaker.send_bytes(&broken)?;
        speaker.act(voltage_mv)?;
        let sample = speaker.sample_armed()?;
        ensure!(
            sample.applied_mv == motor_voltage_mv(motor_counts(voltage_mv)),
            "an act with bit {bit} flipped was carried out: {sample:?}"
        );
    }
    Ok(())
}

pub(super) fn truncated(speaker: &mut Speaker<'_>) -> Result<(), Deviation> {
    let nonce = speaker.greet()?.nonce;
    let sequence = speaker.next_sequence();
    let encoded = Request::Arm { nonce }.encode(sequence);
    let bytes = encoded.as_bytes();
    for length in 1..bytes.len() - 1 {
        // First a frame that a delimiter cuts off, then one that runs into the next frame.
        speaker.send_bytes(&bytes[..length])?;
        speaker.send_bytes(&[0])?;
        let sample = speaker.sample()?;
        ensure!(!sample.status.has(StatusBits::ARMED), "{length} bytes of an Arm armed it");
        speaker.send_bytes(&bytes[..length])?;
        speaker.send(Request::Sample)?;
        speaker.sample()?;
    }
    Ok(())
}

pub(super) fn unknown(speaker: &mut Speaker<'_>) -> Result<(), Deviation> {
    speaker.greet()?;
    for message_type in UNKNOWN_TYPES {
        let sequence = speaker.next_sequence();
        speaker.send_bytes(EncodedFrame::new(message_type, sequence, &[1, 2]).as_bytes())?;
        let reason = RefusalReason::UnknownType;
        speaker.refusal_of(sequence, message_type, "a request of unknown type", reason)?;
    }
    for (message_type, length) in [(1, 0), (1, 3), (2, 3), (2, 5), (3, 1), (4, 2), (4, 25), (5, 1)]
    {
        let sequence = speaker.next_sequence();
        let frame = EncodedFrame::new(message_type, sequence, &[0; 25][..length]);
        speaker.send_bytes(frame.as_bytes())?;
        let reason = RefusalReason::WrongLength;
        speaker.refusal_of(sequence, message_type, "a request of another length", reason)?;
    }
    Ok(())
}

pub(super) fn reply_types(speaker: &mut Speaker<'_>) -> Result<(), Deviation> {
    let types = [0x80, 0x81, 0x83, 0x8F, 0xFF];
    let dropped = dropped_during(speaker, |speaker| {
        for message_type in types {
            let sequence = speaker.next_sequence();
            speaker.send_bytes(EncodedFrame::new(message_type, sequence, &[4, 2]).as_bytes())?;
            speaker.sample()?;
        }
        Ok(())
    })?;
    ensure!(
        usize::from(dropped) == types.len(),
        "{} frames were replies, it counted {dropped}",
        types.len()
    );
    Ok(())
}

pub(super) fn back_to_back(speaker: &mut Speaker<'_>) -> Result<(), Deviation> {
    speaker.greet()?;
    for _ in 0..10 {
        let (first, second) = (speaker.next_sequence(), speaker.next_sequence());
        let mut bytes = Request::Sample.encode(first).as_bytes().to_vec();
        bytes.extend_from_slice(Request::Disarm.encode(second).as_bytes());
        speaker.send_bytes(&bytes)?;
        let sample = speaker.reply_to(first, "Sample")?;
        ensure!(matches!(sample, Reply::Sample(_)), "Sample was answered with {sample:?}");
        let disarm = speaker.reply_to(second, "Disarm")?;
        ensure!(matches!(disarm, Reply::Disarm(_)), "Disarm was answered with {disarm:?}");
    }
    Ok(())
}
