use std::time::{Duration, SystemTime, UNIX_EPOCH};

/// Time since 1970 by the computer's calendar clock; `None` if that clock shows an earlier time. It
/// may go backwards, so it dates files and records and measures nothing.
#[must_use]
pub fn since_1970() -> Option<Duration> {
    SystemTime::now().duration_since(UNIX_EPOCH).ok()
}
