//! Rollouts as MCAP files: schemas, the writer thread, the reader, recovery after a crash.
//!
//! May import `telemetry`, `qube`, `storage`.
//!
//! One file holds one rollout: who, when and how (metadata), the policy (an attachment), every tick
//! (six channels of flat JSON), how it ended (metadata). A rollout can be run again with nothing
//! but its own file, and what is read back is bit for bit what was recorded.
//!
//! Metadata and policy come first and ticks follow in blocks of a tenth of a second, each
//! compressed, checksummed and handed to the operating system as a whole: a process that is killed
//! loses at most the last quarter of a second. A file that ended properly closes with its outcome,
//! an index and checksums over every byte, so a cut-off file is never taken for a whole one and a
//! changed byte is found.

mod error;
mod metadata;
mod not_finite;
mod reader;
mod recorder;
mod recover;
mod return_of;
mod scan;
mod scene;
mod tick_messages;
mod wire_format;
mod writer;

pub use error::{RecordingError, Unreadable};
pub use reader::{Completeness, Recording, parse, read, read_on};
pub use recorder::Recorder;
pub use recover::{Recovered, recover};
pub use return_of::return_of;
pub use writer::{RolloutWriter, Sink};

/// The version that [`crate::telemetry::RolloutHeader::format`] carries in files of this program.
pub const FORMAT_VERSION: u32 = 1;

/// Name of the attachment that holds the policy file.
pub const POLICY_ATTACHMENT: &str = "policy.safetensors";

/// Name of the attachment with the last second before a fault: one JSON object a line, a tick each.
pub const LAST_TICKS_ATTACHMENT: &str = "last-ticks.jsonl";

#[cfg(test)]
pub(crate) mod samples;
#[cfg(test)]
mod tests;
