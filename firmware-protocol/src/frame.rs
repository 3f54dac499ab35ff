use core::fmt;

use crc::{CRC_16_IBM_SDLC, Crc};

/// Largest payload of a message, bytes: the payload of the sample reply.
pub const MAX_PAYLOAD_BYTES: usize = 25;

/// Bytes of type and sequence number, which precede the payload.
const HEADER_BYTES: usize = 3;
const CRC_BYTES: usize = 2;
const MAX_BODY_BYTES: usize = HEADER_BYTES + MAX_PAYLOAD_BYTES + CRC_BYTES;
/// Largest body after COBS, bytes: COBS adds one byte to any body of this protocol.
const MAX_ENCODED_BYTES: usize = MAX_BODY_BYTES + 1;

/// Largest frame on the wire with its closing 0x00, bytes: 32, which take 640 microseconds.
pub const MAX_FRAME_BYTES: usize = MAX_ENCODED_BYTES + 1;

const DELIMITER: u8 = 0;
const CRC: Crc<u16> = Crc::<u16>::new(&CRC_16_IBM_SDLC);

/// A valid frame whose message has not been parsed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Frame {
    /// The message's type.
    pub message_type: u8,
    /// The sequence number.
    pub sequence: u16,
    payload: [u8; MAX_PAYLOAD_BYTES],
    payload_length: usize,
}

impl Frame {
    /// The payload: the bytes between sequence number and checksum.
    #[must_use]
    pub fn payload(&self) -> &[u8] {
        &self.payload[..self.payload_length]
    }
}

/// Bytes ready for the wire: the body under COBS (consistent-overhead byte stuffing, which leaves
/// no 0x00 in it), closed by 0x00.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct EncodedFrame {
    bytes: [u8; MAX_FRAME_BYTES],
    length: usize,
}

impl EncodedFrame {
    /// The bytes to send, in order.
    #[must_use]
    pub fn as_bytes(&self) -> &[u8] {
        &self.bytes[..self.length]
    }

    /// Encodes any type and payload, also those that no message has, so that tests can send invalid
    /// frames. Payload beyond [`MAX_PAYLOAD_BYTES`] is dropped.
    #[must_use]
    pub fn new(message_type: u8, sequence: u16, payload: &[u8]) -> Self {
        let payload = &payload[..payload.len().min(MAX_PAYLOAD_BYTES)];
        let mut body = [0; MAX_BODY_BYTES];
        let crc_at = HEADER_BYTES + payload.len();
        let body_length = crc_at + CRC_BYTES;
        body[0] = message_type;
        body[1..HEADER_BYTES].copy_from_slice(&sequence.to_le_bytes());
        body[HEADER_BYTES..crc_at].copy_from_slice(payload);
        let checksum = CRC.checksum(&body[..crc_at]);
        body[crc_at..body_length].copy_from_slice(&checksum.to_le_bytes());

        let mut bytes = [0; MAX_FRAME_BYTES];
        let encoded = cobs::encode(&body[..body_length], &mut bytes);
        bytes[encoded] = DELIMITER;
        Self { bytes, length: encoded + 1 }
    }
}

impl fmt::Debug for EncodedFrame {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        for byte in self.as_bytes() {
            write!(formatter, "{byte:02x} ")?;
        }
        Ok(())
    }
}

/// The reason why bytes between two delimiters are not a frame. A receiver drops such bytes without
/// a reply; a device also counts a dropped frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FrameError {
    /// The frame is longer than the largest frame of this protocol.
    TooLong,
    /// The bytes are not COBS, or are fewer than in the smallest frame.
    Garbled,
    /// The checksum in the frame is not the checksum of the frame's content.
    Checksum,
}

/// Splits a stream of bytes into frames. The decoder takes one byte at a time, does no I/O, and
/// accepts any bytes.
#[derive(Clone, Debug)]
pub struct Decoder {
    buffer: [u8; MAX_ENCODED_BYTES],
    /// Bytes since the last delimiter, counted up to one more than the buffer holds.
    length: usize,
}

impl Default for Decoder {
    fn default() -> Self {
        Self::new()
    }
}

impl Decoder {
    /// A decoder at the beginning of a frame.
    #[must_use]
    pub const fn new() -> Self {
        Self { buffer: [0; MAX_ENCODED_BYTES], length: 0 }
    }

