//! Tests that no test starts the program with the files of the user who runs the tests.

use std::fs;

use crate::tree::{root, source_files};

#[test]
fn tests_start_the_program_only_in_a_folder_that_is_its_users_home() {
    // Only `command_in` may call the program directly; a test that starts it through a shell or a
    // script calls `isolate`. The search strings are joined from parts, so that this file does not
    // contain them.
    let path = ["CARGO_BIN", "_EXE_qube-hil"].concat();
    let direct = ["Command::new(env!(\"", &path, "\")"].concat();
    let by_name = ["cargo_", "bin("].concat();
    let mut others = 0;
    for file in source_files(&root().join("tests")) {
        if file.ends_with("tests/shared/isolated.rs") {
            continue;
        }
        let text = fs::read_to_string(&file).unwrap();
        let is_direct = text.contains(&direct) || text.contains(&by_name);
        assert!(!is_direct, "{}: use shared::command_in", file.display());
        if text.contains(&path) {
            assert!(text.contains("isolate("), "{}: use shared::isolate", file.display());
            others += 1;
        }
    }
    assert!(others > 1, "the search finds {others} files");
}
