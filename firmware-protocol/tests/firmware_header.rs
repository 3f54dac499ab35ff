//! Tests that the firmware's constants are those of this crate: generates the text of
//! `firmware/wire.h` and compares it with the committed file.
//!
//! `UPDATE_FIRMWARE_HEADER=1 cargo test -p firmware-protocol --test firmware_header` rewrites the
//! file.

use std::fmt::Write;
use std::path::Path;

use firmware_protocol::scaling::{
    CURRENT_COUNTS_PER_A, CURRENT_ZERO, FULL_MOTOR_COUNTS, MAX_VOLTAGE_MV, MOTOR_ENABLE, SUPPLY_MV,
    TACHOMETER_COUNTS_S_TICKS, TACHOMETER_NEGATIVE, TACHOMETER_STILL, TACHOMETER_TICKS,
};
use firmware_protocol::{
    BAUD_RATE, Decoder, DeviceKind, DeviceState, DisarmReply, HelloReply, MAX_FRAME_BYTES,
    MAX_PAYLOAD_BYTES, MAX_SAMPLE_AGE_US, NO_ACT_US, PROTOCOL_VERSION, QUBE_MODULE_ID,
    RefusalReason, Reply, Request, SampleReply, StatusBits, WATCHDOG_MS, WATCHDOG_POLL_MS,
};

/// The C name of a variant: `WATCHDOG_TRIPPED` for `WatchdogTripped`.
fn c_name(name: &str) -> String {
    let mut c_name = String::new();
    for (at, letter) in name.char_indices() {
        if letter.is_uppercase() && at > 0 {
            c_name.push('_');
        }
        c_name.extend(letter.to_uppercase());
    }
    c_name
}

fn define(header: &mut String, name: &str, value: impl std::fmt::Display) {
    writeln!(header, "#define {name} {value}").unwrap();
}

fn c_enum(header: &mut String, name: &str, prefix: &str, values: &[(String, u8)]) {
    writeln!(header, "\nenum {name} {{").unwrap();
    for (value_name, value) in values {
        writeln!(header, "    {prefix}_{} = {value},", c_name(value_name)).unwrap();
    }
    writeln!(header, "}};").unwrap();
}

fn type_of(reply: Reply) -> u8 {
    let mut decoder = Decoder::new();
    let encoded = reply.encode(0);
    let frame = encoded.as_bytes().iter().find_map(|&byte| decoder.push(byte));
    frame.unwrap().unwrap().message_type
}

fn request_types() -> Vec<(String, u8)> {
    [
        ("Hello", Request::Hello { protocol_version: 0 }),
        ("Arm", Request::Arm { nonce: 0 }),
        ("Sample", Request::Sample),
        ("Act", Request::Act { voltage_mv: 0, sampled_at_us: 0 }),
        ("Disarm", Request::Disarm),
    ]
    .map(|(name, request)| (name.to_owned(), request.message_type()))
    .to_vec()
}

fn reply_types() -> Vec<(String, u8)> {
    let hello = HelloReply {
        protocol_version: 0,
        firmware_version: [0; 3],
        kind: 0,
        module_id: 0,
        serial: [0; 8],
        nonce: 0,
        boot_id: 0,
        dropped_frames: 0,
    };
    let disarm = DisarmReply { state: DeviceState::Idle, nonce: 0, dropped_frames: 0 };
    let refusal = Reply::Refusal { refused_type: 0, reason: RefusalReason::NotGreeted };
    [
        ("Hello", Reply::Hello(hello)),
        ("Arm", Reply::Arm { device_time_us: 0 }),
        ("Sample", Reply::Sample(SampleReply::default())),
        ("Disarm", Reply::Disarm(disarm)),
        ("Refusal", refusal),
    ]
    .map(|(name, reply)| (name.to_owned(), type_of(reply)))
    .to_vec()
}

