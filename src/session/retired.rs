//! Entries in settings files of earlier versions that this version does not have, or has under
//! another name.

use std::fmt::{self, Display};

use toml::de::{DeTable, DeValue};
use toml::{Spanned, Table, Value};

use crate::simulation::box_file;

/// Retired entries: the path of their table within a session's settings, and their name.
const RETIRED: [(&[&str], &str); 2] =
    [(&["training"], "widening"), (&["training", "simulation"], "envelope_room_rad")];

/// Renamed entries: the path of their table within a session's settings, and their earlier and
/// present names.
const RENAMED: [(&[&str], Names); 6] = [
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
    value: Value,
}

impl Retired {
    /// Whether the entry had an effect on the session: a value of 0 had none.
    #[must_use]
    pub fn changed_something(&self) -> bool {
        !matches!(self.value, Value::Float(0.0) | Value::Integer(0))
    }
}

impl Display for Retired {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{} = {} is no longer a setting", self.key, self.value)
    }
}

/// Removes retired entries from a session's settings and returns them.
#[must_use]
pub fn take_retired(settings: &mut Table) -> Vec<Retired> {
    let mut taken = Vec::new();
    for (path, name) in RETIRED {
        if let Some(value) = table_at(settings, path).and_then(|table| table.remove(name)) {
            taken.push(Retired { key: format!("{}.{name}", path.join(".")), value });
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

/// The types of whole numbers that the parser names, and what they accept.
const WHOLE_NUMBERS: [(&str, &str); 4] = [
    ("expected u64", "expected a whole number from 0 on"),
    ("expected u32", "expected a whole number from 0 to 4 294 967 295"),
    ("expected u16", "expected a whole number from 0 to 65 535"),
    ("expected u8", "expected a whole number from 0 to 255"),
];

/// The message of an error about TOML, which names no type of the program. Where it lists the names
/// that are expected in place of an unknown one, the list has no earlier name beside the present
/// one.
pub(crate) fn with_present_names(error: &toml::de::Error) -> String {
    let mut message = error.to_string().trim_end().to_owned();
    for (kind, words) in WHOLE_NUMBERS {
        if let Some(above) = message.strip_suffix(kind) {
            message = format!("{above}{words}");
        }
    }
    let before = ", expected one of ";
    let Some((above, list)) = message.rsplit_once(before) else { return message };
    let listed: Vec<&str> = list.split(", ").collect();
    let is_earlier = |name: &str| {
        let mut names = RENAMED.into_iter().flat_map(|(_, names)| names);
        names.any(|(earlier, present)| {
            name == format!("`{earlier}`") && listed.contains(&format!("`{present}`").as_str())
        })
    };
    let present: Vec<&str> = listed.iter().copied().filter(|name| !is_earlier(name)).collect();
    format!("{above}{before}{}", present.join(", "))
}

/// The earlier name of an entry, if it has one.
pub(super) fn earlier_name(present: &str) -> Option<&'static str> {
    let mut names = RENAMED.into_iter().flat_map(|(_, names)| names);
    names.find(|(_, name)| *name == present).map(|(earlier, _)| *earlier)
}

/// The table at a path within the entries of a session's settings file.
pub(super) fn entry_at<'a, 'i>(
    settings: &'a mut DeTable<'i>,
    path: &[&str],
) -> Option<&'a mut DeTable<'i>> {
    path.iter().try_fold(settings, |table, step| match table.get_mut(*step)?.get_mut() {
        DeValue::Table(below) => Some(below),
        _ => None,
    })
}

/// The table at a path within a session's settings.
pub(super) fn table_at<'a>(settings: &'a mut Table, path: &[&str]) -> Option<&'a mut Table> {
    path.iter().try_fold(settings, |table, step| table.get_mut(*step)?.as_table_mut())
}
