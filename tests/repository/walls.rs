//! Tests the walls between the rooms: which room may import which.
//!
//! Every source file is read as tokens, so that a path is found wherever it is written: in nested
//! groups of a `use`, in an expression, in a type, in the arguments or the definition of a macro,
//! in an attribute's text. A path that cannot be followed (an alias of the crate's root, a glob
//! import of the root) is a breach of its own, and so is a room's re-export of another room's item.

mod import_paths;

use std::collections::BTreeSet;
use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use import_paths::{Import, imports, is_ident, literals};
use proc_macro2::{TokenStream, TokenTree};

use crate::tree::{root, source_files};

/// A room, the rooms that it may import, and the rooms that only its tests may import in addition.
struct Room {
    name: &'static str,
    may_import: &'static [&'static str],
    tests_may_import: &'static [&'static str],
}

const fn room(name: &'static str, may_import: &'static [&'static str]) -> Room {
    Room { name, may_import, tests_may_import: &[] }
}

const EVERY_ROOM: &[&str] = &["*"];

/// The permitted imports. A new one must be added here. `firmware_protocol` is the other crate of
/// the workspace.
#[rustfmt::skip]
const ROOMS: &[Room] = &[
    room("clock", &[]),
    room("elementary", &[]),
    room("storage", &[]),
    room("qube", &["elementary"]),
    room("estimation", &["qube", "elementary"]),
    room("safety", &["qube", "elementary", "estimation"]),
    Room {
        name: "policy",
        may_import: &["qube", "elementary", "storage"],
        tests_may_import: &["estimation", "safety"],
    },
    // Its lanes are tested against the emulator's plant.
    Room {
        name: "simulation",
        may_import: &["qube", "elementary", "estimation", "safety", "storage"],
        tests_may_import: &["device"],
    },
    room("learning", &["simulation", "policy", "estimation", "qube", "elementary", "storage"]),
    // Sessions, experiments and the command train hand their trainings to one executor.
    room("jobs", &["learning", "simulation", "storage", "elementary"]),
    room("surrogate", &[]),
    room("search", &["surrogate"]),
    room("device", &["clock", "qube", "firmware_protocol"]),
    room("telemetry", &["qube", "safety", "estimation"]),
    room("control", &["clock", "device", "estimation", "policy", "safety", "telemetry", "qube",
                      "elementary"]),
    Room {
        name: "recording",
        may_import: &["telemetry", "qube", "storage"],
        tests_may_import: &["estimation", "safety"],
    },
    // Sessions, experiments, runs and replays score a rollout alike.
    room("scoring", &["recording", "telemetry", "qube", "storage"]),
    Room {
        name: "replay",
        may_import: &["scoring", "recording", "control", "policy", "safety", "telemetry", "qube",
                      "elementary", "storage"],
        tests_may_import: &["estimation"],
    },
    room("identification", &["replay", "recording", "telemetry", "policy", "qube", "elementary"]),
    // The check measures with the tick's clock and drive, and reports signs and faults.
    room("preflight", &["clock", "device", "control", "estimation", "safety", "telemetry", "qube",
                        "firmware_protocol"]),
    // Sessions, experiments and single runs all use a rig.
    room("rig", &["clock", "qube", "estimation", "safety", "policy", "device", "telemetry", "control",
                  "recording", "preflight", "storage"]),
    room("session", &["qube", "estimation", "safety", "policy", "simulation", "learning", "jobs", "surrogate",
                      "search", "device", "telemetry", "control", "recording",
                      "identification", "rig", "scoring", "storage"]),
    room("experiment", &["elementary", "qube", "policy", "simulation", "learning", "jobs", "search",
                         "recording", "telemetry", "rig", "session", "scoring", "storage", "identification", "replay"]),
    // This room only draws and computes no results.
    room("charts", &["qube", "simulation", "replay", "search", "surrogate"]),
    // This room shows ticks while they are recorded.
    room("live", &["recording", "telemetry"]),
    // This room writes a page from the results of other rooms.
    Room {
        name: "report",
        may_import: &["charts", "experiment", "session", "scoring", "replay", "identification", "recording",
                      "search", "surrogate", "learning", "simulation", "telemetry", "storage", "qube"],
        tests_may_import: &["safety"],
    },
    room("commands", EVERY_ROOM),
];

/// Rooms of pure computation: equal inputs give equal outputs on every machine.
const PURE: &[&str] =
    &["elementary", "qube", "estimation", "safety", "surrogate", "search", "telemetry"];

/// Parts of the standard library that a pure room may not use.
const WORLD: &[&str] = &["fs", "net", "process", "env", "thread", "time"];

/// Parts of the standard library that the room `control` may not use.
const FORBIDDEN_IN_CONTROL: &[&str] = &["fs", "net", "process", "env"];

/// Rooms that may not draw random numbers, not even from a seed.
const WITHOUT_RANDOMNESS: &[&str] = &["elementary", "qube", "estimation", "safety", "telemetry"];

/// A breach of a wall.
#[derive(Debug, PartialEq, Eq)]
struct Breach {
    file: PathBuf,
    line: usize,
    message: String,
}

impl fmt::Display for Breach {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{}:{}: {}", self.file.display(), self.line, self.message)
    }
}

