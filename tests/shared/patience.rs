use std::time::Duration;

/// Longest wait of a test for another process or thread: longer than any busy computer needs, so
/// that only a hang exceeds it.
pub const PATIENCE: Duration = Duration::from_secs(600);
