//! Tests that no test starts the program with the files of the user who runs the tests.

use std::fs;

use crate::tree::{root, source_files};

#[test]
fn tests_start_the_program_only_in_a_folder_that_is_its_users_home() {
    // The one place is `command_in`; the calls are put together, or this file would have them too.
    let by_path = ["Command::new(env!(\"CARGO_BIN", "_EXE_qube-hil\")"].concat();
    let by_name = ["cargo_", "bin("].concat();
    let files = source_files(&root().join("tests"));
    let has_one = |path: &&std::path::PathBuf| {
        let text = fs::read_to_string(path).unwrap();
        text.contains(&by_path) || text.contains(&by_name)
    };
    let found: Vec<_> = files.iter().filter(has_one).collect();
    let only = root().join("tests/shared/isolated.rs");
    assert_eq!(found, [&only], "use shared::command_in");
}
