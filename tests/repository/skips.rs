//! Tests how a test reports that it is skipped.

use std::process::{Command, Output};

use crate::shared::say_skipped;

const REQUIRED: &str = "QUBE_HIL_REQUIRE_AN_EXAMPLE";

#[test]
#[ignore = "run by the test below, in a process of its own"]
fn an_example_is_skipped() {
    say_skipped("an example", "it needs nothing", &[REQUIRED]);
}

/// Runs the example above as `cargo test` does, which hides the output of a test that passes.
fn example(required: &str) -> Output {
    let mut test = Command::new(std::env::current_exe().unwrap());
    test.args(["skips::an_example_is_skipped", "--exact", "--ignored"]).env(REQUIRED, required);
    test.output().unwrap()
}

#[test]
fn a_skip_is_shown_although_its_test_passes_and_fails_where_the_test_is_required() {
    let output = example("");
    let told = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{told}");
    assert!(told.contains("\nSKIPPED: an example. it needs nothing\n"), "{told}");

    let output = example("1");
    let told = String::from_utf8_lossy(&output.stdout);
    assert!(!output.status.success(), "{told}");
    assert!(told.contains("QUBE_HIL_REQUIRE_AN_EXAMPLE requires an example, but: it"), "{told}");
}
