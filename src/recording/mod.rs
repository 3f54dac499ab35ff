//! Rollouts as MCAP files: schemas, the writer thread, the reader, recovery after a crash.
//!
//! One file holds one rollout: its origin and settings (metadata), the policy (an attachment),
//! every tick (five channels of flat JSON; for 3-D viewers a channel of frames as Protocol
//! Buffers), the bodies that these viewers draw (one message), after a fault the ticks of the last
//! second once more (an attachment), and its ending (metadata). A rollout can be replayed from its
//! own file alone, and [`read`] returns the recorded data bit for bit.
//!
//! Metadata and policy come first, then a block (a chunk, in the words of MCAP) that declares the
//! channels. Ticks follow in blocks of at most a tenth of a second. Each block is compressed and
//! checksummed, and the writer hands it to the operating system as a whole, so a killed process
//! loses at most the last quarter of a second. A file that ended properly closes with its outcome,
//! an index and checksums over every byte: a truncated file is never taken for a complete one, and
//! any changed byte is found.
//!
//! The room may import `telemetry`, `qube` and `storage`.
//!
//! ```
//! use std::path::Path;
//!
//! use qube_hil::recording::{Completeness, read};
//!
//! let path = Path::new("tests/fixtures/left_the_speed_envelope.mcap");
//! let recording = read(path)?;
//! assert_eq!(recording.completeness, Completeness::Whole);
//! assert!(!recording.lacks_ticks());
//! for tick in recording.ticks.iter().take(3) {
//!     println!("{}: {:.3} rad, {} mV", tick.tick, tick.state.alpha, tick.voltage_mv);
//! }
//! # Ok::<(), qube_hil::recording::RecordingError>(())
//! ```

mod channels;
mod error;
mod metadata;
mod not_finite;
mod protobuf;
mod reader;
mod recorder;
mod recover;
mod scan;
mod scene;
mod table;
mod tick_messages;
mod viewer;
mod wire_format;
mod writer;

pub use channels::{Channel, ChannelSchema, encode_ending, encode_scene, encode_tick};
pub use error::{RecordingError, Unreadable};
pub use reader::{Completeness, Recording, is_recording, parse, read, read_on};
pub use recorder::Recorder;
pub use recover::{Recovered, recover};
pub use table::{COLUMNS, Field, column, csv_table, table_rows};
pub use viewer::Viewer;
pub use writer::{RolloutWriter, Sink};

/// The format's version, which this program writes into
/// [`crate::telemetry::RolloutHeader::format`].
pub const FORMAT_VERSION: u32 = 1;

/// Time that stands for the start of a rollout under a virtual clock, ns since 1970: the first
/// instant of 2000. A fixed start gives equal rollouts equal bytes; the date that viewers show is
/// meaningless, and the metadata record `clock` says so.
pub const VIRTUAL_EPOCH_UNIX_NS: u64 = 946_684_800_000_000_000;

/// Name of the attachment that holds the policy file.
pub const POLICY_ATTACHMENT: &str = "policy.safetensors";

/// Name of the attachment with the ticks of the last second before a fault: one JSON object for
/// each tick, each on its own line.
pub const LAST_TICKS_ATTACHMENT: &str = "last-ticks.jsonl";

#[cfg(test)]
mod disk_tests;
#[cfg(test)]
mod other_reader_tests;
#[cfg(test)]
pub(crate) mod samples;
#[cfg(test)]
mod tests;
