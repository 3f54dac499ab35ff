//! Entries in settings files of earlier versions that this version does not have, or has under
//! another name.

use std::fmt::{self, Display};

use toml::Spanned;
use toml::de::DeTable;

use super::located_entries::entry_at;
use crate::simulation::box_file;

/// Retired entries: the path of their table within a session's settings, and their name.
const RETIRED: [(&[&str], &str); 2] =
    [(&["training"], "widening"), (&["training", "simulation"], "envelope_room_rad")];

/// Renamed entries: the path of their table within a session's settings, and their earlier and
/// present names.
pub(super) const RENAMED: [(&[&str], Names); 6] = [
    (
        &["training"],
        &[("pendulums", "num_envs"), ("trace_decay", "gae_lambda"), ("enough", "target_return")],
    ),
    (&["safety_box"], &box_file::NAMES),
    (&["training", "simulation", "safety_box"], &box_file::NAMES),
    (&["estimator", "observer"], &OBSERVER_NAMES),
    (&["homing", "estimator", "observer"], &OBSERVER_NAMES),
    (&["training", "simulation", "sensors", "estimator", "observer"], &OBSERVER_NAMES),
];

/// Earlier and present names of the observer's entries.
const OBSERVER_NAMES: [(&str, &str); 1] = [("astray_rad", "reset_error_rad")];

/// Pairs of an entry's earlier name and its present one.
type Names = &'static [(&'static str, &'static str)];

/// An entry of a settings file that was a setting in earlier versions only.
#[derive(Clone, Debug, PartialEq)]
pub struct Retired {
    key: String,
    /// The value as the file has it.
    value: String,
}

impl Retired {
    /// Returns whether the entry had an effect on the session: a value of 0 had none.
    #[must_use]
    pub fn changed_something(&self) -> bool {
        self.value.parse() != Ok(0.0)
    }
}

impl Display for Retired {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{} = {} is a setting of earlier versions only", self.key, self.value)
    }
}

/// Removes retired entries from a session's settings and returns them; `text` is the text of the
/// settings' file.
#[must_use]
pub fn take_retired(settings: &mut DeTable<'_>, text: &str) -> Vec<Retired> {
    let mut taken = Vec::new();
    for (path, name) in RETIRED {
        if let Some(value) = entry_at(settings, path).and_then(|table| table.remove(name)) {
            let key = format!("{}.{name}", path.join("."));
            taken.push(Retired { key, value: text[value.span()].to_owned() });
        }
    }
    taken
}

/// Gives renamed entries of a session's settings their present names. Otherwise such an entry would
/// not override the entry of a preset but stand beside it. An entry under both names stays, because
/// it is refused as a duplicate.
pub(super) fn rename_entries(settings: &mut DeTable<'_>) {
    for (path, names) in RENAMED {
        let Some(table) = entry_at(settings, path) else { continue };
        for (earlier, present) in names {
            if !table.contains_key(*present)
                && let Some((key, value)) = table.remove_entry(*earlier)
            {
                table.insert(Spanned::new(key.span(), (*present).into()), value);
            }
        }
    }
}

/// The earlier name of an entry, if it has one.
pub(super) fn earlier_name(present: &str) -> Option<&'static str> {
    let mut names = RENAMED.into_iter().flat_map(|(_, names)| names);
    names.find(|(_, name)| *name == present).map(|(earlier, _)| *earlier)
}
