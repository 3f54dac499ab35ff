//! Tests the command `soak` with minutes of ticks in virtual time: no tick is lost, and the memory
//! does not grow. `scripts/durability soak` runs a day of them.

use serde_json::Value;

use crate::program::succeeds;

#[test]
fn minutes_of_ticks_drop_none_and_keep_no_memory() {
    let directory = tempfile::tempdir().unwrap();
    let soak = ["soak", "--clock", "virtual", "--hours", "0.05", "--json"];
    let text = succeeds(directory.path(), &soak);
    let result: Value =
        serde_json::from_str(text.lines().last().unwrap_or_default()).expect("JSON");
    assert!(result["ticks"].as_u64() >= Some(18_000), "{result}");
    assert_eq!(result["ended_by"], Value::Null, "{result}");
    for nothing in ["lost", "missed_deadlines", "void"] {
        assert_eq!(result[nothing], 0, "{result}");
    }
    assert!(result["growth_bytes"].as_i64() < Some(5_000_000), "{result}");
}
