//! Tests `golden.txt`, which holds examples of the protocol for implementations in any language:
//! this crate writes exactly the bytes of its frames and reads them back, and drops, converts and
//! compares as the file says. The frames in PROTOCOL.md are among those of the file.

use firmware_protocol::scaling::{
    current_ma, motor_counts, motor_voltage_mv, motor_word, tachometer_counts_s,
};
use firmware_protocol::{
    Decoder, DeviceKind, DeviceState, DisarmReply, Frame, FrameError, HelloReply, NO_ACT_US,
    PROTOCOL_VERSION, QUBE_MODULE_ID, RefusalReason, Reply, Request, SampleReply, StatusBits,
    answers_fresh_sample, is_newer,
};

const GOLDEN: &str = include_str!("../golden.txt");

/// The page whose examples are frames of [`GOLDEN`].
const PAGE: &str = include_str!("../PROTOCOL.md");

fn requests() -> Vec<(&'static str, u16, Request)> {
    vec![
        ("hello", 1, Request::Hello { protocol_version: PROTOCOL_VERSION }),
        ("hello_of_version_1", 2, Request::Hello { protocol_version: 1 }),
        ("arm", 3, Request::Arm { nonce: 0xDEAD_BEEF }),
        ("arm_nonce_with_zeros", 0x0400, Request::Arm { nonce: 0x0001_0000 }),
        ("sample", 4, Request::Sample),
        ("sample_sequence_0", 0, Request::Sample),
        ("act_0_mv", 5, Request::Act { voltage_mv: 0, sampled_at_us: 12_345_678 }),
        ("act_plus_5000_mv", 0xFFFF, Request::Act { voltage_mv: 5000, sampled_at_us: 1 }),
        ("act_minus_5000_mv", 0x0100, Request::Act { voltage_mv: -5000, sampled_at_us: u32::MAX }),
        ("act_out_of_range", 6, Request::Act { voltage_mv: 5001, sampled_at_us: 0x0100_0000 }),
        ("disarm", 7, Request::Disarm),
    ]
}

const HELLO_REPLY: HelloReply = HelloReply {
    protocol_version: PROTOCOL_VERSION,
    firmware_version: [0, 1, 0],
    kind: DeviceKind::Atmega328p as u8,
    module_id: QUBE_MODULE_ID,
    serial: [0x01, 0x23, 0x45, 0x67, 0x89, 0xAB, 0xCD, 0xEF],
    nonce: 0xDEAD_BEEF,
    boot_id: 0x0107,
    dropped_frames: 2,
};

