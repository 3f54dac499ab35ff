//! Tests that readers and viewers of other programs understand a recording.

use std::path::Path;

use prost_reflect::{DescriptorPool, DynamicMessage, Value};

use super::samples::{POLICY, header, outcome, recorded, tick, ticks};
use super::tests::all_bits;
use super::{Completeness, LAST_TICKS_ATTACHMENT, RolloutWriter, VIRTUAL_EPOCH_UNIX_NS, parse};

/// Tests that another reader finds no wrong checksum of a block, the data or the summary, that it
/// finds the index and one attachment, and that each message fits its schema.
#[test]
fn a_recording_is_an_mcap_file_for_other_readers() {
    let ticks = ticks(25);
    let bytes = recorded(&ticks);
    let mut reader = mcap::sans_io::LinearReader::new_with_options(
        mcap::sans_io::LinearReaderOptions::default()
            .with_validate_chunk_crcs(true)
            .with_validate_data_section_crc(true)
            .with_validate_summary_section_crc(true)
            .with_check_finishes_after_end_magic(true),
    );
    let mut rest = bytes.as_slice();
    while let Some(event) = reader.next_event() {
        if let mcap::sans_io::LinearReadEvent::ReadRequest(wanted) = event.unwrap() {
            let count = wanted.min(rest.len());
            reader.insert(count).copy_from_slice(&rest[..count]);
            reader.notify_read(count);
            rest = &rest[count..];
        }
    }

    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    let stats = summary.stats.unwrap();
    assert_eq!((stats.channel_count, stats.attachment_count, stats.metadata_count), (7, 1, 3));
    let held_over = ticks.iter().filter(|tick| tick.measurement.is_none()).count();
    let ending_and_scene = 2;
    assert_eq!(stats.message_count as usize, 6 * ticks.len() - held_over + ending_and_scene);

    let (mut endings, mut frames, mut bodies) = (0, 0, 0);
    for message in mcap::MessageStream::new(&bytes).unwrap() {
        let message = message.unwrap();
        let schema = message.channel.schema.as_ref().unwrap();
        if schema.encoding == "protobuf" {
            assert_eq!(message.channel.message_encoding, "protobuf");
            let pool = DescriptorPool::decode(&*schema.data).unwrap();
            let descriptor = pool.get_message_by_name(&schema.name).unwrap();
            let decoded = DynamicMessage::decode(descriptor, &*message.data).unwrap();
            assert_eq!(decoded.unknown_fields().count(), 0, "{decoded}");
            match message.channel.topic.as_str() {
                "/tf" => frames += list(&decoded, "transforms").len(),
                "/scene" => bodies += list(&decoded, "entities").len(),
                other => panic!("{other} is no topic of a drawing"),
            }
            continue;
        }
        let value: serde_json::Value = serde_json::from_slice(&message.data).unwrap();
        assert_eq!(schema.encoding, "jsonschema");
        let schema: serde_json::Value = serde_json::from_slice(&schema.data).unwrap();
        assert_fits(&value, &schema);
        if value.get("ending") == Some(&"left_box: theta".into()) {
            assert_eq!(value["ending_number"], 2);
            endings += 1;
        }
    }
    assert_eq!((frames, bodies), (2 * ticks.len(), 3));
    assert_eq!(endings, 1);
}

#[test]
fn a_recording_whose_blocks_another_writer_has_divided_anew_loses_no_tick() {
    let bytes = recorded(&ticks(40));
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    for block_bytes in [1, 900, 5000, 1 << 20] {
        let options = mcap::WriteOptions::new().compression(Some(mcap::Compression::Lz4));
        let options = options.chunk_size(Some(block_bytes));
        let mut writer = options.create(std::io::Cursor::new(Vec::new())).unwrap();
        for index in &summary.metadata_indexes {
            let mcap::records::Metadata { name, metadata } =
                mcap::read::metadata(&bytes, index).unwrap();
            writer.write_metadata(&mcap::records::Metadata { name, metadata }).unwrap();
        }
        for index in &summary.attachment_indexes {
            writer.attach(&mcap::read::attachment(&bytes, index).unwrap()).unwrap();
        }
        for message in mcap::MessageStream::new(&bytes).unwrap() {
            writer.write(&message.unwrap()).unwrap();
        }
        writer.finish().unwrap();
        let recording = parse(&writer.into_inner().into_inner()).unwrap();
        assert_eq!(all_bits(&recording.ticks), all_bits(&ticks(40)), "{block_bytes}");
        assert_eq!(recording.outcome, Some(outcome()));
    }
}

fn list(message: &DynamicMessage, field: &str) -> Vec<Value> {
    message.get_field_by_name(field).unwrap().as_list().unwrap().to_vec()
}

/// The number in a field of nested messages.
fn number_at(value: &Value, path: &[&str]) -> f64 {
    match path.split_first() {
        None => value.as_f64().unwrap(),
        Some((field, rest)) => {
            let message = value.as_message().unwrap();
            number_at(&message.get_field_by_name(field).unwrap(), rest)
        }
    }
}

