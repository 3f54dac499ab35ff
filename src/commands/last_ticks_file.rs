use std::fs::File;
use std::io::{self, Write};
use std::path::PathBuf;

use crate::clock::since_1970;
use crate::telemetry::TickRecord;

/// Writes ticks to a new file among the temporary files, one tick a line, and returns its path. It
/// keeps the end of a homing, which has no recording.
pub fn write_last_ticks(ticks: &[TickRecord]) -> io::Result<PathBuf> {
    let since_1970 = since_1970().unwrap_or_default();
    // Two programs whose homing ends in the same millisecond have files of their own.
    let (time_ms, program) = (since_1970.as_millis(), std::process::id());
    let name = format!("qube-hil-homing-{time_ms}-{program}.jsonl");
    let path = std::env::temp_dir().join(name);
    let lines = ticks.iter().map(|tick| format!("{}\n", serde_json::json!(tick)));
    let text: String = lines.collect();
    File::create_new(&path)?.write_all(text.as_bytes())?;
    Ok(path)
}
