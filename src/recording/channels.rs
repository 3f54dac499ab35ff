use std::io;

use schemars::generate::SchemaSettings;
use schemars::{JsonSchema, Schema};
use serde::Serialize;

use super::scene::{FrameTransforms, SceneUpdate};
use super::tick_messages::{
    CommandMessage, MeasurementMessage, SafetyMessage, StateMessage, TimingMessage,
};
use crate::telemetry::{Ending, RolloutHeader, TickRecord};

/// Topics of the channels.
pub(super) mod topic {
    pub(crate) const MEASUREMENT: &str = "/measurement";
    pub(crate) const STATE: &str = "/state";
    pub(crate) const COMMAND: &str = "/command";
    pub(crate) const SAFETY: &str = "/safety";
    pub(crate) const TRANSFORMS: &str = "/tf";
    pub(crate) const SCENE: &str = "/scene";
    /// Topic of the last message of each tick, which completes the tick.
    pub(crate) const TIMING: &str = "/timing";
}

/// A channel of a recording, which live viewers get too.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Channel {
    /// Reports of the device.
    Measurement,
    /// State that the policy saw.
    State,
    /// Voltages requested and sent.
    Command,
    /// Phase, lost samples, stop requests, and the ending.
    Safety,
    /// Frames of arm and pendulum.
    Transforms,
    /// Deadlines and lateness, in the last message of each tick, which completes the tick.
    Timing,
    /// Bodies in the frames, once a rollout.
    Scene,
}

/// The schema of a channel's messages, in the form that MCAP and live viewers require.
#[derive(Clone, Debug)]
pub struct ChannelSchema {
    /// Encoding of the messages: `json` or `protobuf`.
    pub message_encoding: &'static str,
    /// Name of the schema.
    pub name: String,
    /// Encoding of the schema: `jsonschema` or `protobuf`.
    pub encoding: &'static str,
    /// The schema: a text, or a serialised set of descriptors.
    pub data: Vec<u8>,
}

impl Channel {
    /// All channels, in the order of their declaration in a recording.
    pub const ALL: [Self; 7] = [
        Self::Measurement,
        Self::State,
        Self::Command,
        Self::Safety,
        Self::Transforms,
        Self::Timing,
        Self::Scene,
    ];

    /// Name of the channel.
    #[must_use]
    pub const fn topic(self) -> &'static str {
        match self {
            Self::Measurement => topic::MEASUREMENT,
            Self::State => topic::STATE,
            Self::Command => topic::COMMAND,
            Self::Safety => topic::SAFETY,
            Self::Transforms => topic::TRANSFORMS,
            Self::Timing => topic::TIMING,
            Self::Scene => topic::SCENE,
        }
    }

    /// Schema of the channel's messages.
    #[must_use]
    pub fn schema(self) -> ChannelSchema {
        match self {
            Self::Measurement => json_schema::<MeasurementMessage>(),
            Self::State => json_schema::<StateMessage>(),
            Self::Command => json_schema::<CommandMessage>(),
            Self::Safety => json_schema::<SafetyMessage>(),
            Self::Timing => json_schema::<TimingMessage>(),
            Self::Transforms => drawing(&FrameTransforms::SCHEMA),
            Self::Scene => drawing(&SceneUpdate::SCHEMA),
        }
    }
}

fn drawing(schema: &super::scene::Schema) -> ChannelSchema {
    ChannelSchema {
        message_encoding: "protobuf",
        name: schema.name.to_owned(),
        encoding: "protobuf",
        data: schema.descriptors.to_vec(),
    }
}

fn json_schema<T: JsonSchema>() -> ChannelSchema {
    let schema: Schema = SchemaSettings::draft07()
        .with(|settings| settings.inline_subschemas = true)
        .into_generator()
        .into_root_schema_for::<T>();
    let title = schema.get("title").and_then(|title| title.as_str()).unwrap_or_default();
    ChannelSchema {
        message_encoding: "json",
        name: title.to_owned(),
        encoding: "jsonschema",
        data: schema.as_value().to_string().into_bytes(),
    }
}

/// Encodes the messages of one tick and hands each to `take`. The message of [`Channel::Timing`]
/// comes last; a tick without a sample has no message of [`Channel::Measurement`]. `time_ns` is the
/// time of the tick, ns since 1970.
///
/// # Errors
/// A message cannot be encoded, or `take` fails.
pub fn encode_tick(
    header: &RolloutHeader,
    tick: &TickRecord,
    time_ns: u64,
    take: &mut dyn FnMut(Channel, &[u8]) -> io::Result<()>,
) -> io::Result<()> {
    let mut buffer = Vec::with_capacity(512);
    if let Some(measurement) = &tick.measurement {
        let message = MeasurementMessage::new(measurement, header);
        take(Channel::Measurement, json(&mut buffer, &message)?)?;
    }
    take(Channel::State, json(&mut buffer, &StateMessage::new(&tick.state))?)?;
    take(Channel::Command, json(&mut buffer, &CommandMessage::new(tick))?)?;
    take(Channel::Safety, json(&mut buffer, &SafetyMessage::new(tick))?)?;
    let transforms = FrameTransforms::new(&header.settings.plant, &tick.state, time_ns);
    take(Channel::Transforms, &transforms.to_bytes())?;
    take(Channel::Timing, json(&mut buffer, &TimingMessage::new(tick))?)
}

/// The last message of [`Channel::Safety`], with the ending of a rollout whose last tick is `last`.
///
/// # Errors
/// The message cannot be encoded.
pub fn encode_ending(last: &TickRecord, ending: Ending) -> io::Result<Vec<u8>> {
    Ok(serde_json::to_vec(&SafetyMessage::of_ending(last, ending))?)
}

/// The message of [`Channel::Scene`] for a rollout that starts at `time_ns`, ns since 1970.
#[must_use]
pub fn encode_scene(header: &RolloutHeader, time_ns: u64) -> Vec<u8> {
    SceneUpdate::new(&header.settings.plant, time_ns).to_bytes()
}

fn json<'a, T: Serialize>(buffer: &'a mut Vec<u8>, message: &T) -> io::Result<&'a [u8]> {
    buffer.clear();
    serde_json::to_writer(&mut *buffer, message)?;
    Ok(buffer)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_description_in_a_schema_is_one_line() {
        // The doc comments of the messages are part of every recording's bytes: a comment that is
        // wrapped anew would change them.
        for channel in Channel::ALL {
            let ChannelSchema { encoding, data, name, .. } = channel.schema();
            let is_wrapped = encoding == "jsonschema" && data.windows(2).any(|pair| pair == br"\n");
            assert!(!is_wrapped, "{name}: {}", String::from_utf8_lossy(&data));
        }
    }
}