fn replies() -> Vec<(&'static str, u16, Reply)> {
    let sample = SampleReply {
        device_time_us: 12_345_678,
        theta_counts: -250,
        alpha_counts: 1024,
        tachometer_counts_s: -3259,
        current_ma: -119,
        status: StatusBits(StatusBits::ARMED),
        applied_mv: -1009,
        last_act_sequence: 5,
        sample_to_act_us: 920,
    };
    vec![
        ("hello_reply", 1, Reply::Hello(HELLO_REPLY)),
        (
            "hello_reply_without_qube",
            1,
            Reply::Hello(HelloReply { module_id: 0xFFFF, ..HELLO_REPLY }),
        ),
        ("hello_reply_to_another_version", 2, Reply::Hello(HelloReply { nonce: 0, ..HELLO_REPLY })),
        (
            "hello_reply_of_version_1",
            1,
            Reply::Hello(HelloReply { protocol_version: 1, boot_id: 50, ..HELLO_REPLY }),
        ),
        (
            "hello_reply_after_a_restart",
            1,
            Reply::Hello(HelloReply {
                boot_id: 0x0108,
                nonce: 0x0108_0001,
                dropped_frames: 0,
                ..HELLO_REPLY
            }),
        ),
        ("arm_reply", 3, Reply::Arm { device_time_us: 12_000_000 }),
        ("sample_reply", 4, Reply::Sample(sample)),
        (
            "sample_reply_tripped",
            8,
            Reply::Sample(SampleReply {
                status: StatusBits(StatusBits::WATCHDOG_TRIPPED),
                applied_mv: 0,
                sample_to_act_us: NO_ACT_US,
                ..sample
            }),
        ),
        (
            "sample_reply_before_any_arm",
            4,
            Reply::Sample(SampleReply {
                status: StatusBits(0),
                applied_mv: 0,
                last_act_sequence: 0,
                sample_to_act_us: NO_ACT_US,
                ..sample
            }),
        ),
        (
            "sample_reply_stalled",
            8,
            Reply::Sample(SampleReply {
                status: StatusBits(StatusBits::STALL_DETECTED | StatusBits::STALL_ERROR),
                applied_mv: 0,
                sample_to_act_us: NO_ACT_US,
                ..sample
            }),
        ),
        (
            "sample_reply_first_after_arm_cleared_the_stall",
            9,
            Reply::Sample(SampleReply {
                applied_mv: 0,
                last_act_sequence: 8,
                sample_to_act_us: NO_ACT_US,
                ..sample
            }),
        ),
        (
            "sample_reply_emergency_stop",
            8,
            Reply::Sample(SampleReply {
                status: StatusBits(StatusBits::EMERGENCY_STOP | StatusBits::STOP_SWITCH_FITTED),
                applied_mv: 0,
                sample_to_act_us: NO_ACT_US,
                ..sample
            }),
        ),
        (
            "disarm_reply",
            7,
            Reply::Disarm(DisarmReply {
                state: DeviceState::Greeted,
                nonce: 0x1234_5678,
                dropped_frames: 2,
            }),
        ),
        (
            "disarm_reply_tripped",
            7,
            Reply::Disarm(DisarmReply { state: DeviceState::Tripped, nonce: 0, dropped_frames: 2 }),
        ),
        (
            "refusal_stale_act",
            5,
            Reply::Refusal { refused_type: 0x04, reason: RefusalReason::StaleSequence },
        ),
        (
            "refusal_stale_sample",
            6,
            Reply::Refusal { refused_type: 0x04, reason: RefusalReason::StaleSample },
        ),
        (
            "refusal_emergency_stop",
            3,
            Reply::Refusal { refused_type: 0x02, reason: RefusalReason::EmergencyStop },
        ),
        (
            "refusal_unknown_type",
            9,
            Reply::Refusal { refused_type: 0x42, reason: RefusalReason::UnknownType },
        ),
    ]
}

fn decode(bytes: &[u8]) -> Option<Result<Frame, FrameError>> {
    let mut decoder = Decoder::new();
    bytes.iter().fold(None, |last, &byte| decoder.push(byte).or(last))
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn bytes(hex: &str) -> Vec<u8> {
    (0..hex.len()).step_by(2).map(|at| u8::from_str_radix(&hex[at..at + 2], 16).unwrap()).collect()
}

/// The lines of this kind in the file, split into words.
fn lines(kind: &str) -> Vec<Vec<&'static str>> {
    let lines: Vec<Vec<_>> = GOLDEN
        .lines()
        .filter(|line| !line.starts_with('#'))
        .map(|line| line.split_whitespace().collect())
        .filter(|words: &Vec<_>| words.first() == Some(&kind))
        .collect();
    assert!(!lines.is_empty(), "golden.txt has no line `{kind}`");
    lines
}

fn number<T: TryFrom<i64>>(word: &str) -> T {
    let value = match word.strip_prefix("0x") {
        Some(digits) => i64::from_str_radix(digits, 16).unwrap(),
        None => word.parse().unwrap(),
    };
    T::try_from(value).ok().unwrap_or_else(|| panic!("{word} is out of range"))
}

#[test]
fn the_examples_of_the_page_are_golden_frames() {
    let frames: Vec<&str> =
        ["request", "reply"].into_iter().flat_map(lines).map(|words| words[2]).collect();
    let examples: Vec<String> = PAGE
        .split('`')
        .filter(|text| text.len() > 2 * 7 && text.split(' ').all(is_hexadecimal_byte))
        .map(|text| text.replace(' ', ""))
        .collect();
    assert!(examples.len() >= 9, "{examples:?}");
    for example in examples {
        assert!(frames.contains(&example.as_str()), "{example} is not in golden.txt");
    }
}

