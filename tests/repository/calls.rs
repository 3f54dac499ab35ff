//! Tests the calls of tests in pages and scripts: the program of tests exists, and each filter
//! selects at least one of its tests that the call runs, ignored or not.

use std::fs;

use crate::documents::pages;
use crate::tree::{root, source_files};

/// A test: its path, in which filters search, and whether it runs only on request.
struct Test {
    path: String,
    is_ignored: bool,
}

/// The tests in the text of a module with this path.
fn tests_in(text: &str, module: &str) -> Vec<Test> {
    let mut found = Vec::new();
    let (mut is_test, mut is_ignored) = (false, false);
    for line in text.lines().map(str::trim_start) {
        is_test |= line.starts_with("#[test]");
        is_ignored |= line.starts_with("#[ignore");
        if let Some(function) = line.strip_prefix("fn ").or_else(|| line.strip_prefix("pub fn ")) {
            let name = function.split(['(', '<']).next().unwrap();
            if is_test {
                found.push(Test { path: format!("{module}{name}"), is_ignored });
            }
            (is_test, is_ignored) = (false, false);
        }
    }
    found
}

/// The tests of a program of tests, or of the library if the program is `lib`; `None` if there is
/// no such program.
fn tests_of(program: &str) -> Option<Vec<Test>> {
    let file = root().join("tests").join(program).with_extension("rs");
    if file.exists() {
        return Some(tests_in(&fs::read_to_string(file).unwrap(), ""));
    }
    let is_library = program == "lib";
    let folder = if is_library { root().join("src") } else { root().join("tests").join(program) };
    if !is_library && !folder.join("main.rs").exists() {
        return None;
    }
    let tests = source_files(&folder).into_iter().flat_map(|file| {
        let inside = file.strip_prefix(&folder).unwrap().with_extension("");
        let mut module: Vec<String> =
            inside.iter().map(|part| part.to_string_lossy().into_owned()).collect();
        module.retain(|part| part != "mod" && part != "lib");
        // A module of the library has its tests in a module below it, whichever file they are in.
        if is_library {
            if let Some(last) = module.last_mut() {
                *last = last.trim_end_matches("_tests").to_owned();
            }
            if module.last().is_none_or(|last| last != "tests") {
                module.push("tests".into());
            }
        }
        let module = module.iter().map(|part| format!("{part}::")).collect::<String>();
        tests_in(&fs::read_to_string(file).unwrap(), &module)
    });
    Some(tests.collect())
}

/// A call of a program of tests.
#[derive(Debug, PartialEq, Eq)]
struct Call {
    program: String,
    filters: Vec<String>,
    only_ignored: bool,
}

impl Call {
    /// The call that a text after `cargo test` describes, up to the end of the command or of its
    /// quotation; `None` if the call names no program of tests of this package.
    fn new(arguments: &str) -> Option<Self> {
        let arguments = arguments.split(['`', '#', '|', ';', '\n']).next().unwrap();
        let (mut program, mut filters, mut only_ignored) = (None, Vec::new(), false);
        let mut words = arguments.split_whitespace();
        while let Some(word) = words.next() {
            match word {
                "--test" => program = words.next().map(str::to_owned),
                "--lib" => program = Some("lib".to_owned()),
                "--ignored" => only_ignored = true,
                "--package" | "-p" => return None,
                "--features" | "--test-threads" | "--skip" | "--manifest-path" | "--target"
                | "--profile" => drop(words.next()),
                _ if word.starts_with(['-', '"', '$']) => {}
                _ => filters.push(word.to_owned()),
            }
        }
        Some(Self { program: program?, filters, only_ignored })
    }

    /// The calls in a page or script.
    fn all(text: &str) -> Vec<Self> {
        let text = text.replace("\\\n", " ");
        let unfolded = format!("{text}\n{}", unfolded(&text));
        unfolded.split("cargo test").skip(1).filter_map(Self::new).collect()
    }

