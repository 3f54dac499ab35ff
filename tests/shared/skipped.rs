//! Reports tests that are skipped.

use std::fmt::Display;
use std::io::Write;

/// Prints that tests are skipped, and the reason. Panics instead if one of these variables of the
/// environment, which require the tests, is set to more than the empty text.
#[track_caller]
pub fn say_skipped(tests: &str, reason: impl Display, variables: &[&str]) {
    let is_set = |name: &&&str| std::env::var_os(name).is_some_and(|value| !value.is_empty());
    if let Some(variable) = variables.iter().find(is_set) {
        panic!("{variable} requires {tests}, but: {reason}");
    }
    // Not with eprintln, whose text the test harness hides if the test passes.
    let _ = writeln!(std::io::stderr(), "\nSKIPPED: {tests}. {reason}");
}