    /// Takes one byte. At a delimiter, returns the frame before it or the reason why the bytes
    /// before it are no frame; otherwise, and if no bytes precede the delimiter, returns `None`.
    pub fn push(&mut self, byte: u8) -> Option<Result<Frame, FrameError>> {
        if byte != DELIMITER {
            if let Some(place) = self.buffer.get_mut(self.length) {
                *place = byte;
            }
            self.length = (self.length + 1).min(MAX_ENCODED_BYTES + 1);
            return None;
        }
        let length = core::mem::take(&mut self.length);
        match length {
            0 => None,
            1..=MAX_ENCODED_BYTES => Some(decode(&mut self.buffer[..length])),
            _ => Some(Err(FrameError::TooLong)),
        }
    }

    /// Drops the bytes since the last delimiter.
    pub fn reset(&mut self) {
        self.length = 0;
    }
}

fn decode(encoded: &mut [u8]) -> Result<Frame, FrameError> {
    let body_length = cobs::decode_in_place(encoded).map_err(|_| FrameError::Garbled)?;
    let body = encoded.get(..body_length).ok_or(FrameError::Garbled)?;
    let (content, checksum) = body.split_last_chunk::<CRC_BYTES>().ok_or(FrameError::Garbled)?;
    let (header, payload) =
        content.split_first_chunk::<HEADER_BYTES>().ok_or(FrameError::Garbled)?;
    if CRC.checksum(content) != u16::from_le_bytes(*checksum) {
        return Err(FrameError::Checksum);
    }
    let mut frame = Frame {
        message_type: header[0],
        sequence: u16::from_le_bytes([header[1], header[2]]),
        payload: [0; MAX_PAYLOAD_BYTES],
        payload_length: payload.len(),
    };
    frame.payload.get_mut(..payload.len()).ok_or(FrameError::TooLong)?.copy_from_slice(payload);
    Ok(frame)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn feed(decoder: &mut Decoder, bytes: &[u8]) -> Option<Result<Frame, FrameError>> {
        bytes.iter().fold(None, |last, &byte| decoder.push(byte).or(last))
    }

    #[test]
    fn the_checksum_is_crc_16_ibm_sdlc() {
        assert_eq!(CRC.checksum(b"123456789"), 0x906E);
    }

    #[test]
    fn the_largest_frame_fills_the_buffer_and_comes_back() {
        let payload = [0xAB; MAX_PAYLOAD_BYTES];
        let encoded = EncodedFrame::new(0x83, 0x0100, &payload);
        assert_eq!(encoded.as_bytes().len(), MAX_FRAME_BYTES);
        let frame = feed(&mut Decoder::new(), encoded.as_bytes()).unwrap().unwrap();
        assert_eq!((frame.message_type, frame.sequence), (0x83, 0x0100));
        assert_eq!(frame.payload(), payload);
    }

    #[test]
    fn every_flipped_bit_is_found_and_the_next_frame_is_read() {
        let encoded = EncodedFrame::new(0x04, 77, &[0x00, 0x10]);
        let bytes = encoded.as_bytes();
        for bit in 0..8 * (bytes.len() - 1) {
            let mut broken = [0; MAX_FRAME_BYTES];
            broken[..bytes.len()].copy_from_slice(bytes);
            broken[bit / 8] ^= 1 << (bit % 8);
            let mut decoder = Decoder::new();
            for &byte in &broken[..bytes.len()] {
                assert!(!matches!(decoder.push(byte), Some(Ok(_))), "bit {bit}");
            }
            assert!(matches!(feed(&mut decoder, bytes), Some(Ok(_))), "bit {bit}");
        }
    }

    #[test]
    fn too_long_and_too_short_are_told_apart_and_empty_is_nothing() {
        let mut decoder = Decoder::new();
        assert_eq!(feed(&mut decoder, &[0, 0, 0]), None);
        assert_eq!(feed(&mut decoder, &[1; 5000]), None);
        assert_eq!(decoder.push(0), Some(Err(FrameError::TooLong)));
        assert_eq!(feed(&mut decoder, &[3, 1, 2, 0]), Some(Err(FrameError::Garbled)));
        assert_eq!(feed(&mut decoder, &[9, 1, 2, 0]), Some(Err(FrameError::Garbled)));
    }

    #[test]
    fn a_reset_forgets_half_a_frame() {
        let encoded = EncodedFrame::new(0x03, 1, &[]);
        let mut decoder = Decoder::new();
        feed(&mut decoder, &[7, 7, 7]);
        decoder.reset();
        assert!(matches!(feed(&mut decoder, encoded.as_bytes()), Some(Ok(_))));
    }
}
