//! The wire between a computer and the microcontroller at a Quanser Qube: messages, framing,
//! scaling, version.
//!
//! Host and emulator share this code of the wire, and no other. The microcontroller's program is
//! tested against `golden.txt`, and its `wire.h` is generated from this crate. The crate does no
//! I/O, keeps no clock, allocates nothing and imports nothing of the project.
//!
//! ```
//! use firmware_protocol::{Decoder, Request};
//!
//! let act = Request::Act { voltage_mv: -1500, sampled_at_us: 250_000 };
//! let encoded = act.encode(7);
//! let mut decoder = Decoder::new();
//! let frame = encoded.as_bytes().iter().find_map(|&byte| decoder.push(byte)).unwrap().unwrap();
//! assert_eq!(frame.sequence, 7);
//! assert_eq!(Request::parse(&frame), Ok(act));
//! ```
#![no_std]

mod fields;
mod frame;
mod reply;
mod request;
pub mod scaling;
mod sequence;
mod timing;

pub use frame::{Decoder, EncodedFrame, Frame, FrameError, MAX_FRAME_BYTES, MAX_PAYLOAD_BYTES};
pub use reply::{
    DeviceKind, DeviceState, DisarmReply, HelloReply, RefusalReason, Reply, SampleReply, StatusBits,
};
pub use request::{ParseError, Request};
pub use sequence::{answers_fresh_sample, is_newer};
pub use timing::{
    BAUD_RATE, BITS_PER_BYTE, MAX_SAMPLE_AGE_US, NO_ACT_US, WATCHDOG_MS, WATCHDOG_POLL_MS,
};

/// The version of this protocol. It is raised whenever the meaning of anything in `PROTOCOL.md`
/// changes.
pub const PROTOCOL_VERSION: u16 = 2;

/// Module id in the first two SPI bytes of a Qube; any other value means that there is no Qube.
pub const QUBE_MODULE_ID: u16 = 0x0309;
