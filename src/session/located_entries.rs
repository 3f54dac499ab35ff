//! Reads the entries of a TOML text and keeps their places, so that an error names a line.

use std::path::Path;

use serde::de::DeserializeOwned;
use toml::Spanned;
use toml::de::{DeTable, DeValue, Deserializer};

use super::ConfigurationError;

/// The entries of a TOML text with their places in it, so that an error names a line.
pub(super) struct LocatedEntries<'a> {
    pub(super) text: &'a str,
    pub(super) path: &'a Path,
    pub(super) table: Spanned<DeTable<'a>>,
}

impl<'a> LocatedEntries<'a> {
    /// Reads the entries of the table `part` of a text, or of the whole text if `part` is `None`. A
    /// text without the table `part` has no entries. `path` only appears in errors.
    pub(super) fn of(
        text: &'a str,
        part: Option<&str>,
        path: &'a Path,
    ) -> Result<Self, ConfigurationError> {
        let mut table = match DeTable::parse(text) {
            Ok(table) => table,
            Err(error) if error.span().is_some() => return Err(invalid(path, error)),
            Err(error) => {
                // The parser names no place for a key with too many parts.
                let ends = text.match_indices('\n').map(|(at, _)| at + 1);
                let ends: Vec<usize> = ends.chain([text.len()]).collect();
                let is_fine = |end: &usize| {
                    !DeTable::parse(&text[..*end]).is_err_and(|error| error.span().is_none())
                };
                return Err(ConfigurationError::OutOfRange {
                    path: path.to_owned(),
                    line: Some(1 + ends.partition_point(is_fine)),
                    reason: format!("a key has too many parts: {}", error.message()),
                });
            }
        };
        if let Some(part) = part {
            let value = table.get_mut().remove(part);
            let value = value.map(|value| (value.span(), value.into_inner()));
            table = match value {
                Some((span, DeValue::Table(entries))) => Spanned::new(span, entries),
                _ => Spanned::new(table.span(), DeTable::new()),
            };
        }
        Ok(Self { text, path, table })
    }

    /// Converts the entries to a value of type `T`.
    ///
    /// # Errors
    /// The entries do not form such a value; the error names the line.
    pub(super) fn read<T: DeserializeOwned>(&self) -> Result<T, ConfigurationError> {
        T::deserialize(Deserializer::from(self.table.clone())).map_err(|mut error| {
            error.set_input(Some(self.text));
            invalid(self.path, error)
        })
    }
}

/// Enters `above` into `below`: an entry replaces an entry with the same key; tables are merged.
pub(super) fn merge_into<'a>(below: &mut DeTable<'a>, above: DeTable<'a>) {
    for (key, value) in above {
        let (span, value) = (value.span(), value.into_inner());
        let replaced = below.remove(&**key.get_ref()).map(Spanned::into_inner);
        let value = match (replaced, value) {
            (Some(DeValue::Table(mut merged)), DeValue::Table(above)) => {
                merge_into(&mut merged, above);
                DeValue::Table(merged)
            }
            (_, value) => value,
        };
        below.insert(key, Spanned::new(span, value));
    }
}

/// The table below `entries` at these keys, from the outermost to the innermost; `None` if there is
/// no table.
pub(crate) fn entry_at<'a, 'i>(
    entries: &'a mut DeTable<'i>,
    keys: &[&str],
) -> Option<&'a mut DeTable<'i>> {
    keys.iter().try_fold(entries, |table, key| match table.get_mut(*key)?.get_mut() {
        DeValue::Table(nested) => Some(nested),
        _ => None,
    })
}

/// The error of a file that is not TOML or whose entries do not form the expected value.
pub(super) fn invalid(path: &Path, source: toml::de::Error) -> ConfigurationError {
    ConfigurationError::Invalid { path: path.to_owned(), source: Box::new(source) }
}
