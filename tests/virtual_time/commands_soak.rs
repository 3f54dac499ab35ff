//! Tests the command `soak` with minutes of ticks in virtual time: no tick is lost, and the memory
//! does not grow. `scripts/durability soak` runs a day of them.

use std::process::Command;

use serde_json::Value;

#[test]
fn minutes_of_ticks_drop_none_and_keep_no_memory() {
    let output = Command::new(env!("CARGO_BIN_EXE_qube-hil"))
        .args(["soak", "--clock", "virtual", "--hours", "0.05", "--json"])
        .output()
        .expect("it runs");
    assert!(output.status.success(), "{output:?}");
    let text = String::from_utf8(output.stdout).expect("UTF-8");
    let result: Value =
        serde_json::from_str(text.lines().last().unwrap_or_default()).expect("JSON");
    assert!(result["ticks"].as_u64() >= Some(18_000), "{result}");
    assert_eq!(result["ended_by"], Value::Null, "{result}");
    for nothing in ["lost", "missed_deadlines", "void"] {
        assert_eq!(result[nothing], 0, "{result}");
    }
    assert!(result["growth_bytes"].as_i64() < Some(5_000_000), "{result}");
}
