use serde::{Deserialize, Serialize};

/// The measured watchdog of a board behind the vendor's library; `[watchdog]` in `qube.toml`. The
/// check also shows that the motor goes off: the arm turned no farther than after a push that the
/// program ended.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LibraryWatchdog {
    /// Time from the last act until the library reported that its watchdog had expired, ms.
    pub expired_ms: f64,
    /// Date of the check, as year-month-day.
    pub date: String,
    /// Serial number of the board in the check.
    pub board: String,
}
