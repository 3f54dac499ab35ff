use toml::de::{DeTable, DeValue};

/// The line in which a TOML text gives this key its value, from 1; `None` if the text has no such
/// key or is not TOML. The key is a path such as `parameters.g` or `correlations.rows[2]`; entries
/// of a list count from 1. `is_named` tells whether a name in the text means a part of the key.
pub(crate) fn line_of_key(
    text: &str,
    key: &str,
    is_named: impl Fn(&str, &str) -> bool,
) -> Option<usize> {
    let document = DeTable::parse(text).ok()?;
    let mut table = document.get_ref();
    let mut parts = key.split('.').peekable();
    while let Some(part) = parts.next() {
        let numbered = part.strip_suffix(']').and_then(|part| part.split_once('['));
        let (part, number) = numbered.unwrap_or((part, ""));
        let (_, mut value) = table.iter().find(|(name, _)| is_named(name.get_ref(), part))?;
        if let (DeValue::Array(entries), Ok(number)) = (value.get_ref(), number.parse::<usize>()) {
            value = entries.get(number.checked_sub(1)?)?;
        }
        match value.get_ref() {
            DeValue::Table(below) if parts.peek().is_some() => table = below,
            _ => return Some(1 + text[..value.span().start].matches('\n').count()),
        }
    }
    None
}

/// The key at the beginning of a message such as `parameters.g = -1: give another number`.
pub(crate) fn key_of_message(message: &str) -> &str {
    let is_of_key = |letter: char| letter.is_alphanumeric() || "._[]".contains(letter);
    let end = message.find(|letter| !is_of_key(letter)).unwrap_or(message.len());
    message[..end].trim_end_matches('.')
}
