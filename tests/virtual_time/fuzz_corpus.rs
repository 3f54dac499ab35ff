//! Replays the fuzzers' corpus, so that faults found once stay fixed. `fuzz/README.md` explains how
//! to extend it.

#[path = "../../fuzz/bodies.rs"]
mod bodies;

use std::path::{Path, PathBuf};

use firmware_protocol::{PROTOCOL_VERSION, Request};
use qube_hil::policy::{ClassicalController, ClassicalGains, Policy};
use qube_hil::session::{Entry, Purpose, SessionSettings};

use crate::program;

fn corpus(target: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/corpus").join(target)
}

/// Runs a body on each file of its corpus, and on up to 16 truncated copies of the file and as many
/// copies with one changed byte. The body must accept at least one of the files.
fn replay(target: &str, body: fn(&[u8]) -> bool) {
    let mut files: Vec<_> = std::fs::read_dir(corpus(target))
        .unwrap_or_else(|error| panic!("{target}: {error}"))
        .map(|file| file.unwrap().path())
        .collect();
    files.sort();
    assert!(files.len() >= 3, "{target}: the corpus has fewer than three files");
    let mut accepted = 0;
    for file in files {
        let bytes = std::fs::read(&file).unwrap();
        accepted += usize::from(body(&bytes));
        for length in (0..bytes.len()).step_by(bytes.len() / 16 + 1) {
            body(&bytes[..length]);
            let mut changed = bytes.clone();
            changed[length] ^= 0x41;
            body(&changed);
        }
    }
    assert!(accepted > 0, "{target}: every file of the corpus is refused: run make_seeds");
}

#[test]
fn messages_are_read_from_their_corpus() {
    replay("wire", bodies::wire);
    let hello = Request::Hello { protocol_version: PROTOCOL_VERSION }.encode(1);
    for mode in [0, 1] {
        assert!(bodies::wire(&[&[mode], hello.as_bytes()].concat()), "mode {mode}");
    }
    // The mode, then length, type and sequence number of a hello, and its payload.
    let [low, high] = PROTOCOL_VERSION.to_le_bytes();
    assert!(bodies::wire(&[2, 2, 1, 1, 0, low, high]));
}

#[test]
fn policies_are_read_from_their_corpus() {
    replay("policy", bodies::policy);
    assert!(bodies::policy(&classical()));
}

#[test]
fn recordings_are_read_from_their_corpus() {
    replay("recording", bodies::recording);
    let whole = std::fs::read(
        Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/left_the_speed_envelope.mcap"),
    )
    .unwrap();
    assert!(bodies::recording(&whole));
    let outcome = records(&whole)
        .into_iter()
        .map(|(opcode, start, end)| (opcode, &whole[start + 9..end]))
        .find(|(opcode, body)| *opcode == 12 && body[4..].starts_with(b"outcome"))
        .unwrap()
        .1;
    let mut seed = [&[1], outcome].concat();
    assert!(bodies::recording(&seed));
    // The body replaces a wrong checksum.
    let checksum = seed.windows(5).position(|word| word == b"crc32").unwrap() + 9;
    seed[checksum] ^= 1;
    assert!(bodies::recording(&seed));
}

#[test]
fn configurations_are_read_from_their_corpus() {
    replay("configuration", bodies::configuration);
    assert!(bodies::configuration(SessionSettings::quick().to_toml().unwrap().as_bytes()));
}

#[test]
fn ledgers_are_read_from_their_corpus() {
    replay("ledger", bodies::ledger);
    let entries = [
        Entry::Proposed {
            candidate: 0,
            purpose: Purpose::Initial,
            point: vec![0.1, 1.0 / 3.0],
            pending: Vec::new(),
            policy_of: None,
        },
        Entry::Trained { candidate: 0, checksum: None },
    ];
    let lines = entries.map(|entry| serde_json::to_string(&entry).unwrap());
    assert!(bodies::ledger(format!("!{}", lines.join("\n")).as_bytes()));
}

/// The bytes of a policy file with the classical controller.
fn classical() -> Vec<u8> {
    Policy::Classical(ClassicalController::new(ClassicalGains::default())).to_bytes()
}