    /// The reasons why this call, or a part of it, runs no test.
    fn defects(&self) -> Vec<String> {
        let Self { program, filters, only_ignored } = self;
        let Some(tests) = tests_of(program) else {
            return vec![format!("there is no --test {program}")];
        };
        let any = [String::new()];
        let filters = if filters.is_empty() { &any[..] } else { filters.as_slice() };
        let selects = |filter: &String| {
            tests.iter().any(|it| it.path.contains(filter) && it.is_ignored == *only_ignored)
        };
        let which = if *only_ignored { "ignored test" } else { "test" };
        let useless = filters.iter().filter(|filter| !selects(filter));
        useless.map(|it| format!("{program}: no {which} has {it:?} in its name")).collect()
    }
}

/// The commands of a script through its own functions whose `cargo test` has the arguments `"$@"`:
/// for each line that calls such a function, the command with the arguments of that line.
fn unfolded(script: &str) -> String {
    let mut commands = String::new();
    for (head, rest) in script.split("() {").zip(script.split("() {").skip(1)) {
        let function = head.rsplit('\n').next().unwrap();
        let body = rest.split('}').next().unwrap();
        let Some(arguments) = body.split("cargo test").nth(1) else { continue };
        let arguments = arguments.split(['|', ';', '\n']).next().unwrap();
        let Some((before, after)) = arguments.split_once("\"$@\"") else { continue };
        for line in script.lines().filter(|line| !line.trim_start().starts_with('#')) {
            // Variables, the options of `timed` and the like stand before a function's name.
            let call = format!(" {line}");
            if let Some((_, given)) = call.split_once(&format!(" {function} ")) {
                commands += &format!("cargo test {before} {given} {after}\n");
            }
        }
    }
    commands
}

#[test]
fn every_test_that_a_page_or_a_script_calls_exists() {
    let scripts = fs::read_dir(root().join("scripts")).unwrap().map(|entry| entry.unwrap().path());
    let files = scripts.filter(|path| path.is_file()).chain([root().join(".ci/run")]);
    let pages = pages().into_iter().filter(|page| !page.ends_with("CHANGELOG.md"));
    let (mut defects, mut looked_at) = (Vec::new(), 0);
    for file in files.chain(pages.map(|page| root().join(page))) {
        let text = fs::read_to_string(&file).unwrap();
        for call in Call::all(&text) {
            looked_at += 1;
            let found = call.defects().into_iter();
            defects.extend(found.map(|defect| format!("{}: {defect}", file.display())));
        }
    }
    assert!(looked_at > 30, "only {looked_at} calls of tests were found");
    assert!(defects.is_empty(), "calls that run no test:\n{}", defects.join("\n"));
}

#[test]
fn a_call_that_runs_no_test_is_found() {
    for call in [
        "--test repository",
        "--test repository documents::",
        "--test repository calls::a_call_that",
        "--release --lib -- --ignored --nocapture every_pattern_of_an_f32 in_a_long_search",
        "--lib surrogate::",
        "--test virtual_time wrong_on_many_rigs -- --ignored`) and more",
        "--test jobs_cost -- --ignored",
    ] {
        assert_eq!(Call::new(call).unwrap().defects(), [""; 0], "{call}");
    }
    for call in [
        "--test none",
        "--test repository document::",
        "--test repository calls::no_such_function",
        // One of two filters selects nothing.
        "--lib -- --ignored every_pattern_of_an_f32 in_no_search",
        "--lib no_such_room::",
        // The test is not ignored, or runs only on request.
        "--test repository documents:: -- --ignored",
        "--test virtual_time wrong_on_many_rigs",
    ] {
        assert_eq!(Call::new(call).unwrap().defects().len(), 1, "{call}");
    }
}

#[test]
fn the_calls_through_a_scripts_functions_are_found() {
    let script = "part() {\n    cargo test --test durability -- --nocapture \"$@\" | grep -v x\n}\n\
                  # part of it\nSEED=1 timed part cuts::a_ledger \\\n    cuts::a_recording\n";
    let call = |filters: &[&str]| Call {
        program: "durability".into(),
        filters: filters.iter().map(|&it| it.to_owned()).collect(),
        only_ignored: false,
    };
    let found = Call::all(script);
    assert!(found.contains(&call(&["cuts::a_ledger", "cuts::a_recording"])), "{found:?}");
}
