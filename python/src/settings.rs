//! Settings of simulations as Python's arguments name them. An error names the entry and the values
//! that it accepts.

use pyo3::prelude::*;
use qube_hil::estimation::{EstimatorSettings, ObserverSettings, SettingsError};
use qube_hil::qube::{MAX_HISTORY, PlantModel};
use qube_hil::safety::HardwareRefusal;
use qube_hil::simulation::{SensorModel, SimulationSettingError, SimulationSettings, box_file};
use serde_json::{Map, Value};

use crate::errors::{bad_settings, shown};

/// Entries whose values are names, with the names that are accepted.
const CHOICES: [(&str, &[&str]); 1] = [("sensors.type", &["true_state", "encoders"])];

/// Tables of which no entry has a default.
const WITHOUT_DEFAULTS: [&str; 8] = [
    "reward",
    "plant",
    "plant.parameters",
    "plant.encoders",
    "plant.limits",
    "plant.motor",
    "sensors.estimator.observer.model",
    "sensors.estimator.observer.model.parameters",
];

/// Entries that accept null, which has the effect of leaving them out.
const MAY_BE_NULL: [&str; 1] = ["sensors.estimator.observer"];

/// Names that files of earlier versions have, by their table.
const EARLIER_NAMES: [(&str, &[&str]); 2] = [
    ("safety_box", &["theta", "alpha", "theta_dot", "alpha_dot"]),
    ("sensors.estimator.observer", &["astray_rad"]),
];

