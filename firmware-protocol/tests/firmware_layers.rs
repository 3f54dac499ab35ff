//! Tests the firmware's pure layers, compiled for this computer with warnings as errors and, where
//! the compiler has them, with sanitisers: the layers agree with `golden.txt` and, on random bytes
//! and counts, with this crate; emergency stop and watchdog act as PROTOCOL.md says.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::OnceLock;

use firmware_protocol::{Decoder, DeviceState, Request, WATCHDOG_MS};

const GOLDEN: &str = include_str!("../golden.txt");

const SANITISERS: &str = "-fsanitize=address,undefined";

/// Compiles the C program that answers questions about the firmware's layers; returns whether the
/// compiler succeeded.
fn compile(flags: &[&str], program: &Path) -> bool {
    let firmware = Path::new(env!("CARGO_MANIFEST_DIR")).join("firmware");
    let sources = ["host_test/layers.c", "device.c", "link.c", "qube_frame.c"];
    Command::new("cc")
        .args(["-std=c11", "-O1", "-g", "-Wall", "-Wextra", "-Werror", "-fshort-enums"])
        .args(flags)
        .args(sources.map(|source| firmware.join(source)))
        .arg("-o")
        .arg(program)
        .status()
        .expect("a C compiler is needed to build this workspace at all")
        .success()
}

/// The path of the C program, which is compiled once for each run of the tests. If it cannot be
/// compiled with sanitisers, it is compiled without them, and a line on stderr says so; with
/// `QUBE_HIL_REQUIRE_FIRMWARE` set, the tests fail instead.
fn program() -> &'static Path {
    static PROGRAM: OnceLock<PathBuf> = OnceLock::new();
    PROGRAM.get_or_init(|| {
        let program = Path::new(env!("CARGO_TARGET_TMPDIR")).join("firmware_layers");
        if !compile(&[SANITISERS], &program) {
            assert!(compile(&[], &program), "the C program does not compile");
            let required = std::env::var_os("QUBE_HIL_REQUIRE_FIRMWARE")
                .is_some_and(|value| !value.is_empty());
            assert!(!required, "the firmware must be tested here, but cc has no {SANITISERS}");
            // Not with eprintln, which the test harness captures.
            let _ = writeln!(std::io::stderr(), "\nSKIPPED: sanitisers: cc has no {SANITISERS}");
        }
        program
    })
}

/// Asks the C program, one question a line; returns the answers, one a question.
fn ask(questions: &[String]) -> Vec<String> {
    let mut child = Command::new(program())
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .expect("the C program starts");
    let mut stdin = child.stdin.take().unwrap();
    let input = questions.join("\n") + "\n";
    let writer = std::thread::spawn(move || stdin.write_all(input.as_bytes()).unwrap());
    let output = child.wait_with_output().unwrap();
    writer.join().unwrap();
    assert!(output.status.success(), "the C program failed: {}", output.status);
    let answers: Vec<_> =
        String::from_utf8(output.stdout).unwrap().lines().map(str::to_owned).collect();
    assert_eq!(answers.len(), questions.len());
    answers
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// A random generator with the same numbers in every run.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0 >> 16
    }
}

#[test]
fn the_firmware_agrees_with_the_golden_file() {
    let mut questions = Vec::new();
    let mut expected = Vec::new();
    for line in GOLDEN.lines().filter(|line| !line.starts_with('#')) {
        let words: Vec<_> = line.split_whitespace().collect();
        let (question, answer) = match words[0] {
            "request" | "reply" => (format!("again {}", words[2]), format!("again {}", words[2])),
            "dropped" => (format!("stream {}", words[2]), "stream dropped".to_owned()),
            "newer" | "fresh" => {
                let (answer, question) = words.split_last().unwrap();
                (question.join(" "), format!("{} {answer}", words[0]))
            }
            kind => (format!("{kind} {}", words[1]), format!("{kind} {}", words[2..].join(" "))),
        };
        questions.push(question);
        expected.push(answer);
    }
    assert!(questions.len() > 40);
    assert_eq!(ask(&questions), expected);
}