fn header() -> String {
    let mut header = String::from(
        "/* Written from the Rust crate firmware-protocol by its test `firmware_header`: do not edit.\n\
         \x20* PROTOCOL.md explains the values. */\n\
         #ifndef WIRE_H\n#define WIRE_H\n\n",
    );
    let text = &mut header;
    let mut version = env!("CARGO_PKG_VERSION").split('.');
    for part in ["MAJOR", "MINOR", "PATCH"] {
        define(text, &format!("FIRMWARE_VERSION_{part}"), version.next().unwrap());
    }
    define(text, "PROTOCOL_VERSION", format_args!("{PROTOCOL_VERSION}u"));
    define(text, "QUBE_MODULE_ID", format_args!("0x{QUBE_MODULE_ID:04X}u"));
    define(text, "BAUD_RATE", format_args!("{BAUD_RATE}ul"));
    define(text, "WATCHDOG_MS", format_args!("{WATCHDOG_MS}u"));
    define(text, "WATCHDOG_POLL_MS", format_args!("{WATCHDOG_POLL_MS}u"));
    define(text, "MAX_SAMPLE_AGE_US", format_args!("{MAX_SAMPLE_AGE_US}ul"));
    define(text, "NO_ACT_US", format_args!("0x{NO_ACT_US:04X}u"));
    define(text, "MAX_PAYLOAD_BYTES", format_args!("{MAX_PAYLOAD_BYTES}u"));
    define(text, "MAX_FRAME_BYTES", format_args!("{MAX_FRAME_BYTES}u"));
    define(text, "MAX_VOLTAGE_MV", MAX_VOLTAGE_MV);
    define(text, "FULL_MOTOR_COUNTS", format_args!("{FULL_MOTOR_COUNTS}l"));
    define(text, "SUPPLY_MV", format_args!("{SUPPLY_MV}l"));
    define(text, "MOTOR_ENABLE", format_args!("0x{MOTOR_ENABLE:04X}u"));
    define(text, "CURRENT_ZERO", format_args!("{CURRENT_ZERO}l"));
    define(text, "CURRENT_COUNTS_PER_A", format_args!("{CURRENT_COUNTS_PER_A}l"));
    define(text, "TACHOMETER_TICKS", format_args!("0x{TACHOMETER_TICKS:06X}ul"));
    define(text, "TACHOMETER_STILL", format_args!("0x{TACHOMETER_STILL:06X}ul"));
    define(text, "TACHOMETER_NEGATIVE", format_args!("0x{TACHOMETER_NEGATIVE:06X}ul"));
    define(text, "TACHOMETER_COUNTS_S_TICKS", format_args!("{TACHOMETER_COUNTS_S_TICKS}ul"));

    c_enum(text, "request_type", "REQUEST", &request_types());
    // A device drops frames with a type from 0x80 on, because only replies have such a type.
    define(text, "FIRST_REPLY_TYPE", "0x80u");
    c_enum(text, "reply_type", "REPLY", &reply_types());
    let status = [
        ("Armed", StatusBits::ARMED),
        ("WatchdogTripped", StatusBits::WATCHDOG_TRIPPED),
        ("AmplifierFault", StatusBits::AMPLIFIER_FAULT),
        ("StallDetected", StatusBits::STALL_DETECTED),
        ("StallError", StatusBits::STALL_ERROR),
        ("EmergencyStop", StatusBits::EMERGENCY_STOP),
        ("StopSwitchFitted", StatusBits::STOP_SWITCH_FITTED),
    ]
    .map(|(name, bit)| (name.to_owned(), bit));
    c_enum(text, "status_bit", "STATUS", &status);
    macro_rules! all {
        ($type:ident) => {
            $type::ALL.iter().map(|value| (format!("{value:?}"), *value as u8)).collect::<Vec<_>>()
        };
    }
    c_enum(text, "device_kind", "KIND", &all!(DeviceKind));
    c_enum(text, "device_state", "STATE", &all!(DeviceState));
    c_enum(text, "refusal_reason", "REFUSAL", &all!(RefusalReason));
    header.push_str("\n#endif\n");
    header
}

#[test]
fn the_firmware_has_the_constants_of_this_crate() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("firmware/wire.h");
    let expected = header();
    if std::env::var_os("UPDATE_FIRMWARE_HEADER").is_some() {
        std::fs::write(&path, &expected).unwrap();
    }
    let committed = std::fs::read_to_string(&path).unwrap_or_default();
    assert!(
        committed == expected,
        "{} differs from this crate's constants; write it anew with \
         UPDATE_FIRMWARE_HEADER=1 cargo test -p firmware-protocol --test firmware_header",
        path.display()
    );
}
