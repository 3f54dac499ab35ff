use serde::{Deserialize, Serialize};

/// The measured watchdog of a card behind the vendor's library; `[watchdog]` in `qube.toml`. The motor was seen to
/// go off: the arm turned no farther than when the push was ended by the program.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LibraryWatchdog {
    /// Time from the last act until the library called its watchdog expired, ms.
    pub expired_ms: f64,
    /// Date of the check, as year-month-day.
    pub date: String,
    /// Serial number of the board in the check.
    pub board: String,
}