#[test]
fn every_room_keeps_to_its_walls() {
    let source = root().join("src");
    let mut breaches = Vec::new();
    for file in source_files(&source) {
        let text = fs::read_to_string(&file).unwrap();
        breaches.extend(check_file(file.strip_prefix(&source).unwrap(), &text));
    }
    assert!(breaches.is_empty(), "{}", list(&breaches));
}

#[test]
fn no_permission_to_import_is_unused() {
    let source = root().join("src");
    for room in ROOMS.iter().filter(|room| room.may_import != EVERY_ROOM) {
        let (mut used, mut used_by_tests) = (BTreeSet::new(), BTreeSet::new());
        for file in source_files(&source.join(room.name)) {
            let module = module_of(file.strip_prefix(&source).unwrap());
            for import in imports(&module, &fs::read_to_string(&file).unwrap()) {
                let used = if import.in_tests { &mut used_by_tests } else { &mut used };
                match import.path.as_slice() {
                    [root, target, ..] if root == "crate" => used.insert(target.clone()),
                    [root, ..] => used.insert(root.clone()),
                    [] => false,
                };
            }
        }
        let name = room.name;
        for &target in room.may_import {
            assert!(used.contains(target), "`{name}` does not import `{target}` outside its tests");
        }
        for &target in room.tests_may_import {
            assert!(used_by_tests.contains(target), "the tests of `{name}` import no `{target}`");
        }
    }
}

#[test]
fn the_table_of_rooms_in_architecture_is_these_walls() {
    let text = fs::read_to_string(root().join("ARCHITECTURE.md")).unwrap();
    let rows: Vec<(String, String)> = text
        .lines()
        .skip_while(|line| !line.starts_with("| room |"))
        .skip(2)
        .take_while(|line| line.starts_with('|'))
        .map(|line| {
            let cells: Vec<&str> = line.trim_matches('|').split(" | ").collect();
            (cells[0].trim_matches([' ', '`', '/']).to_owned(), cells[2].to_owned())
        })
        .filter(|(room, _)| !["firmware-protocol", "python"].contains(&room.as_str()))
        .collect();
    let drawn: BTreeSet<&str> = rows.iter().map(|(room, _)| room.as_str()).collect();
    assert_eq!(drawn, ROOMS.iter().map(|room| room.name).collect());
    for (name, cell) in &rows {
        let room = ROOMS.iter().find(|room| room.name == name).unwrap();
        if room.may_import == EVERY_ROOM {
            assert!(cell.contains("everything"), "{name}: {cell}");
        } else {
            assert_eq!(rooms_named_in(cell), room.may_import.iter().copied().collect(), "{name}");
        }
    }
}

