use serde::{Deserialize, Serialize};

/// The watchdog of a board behind the vendor's library, as `check` has measured it; `[watchdog]` in
/// `qube.toml`. It is measured only if the motor really went off: after the program had fallen
/// silent, the arm turned no farther than after a push that the program itself had ended.
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
