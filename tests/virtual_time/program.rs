//! Runs the program as a user does.

use std::path::Path;
use std::process::Output;

use assert_cmd::Command;

use crate::shared::command_in;

/// The program in a working directory that is also its user's home, so that it writes nowhere else.
pub fn program(directory: &Path) -> Command {
    Command::from_std(command_in(directory))
}

/// Runs the program to its end.
pub fn qube_hil(directory: &Path, arguments: &[&str]) -> Output {
    program(directory).args(arguments).output().expect("the program runs")
}

/// Checks that the program has succeeded; returns its output on stdout.
#[track_caller]
pub fn succeeded(output: &Output) -> String {
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout.clone()).expect("UTF-8")
}

/// Runs the program, which must succeed; returns its output on stdout.
#[track_caller]
pub fn succeeds(directory: &Path, arguments: &[&str]) -> String {
    println!("{arguments:?}");
    succeeded(&qube_hil(directory, arguments))
}

/// Checks that the program has refused: its exit code, silence on stdout, and each word on stderr.
#[track_caller]
pub fn has_refused(output: &Output, code: i32, words: &[&str]) {
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(code), "{stderr}");
    assert!(output.stdout.is_empty(), "the program printed a result");
    for word in words {
        assert!(stderr.contains(word), "{word:?} is missing in: {stderr}");
    }
}

/// Runs the program, which must refuse; see [`has_refused`].
#[track_caller]
pub fn refused(directory: &Path, arguments: &[&str], code: i32, words: &[&str]) {
    println!("{arguments:?}");
    has_refused(&qube_hil(directory, arguments), code, words);
}