#[test]
fn the_page_of_each_room_states_its_walls() {
    let source = root().join("src");
    for room in ROOMS.iter().filter(|room| room.may_import != EVERY_ROOM) {
        let text = fs::read_to_string(source.join(room.name).join("mod.rs")).unwrap();
        let page: Vec<&str> =
            text.lines().filter_map(|line| line.strip_prefix("//!")).map(str::trim).collect();
        let page = page.join(" ");
        let stated = page.split_once("ay import ").map_or("", |(_, list)| list);
        let list = stated.split([';', '.']).next().unwrap_or_default();
        assert_eq!(
            rooms_named_in(list),
            room.may_import.iter().copied().collect(),
            "{}",
            room.name
        );
    }
}

/// The rooms, and the wire, that a text names in backticks.
fn rooms_named_in(text: &str) -> BTreeSet<&'static str> {
    let names: Vec<String> =
        text.split('`').skip(1).step_by(2).map(|name| name.replace('-', "_")).collect();
    let known = ROOMS.iter().map(|room| room.name).chain(["firmware_protocol"]);
    known.filter(|room| names.iter().any(|name| name == room)).collect()
}

#[test]
fn the_wire_needs_no_standard_library() {
    let source = root().join("firmware-protocol/src");
    let lib = fs::read_to_string(source.join("lib.rs")).unwrap();
    assert!(lib.lines().any(|line| line.trim() == "#![no_std]"), "firmware-protocol is not no_std");
    let mut breaches = Vec::new();
    for file in source_files(&source) {
        breaches.extend(check_protocol(&file, &fs::read_to_string(&file).unwrap()));
    }
    assert!(breaches.is_empty(), "{}", list(&breaches));
}

#[test]
fn the_library_names_no_word_of_the_command_line() {
    let source = root().join("src");
    let mut breaches = Vec::new();
    for file in source_files(&source) {
        let module = module_of(file.strip_prefix(&source).unwrap());
        if module.first().is_none_or(|room| room == "commands") {
            continue;
        }
        for (line, text) in literals(&module, &fs::read_to_string(&file).unwrap()) {
            if let Some(word) = command_line_word(&text) {
                let message =
                    format!("`{word}` is a word of the command line: src/commands adds it");
                breaches.push(Breach { file: file.clone(), line, message });
            }
        }
    }
    assert!(breaches.is_empty(), "{}", list(&breaches));
}

/// The first option in a text, or else the first call of the program in it.
fn command_line_word(text: &str) -> Option<&str> {
    let is_letter = |letter: Option<char>| letter.is_some_and(|it| it.is_ascii_lowercase());
    let option = text.match_indices("--").find(|(at, dashes)| {
        !text[..*at].ends_with('-') && is_letter(text[at + dashes.len()..].chars().next())
    });
    let call = text
        .match_indices("qube-hil ")
        .find(|(at, name)| is_letter(text[at + name.len()..].chars().next()));
    option.or(call).map(|(at, _)| text[at..].split(['"', '\\', '.', ',']).next().unwrap_or(text))
}

fn list(breaches: &[Breach]) -> String {
    let lines: Vec<_> = breaches.iter().map(ToString::to_string).collect();
    format!("\n{}\n", lines.join("\n"))
}

/// The module of a file, from the crate's root.
fn module_of(file: &Path) -> Vec<String> {
    let mut module: Vec<String> =
        file.with_extension("").iter().map(|part| part.to_string_lossy().into_owned()).collect();
    if module.last().is_some_and(|last| ["mod", "lib", "main"].contains(&last.as_str())) {
        module.pop();
    }
    module
}

fn check_file(file: &Path, source: &str) -> Vec<Breach> {
    let module = module_of(file);
    let breach = |line, message| Breach { file: file.to_owned(), line, message };
    match module.first() {
        None => check_root(file, source).into_iter().map(|message| breach(1, message)).collect(),
        Some(name) => match ROOMS.iter().find(|room| room.name == name) {
            None => {
                vec![breach(1, format!("`{name}` is no room: add it to tests/repository/walls.rs"))]
            }
            Some(room) => imports(&module, source)
                .iter()
                .filter_map(|import| {
                    Some(breach(import.line, check_import(room, &module, import)?))
                })
                .collect(),
        },
    }
}

