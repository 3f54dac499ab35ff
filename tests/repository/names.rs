//! Tests that one name has one meaning: no two rooms publish different types of the same name.

use std::collections::BTreeMap;
use std::fs;

use crate::tree::{root, source_files};

/// The types that a `mod.rs` re-exports by name: the published types of its room.
fn published_types(page: &str) -> Vec<String> {
    let uses = page.split("\npub use ").skip(1).filter_map(|rest| rest.split_once(';'));
    let names = uses.flat_map(|(names, _)| names.split(|letter: char| !letter.is_alphanumeric()));
    let is_type =
        |name: &&str| name.starts_with(char::is_uppercase) && name.contains(char::is_lowercase);
    names.filter(is_type).map(str::to_owned).collect()
}

#[test]
fn no_two_rooms_publish_a_type_of_the_same_name() {
    let source = root().join("src");
    let mut rooms_of: BTreeMap<String, Vec<String>> = BTreeMap::new();
    for path in source_files(&source).iter().filter(|path| path.ends_with("mod.rs")) {
        let inside = path.strip_prefix(&source).unwrap();
        let room = inside.iter().next().unwrap().to_string_lossy().into_owned();
        for name in published_types(&fs::read_to_string(path).unwrap()) {
            let rooms = rooms_of.entry(name).or_default();
            if !rooms.contains(&room) {
                rooms.push(room.clone());
            }
        }
    }
    assert!(rooms_of.len() > 300, "only {} names were found", rooms_of.len());
    rooms_of.retain(|_, rooms| rooms.len() > 1);
    assert!(rooms_of.is_empty(), "names with two meanings: {rooms_of:#?}");
}

#[test]
fn published_types_are_found_in_lists_and_in_lines_of_their_own() {
    let page = "mod a;\npub use a::Alone;\npub use b::{\n    Second, Third, LIMIT_V, of,\n};\nuse c::Hidden;\n";
    assert_eq!(published_types(page), ["Alone", "Second", "Third"]);
}