/// Tests the emergency-stop switch by lists of events. A question says whether the board knows of a
/// switch at its start (1 or 0) and lists events: a millisecond with closed (`c`) or open (`o`)
/// contact, a Hello (`h`), an Arm (`a`). In the answers, a number is the state after an event (1
/// Greeted, 2 Armed, 4 Faulted), `!` means that the switch is latched as open, `r` is an Arm that
/// is refused for it, `?` a board that knows of no emergency-stop switch.
#[test]
fn the_firmware_latches_the_emergency_stop_until_hello() {
    let closed = "c".repeat(101);
    let fitted_after = format!("{}{}", " 1?".repeat(100), " 1");
    let (questions, expected): (Vec<String>, Vec<String>) = [
        // The switch opens while armed: Faulted, and only a Hello that finds it closed allows an
        // Arm.
        ("1 cacoooocchah", " 1 2 2 2 2 2 4! 4! 4! 1 2 1"),
        ("1 caooooahachcca", " 1 2 2 2 2 4! 4! 1! r 1! 1 1 1 2"),
        // An opening of 2 ms does not count.
        ("1 caoocoocooc", " 1 2 2 2 2 2 2 2 2 2 2"),
        // The switch opens and closes before the Arm: it is latched as open.
        ("1 cooooccaha", " 1 1 1 1 1! 1! 1! r 1 2"),
        // The switch was never closed, so nothing stops and nothing is latched.
        ("0 ooooaoooo", " 1? 1? 1? 1? 2? 2? 2? 2? 2?"),
    ]
    .map(|(question, answer)| (format!("stop {question}"), format!("stop{answer}")))
    .into_iter()
    .chain([(format!("stop 0 {closed}"), format!("stop{fitted_after}"))])
    .unzip();
    assert_eq!(ask(&questions), expected);
}

#[test]
fn the_firmware_cuts_any_bytes_into_the_same_frames() {
    let mut random = Random(0x5EED_CAFE);
    let mut questions = Vec::new();
    let mut expected = Vec::new();
    for _ in 0..2000 {
        let mut bytes = Vec::new();
        while bytes.len() < 150 {
            let mut piece = match random.next() % 5 {
                0 => vec![random.next() as u8; (random.next() % 40) as usize],
                1 => vec![0],
                2 => Request::Arm { nonce: random.next() as u32 }
                    .encode(random.next() as u16)
                    .as_bytes()
                    .to_vec(),
                _ => Request::Act {
                    voltage_mv: random.next() as i16,
                    sampled_at_us: random.next() as u32,
                }
                .encode(random.next() as u16)
                .as_bytes()
                .to_vec(),
            };
            if random.next().is_multiple_of(4) && !piece.is_empty() {
                let at = random.next() as usize % piece.len();
                piece[at] ^= 1 << (random.next() % 8);
            }
            bytes.extend(piece);
        }
        let mut answer = "stream".to_owned();
        let mut decoder = Decoder::new();
        for event in bytes.iter().filter_map(|&byte| decoder.push(byte)) {
            answer.push_str(&match event {
                Ok(frame) => format!(
                    " {:02x}:{:04x}:{}",
                    frame.message_type,
                    frame.sequence,
                    hex(frame.payload())
                ),
                Err(_) => " dropped".to_owned(),
            });
        }
        questions.push(format!("stream {}", hex(&bytes)));
        expected.push(answer);
    }
    assert_eq!(ask(&questions), expected);
}

#[test]
fn the_firmware_extends_counters_across_every_edge() {
    let mut random = Random(77);
    let mut questions = Vec::new();
    let mut expected = Vec::new();
    for round in 0..2000 {
        let edge = [0, 0x7F_FFFF, -0x80_0000, 0xFF_FFFF, i32::MAX, i32::MIN][round % 6];
        let last = edge.wrapping_add((random.next() % 2001) as i32 - 1000);
        let moved = (random.next() % 2001) as i32 - 1000;
        let next = last.wrapping_add(moved);
        questions.push(format!("extend {last} {}", next as u32 & 0xFF_FFFF));
        expected.push(format!("extend {next}"));
    }
    assert_eq!(ask(&questions), expected);
}

#[test]
fn the_firmwares_watchdog_is_right_across_the_wrap_of_its_clock() {
    let watchdog_us = u32::from(WATCHDOG_MS) * 1000;
    let mut questions = Vec::new();
    let mut expected = Vec::new();
    for fed_us in [0, 1, u32::MAX - watchdog_us, u32::MAX - 20_000, u32::MAX] {
        for (elapsed_us, state, motor) in [
            (0, DeviceState::Armed, "0x8000"),
            (watchdog_us - 1, DeviceState::Armed, "0x8000"),
            (watchdog_us, DeviceState::Tripped, "0x0000"),
            (u32::MAX, DeviceState::Tripped, "0x0000"),
        ] {
            questions.push(format!("watchdog {fed_us} {}", fed_us.wrapping_add(elapsed_us)));
            expected.push(format!("watchdog {} {motor}", state as u8));
        }
    }
    assert_eq!(ask(&questions), expected);
}
