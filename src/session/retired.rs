//! Entries of earlier settings files that are no longer settings, or have another name.

use std::fmt::{self, Display};

use toml::{Table, Value};

/// Retired entries: the path of their table within a session's settings, and their name.
const RETIRED: [(&[&str], &str); 2] =
    [(&["training"], "widening"), (&["training", "simulation"], "envelope_room_rad")];

/// Renamed entries of the table `training`: the earlier name and the present one.
pub const RENAMED: [(&str, &str); 3] =
    [("pendulums", "num_envs"), ("trace_decay", "gae_lambda"), ("enough", "target_return")];

/// An entry of a settings file that is no longer a setting.
#[derive(Clone, Debug, PartialEq)]
pub struct Retired {
    key: String,
    value: Value,
}

impl Retired {
    /// Whether the entry had an effect on the run.
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
        let mut table = Some(&mut *settings);
        for step in path {
            table = table.and_then(|table| table.get_mut(*step)).and_then(Value::as_table_mut);
        }
        if let Some(value) = table.and_then(|table| table.remove(name)) {
            taken.push(Retired { key: format!("{}.{name}", path.join(".")), value });
        }
    }
    taken
}

/// Gives renamed entries of a session's settings their present names, so that they override entries of a
/// preset instead of standing beside them.
pub(super) fn rename_entries(settings: &mut Table) {
    let Some(training) = settings.get_mut("training").and_then(Value::as_table_mut) else { return };
    for (earlier, present) in RENAMED {
        if let Some(value) = training.remove(earlier) {
            training.insert(present.to_owned(), value);
        }
    }
}