/// Describes the breach that an import commits; `None` if the import is allowed.
fn check_import(room: &Room, module: &[String], import: &Import) -> Option<String> {
    let name = room.name;
    let is_allowed = |target: &str| {
        room.may_import == EVERY_ROOM
            || room.may_import.contains(&target)
            || (import.in_tests && room.tests_may_import.contains(&target))
    };
    let (head, rest) = import.path.split_first()?;
    match (head.as_str(), rest.first().map(String::as_str)) {
        ("crate", None | Some("*")) => Some(
            "the crate's root under another name or as a whole cannot be followed: name the room"
                .to_owned(),
        ),
        ("crate", Some(target)) if target == name => check_emulator(module, rest),
        ("crate", Some(target)) if !ROOMS.iter().any(|room| room.name == target) => {
            Some(format!("`crate::{target}` is no room"))
        }
        ("crate", Some(target)) if !is_allowed(target) => {
            Some(format!("`{name}` may not import `{target}`"))
        }
        ("crate", Some(target)) => {
            import.is_public_use.then(|| format!("`{name}` re-exports an item of `{target}`"))
        }
        ("firmware_protocol", _) => {
            (!is_allowed("firmware_protocol")).then(|| format!("`{name}` may not import the wire"))
        }
        ("std", part) if !import.in_tests => {
            let forbidden = match name {
                name if PURE.contains(&name) => WORLD,
                "control" => FORBIDDEN_IN_CONTROL,
                _ => return None,
            };
            match part {
                None | Some("*") => Some(
                    "`std` under another name or as a whole cannot be followed: name its part"
                        .to_owned(),
                ),
                Some(part) => {
                    forbidden.contains(&part).then(|| format!("`{name}` may not use `std::{part}`"))
                }
            }
        }
        ("rand" | "rand_chacha", _) if !import.in_tests => {
            WITHOUT_RANDOMNESS.contains(&name).then(|| format!("`{name}` draws no random numbers"))
        }
        _ => None,
    }
}

/// Describes an import of the host's side by the emulator; `None` for any other import. The
/// emulator implements the other side of the wire, and shared code would hide faults of the
/// protocol.
fn check_emulator(module: &[String], target: &[String]) -> Option<String> {
    let part_of = |path: &[String]| path.get(1).map(String::as_str) == Some("emulator");
    (module[0] == "device" && part_of(module) && !part_of(target))
        .then(|| format!("the emulator may not import `{}` of the host's side", target.join("::")))
}

/// The breaches in the files at the crate's root: `lib.rs` declares exactly the rooms and has no
/// `use`, and `main.rs` imports no room but `commands`.
fn check_root(file: &Path, source: &str) -> Vec<String> {
    if file == Path::new("main.rs") {
        return imports(&[], source)
            .iter()
            .filter(|import| ["crate", "firmware_protocol"].contains(&import.path[0].as_str()))
            .filter(|import| import.path.get(1).is_none_or(|room| room != "commands"))
            .map(|_| "main.rs may import only the commands".to_owned())
            .collect();
    }
    let tokens: Vec<TokenTree> = TokenStream::from_str(source).unwrap().into_iter().collect();
    let declared: BTreeSet<String> = tokens
        .windows(2)
        .filter(|pair| is_ident(&pair[0], "mod"))
        .map(|pair| pair[1].to_string())
        .collect();
    let known: BTreeSet<String> = ROOMS.iter().map(|room| room.name.to_owned()).collect();
    let mut breaches: Vec<_> = declared
        .symmetric_difference(&known)
        .map(|name| format!("`{name}` is not a room both here and in tests/repository/walls.rs"))
        .collect();
    if tokens.iter().any(|token| is_ident(token, "use")) {
        breaches.push("lib.rs may not re-export: import from the room".to_owned());
    }
    breaches
}

fn check_protocol(file: &Path, source: &str) -> Vec<Breach> {
    imports(&[], source)
        .iter()
        .filter(|import| !import.in_tests)
        .filter(|import| ["std", "alloc", "qube_hil"].contains(&import.path[0].as_str()))
        .map(|import| Breach {
            file: file.to_owned(),
            line: import.line,
            message: format!("firmware-protocol may not use `{}`", import.path.join("::")),
        })
        .collect()
}

