//! The bodies of the fuzz targets. Each calls public functions of the library with bytes of any
//! origin and returns whether they were accepted. The fuzzer runs them on generated input and
//! `tests/virtual_time/fuzz_corpus.rs` on the corpus.
//!
//! The first byte decides whether `wire`, `recording` and `ledger` take the bytes as they are or
//! first give them a correct checksum; `recording` then also puts them into a file. Bytes without a
//! correct checksum are refused before their content is read.
#![allow(dead_code)]

use std::collections::BTreeMap;
use std::io::Write;
use std::path::Path;

use crc::{CRC_32_ISO_HDLC, Crc};
use firmware_protocol::{Decoder, DeviceState, EncodedFrame, Frame, Reply, Request};
use qube_hil::clock::{Clock, Nanoseconds, VirtualClock};
use qube_hil::device::emulator::{Board, EmulatorSettings};
use qube_hil::device::{Device, LinkFault, SerialLink, Transport};
use qube_hil::policy::{Controller, Policy};
use qube_hil::qube::State;
use qube_hil::recording::Completeness;
use qube_hil::session::{Extent, IdentificationSettings, SessionSettings, next_step, parse_ledger};

const CRC_32: Crc<u32> = Crc::<u32>::new(&CRC_32_ISO_HDLC);

/// Decodes the bytes, or sends them to a device or to a host.
pub fn wire(bytes: &[u8]) -> bool {
    let Some((&mode, bytes)) = bytes.split_first() else { return false };
    match mode % 4 {
        0 => decode(bytes),
        1 => to_board(bytes.iter().copied()),
        2 => {
            let frames: Vec<u8> = with_checksums(bytes).collect();
            to_board(frames.into_iter())
        }
        _ => to_host(bytes),
    }
}

/// Decodes the bytes and checks that a request or a reply that is accepted is the same after it is
/// encoded and decoded.
fn decode(bytes: &[u8]) -> bool {
    let mut decoder = Decoder::new();
    let mut accepted = false;
    for &byte in bytes {
        let Some(Ok(frame)) = decoder.push(byte) else { continue };
        if let Ok(request) = Request::parse(&frame) {
            let again = decoded(&request.encode(frame.sequence));
            assert_eq!(again.map(|frame| Request::parse(&frame)), Some(Ok(request)));
            accepted = true;
        }
        if let Ok(reply) = Reply::parse(&frame) {
            let again = decoded(&reply.encode(frame.sequence));
            assert_eq!(again.map(|frame| Reply::parse(&frame)), Some(Ok(reply)));
            accepted = true;
        }
    }
    accepted
}

/// The frame in these bytes; `None` if they hold none.
fn decoded(encoded: &EncodedFrame) -> Option<Frame> {
    let mut decoder = Decoder::new();
    encoded.as_bytes().iter().find_map(|&byte| decoder.push(byte))?.ok()
}

/// Splits the bytes into contents and encodes each as a valid frame. A content is the payload's
/// length, taken modulo 26, the type, taken modulo 16, the sequence number and the payload, which
/// is shorter where the bytes end.
fn with_checksums(mut bytes: &[u8]) -> impl Iterator<Item = u8> + '_ {
    let mut frames = Vec::new();
    while let [length, message_type, low, high, rest @ ..] = bytes {
        let length = usize::from(length % 26).min(rest.len());
        let sequence = u16::from_le_bytes([*low, *high]);
        frames.extend(EncodedFrame::new(message_type % 16, sequence, &rest[..length]).as_bytes());
        bytes = &rest[length..];
    }
    frames.into_iter()
}

/// Sends the bytes to a device and checks that its amplifier is on no longer than the watchdog
/// allows and never at more than 5 V. The device has accepted the bytes if the last hello in them
/// is of its version.
fn to_board(bytes: impl Iterator<Item = u8>) -> bool {
    let mut board = Board::new(EmulatorSettings::default());
    let mut now_us = 0;
    for byte in bytes {
        now_us += 20 + 1000 * u64::from(byte % 3);
        board.advance_to(now_us);
        board.receive(byte);
        if board.state() == DeviceState::Armed {
            assert!(now_us - board.last_command_us() <= 55_000);
        } else {
            assert_eq!(board.applied_mv(), 0);
        }
        assert!(board.applied_mv().abs() <= 5_020, "more than the count nearest to 5 V, 4997 mV");
    }
    board.state() != DeviceState::Idle
}

