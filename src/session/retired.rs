//! What settings files of the past say that is no setting any more.

use std::fmt::{self, Display};

use toml::{Table, Value};

/// The tables that hold such entries, by their path within a session's settings, with the entries' names.
const RETIRED: [(&[&str], &str); 2] =
    [(&["training"], "widening"), (&["training", "simulation"], "envelope_room_rad")];

/// An entry of a settings file that is no setting any more.
#[derive(Clone, Debug, PartialEq)]
pub struct Retired {
    key: String,
    value: Value,
}

impl Retired {
    /// Whether what ran with it ran otherwise than without.
    #[must_use]
    pub fn changed_something(&self) -> bool {
        !matches!(self.value, Value::Float(0.0) | Value::Integer(0))
    }
}

impl Display for Retired {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{} = {} is no setting any more", self.key, self.value)
    }
}

/// Takes out of a session's settings what is no setting any more.
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
