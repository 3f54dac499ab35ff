use serde::de::Error as _;
use serde::{Deserialize, Deserializer};
use toml::value::Datetime;

/// Reads a date such as 2026-01-31.
pub(super) fn date<'de, D: Deserializer<'de>>(deserializer: D) -> Result<String, D::Error> {
    let text = String::deserialize(deserializer)?;
    match text.parse() {
        Ok(Datetime { date: Some(_), time: None, offset: None }) => Ok(text),
        _ => Err(D::Error::custom(format!(
            "{text:?} is no date: give year-month-day, such as \"2026-01-31\""
        ))),
    }
}
