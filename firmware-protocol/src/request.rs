use core::fmt;

use crate::EncodedFrame;
use crate::Frame;
use crate::fields::{Reader, Writer};

const HELLO: u8 = 0x01;
const ARM: u8 = 0x02;
const SAMPLE: u8 = 0x03;
const ACT: u8 = 0x04;
const DISARM: u8 = 0x05;

/// A message from the computer to the device.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Request {
    /// Asks for the device's identity, and switches the motor off in any state.
    Hello {
        /// Protocol version of the computer.
        protocol_version: u16,
    },
    /// Lets the amplifier follow acts, starting at 0 V.
    Arm {
        /// Nonce from the last hello or disarm reply; valid for one `Arm` request.
        nonce: u32,
    },
    /// Asks for one sample.
    Sample,
    /// Sets the motor voltage. The device sends no answer to an act that it accepts, and a refusal
    /// to one that it does not.
    Act {
        /// Voltage in mV, -5000 to 5000.
        voltage_mv: i16,
        /// `device_time_us` of the sample from which the voltage was decided.
        sampled_at_us: u32,
    },
    /// Switches the amplifier off.
    Disarm,
}

/// The reason why a valid frame is not a message; each variant holds the frame's type.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ParseError {
    /// No message in this direction has the type.
    UnknownType(u8),
    /// The payload is longer or shorter than that of a message of the type.
    WrongLength(u8),
    /// A field of the payload holds a value that has no meaning.
    BadField(u8),
}

impl fmt::Display for ParseError {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::UnknownType(message_type) => {
                write!(formatter, "no message has the type 0x{message_type:02x}")
            }
            Self::WrongLength(message_type) => {
                write!(formatter, "a message of type 0x{message_type:02x} has the wrong length")
            }
            Self::BadField(message_type) => {
                write!(formatter, "a message of type 0x{message_type:02x} has a meaningless field")
            }
        }
    }
}

impl core::error::Error for ParseError {}

impl Request {
    /// The request's type on the wire.
    #[must_use]
    pub fn message_type(&self) -> u8 {
        match self {
            Self::Hello { .. } => HELLO,
            Self::Arm { .. } => ARM,
            Self::Sample => SAMPLE,
            Self::Act { .. } => ACT,
            Self::Disarm => DISARM,
        }
    }

    /// Encodes the request with this sequence number.
    #[must_use]
    pub fn encode(&self, sequence: u16) -> EncodedFrame {
        let mut payload = Writer::new();
        match *self {
            Self::Hello { protocol_version } => payload.put(protocol_version.to_le_bytes()),
            Self::Arm { nonce } => payload.put(nonce.to_le_bytes()),
            Self::Act { voltage_mv, sampled_at_us } => {
                payload.put(voltage_mv.to_le_bytes());
                payload.put(sampled_at_us.to_le_bytes());
            }
            Self::Sample | Self::Disarm => {}
        }
        EncodedFrame::new(self.message_type(), sequence, payload.as_bytes())
    }

    /// Parses the request in a frame.
    ///
    /// # Errors
    /// Fails on a type that no request has, or a payload of another length than the type's.
    pub fn parse(frame: &Frame) -> Result<Self, ParseError> {
        let mut fields = Reader::new(frame.payload());
        let (length, request) = match frame.message_type {
            HELLO => (2, Self::Hello { protocol_version: fields.u16() }),
            ARM => (4, Self::Arm { nonce: fields.u32() }),
            SAMPLE => (0, Self::Sample),
            ACT => (6, Self::Act { voltage_mv: fields.i16(), sampled_at_us: fields.u32() }),
            DISARM => (0, Self::Disarm),
            other => return Err(ParseError::UnknownType(other)),
        };
        if frame.payload().len() == length {
            Ok(request)
        } else {
            Err(ParseError::WrongLength(frame.message_type))
        }
    }
}
