//! Tests the command `soak` with minutes of ticks in virtual time: no tick is lost, and the memory
//! does not grow. `scripts/durability soak` runs a day of them.
//!
//! A day has 8 640 000 ticks, in which the memory may grow by 5 MB. The test has 108 000 ticks,
//! most of them after the warm-up; it fails even if only 8 bytes of each tick are kept.

use serde_json::Value;

use crate::program::succeeds;

/// Largest accepted growth of the memory after the warm-up, bytes.
const MOST_BYTES: i64 = 500_000;

#[test]
fn minutes_of_ticks_drop_none_and_keep_no_memory() {
    let directory = tempfile::tempdir().unwrap();
    let soak = ["soak", "--clock", "virtual", "--hours", "0.3", "--json"];
    let text = succeeds(directory.path(), &soak);
    let result: Value =
        serde_json::from_str(text.lines().last().unwrap_or_default()).expect("JSON");
    assert!(result["ticks"].as_u64() >= Some(108_000), "{result}");
    assert_eq!(result["ended_by"], Value::Null, "{result}");
    for count in ["lost", "missed_deadlines", "void"] {
        assert_eq!(result[count], 0, "{result}");
    }
    let growth_bytes = result["growth_bytes"].as_i64().expect("more rollouts than the warm-up");
    println!("the memory grew by {growth_bytes} bytes");
    assert!(growth_bytes < MOST_BYTES, "{result}");
}
