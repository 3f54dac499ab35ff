use std::collections::BTreeMap;

use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;
use thiserror::Error;

use super::wire_format::CRC_32;

/// Name of the metadata record with the rollout's header.
pub(super) const HEADER: &str = "rollout";
/// Name of the metadata record with the clock of the file's times, `wall` or `virtual`, and the
/// time from which they count.
pub(super) const CLOCK: &str = "clock";
/// Name of the metadata record with the rollout's outcome.
pub(super) const OUTCOME: &str = "outcome";
/// Name of the metadata record that marks a recovered file and lists the losses.
pub(super) const RECOVERED: &str = "recovered";

/// Key of the checksum over a metadata record. MCAP has no checksum of metadata itself, and a
/// truncated file lacks the checksum over its data section too.
const CHECKSUM: &str = "crc32";

/// Converts a struct to a map: one JSON text for each field, and a checksum over all of them.
/// `None` if the value would not read back unchanged, as with a number that is not finite.
pub(super) fn to_map<T>(value: &T) -> Option<BTreeMap<String, String>>
where
    T: Serialize + DeserializeOwned + PartialEq,
{
    let Ok(Value::Object(fields)) = serde_json::to_value(value) else { return None };
    let mut map: BTreeMap<String, String> =
        fields.into_iter().map(|(name, value)| (name, value.to_string())).collect();
    map.insert(CHECKSUM.to_owned(), checksum(&map));
    let restored: T = from_map(&map).ok()?;
    (restored == *value).then_some(map)
}

/// The reason why the map of a metadata record gives no struct.
#[derive(Debug, Error)]
pub(super) enum MetadataDefect {
    #[error("its checksum does not fit")]
    Checksum,
    #[error("{name}: {error}")]
    Field { name: String, error: serde_json::Error },
    #[error(transparent)]
    Struct(serde_json::Error),
}

/// Restores a struct from the map that [`to_map`] made.
pub(super) fn from_map<T>(map: &BTreeMap<String, String>) -> Result<T, MetadataDefect>
where
    T: DeserializeOwned,
{
    if !is_sound(map) {
        return Err(MetadataDefect::Checksum);
    }
    let mut fields = serde_json::Map::new();
    for (name, text) in map.iter().filter(|(name, _)| *name != CHECKSUM) {
        let value = serde_json::from_str(text)
            .map_err(|error| MetadataDefect::Field { name: name.clone(), error })?;
        fields.insert(name.clone(), value);
    }
    serde_json::from_value(Value::Object(fields)).map_err(MetadataDefect::Struct)
}

/// Returns whether the checksum of a map that [`to_map`] made fits its content.
pub(super) fn is_sound(map: &BTreeMap<String, String>) -> bool {
    map.get(CHECKSUM) == Some(&checksum(map))
}

fn checksum(map: &BTreeMap<String, String>) -> String {
    let mut digest = CRC_32.digest();
    for (name, value) in map.iter().filter(|(name, _)| *name != CHECKSUM) {
        for part in [name, value] {
            digest.update(&(part.len() as u64).to_le_bytes());
            digest.update(part.as_bytes());
        }
    }
    format!("{:08x}", digest.finalize())
}

#[cfg(test)]
mod tests {
    use super::super::samples::header;
    use super::*;
    use crate::telemetry::{Preflight, RolloutHeader};

    #[test]
    fn a_header_without_a_preflight_entry_reads_as_unknown() {
        let mut map = to_map(&header()).unwrap();
        map.remove("preflight").unwrap();
        map.insert(CHECKSUM.to_owned(), checksum(&map));
        let read: RolloutHeader = from_map(&map).unwrap();
        assert_eq!(read, RolloutHeader { preflight: Preflight::Unknown, ..header() });
    }
}