/// A port that ignores each request and delivers these bytes, at most 48 for a read.
struct ScriptedPort<'a> {
    bytes: &'a [u8],
    clock: VirtualClock,
}

impl Transport for ScriptedPort<'_> {
    fn read(&mut self, buffer: &mut [u8], deadline_ns: Nanoseconds) -> Result<usize, LinkFault> {
        let length = buffer.len().min(self.bytes.len()).min(48);
        let (now, later) = self.bytes.split_at(length);
        buffer[..length].copy_from_slice(now);
        self.bytes = later;
        self.clock.sleep_until(if length == 0 { deadline_ns } else { self.clock.now_ns() + 1000 });
        Ok(length)
    }

    fn write(&mut self, _bytes: &[u8]) -> Result<(), LinkFault> {
        Ok(())
    }

    fn name(&self) -> &str {
        "scripted"
    }

    fn boot_time_ns(&self) -> Nanoseconds {
        200_000_000
    }
}

/// Sends the bytes to a host and checks that it does not panic, and that it waits for a sample no
/// longer than 1 ms past the deadline. The host has accepted the bytes if they answer its hello.
fn to_host(bytes: &[u8]) -> bool {
    let clock = VirtualClock::default();
    let port = ScriptedPort { bytes, clock: clock.clone() };
    let mut link = SerialLink::new(port, std::sync::Arc::new(clock.clone()));
    let accepted = link.hello().is_ok();
    let _ = link.arm();
    let deadline_ns = clock.now_ns() + 6_000_000;
    let sample = link.sample(deadline_ns);
    assert!(clock.now_ns() <= deadline_ns + 1_000_000);
    let _ = link.act(1000, sample.map_or(0, |sample| sample.device_time_us));
    let _ = link.disarm();
    accepted
}

/// Reads a policy and checks that, if it is accepted, it survives a round trip and decides without
/// a panic.
pub fn policy(bytes: &[u8]) -> bool {
    let Ok(mut policy) = Policy::from_bytes(bytes) else { return false };
    let again = policy.to_bytes();
    let same = Policy::from_bytes(&again).map(|policy| policy.to_bytes());
    assert!(same.is_ok_and(|same| same == again));
    policy.start();
    for scale in [0.0, 1.0, 1e3, f64::NAN] {
        let state = State { theta: scale, alpha: -scale, theta_dot: 9.0 * scale, alpha_dot: scale };
        let _ = policy.voltage_v(&state);
        policy.applied(scale);
    }
    true
}

/// Reads a recording and checks that, if any of it can be used, it is scored without a panic. The
/// bytes are accepted if every byte can be used.
pub fn recording(bytes: &[u8]) -> bool {
    let Some((&mode, rest)) = bytes.split_first() else { return false };
    let parsed = match mode {
        // The content of one block, compressed and under its checksum.
        0 => qube_hil::recording::parse(&recording_with(6, &block(rest))),
        // A metadata record, whose map has its checksum.
        1 => {
            let body = metadata_with_checksum(rest).unwrap_or_else(|| rest.to_vec());
            qube_hil::recording::parse(&recording_with(12, &body))
        }
        // An attachment, under its checksum.
        2 => {
            let checksum = CRC_32.checksum(rest).to_le_bytes();
            qube_hil::recording::parse(&recording_with(9, &[rest, &checksum].concat()))
        }
        _ => qube_hil::recording::parse(bytes),
    };
    let Ok(recording) = parsed else { return false };
    let _ = qube_hil::scoring::return_of(&recording.ticks, &recording.header.reward);
    let _ = qube_hil::scoring::score_recording(&recording);
    !matches!(recording.completeness, Completeness::CutOff { lost_bytes: 1.., .. })
}

/// The beginning of a recording of the program (header, policy, channels), followed by one record.
fn recording_with(opcode: u8, body: &[u8]) -> Vec<u8> {
    const BEGUN: &[u8] = include_bytes!("begun.mcap");
    let mut bytes = BEGUN.to_vec();
    bytes.push(opcode);
    bytes.extend((body.len() as u64).to_le_bytes());
    bytes.extend(body);
    bytes
}