/// Tests of the checker: it finds each planted breach and accepts look-alikes.
mod the_checker {
    use super::*;

    fn breaches(file: &str, source: &str) -> Vec<String> {
        check_file(Path::new(file), source).into_iter().map(|breach| breach.message).collect()
    }

    #[track_caller]
    fn finds(file: &str, source: &str, expected: &str) {
        let found = breaches(file, source);
        assert!(found.iter().any(|message| message.contains(expected)), "{source}: {found:?}");
    }

    #[track_caller]
    fn accepts(file: &str, source: &str) {
        assert_eq!(breaches(file, source), Vec::<String>::new(), "{source}");
    }

    #[test]
    fn finds_every_way_to_write_an_import() {
        let expected = "`control` may not import `learning`";
        for source in [
            "use crate::learning::Trainer;",
            "use crate::learning;",
            "use crate::learning as l;",
            "use crate::{qube::State, learning::Trainer};",
            "use crate::{qube::{State, limits::*}, learning::{self, Trainer}};",
            "use {crate::qube::State, crate::learning::*};",
            "use crate::{self as root, learning};",
            "pub(crate) use crate::learning::Trainer;",
            "use super::super::learning::Trainer;",
            "use super::super::{qube, learning};",
            "use super::{super::learning::Trainer, drive};",
            "use self::super::super::learning;",
            "use qube_hil::learning;",
            "use ::qube_hil::learning;",
            "fn f() { crate::learning::train(); }",
            "fn f(t: &crate::learning::Trainer) -> Vec<crate::qube::State> {}",
            "impl<T: crate::learning::Train> Foo for T {}",
            "fn f() { let x = <crate::learning::Trainer as Default>::default(); }",
            "fn f() { println!(\"{}\", crate::learning::STEPS); }",
            "fn f() { vec![crate::learning::STEPS; 3]; }",
            "macro_rules! m { ($x:expr) => { $crate::learning::train($x) }; }",
            "#[serde(with = \"crate::learning::codec\")] struct S;",
            "mod inner { use super::super::super::learning::Trainer; }",
            "mod a { mod b { fn f() { super::super::super::super::learning::train() } } }",
            "#[cfg(test)] mod tests { use crate::learning::Trainer; }",
            "#[cfg(test)] use crate::{qube, learning};",
        ] {
            finds("control/tick.rs", source, expected);
        }
    }

    #[test]
    fn reports_paths_that_cannot_be_followed_and_re_exports() {
        for source in [
            "use crate as root;",
            "use crate::{self as root};",
            "use crate::*;",
            "use super::super::*;",
            "extern crate self as me;",
        ] {
            finds("control/tick.rs", source, "cannot be followed");
        }
        for source in
            ["use std as s;", "use std::{self as s};", "use std::*;", "extern crate std as s;"]
        {
            finds("control/tick.rs", source, "cannot be followed");
            finds("safety/gate.rs", source, "cannot be followed");
            accepts("session/rig.rs", source);
        }
        finds("control/tick.rs", "pub use crate::qube::State;", "re-exports an item of `qube`");
        finds("control/tick.rs", "use crate::utils::f;", "is no room");
        finds("utils/mod.rs", "", "is no room");
        finds("lib.rs", "pub mod clock; pub mod attic;", "`attic` is not a room");
        finds("lib.rs", "pub mod clock;", "`qube` is not a room");
        finds("lib.rs", "pub use qube::State;", "lib.rs may not re-export");
        finds(
            "main.rs",
            "fn main() { qube_hil::learning::train() }",
            "may import only the commands",
        );
    }

