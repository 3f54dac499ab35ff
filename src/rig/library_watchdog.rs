use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize};

use super::file_date::date;

/// Longest accepted time until a watchdog expires, ms.
const LONGEST_MS: f64 = 60_000.0;

/// The watchdog of a board behind the vendor's library, as `check` has measured it; `[watchdog]` in
/// `qube.toml`. It is measured only if the motor really went off: after the program had fallen
/// silent, the arm turned not much farther than after a push that the program itself had ended.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LibraryWatchdog {
    /// Time from the last act until the library reported that its watchdog had expired, ms.
    #[serde(deserialize_with = "milliseconds")]
    pub expired_ms: f64,
    /// Date of the check, as year-month-day.
    #[serde(deserialize_with = "date")]
    pub date: String,
    /// Serial number of the board in the check.
    pub board: String,
}

fn milliseconds<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    let value = f64::deserialize(deserializer)?;
    if (0.0..=LONGEST_MS).contains(&value) {
        Ok(value)
    } else {
        Err(D::Error::custom(format!("{value}: give a number from 0 to {LONGEST_MS} ms")))
    }
}