fn is_hexadecimal_byte(word: &str) -> bool {
    word.len() == 2 && u8::from_str_radix(word, 16).is_ok()
}

/// Rewrites the frames of requests and replies in the file and keeps the other lines.
#[test]
#[ignore = "writes golden.txt; run it when the wire has changed"]
fn rewrite_golden_txt() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/golden.txt");
    let frames = |kind: &str| -> Vec<String> {
        if kind == "request" {
            let line = |(name, sequence, request): (_, _, Request)| {
                format!("request {name} {}", hex(request.encode(sequence).as_bytes()))
            };
            requests().into_iter().map(line).collect()
        } else {
            let line = |(name, sequence, reply): (_, _, Reply)| {
                format!("reply {name} {}", hex(reply.encode(sequence).as_bytes()))
            };
            replies().into_iter().map(line).collect()
        }
    };
    let (mut text, mut last) = (String::new(), "");
    for line in GOLDEN.lines() {
        let kind = line.split_whitespace().next().unwrap_or_default();
        if !matches!(kind, "request" | "reply") {
            text += &format!("{line}\n");
        } else if kind != last {
            text += &format!("{}\n", frames(kind).join("\n"));
        }
        last = kind;
    }
    std::fs::write(path, &text).unwrap();
}

#[test]
fn requests_are_written_and_read_as_in_the_file() {
    let file = lines("request");
    let expected: Vec<Vec<String>> = requests()
        .iter()
        .map(|(name, sequence, request)| {
            vec!["request".into(), (*name).into(), hex(request.encode(*sequence).as_bytes())]
        })
        .collect();
    assert_eq!(file, expected);
    for (words, (_, sequence, request)) in file.iter().zip(requests()) {
        let frame = decode(&bytes(words[2])).unwrap().unwrap();
        assert_eq!(frame.sequence, sequence);
        assert_eq!(Request::parse(&frame), Ok(request));
    }
}

#[test]
fn replies_are_written_and_read_as_in_the_file() {
    let file = lines("reply");
    let expected: Vec<Vec<String>> = replies()
        .iter()
        .map(|(name, sequence, reply)| {
            vec!["reply".into(), (*name).into(), hex(reply.encode(*sequence).as_bytes())]
        })
        .collect();
    assert_eq!(file, expected);
    for (words, (_, sequence, reply)) in file.iter().zip(replies()) {
        let frame = decode(&bytes(words[2])).unwrap().unwrap();
        assert_eq!(frame.sequence, sequence);
        assert_eq!(Reply::parse(&frame), Ok(reply));
    }
}

#[test]
fn bad_frames_are_dropped_as_the_file_says() {
    for words in lines("dropped") {
        let expected = match words[1] {
            "garbled" => FrameError::Garbled,
            "checksum" => FrameError::Checksum,
            "too_long" => FrameError::TooLong,
            other => panic!("golden.txt has an unknown reason `{other}`"),
        };
        assert_eq!(decode(&bytes(words[2])), Some(Err(expected)), "{words:?}");
    }
}

#[test]
fn conversions_give_the_numbers_in_the_file() {
    for words in lines("motor") {
        let counts = motor_counts(number(words[1]));
        assert_eq!(counts, number::<i16>(words[2]), "{words:?}");
        assert_eq!(motor_word(counts), number::<u16>(words[3]), "{words:?}");
        assert_eq!(motor_voltage_mv(counts), number::<i16>(words[4]), "{words:?}");
    }
    for words in lines("current") {
        assert_eq!(current_ma(number(words[1])), number::<i16>(words[2]), "{words:?}");
    }
    for words in lines("tachometer") {
        assert_eq!(tachometer_counts_s(number(words[1])), number::<i32>(words[2]), "{words:?}");
    }
    for words in lines("newer") {
        let newer = is_newer(number(words[1]), number(words[2]));
        assert_eq!(u8::from(newer), number::<u8>(words[3]), "{words:?}");
    }
    for words in lines("fresh") {
        let given_us = (words[2] != "none").then(|| number(words[2]));
        let fresh = answers_fresh_sample(number(words[1]), given_us, number(words[3]));
        assert_eq!(u8::from(fresh), number::<u8>(words[4]), "{words:?}");
    }
}
