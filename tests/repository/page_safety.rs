//! Tests that every promise in SAFETY.md names tests, each of which is a function of the source or
//! a file that exists.

use std::fs;

use crate::tree::{root, source_files};

/// The names between backticks in the fourth column of the tables of promises.
fn named_tests(page: &str) -> Vec<String> {
    let tables = page.split("\n| promise |").skip(1);
    let lines = tables.flat_map(|table| table.lines().skip(2).take_while(|l| l.starts_with('|')));
    lines
        .flat_map(|line| {
            let cell = line.split('|').nth(4).unwrap_or_else(|| panic!("too few columns: {line}"));
            let names: Vec<String> =
                cell.split('`').skip(1).step_by(2).map(str::to_owned).collect();
            assert!(!names.is_empty(), "a promise without a test: {line}");
            names
        })
        .collect()
}

#[test]
fn every_test_that_safety_md_names_exists() {
    let page = fs::read_to_string(root().join("SAFETY.md")).expect("SAFETY.md");
    let folders = ["src", "tests", "firmware-protocol/src"];
    let files = folders.into_iter().flat_map(|folder| source_files(&root().join(folder)));
    let code: String = files.map(|path| fs::read_to_string(path).expect("UTF-8")).collect();
    let names = named_tests(&page);
    assert!(names.len() > 60, "the tables of promises were not found");
    for name in names {
        let is_file = root().join(&name).exists();
        assert!(is_file || code.contains(&format!("fn {name}(")), "SAFETY.md names {name}");
    }
}
