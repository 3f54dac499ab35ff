use std::time::Duration;

use serde::{Deserialize, Serialize};

/// Version of the format of a folder's files.
const FORMAT: u32 = 1;

/// The name and version of this program and the revision of its source.
#[must_use]
pub fn program() -> String {
    format!("qube-hil {} ({})", env!("CARGO_PKG_VERSION"), env!("QUBE_HIL_GIT_REVISION"))
}

/// The settings that all processes of a folder share.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Terms {
    /// Version of the format of the folder's files.
    pub format: u32,
    /// Name, version and source revision of the program, as [`program`] gives them.
    pub program: String,
    /// Time between two beats of a process, ms.
    pub beat_ms: u64,
    /// Time without a beat after which a process counts as dead, ms.
    pub stale_ms: u64,
    /// Number of failed tries after which a job is given up.
    pub tries: u32,
    /// True if a person starts the workers, so that nobody replaces one that has ended: workers
    /// then stay while the coordinator lives, also without work.
    #[serde(default)]
    pub by_hand: bool,
}

impl Default for Terms {
    /// The default terms: a process counts as dead after a minute without a beat, and a job is
    /// given up after three failed tries.
    fn default() -> Self {
        Self::new(Duration::from_secs(60), 3)
    }
}

/// Number of beats in the time after which a process counts as dead. A shared file system may show
/// some of them late.
const BEATS_BEFORE_STALE: u64 = 12;

impl Terms {
    /// The terms under which this program's processes count as dead after the time `stale`, and a
    /// job is given up after `tries` failed tries. Workers end when they have no work.
    #[must_use]
    pub fn new(stale: Duration, tries: u32) -> Self {
        let stale_ms = stale.as_millis() as u64;
        let beat_ms = stale_ms / BEATS_BEFORE_STALE;
        Self { format: FORMAT, program: program(), beat_ms, stale_ms, tries, by_hand: false }
    }

    /// Returns whether processes of this program can work under these terms.
    #[must_use]
    pub fn are_of_this_program(&self) -> bool {
        self.program == program() && self.format == FORMAT
    }

    /// Time between two beats of a process.
    #[must_use]
    pub fn beat(&self) -> Duration {
        Duration::from_millis(self.beat_ms.max(1))
    }

    /// Time without a beat after which a process counts as dead.
    #[must_use]
    pub fn stale(&self) -> Duration {
        Duration::from_millis(self.stale_ms)
    }
}
