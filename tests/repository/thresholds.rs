//! Compares the table of thresholds in `docs/researcher.md` with the constants of the source.

use std::collections::BTreeSet;
use std::fs;

use crate::tree::root;

/// Thresholds that the table must have, because they decide verdicts and trainings.
const NEEDED: [&str; 11] = [
    "QUESTIONABLE_WIDTH",
    "LARGEST_CHANCE",
    "LARGEST_GROWTH",
    "LARGEST_HELD_OUT_RATIO",
    "LARGEST_NOISE_RATIO",
    "LARGEST_WHITENESS",
    "NAMED_SHARE",
    "ROUNDS",
    "SIGNIFICANT",
    "SUCCEEDED",
    "UNFIT_RAD",
];

/// The value of a constant in a source file.
fn constant(file: &str, name: &str) -> f64 {
    let text =
        fs::read_to_string(root().join(file)).unwrap_or_else(|error| panic!("{file}: {error}"));
    let begins = format!("const {name}: ");
    let line = text.lines().find(|line| line.contains(&begins));
    let line = line.unwrap_or_else(|| panic!("{file} has no constant {name}"));
    let value = line.rsplit(" = ").next().unwrap().trim_end_matches(';').replace('_', "");
    value.parse().unwrap_or_else(|_| panic!("{file}: {line}"))
}

#[test]
fn every_threshold_in_the_table_equals_its_constant() {
    let page = fs::read_to_string(root().join("docs/researcher.md")).unwrap();
    let table = page.split("\n| threshold | constant | value |").nth(1).expect("the table");
    let rows = table.lines().skip(2).take_while(|line| line.starts_with('|'));
    let mut named = BTreeSet::new();
    for row in rows {
        let cells: Vec<&str> = row.split('|').map(str::trim).collect();
        let [_, _, place, value, ..] = cells.as_slice() else { panic!("too few columns: {row}") };
        let quoted: Vec<&str> = place.split('`').skip(1).step_by(2).collect();
        let [name, file] = quoted.as_slice() else { panic!("no constant with its file: {row}") };
        let value: f64 = value.parse().unwrap_or_else(|_| panic!("no value: {row}"));
        assert_eq!(value, constant(file, name), "{row}");
        named.insert(*name);
    }
    let missing: Vec<_> = NEEDED.iter().filter(|name| !named.contains(*name)).collect();
    assert!(missing.is_empty(), "the table lacks {missing:?}");
}
