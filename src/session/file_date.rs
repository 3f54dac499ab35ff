use serde::de::Error as _;
use serde::{Deserialize, Deserializer};

/// Reads a date such as 2026-01-31.
pub(super) fn date<'de, D: Deserializer<'de>>(deserializer: D) -> Result<String, D::Error> {
    let text = String::deserialize(deserializer)?;
    if is_date(&text) {
        Ok(text)
    } else {
        Err(D::Error::custom(format!(
            "{text:?} is no date: give year-month-day, such as \"2026-01-31\""
        )))
    }
}

fn is_date(text: &str) -> bool {
    let number = |range: std::ops::Range<usize>| {
        let digits = text.get(range).filter(|it| it.bytes().all(|byte| byte.is_ascii_digit()));
        digits.and_then(|digits| digits.parse::<u32>().ok())
    };
    let separators = (text.get(4..5), text.get(7..8));
    text.len() == 10
        && separators == (Some("-"), Some("-"))
        && number(0..4).is_some()
        && number(5..7).is_some_and(|month| (1..=12).contains(&month))
        && number(8..10).is_some_and(|day| (1..=31).contains(&day))
}
