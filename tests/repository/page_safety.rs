//! Tests that every promise in SAFETY.md names tests that exist, in the source or as a file, that
//! `cargo test` runs at least one of them, and that every test that the page names exists.

use std::collections::BTreeMap;
use std::fs;

use crate::tree::{root, source_files};

/// Fewest underscores of a name in the page that is taken for a test's name:
/// `the_default_is_guarded` has three, and no name of anything else in the page has more than two.
const FEWEST_UNDERSCORES: usize = 3;

/// The names of all tests in a source text, each with whether `cargo test` leaves it out.
fn tests_of(text: &str) -> Vec<(&str, bool)> {
    let lines: Vec<&str> = text.lines().map(str::trim).collect();
    let is_above = |line: &&&str| line.starts_with("#[") || line.starts_with("//");
    lines
        .iter()
        .enumerate()
        .filter_map(|(at, line)| {
            let name = line.strip_prefix("fn ")?.split_once('(')?.0;
            let above: Vec<_> = lines[..at].iter().rev().take_while(is_above).collect();
            let is_ignored = above.iter().any(|line| line.starts_with("#[ignore"));
            above.contains(&&"#[test]").then_some((name, is_ignored))
        })
        .collect()
}

/// The names of all tests, each with whether `cargo test` runs a test of this name.
fn all_tests() -> BTreeMap<String, bool> {
    let mut tests = BTreeMap::new();
    for folder in ["src", "tests", "firmware-protocol/src"] {
        for path in source_files(&root().join(folder)) {
            let text = fs::read_to_string(path).expect("UTF-8");
            for (name, is_ignored) in tests_of(&text) {
                *tests.entry(name.to_owned()).or_default() |= !is_ignored;
            }
        }
    }
    tests
}

/// The texts between backticks.
fn quoted(text: &str) -> impl Iterator<Item = &str> {
    text.split('`').skip(1).step_by(2)
}

/// The lines of the tables of promises.
fn promises(page: &str) -> Vec<&str> {
    let tables = page.split("\n| promise |").skip(1);
    tables
        .flat_map(|table| table.lines().skip(2).take_while(|line| line.starts_with('|')))
        .collect()
}

#[test]
fn every_promise_of_safety_md_is_tested() {
    let page = fs::read_to_string(root().join("SAFETY.md")).expect("SAFETY.md");
    let tests = all_tests();
    let promises = promises(&page);
    assert!(promises.len() > 40, "the tables of promises were not found");
    for line in promises {
        let cell = line.split('|').nth(4).unwrap_or_else(|| panic!("too few columns: {line}"));
        let mut is_run = false;
        for name in quoted(cell) {
            // A file of tests is run as a whole.
            let runs = tests.get(name).copied().or(root().join(name).is_file().then_some(true));
            is_run |= runs.unwrap_or_else(|| panic!("SAFETY.md names {name}, which is no test"));
        }
        assert!(is_run, "cargo test runs no test of this promise: {line}");
    }
}

#[test]
fn every_test_that_safety_md_names_exists() {
    let page = fs::read_to_string(root().join("SAFETY.md")).expect("SAFETY.md");
    let tests = all_tests();
    let is_long = |name: &&str| {
        name.chars().all(|letter| matches!(letter, 'a'..='z' | '0'..='9' | '_'))
            && name.matches('_').count() >= FEWEST_UNDERSCORES
    };
    let names: Vec<_> = quoted(&page).filter(is_long).collect();
    assert!(names.len() > 150, "the names of tests were not found: {}", names.len());
    for name in names {
        assert!(tests.contains_key(name), "SAFETY.md names {name}, which is no test");
    }
}

#[test]
fn a_test_has_its_attribute_and_is_run_unless_it_is_ignored() {
    let text = "#[test]\nfn runs() {}\n\n    #[test]\n    #[ignore = \"long\"]\n    /// Words.\n    \
                fn waits() {}\n\n#[test]\n\nfn apart() {}\nfn helps() {}\n";
    assert_eq!(tests_of(text), [("runs", false), ("waits", true)]);
}