    #[test]
    fn finds_each_import_that_a_room_must_not_have() {
        finds("qube/state.rs", "use crate::clock::Clock;", "`qube` may not import `clock`");
        finds("session/mod.rs", "use crate::commands::run;", "`session` may not import `commands`");
        finds("learning/ppo.rs", "use crate::device::Device;", "may not import `device`");
        finds("surrogate/gp.rs", "use crate::qube::State;", "may not import `qube`");
        finds("control/tick.rs", "use crate::recording::Recorder;", "may not import `recording`");
        finds("control/tick.rs", "use std::{fs::File, io};", "may not use `std::fs`");
        finds("control/tick.rs", "fn f() { std::process::exit(1) }", "may not use");
        finds("safety/gate.rs", "use std::time::Instant;", "may not use `std::time`");
        finds("estimation/filter.rs", "use rand::Rng;", "draws no random numbers");
        finds("session/rig.rs", "use firmware_protocol::Frame;", "may not import the wire");
        finds("recording/writer.rs", "use crate::safety::Limit;", "may not import `safety`");
        for source in [
            "use crate::device::SerialLink;",
            "use super::super::serial_link::Reader;",
            "use super::super::*;",
            "use super::super::{emulator::plant, transport::Transport};",
        ] {
            finds("device/emulator/mcu.rs", source, "the host's side");
        }
    }

    #[test]
    fn accepts_allowed_imports() {
        accepts("control/tick.rs", "use super::Motion; use crate::{qube::State, policy::Policy};");
        accepts("control/mod.rs", "mod tick; pub use tick::Tick; pub use self::drive::drive;");
        accepts("control/tick.rs", "mod tests { use super::super::drive; use super::*; }");
        accepts("control/tick.rs", "// crate::learning\n/// [`crate::learning`]\nfn f() {}");
        accepts("control/tick.rs", "const S: &str = \"learning\"; fn learning() {}");
        accepts("device/emulator/mcu.rs", "use super::plant; use crate::qube::State;");
        accepts("device/emulator/mod.rs", "use firmware_protocol::Frame; use self::plant::Plant;");
        accepts("recording/tests.rs", "use crate::safety::Limit;");
        accepts("recording/writer_tests.rs", "use crate::safety::Limit;");
        accepts("recording/writer.rs", "#[cfg(test)] mod t { use crate::safety::Limit; } ");
        accepts("safety/gate.rs", "#[cfg(test)] use std::time::Instant; use crate::qube::State;");
        accepts("commands/run.rs", "use crate::rig::Rig; use super::exit::Failure;");
    }

    #[test]
    fn test_code_ends_with_its_item() {
        for test in ["mod t {}", "mod t;", "use std::{fs, io};", "fn f() {}"] {
            let source = format!("#[cfg(test)] {test} use crate::safety::Limit;");
            finds("recording/writer.rs", &source, "may not import `safety`");
        }
    }

    #[test]
    fn keeps_the_standard_library_out_of_the_wire() {
        let file = Path::new("frame.rs");
        for source in ["use std::vec::Vec;", "extern crate alloc;", "fn f() { std::mem::swap() }"] {
            assert_eq!(check_protocol(file, source).len(), 1, "{source}");
        }
        let fine = "use core::mem; #[cfg(test)] mod tests { use std::vec::Vec; }";
        assert_eq!(check_protocol(file, fine), []);
    }

    #[test]
    fn names_file_and_line_of_a_breach() {
        let found = check_file(Path::new("control/tick.rs"), "\n\nuse crate::learning::Trainer;\n");
        assert_eq!(found[0].to_string(), "control/tick.rs:3: `control` may not import `learning`");
    }
}

#[test]
fn words_of_the_command_line_are_found_outside_tests_alone() {
    let found = |source: &str| {
        let texts = literals(&["rig".into()], source).into_iter();
        texts.filter(|(_, text)| command_line_word(text).is_some()).map(|(line, _)| line).collect()
    };
    let none: [usize; 0] = [];
    let lines: Vec<usize> = found("fn a() {}\nfn b() { panic!(\"try --force\") }");
    assert_eq!(lines, [2]);
    assert_eq!(found("#[error(\"see qube-hil doctor\")]\nstruct A;") as Vec<usize>, [1]);
    for clean in [
        "/// Like `--force`.\nfn a() {}",
        "fn a() { f(\"a---b -- c\", \"qube-hil: stopped\", \"qube-hil 0.1\") }",
        "#[cfg(test)]\nmod tests { fn a() { f(\"--force\") } }",
    ] {
        assert_eq!(found(clean) as Vec<usize>, none, "{clean}");
    }
}