/// Settings of simulations by name, in the order in which messages list them.
fn named_settings() -> [(&'static str, SimulationSettings); 3] {
    [
        ("thesis", SimulationSettings::default()),
        ("machine", SimulationSettings::machine()),
        ("robust", SimulationSettings::robust()),
    ]
}

/// Parses the settings of a simulation from JSON, either a name or an object, and checks them. A
/// setting that the object leaves out has its default, if there is one; beside a plant whose stops
/// are nearer than a Qube's, the limit of theta shrinks with the travel. `argument` is the name of
/// Python's argument.
pub fn read_settings(argument: &str, json: &str) -> PyResult<SimulationSettings> {
    let refused = |message: String| bad_settings(format!("{argument}: {message}"));
    let names = named_settings().map(|(known, _)| known).join(", ");
    let given: Value = serde_json::from_str(json).map_err(|error| refused(error.to_string()))?;
    let table = match &given {
        Value::Object(table) => table,
        Value::String(name) => {
            let known = named_settings().into_iter().find(|(known, _)| known == name);
            return known.map(|(_, settings)| settings).ok_or_else(|| {
                refused(format!("there are no settings {name:?}: give a mapping or one of {names}"))
            });
        }
        other => return Err(refused(format!("{other}: give a mapping or one of {names}"))),
    };
    check_used(argument, &given).map_err(refused)?;
    check_table("", table, &every_entry()).map_err(refused)?;
    // The message of serde_json ends with a place in the text, which Python does not get.
    let settings: SimulationSettings = serde_json::from_value(given.clone())
        .map_err(|error| refused(error.to_string().replace(" at line 0 column 0", "")))?;
    let limit = table.get("safety_box").and_then(Value::as_object);
    let gives_limit = limit
        .is_some_and(|limits| limits.contains_key("theta_rad") || limits.contains_key("theta"));
    let settings = match gives_limit || !table.contains_key("plant") {
        true => settings,
        false => settings.of_plant(&settings.plant),
    };
    settings.check().map_err(|error| refused(in_words(&error)))?;
    let (given_rad, most_rad) =
        (settings.safety_box.theta, settings.safety_box.inside_travel(&settings.plant).theta);
    // The limit of another program may be rounded.
    if given_rad > most_rad * (1.0 + 1e-6) {
        return Err(refused(format!(
            "safety_box.theta_rad = {}: the stops of the plant {} are nearer than a Qube's, so give at most {}",
            shown(given_rad),
            settings.plant.name,
            shown(most_rad)
        )));
    }
    Ok(settings)
}

/// Parses a plant from JSON and checks it.
pub fn read_plant(json: &str) -> PyResult<PlantModel> {
    let refused = |message: String| bad_settings(format!("plant: {message}"));
    let given: Value = serde_json::from_str(json).map_err(|error| refused(error.to_string()))?;
    let Value::Object(all) = &given else {
        return Err(refused(format!("{given}: give a mapping with the entries of a plant file")));
    };
    let table = Map::from_iter([("plant".to_owned(), given.clone())]);
    check_table("", &table, &every_entry()).map_err(bad_settings)?;
    let plant: PlantModel = serde_json::from_value(Value::Object(all.clone()))
        .map_err(|error| refused(error.to_string().replace(" at line 0 column 0", "")))?;
    plant.check().map_err(|error| refused(error.to_string()))?;
    Ok(plant)
}

/// Checks that no entry is given which would have no effect. The guard `box`, which all simulations
/// have, is allowed, because records of simulations name it.
fn check_used(argument: &str, given: &Value) -> Result<(), String> {
    let guard = &given["safety_box"]["guard"];
    if !guard.is_null() && guard != "box" {
        let remedy = if argument == "settings" {
            "leave it out, and give the environment guard=\"foresight\" for a simulated guard"
        } else {
            "simulations of a training have no guard but the box, so leave it out"
        };
        return Err(format!("safety_box.guard = {guard}: {remedy}"));
    }
    let sensors = &given["sensors"];
    if sensors["type"] == "true_state" && !sensors["estimator"].is_null() {
        return Err("sensors.estimator beside sensors.type = \"true_state\": true states need no estimator, so leave it \
                    out, or give the type encoders"
            .into());
    }
    Ok(())
}

/// The message of a refused setting, with its value in few digits.
fn in_words(error: &SimulationSettingError) -> String {
    match error {
        SimulationSettingError::OutOfRange { name, value, bound } => {
            format!("{name} = {}: give {bound}", shown(*value))
        }
        SimulationSettingError::Estimator(SettingsError::OutOfRange { name, value, largest }) => {
            format!(
                "sensors.estimator.{name} = {}: give a number above 0 and up to {}",
                shown(*value),
                shown(*largest)
            )
        }
        SimulationSettingError::SafetyBox(HardwareRefusal::Limit { name, value, widest }) => {
            let named = box_file::NAMES.iter().find(|(bare, _)| bare == name);
            format!(
                "safety_box.{} = {}: give a number above 0, at most {widest}",
                named.map_or(*name, |(_, in_files)| *in_files),
                shown(*value)
            )
        }
        other => other.to_string(),
    }
}

/// Settings in which every entry has a value, of the type that is accepted.
fn every_entry() -> Map<String, Value> {
    let observer = EstimatorSettings::observer(ObserverSettings::default());
    let settings = SimulationSettings {
        sensors: SensorModel::Encoders { estimator: observer },
        ..SimulationSettings::default()
    };
    let Ok(Value::Object(mut all)) = serde_json::to_value(settings) else { return Map::new() };
    // The built-in Qube is left out of files.
    if let Ok(plant) = serde_json::to_value(settings.plant) {
        all.insert("plant".into(), plant);
    }
    all
}

/// Checks that each entry of a table is known and of the type that the entry of `all` has, and that
/// no entry without a default is missing. `path` is the table's own name, empty for the settings
/// themselves. The error names the first entry that is refused or missing, and the values that it
/// accepts.
fn check_table(
    path: &str,
    table: &Map<String, Value>,
    all: &Map<String, Value>,
) -> Result<(), String> {
    let names = || all.keys().cloned().collect::<Vec<_>>().join(", ");
    for (name, value) in table {
        let entry = if path.is_empty() { name.clone() } else { format!("{path}.{name}") };
        match all.get(name) {
            Some(known) => check_value(&entry, value, known)?,
            None if names_of(&EARLIER_NAMES, path)
                .is_some_and(|own| own.contains(&name.as_str())) => {}
            None => return Err(format!("there is no entry {entry}: give some of {}", names())),
        }
    }
    let missing = all.keys().find(|name| !table.contains_key(*name));
    match missing {
        Some(name) if WITHOUT_DEFAULTS.contains(&path) => {
            Err(format!("{path} has no {name}: give all of {}", names()))
        }
        _ if path == "sensors" && !table.contains_key("type") => {
            Err("sensors has no type: give true_state or encoders".into())
        }
        _ => Ok(()),
    }
}

/// Checks that a value is of the type of `known`. Where an entry's values are names, checks that
/// the entry accepts the name.
fn check_value(entry: &str, value: &Value, known: &Value) -> Result<(), String> {
    let choices = names_of(&CHOICES, entry);
    let wanted = match (known, value) {
        (_, Value::Null) if MAY_BE_NULL.contains(&entry) => return Ok(()),
        (Value::Object(known), Value::Object(table)) => return check_table(entry, table, known),
        (Value::Object(known), _) => {
            let names = known.keys().cloned().collect::<Vec<_>>().join(", ");
            format!("a mapping with entries of {names}")
        }
        (Value::Number(known), Value::Number(number)) if known.is_f64() || number.is_u64() => {
            return Ok(());
        }
        (Value::Number(_), _) if entry == "history" => {
            format!("a whole number from 0 to {MAX_HISTORY}")
        }
        (Value::Number(known), _) if known.is_f64() => "a number".into(),
        (Value::Number(_), _) => "a whole number that is not negative".into(),
        (Value::String(_), Value::String(name))
            if choices.is_none_or(|names| names.contains(&name.as_str())) =>
        {
            return Ok(());
        }
        (Value::String(_), _) => choices.map_or("a text".into(), |names| names.join(" or ")),
        _ => return Ok(()),
    };
    Err(format!("{entry} = {value}: give {wanted}"))
}

/// The names that belong to an entry.
fn names_of<'a>(table: &[(&str, &'a [&'a str])], entry: &str) -> Option<&'a [&'a str]> {
    table.iter().find(|(name, _)| *name == entry).map(|(_, names)| *names)
}