/// Rebuilds the seeds of the corpus and `fuzz/begun.mcap`: those of the wire from `golden.txt` and
/// from frames given here, the others from files that this program writes.
#[test]
#[ignore = "writes into fuzz/; run it when a format has changed"]
fn make_seeds() {
    let directory = tempfile::tempdir().unwrap();
    let program = |arguments: &[&str]| {
        program::program(directory.path()).args(arguments).assert().success();
    };
    let put = |target: &str, name: &str, bytes: &[u8]| {
        std::fs::create_dir_all(corpus(target)).unwrap();
        std::fs::write(corpus(target).join(name), bytes).unwrap();
    };

    let small = "strategy = \"random\"\n[extent]\ninitial_candidates = 1\niterations = 0\n\
        rollouts = 1\nverification_rollouts = 1\nsteps = 1\n[homing]\nmethod = \"hand\"\n\
        [training]\nupdates = 1\nnum_envs = 16\nepochs = 1\nevaluation_starts = 1\n";
    std::fs::write(directory.path().join("small.toml"), small).unwrap();
    program(&["session", "--clock", "virtual", "--config", "small.toml", "--out", "session"]);
    let file = |name: &str| std::fs::read(directory.path().join("session").join(name)).unwrap();

    put("configuration", "small", small.as_bytes());
    put("configuration", "resolved", &file("session.toml"));
    put("configuration", "thesis", SessionSettings::thesis().to_toml().unwrap().as_bytes());
    let ledger = file("ledger.jsonl");
    put("ledger", "whole", &ledger);
    put("ledger", "torn", &ledger[..ledger.len() - 20]);
    let entries: Vec<String> = String::from_utf8(ledger)
        .unwrap()
        .lines()
        .filter_map(|line| Some(line.split_once("\"entry\":")?.1.strip_suffix('}')?.to_owned()))
        .collect();
    put("ledger", "entries", format!("!{}", entries.join("\n")).as_bytes());

    let policy = file("candidates/000/policy.safetensors");
    put("policy", "network", &policy);
    put("policy", "classical", &classical());
    put("policy", "torn", &policy[..400]);

    let recording = file("candidates/000/rollout-0-attempt-0.mcap");
    let records = records(&recording);
    let begun_end = records.iter().filter(|(opcode, ..)| *opcode == 6).nth(1).unwrap().1;
    let fuzz = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz");
    std::fs::write(fuzz.join("begun.mcap"), &recording[..begun_end]).unwrap();
    let two_blocks = records.iter().filter(|(opcode, ..)| *opcode == 6).nth(3).unwrap().1;
    put("recording", "two-blocks", &recording[..two_blocks]);
    let body_of = |wanted: u8, skip: usize| {
        let (_, start, end) = records.iter().filter(|(it, ..)| *it == wanted).nth(skip).unwrap();
        &recording[start + 9..*end]
    };
    put("recording", "header", &[&[1], body_of(12, 0)].concat());
    put("recording", "outcome", &[&[1], body_of(12, 1)].concat());
    let mut content = Vec::new();
    let packed = &body_of(6, 1)[43..];
    std::io::Read::read_to_end(&mut lz4::Decoder::new(packed).unwrap(), &mut content).unwrap();
    // One tick and a half are enough.
    content.truncate(2600);
    put("recording", "block", &[&[0], content.as_slice()].concat());

    for (name, line) in [("hello", 0), ("arm", 2), ("act", 6)] {
        let golden = include_str!("../../firmware-protocol/golden.txt");
        let frames: Vec<Vec<u8>> = golden.lines().filter_map(hexadecimal).collect();
        for mode in 0..4 {
            let bytes = [&[mode], frames[line].as_slice(), &frames.concat()].concat();
            put("wire", &format!("{name}-{mode}"), &bytes[..bytes.len().min(400)]);
        }
    }
    // Hello, Sample, Act, Disarm.
    let session = [2, 1, 1, 0, 2, 0, 0, 3, 2, 0, 6, 4, 3, 0, 232, 3, 78, 97, 188, 0, 0, 5, 4, 0];
    put("wire", "frames", &[&[2], session.as_slice()].concat());
}

/// Opcode, start and end of each record.
fn records(bytes: &[u8]) -> Vec<(u8, usize, usize)> {
    let mut records = Vec::new();
    let mut start = 8;
    while start + 9 < bytes.len() {
        let length = u64::from_le_bytes(bytes[start + 1..start + 9].try_into().unwrap());
        let end = start + 9 + length as usize;
        records.push((bytes[start], start, end));
        start = end;
    }
    records
}

/// The bytes of the frame that is the last word of a line; `None` if that word is no frame.
fn hexadecimal(line: &str) -> Option<Vec<u8>> {
    let digits = line.split_whitespace().next_back()?.as_bytes();
    if line.starts_with('#') || digits.len() < 14 || digits.len() % 2 == 1 {
        return None;
    }
    digits
        .chunks(2)
        .map(|pair| u8::from_str_radix(std::str::from_utf8(pair).ok()?, 16).ok())
        .collect()
}