#[test]
fn viewers_read_the_frames_and_bodies_that_were_meant() {
    let mut tick = tick(0);
    (tick.state.theta, tick.state.alpha) = (0.5, -1.0);
    let bytes = recorded(&[tick]);
    for message in mcap::MessageStream::new(&bytes).unwrap() {
        let message = message.unwrap();
        let schema = message.channel.schema.as_ref().unwrap();
        if schema.encoding != "protobuf" {
            continue;
        }
        let pool = DescriptorPool::decode(&*schema.data).unwrap();
        let descriptor = pool.get_message_by_name(&schema.name).unwrap();
        let decoded = DynamicMessage::decode(descriptor, &*message.data).unwrap();
        if message.channel.topic == "/tf" {
            let frames = list(&decoded, "transforms");
            assert_eq!(number_at(&frames[0], &["rotation", "z"]), 0.25_f64.sin());
            assert_eq!(number_at(&frames[0], &["rotation", "w"]), 0.25_f64.cos());
            assert_eq!(number_at(&frames[1], &["rotation", "x"]), (-0.5_f64).sin());
            assert_eq!(number_at(&frames[1], &["translation", "x"]), 0.085);
        } else {
            let bodies = list(&decoded, "entities");
            let cubes = bodies[2].as_message().unwrap().get_field_by_name("cubes").unwrap();
            let pendulum = &cubes.as_list().unwrap()[0];
            assert_eq!(number_at(pendulum, &["size", "z"]), 0.129);
            assert_eq!(number_at(pendulum, &["pose", "position", "z"]), -0.5 * 0.129);
            assert_eq!(number_at(pendulum, &["pose", "orientation", "w"]), 1.0);
            assert_eq!(number_at(pendulum, &["color", "r"]), 0.8);
        }
    }
}

#[test]
fn times_of_a_virtual_clock_count_from_a_named_date() {
    let log_times = |started_unix_ns| {
        let header = crate::telemetry::RolloutHeader { started_unix_ns, ..header() };
        let path = Path::new("memory");
        let mut writer = RolloutWriter::begin(Vec::new(), path, header, POLICY).unwrap();
        writer.write(&tick(0)).unwrap();
        writer.write(&tick(1)).unwrap();
        let bytes = writer.finish(&outcome()).unwrap();
        let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
        let index = summary.metadata_indexes.iter().find(|it| it.name == "clock").unwrap();
        let clock = mcap::read::metadata(&bytes, index).unwrap().metadata;
        let stats = summary.stats.unwrap();
        (clock, stats.message_start_time, stats.message_end_time)
    };
    let (clock, start_ns, end_ns) = log_times(None);
    assert_eq!(clock["clock"], "virtual");
    assert_eq!(clock["epoch_unix_ns"], VIRTUAL_EPOCH_UNIX_NS.to_string());
    assert_eq!((start_ns, end_ns), (VIRTUAL_EPOCH_UNIX_NS, VIRTUAL_EPOCH_UNIX_NS + 10_000_000));
    let (clock, start_ns, _) = log_times(Some(1_700_000_000_000_000_000));
    assert_eq!((clock["clock"].as_str(), start_ns), ("wall", 1_700_000_000_000_000_000));
    assert_eq!(clock["epoch_unix_ns"], "1700000000000000000");
}

/// Checks a value against a schema of the types that viewers support: one plain type a field.
fn assert_fits(value: &serde_json::Value, schema: &serde_json::Value) {
    let kind = schema["type"].as_str().unwrap_or_else(|| panic!("{schema} has no plain type"));
    match kind {
        "object" => {
            for required in schema["required"].as_array().into_iter().flatten() {
                assert!(value.get(required.as_str().unwrap()).is_some(), "{required} in {value}");
            }
            for (name, field) in value.as_object().unwrap() {
                assert_fits(field, &schema["properties"][name]);
            }
        }
        "array" => {
            for item in value.as_array().unwrap() {
                assert_fits(item, &schema["items"]);
            }
        }
        "number" => assert!(value.is_number()),
        "integer" => assert!(value.is_i64() || value.is_u64()),
        "boolean" => assert!(value.is_boolean()),
        "string" => assert!(value.is_string()),
        other => panic!("viewers do not support the type {other}"),
    }
}

#[test]
fn the_last_ticks_of_a_fault_are_attached() {
    let mut writer =
        RolloutWriter::begin(Vec::new(), Path::new("memory"), header(), POLICY).unwrap();
    for number in 0..7 {
        writer.write(&tick(number)).unwrap();
    }
    writer.attach_last_ticks(&ticks(7)[2..]).unwrap();
    let bytes = writer.finish(&outcome()).unwrap();

    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    let index = summary
        .attachment_indexes
        .iter()
        .find(|index| index.name == LAST_TICKS_ATTACHMENT)
        .unwrap();
    let attachment = mcap::read::attachment(&bytes, index).unwrap();
    let lines: Vec<serde_json::Value> = attachment
        .data
        .split(|byte| *byte == b'\n')
        .filter(|line| !line.is_empty())
        .map(|line| serde_json::from_slice(line).unwrap())
        .collect();
    let numbers: Vec<_> = lines.iter().map(|line| line["tick"].as_u64().unwrap()).collect();
    assert_eq!(numbers, [2, 3, 4, 5, 6]);

    let recording = parse(&bytes).unwrap();
    assert_eq!(recording.completeness, Completeness::Whole);
    assert_eq!(all_bits(&recording.ticks), all_bits(&ticks(7)));
}
