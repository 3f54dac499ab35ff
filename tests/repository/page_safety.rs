//! Tests that every promise in SAFETY.md names tests, each of which is a function of the source or
//! a file that exists.

use std::fs;
use std::path::{Path, PathBuf};

fn sources(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).expect("a folder of sources") {
        let path = entry.expect("an entry").path();
        if path.is_dir() {
            sources(&path, found);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            found.push(path);
        }
    }
}

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
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let page = fs::read_to_string(root.join("SAFETY.md")).expect("SAFETY.md");
    let mut files = Vec::new();
    for folder in ["src", "tests", "firmware-protocol/src"] {
        sources(&root.join(folder), &mut files);
    }
    let code: String = files.iter().map(|path| fs::read_to_string(path).expect("UTF-8")).collect();
    let names = named_tests(&page);
    assert!(names.len() > 60, "the tables of promises were not found");
    for name in names {
        let is_file = root.join(&name).exists();
        assert!(is_file || code.contains(&format!("fn {name}(")), "SAFETY.md names {name}");
    }
}