/// The body of a metadata record (a name and a map) with the right checksum in its map; `None` if
/// the bytes are no such body.
fn metadata_with_checksum(mut bytes: &[u8]) -> Option<Vec<u8>> {
    const CHECKSUM: &[u8] = b"crc32";
    let name = take_field(&mut bytes)?;
    let mut pairs = take_field(&mut bytes)?;
    let mut map = BTreeMap::new();
    while !pairs.is_empty() {
        let key = take_field(&mut pairs)?;
        map.insert(key, take_field(&mut pairs)?);
    }
    map.remove(CHECKSUM);
    let mut digest = CRC_32.digest();
    for part in map.iter().flat_map(|(key, value)| [*key, *value]) {
        digest.update(&(part.len() as u64).to_le_bytes());
        digest.update(part);
    }
    let checksum = format!("{:08x}", digest.finalize());
    map.insert(CHECKSUM, checksum.as_bytes());
    let pairs: Vec<u8> =
        map.iter().flat_map(|(key, value)| [field(key), field(value)].concat()).collect();
    Some([field(name), field(&pairs)].concat())
}

/// The bytes behind their length, as MCAP stores texts and maps.
fn field(bytes: &[u8]) -> Vec<u8> {
    [(bytes.len() as u32).to_le_bytes().as_slice(), bytes].concat()
}

/// Takes the content of a [`field`] off the bytes; `None` if they hold none.
fn take_field<'a>(bytes: &mut &'a [u8]) -> Option<&'a [u8]> {
    let (length, rest) = bytes.split_first_chunk()?;
    let (content, rest) = rest.split_at_checked(u32::from_le_bytes(*length) as usize)?;
    *bytes = rest;
    Some(content)
}

/// The body of a block with this content, compressed and under its checksum.
fn block(content: &[u8]) -> Vec<u8> {
    let mut encoder =
        lz4::EncoderBuilder::new().build(Vec::new()).expect("writing to memory does not fail");
    encoder.write_all(content).expect("writing to memory does not fail");
    let packed = encoder.finish().0;
    let mut chunk = vec![0; 16];
    chunk.extend((content.len() as u64).to_le_bytes());
    chunk.extend(CRC_32.checksum(content).to_le_bytes());
    chunk.extend(3_u32.to_le_bytes());
    chunk.extend(b"lz4");
    chunk.extend((packed.len() as u64).to_le_bytes());
    chunk.extend(packed);
    chunk
}

/// Reads a configuration and checks that, if it is accepted and has a form in TOML, it survives a
/// round trip.
pub fn configuration(bytes: &[u8]) -> bool {
    let Ok(text) = std::str::from_utf8(bytes) else { return false };
    let path = Path::new("session.toml");
    let Ok(settings) = SessionSettings::quick().overridden_by_text(text, path) else {
        return false;
    };
    if let Ok(written) = settings.to_toml() {
        let again = SessionSettings::thesis().overridden_by_text(&written, path);
        assert_eq!(again.ok(), Some(settings));
    }
    true
}

/// Reads a ledger and checks that, if it is accepted, the next step of its session can be decided.
/// A ledger without an entry does not count as accepted.
pub fn ledger(bytes: &[u8]) -> bool {
    let Some((&mode, rest)) = bytes.split_first() else { return false };
    let mut text = Vec::new();
    let bytes = if mode == b'!' {
        for entry in rest.split(|&byte| byte == b'\n') {
            let checksum = CRC_32.checksum(entry);
            let _ = write!(text, "{{\"crc32\":\"{checksum:08x}\",\"entry\":");
            text.extend(entry);
            text.extend(b"}\n");
        }
        text.as_slice()
    } else {
        bytes
    };
    let Ok(parsed) = parse_ledger(bytes) else { return false };
    assert!(parsed.whole_bytes <= bytes.len());
    for identification in [None, Some(&IdentificationSettings::DEFAULT)] {
        let _ = next_step(&parsed.state, &Extent::QUICK, identification);
    }
    assert!(parsed.state.candidates().len() <= parsed.entries.len());
    !parsed.entries.is_empty()
}
