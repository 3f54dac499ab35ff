use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

/// Facts about a device by name: its identity (kind, serial, firmware version, protocol version,
/// port); the timing of its link, if it was measured; and for a device without a clock the assumed
/// age of its samples.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct DeviceFacts(BTreeMap<String, String>);

impl DeviceFacts {
    /// Name of the fact that states the device's kind.
    pub const KIND: &'static str = "kind";
    /// Name of the fact that states the board's serial number.
    pub const SERIAL: &'static str = "serial";
    /// Name of the fact that states the port at which the device answered.
    pub const PORT: &'static str = "port";

    /// Kind of the device.
    #[must_use]
    pub fn kind(&self) -> Option<&str> {
        self.get(Self::KIND)
    }

    /// Serial number of the board; `None` for a device that names none.
    #[must_use]
    pub fn serial(&self) -> Option<&str> {
        self.get(Self::SERIAL)
    }

    /// Port at which the device answered.
    #[must_use]
    pub fn port(&self) -> Option<&str> {
        self.get(Self::PORT)
    }

    /// The fact of this name.
    #[must_use]
    pub fn get(&self, name: &str) -> Option<&str> {
        self.0.get(name).map(String::as_str)
    }

    /// Adds a fact, or replaces the fact of this name.
    pub fn insert(&mut self, name: impl Into<String>, value: impl Into<String>) {
        self.0.insert(name.into(), value.into());
    }

    /// The names and the facts, in the order of the names.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &str)> {
        self.0.iter().map(|(name, value)| (name.as_str(), value.as_str()))
    }
}

impl<Name: Into<String>, Value: Into<String>> FromIterator<(Name, Value)> for DeviceFacts {
    fn from_iter<Facts: IntoIterator<Item = (Name, Value)>>(facts: Facts) -> Self {
        Self(facts.into_iter().map(|(name, value)| (name.into(), value.into())).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn facts_are_written_as_a_plain_map() {
        let facts = DeviceFacts::from_iter([(DeviceFacts::SERIAL, "one"), ("sample_age", "2 ms")]);
        let json = serde_json::to_string(&facts).unwrap();
        assert_eq!(json, r#"{"sample_age":"2 ms","serial":"one"}"#);
        assert_eq!(serde_json::from_str::<DeviceFacts>(&json).unwrap(), facts);
        assert_eq!((facts.serial(), facts.kind(), facts.port()), (Some("one"), None, None));
    }
}
