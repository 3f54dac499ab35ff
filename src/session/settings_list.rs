//! The list of a session's settings with meaning, unit, range and default. It is printed in the
//! form of a settings file that the program can read.

use std::fmt::Write;

use toml::{Table, Value};

use super::settings_words::words;
use super::{ConfigurationError, IdentificationSettings, SessionSettings};
use crate::device::emulator::Effects;
use crate::estimation::{EstimatorSettings, ObserverSettings};
use crate::qube::{DomainParameter, QubeModel};
use crate::simulation::{Direction, ProfileSettings, SensorModel};

/// One setting of a session.
#[derive(Clone, Debug, PartialEq)]
pub struct Setting {
    /// Path of the key, for example `extent.rollouts`.
    pub key: String,
    /// Default; `None` if the setting is absent by default.
    pub default: Option<Value>,
    /// Value in TOML: the default, or an example if the setting is absent by default.
    pub shown: String,
    /// Meaning in one line.
    pub meaning: &'static str,
    /// Unit; empty for a value without one.
    pub unit: &'static str,
    /// Accepted values in words, taken from the errors that refuse other values, if there are any.
    pub range: String,
}

/// A setting whose value differs from its default.
#[derive(Clone, Debug, PartialEq)]
pub struct ChangedSetting {
    /// Path of the key.
    pub key: String,
    /// Value; `None` if the setting is absent.
    pub value: Option<Value>,
    /// Default; `None` if the setting is absent by default.
    pub default: Option<Value>,
}

/// A line of the list.
enum Line {
    /// The header of a table, and whether the defaults have that table.
    Header(String, bool),
    Setting(Setting),
}

impl SessionSettings {
    /// Every setting that a file for a new session may have, in the order of the file, with the
    /// values of these settings as defaults. Another plant than a Qube
    /// (`training.simulation.plant`, `homing.signs.encoders`) is described in a file of its own.
    ///
    /// # Errors
    /// A number has no TOML form.
    pub fn list(&self) -> Result<Vec<Setting>, ConfigurationError> {
        let settings = self.lines()?.into_iter().filter_map(|line| match line {
            Line::Setting(setting) => Some(setting),
            Line::Header(..) => None,
        });
        Ok(settings.collect())
    }

    /// These settings as the text of a file that explains each entry. A setting that is absent by
    /// default is shown as an example after a `#` without a space.
    ///
    /// # Errors
    /// A number has no TOML form.
    pub fn explained(&self) -> Result<String, ConfigurationError> {
        let mut text = String::new();
        let mut explained: Vec<String> = Vec::new();
        for line in self.lines()? {
            match line {
                Line::Header(header, present) => {
                    let mark = if present { "" } else { "#" };
                    let _ = writeln!(text, "\n{mark}{header}");
                }
                Line::Setting(setting) => {
                    let name = setting.key.rsplit('.').next().unwrap_or_default();
                    if !explained.contains(&setting.key) {
                        let _ = writeln!(text, "# {}", setting.explanation());
                    }
                    let mark = if setting.default.is_some() { "" } else { "#" };
                    let _ = writeln!(text, "{mark}{name} = {}", setting.shown);
                    explained.push(setting.key);
                }
            }
        }
        Ok(text)
    }

    /// The settings whose values differ from those in `defaults`, sorted by key.
    ///
    /// # Errors
    /// A number has no TOML form.
    pub fn differences(&self, defaults: &Self) -> Result<Vec<ChangedSetting>, ConfigurationError> {
        let (mut here, mut there) = (Vec::new(), Vec::new());
        leaves("", Value::Table(Table::try_from(self)?), &mut here);
        leaves("", Value::Table(Table::try_from(defaults)?), &mut there);
        let value_in = |list: &[(String, Value)], key: &str| {
            list.iter().find(|(other, _)| other == key).map(|(_, value)| value.clone())
        };
        let mut keys: Vec<&String> = here.iter().chain(&there).map(|(key, _)| key).collect();
        keys.sort();
        keys.dedup();
        let rows = keys.into_iter().map(|key| ChangedSetting {
            key: key.clone(),
            value: value_in(&here, key),
            default: value_in(&there, key),
        });
        Ok(rows.filter(|row| row.value != row.default).collect())
    }

    fn lines(&self) -> Result<Vec<Line>, ConfigurationError> {
        let defaults = Table::try_from(self)?;
        let fullest = self.with_everything();
        let probed = Table::try_from(&fullest)?;
        let text = toml::to_string(&fullest)?;
        let mut lines = Vec::new();
        let mut table: Vec<String> = Vec::new();
        let mut array = ArrayEntry::default();
        for line in text.lines().filter(|line| !line.is_empty()) {
            if line.starts_with('[') {
                let path = line.trim_matches(['[', ']']);
                table = path.split('.').map(str::to_owned).collect();
                array.enter(line, path);
                let present = at(&defaults, &table, array.number).is_some();
                lines.push(Line::Header(line.to_owned(), present));
            } else if let Some((name, shown)) = line.split_once(" = ") {
                let mut path = table.clone();
                path.push(name.to_owned());
                let key = path.join(".");
                let words = words(&key);
                lines.push(Line::Setting(Setting {
                    default: at(&defaults, &path, array.number).cloned(),
                    shown: shown.to_owned(),
                    meaning: words.map_or("", |words| words.meaning),
                    unit: words.map_or("", |words| words.unit),
                    range: range(&probed, &path),
                    key,
                }));
            }
        }
        Ok(lines)
    }

    /// These settings, with an example for each setting that is absent by default.
    fn with_everything(&self) -> Self {
        let drifting = |mut model: QubeModel| {
            if model.nonidealities.cable_drift_rad_per_min == 0.0 {
                model.nonidealities.cable_drift_rad_per_min = 0.1;
            }
            model
        };
        let observing = |estimator: &EstimatorSettings| {
            let observer = estimator.observer.unwrap_or(ObserverSettings::of(QubeModel::NOMINAL));
            let model = drifting(observer.model);
            EstimatorSettings {
                observer: Some(ObserverSettings { model, ..observer }),
                ..*estimator
            }
        };
        let mut all = self.clone();
        all.estimator = observing(&all.estimator);
        all.homing.estimator = observing(&all.homing.estimator);
        all.homing.travel_rad.get_or_insert(all.homing.expected_travel_rad());
        all.identification.get_or_insert(IdentificationSettings::DEFAULT);
        let example_profile = ProfileSettings {
            model: QubeModel::NOMINAL,
            spread: 0.1,
            directions: vec![],
            axes: vec![],
        };
        let profile = all.profile.get_or_insert(example_profile);
        profile.model = drifting(profile.model);
        if profile.directions.is_empty() {
            profile.directions =
                vec![Direction::new(&[(DomainParameter::PendulumMass.into(), 0.001)])];
        }
        all.emulated.model = drifting(all.emulated.model);
        let replace_zero = |value: &mut f64, example: f64| {
            if *value == 0.0 {
                *value = example;
            }
        };
        replace_zero(&mut all.emulated.play_rad, 0.005);
        all.emulated.unidentified = true;
        let Effects {
            presliding_rad,
            stribeck,
            hysteresis_n_m,
            slack,
            warming_per_w,
            eccentricity_rad,
            tilt_rad,
            ripple,
            pendulum_friction_n_m,
            cubic_n_m_rad3,
        } = &mut all.emulated.effects;
        replace_zero(presliding_rad, 0.01);
        replace_zero(stribeck, 0.2);
        replace_zero(hysteresis_n_m, 0.0001);
        replace_zero(slack, 0.2);
        replace_zero(warming_per_w, 0.02);
        replace_zero(eccentricity_rad, 0.005);
        replace_zero(tilt_rad, 0.005);
        replace_zero(ripple, 0.05);
        replace_zero(pendulum_friction_n_m, 0.00005);
        replace_zero(cubic_n_m_rad3, 0.0001);
        all.extent.baseline = true;
        all.extent.pending = all.extent.pending.max(1);
        all.preset.get_or_insert(self.preset());
        all.training.target_return.get_or_insert(550.0);
        all.training.adam_epsilon_beside_root = true;
        if all.training.worst_share == 1.0 {
            all.training.worst_share = 0.1;
        }
        let simulated = match &all.training.simulation.sensors {
            SensorModel::Encoders { estimator } => *estimator,
            SensorModel::TrueState => EstimatorSettings::default(),
        };
        all.training.simulation.sensors =
            SensorModel::Encoders { estimator: observing(&simulated) };
        all
    }
}

impl Setting {
    /// Meaning, unit and range in one line.
    #[must_use]
    pub fn explanation(&self) -> String {
        let unit = if self.unit.is_empty() { String::new() } else { format!(", {}", self.unit) };
        format!("{}{unit}: {}", self.meaning, self.range)
    }
}

/// The entry of an array of tables to which the lines of a text belong.
#[derive(Default)]
struct ArrayEntry {
    /// Path of the array; empty outside of any.
    path: String,
    /// Number of the entry, from 0.
    number: usize,
}

impl ArrayEntry {
    /// Goes on to the table with this header line and path.
    fn enter(&mut self, header: &str, path: &str) {
        let begins_entry = header.starts_with("[[");
        if begins_entry && path == self.path {
            self.number += 1;
        } else if begins_entry {
            *self = Self { path: path.to_owned(), number: 0 };
        } else if !path.starts_with(&format!("{}.", self.path)) {
            *self = Self::default();
        }
    }
}

/// The value at a path. In an array of tables the path leads into the table with this number.
fn at<'a>(table: &'a Table, path: &[String], number: usize) -> Option<&'a Value> {
    let (name, below) = path.split_first()?;
    let value = table.get(name)?;
    let value = match value {
        Value::Array(entries) if entries.iter().all(Value::is_table) && !below.is_empty() => {
            entries.get(number)?
        }
        other => other,
    };
    if below.is_empty() { Some(value) } else { at(value.as_table()?, below, number) }
}

fn at_mut<'a>(table: &'a mut Table, path: &[String]) -> Option<&'a mut Value> {
    let (name, below) = path.split_first()?;
    let mut value = table.get_mut(name)?;
    if below.is_empty() {
        return Some(value);
    }
    if let Value::Array(entries) = value {
        value = entries.first_mut()?;
    }
    at_mut(value.as_table_mut()?, below)
}

/// Collects every value that is not a table, with the path of its key.
fn leaves(key: &str, value: Value, found: &mut Vec<(String, Value)>) {
    match value {
        Value::Table(table) => {
            for (name, value) in table {
                let key = if key.is_empty() { name } else { format!("{key}.{name}") };
                leaves(&key, value, found);
            }
        }
        Value::Float(number) => found.push((key.to_owned(), Value::Float(as_written(number)))),
        value => found.push((key.to_owned(), value)),
    }
}

/// The number with the fewest digits that gives the same setting: a setting of single precision,
/// such as 0.98, is 0.9800000190734863 as a double.
fn as_written(number: f64) -> f64 {
    let single = number as f32;
    if f64::from(single) == number { single.to_string().parse().unwrap_or(number) } else { number }
}

/// The accepted values of the setting at a path, in words. The function tries extreme values and
/// takes the range from the errors with which the parser or the settings' own check refuses them.
fn range(settings: &Table, path: &[String]) -> String {
    let Some(value) = at(settings, path, 0) else { return String::new() };
    let (trials, otherwise): (Vec<Value>, &str) = match value {
        Value::Boolean(_) => return "true or false".into(),
        Value::Integer(present) => {
            let trials = [-1, 0, 65_535, 4_294_967_295, present + 1].map(Value::Integer);
            (trials.into(), "a whole number")
        }
        Value::Float(_) => ([-1e300, 0.0, 1e300, f64::NAN].map(Value::Float).into(), "a number"),
        Value::String(_) => return names(settings, path),
        _ => return "a list".into(),
    };
    let key = path.join(".");
    let mut ranges: Vec<String> = Vec::new();
    for trial in trials {
        let mut tried = settings.clone();
        let Some(place) = at_mut(&mut tried, path) else { continue };
        *place = trial;
        let range = match tried.try_into::<SessionSettings>() {
            Err(refused) => choices(refused.message()),
            Ok(settings) => {
                settings.check().err().and_then(|refused| bound(&refused.to_string(), &key))
            }
        };
        if let Some(range) = range
            && !ranges.contains(&range)
        {
            ranges.push(range);
        }
    }
    if ranges.is_empty() { otherwise.into() } else { ranges.join("; ") }
}

/// The accepted names of the setting at a path, separated by commas: the names that the error for
/// an unknown name lists, without earlier names and without names that are refused as well.
fn names(settings: &Table, path: &[String]) -> String {
    let read = |name: &str| {
        let mut tried = settings.clone();
        if let Some(place) = at_mut(&mut tried, path) {
            *place = Value::String(name.into());
        }
        tried.try_into::<SessionSettings>()
    };
    let Some(offered) = read("?").err().and_then(|refused| choices(refused.message())) else {
        return "text".into();
    };
    let mut accepted: Vec<(&str, Option<SessionSettings>)> = Vec::new();
    for name in offered.split(", ") {
        match read(name) {
            Err(refused) if refused.message().contains(name) => {}
            // The error is about the other fields, which belong to the present variant.
            Err(_) => accepted.push((name, None)),
            Ok(settings) if settings.check_begun().is_err() => {}
            // An earlier name of a value that is listed under its present name.
            Ok(settings) if accepted.iter().any(|(_, it)| it.as_ref() == Some(&settings)) => {}
            Ok(settings) => accepted.push((name, Some(settings))),
        }
    }
    accepted.into_iter().map(|(name, _)| name).collect::<Vec<_>>().join(", ")
}

/// The names that an error lists in place of an unknown one, separated by commas.
fn choices(refused: &str) -> Option<String> {
    let (_, names) = refused.split_once("expected one of ").or_else(|| {
        let (_, names) = refused.split_once("expected ")?;
        names.starts_with('`').then_some(("", names))
    })?;
    Some(names.lines().next()?.replace("` or `", "`, `").replace('`', ""))
}

/// The range that an error of the check gives for this key; `None` if the error is about another
/// key.
fn bound(refused: &str, key: &str) -> Option<String> {
    // Extreme values are tried in the first entry of a list.
    let refused = refused.replacen("[1]", "", 1);
    let (_, range) = refused.strip_prefix(key)?.split_once(": ")?;
    let range = ["it must be ", "give a number ", "give "]
        .iter()
        .find_map(|words| range.strip_prefix(words))
        .unwrap_or(range);
    Some(range.to_owned())
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::path::Path;

    use super::*;
    use crate::learning::Preset;
    use crate::session::retired::earlier_name;

    /// The settings of a session without arguments.
    fn of_a_session() -> SessionSettings {
        let identification = Some(IdentificationSettings::DEFAULT);
        SessionSettings { identification, ..SessionSettings::quick() }
    }

    fn read_back(text: &str) -> SessionSettings {
        of_a_session().overridden_by_text(text, Path::new("printed.toml")).unwrap()
    }

    /// The printed list without the `#` before each setting that is absent by default.
    fn with_all(text: &str) -> String {
        let lines = text.lines().map(|line| match line.strip_prefix('#') {
            Some(setting) if !setting.starts_with(' ') => setting,
            _ => line,
        });
        lines.collect::<Vec<_>>().join("\n")
    }

    #[test]
    fn a_changed_setting_is_shown_with_the_digits_that_were_written() {
        let defaults = of_a_session();
        let mut settings = defaults.clone();
        settings.training.discount = 0.98;
        settings.emulated.command_jitter_s = 0.001_234_567_890_123;
        let changed = settings.differences(&defaults).unwrap();
        let shown: Vec<String> =
            changed.iter().filter_map(|row| Some(row.value.as_ref()?.to_string())).collect();
        assert_eq!(shown, ["0.001234567890123", "0.98"]);
    }

    #[test]
    fn reading_the_printed_list_gives_the_same_settings() {
        for settings in [of_a_session(), SessionSettings::quick(), SessionSettings::thesis()] {
            let text = settings.explained().unwrap();
            let again = settings.overridden_by_text(&text, Path::new("printed.toml")).unwrap();
            assert_eq!(again, settings);
            assert!(settings.differences(&again).unwrap().is_empty());
        }
        // A training with a target return belongs to no preset.
        let everything =
            SessionSettings { preset: Some(Preset::Custom), ..of_a_session().with_everything() };
        assert_eq!(read_back(&with_all(&of_a_session().explained().unwrap())), everything);
    }

    #[test]
    fn each_entry_of_an_array_has_its_own_values() {
        let settings = of_a_session();
        let names: Vec<_> =
            settings.list().unwrap().into_iter().filter(|it| it.key == "psi.name").collect();
        let shown: Vec<_> =
            names.iter().map(|it| it.default.as_ref().unwrap().to_string()).collect();
        let expected: Vec<_> = settings.psi.names().map(|name| format!("\"{name}\"")).collect();
        assert_eq!(shown, expected);
        assert!(shown.len() > 1);
    }

    /// The names that the program accepts in a table, taken from the error for an unknown name.
    fn read_names(settings: &Table, table: &[String]) -> BTreeSet<String> {
        let mut tried = settings.clone();
        let unknown = ("unknown setting".to_owned(), Value::Boolean(true));
        match table {
            [] => drop(tried.insert(unknown.0, unknown.1)),
            path => {
                let mut place = at_mut(&mut tried, path).unwrap();
                if let Value::Array(entries) = place {
                    place = &mut entries[0];
                }
                drop(place.as_table_mut().unwrap().insert(unknown.0, unknown.1));
            }
        }
        let refused = tried.try_into::<SessionSettings>().unwrap_err();
        let names = choices(refused.message());
        let names =
            names.unwrap_or_else(|| panic!("[{}] lists no names: {refused}", table.join(".")));
        names.split(", ").map(str::to_owned).collect()
    }

    #[test]
    fn no_setting_that_the_program_reads_is_missing() {
        // docs/reference/plants.md describes other plants and their encoders. Rigs are named on
        // the command line.
        const ELSEWHERE: [&str; 3] = ["plant", "encoders", "rigs"];
        let fullest = of_a_session().with_everything();
        let table = Table::try_from(&fullest).unwrap();
        let mut listed: Vec<Vec<String>> = Vec::new();
        for line in of_a_session().lines().unwrap() {
            let path = match line {
                Line::Header(header, _) => header.trim_matches(['[', ']']).to_owned(),
                Line::Setting(setting) => setting.key,
            };
            listed.push(path.split('.').map(str::to_owned).collect());
        }
        let mut tables: BTreeSet<Vec<String>> =
            listed.iter().map(|path| path[..path.len() - 1].to_vec()).collect();
        // The keys of a direction are quantities.
        tables.remove(["profile", "directions"].map(str::to_owned).as_slice());
        let mut compared = 0;
        for path in tables {
            let is_here =
                |entry: &&Vec<String>| entry.len() > path.len() && entry.starts_with(&path);
            let printed: BTreeSet<&String> =
                listed.iter().filter(is_here).map(|entry| &entry[path.len()]).collect();
            let earlier: Vec<_> = printed.iter().filter_map(|name| earlier_name(name)).collect();
            for name in read_names(&table, &path) {
                let is_known = printed.contains(&name)
                    || earlier.contains(&name.as_str())
                    || ELSEWHERE.contains(&name.as_str());
                assert!(is_known, "[{}] {name} is read and not printed", path.join("."));
                compared += 1;
            }
        }
        assert!(compared > 150, "{compared}");
    }

    #[test]
    fn every_setting_has_a_meaning_and_the_range_of_its_check() {
        let settings = of_a_session().list().unwrap();
        for setting in &settings {
            assert!(!setting.meaning.is_empty(), "{}", setting.key);
            assert!(!setting.range.is_empty(), "{}", setting.key);
        }
        let of = |key: &str| settings.iter().find(|setting| setting.key == key).unwrap();
        let rollouts = of("extent.rollouts");
        assert_eq!(rollouts.range, "from 1 to 1000");
        assert_eq!(rollouts.explanation(), "Number of rollouts of each candidate: from 1 to 1000");
        assert_eq!(of("training.num_envs").range, "16 to 4096; a multiple of 16");
        assert_eq!(of("family").range, "normal, uniform");
        assert_eq!(of("homing.theta_offset_rad").unit, "rad");
        assert_eq!(of("homing.method").range, "stops, hand");
        assert_eq!(of("safety_box.guard").range, "box, foresight");
        assert_eq!(of("training.simulation.safety_box.guard").range, "box");
        assert!(
            !of("model").range.contains("handcrafted, nominal"),
            "only models with a psi: {}",
            of("model").range
        );
        assert!(
            of("estimator.corner_rad_s").range.contains("above 0"),
            "{:?}",
            of("estimator.corner_rad_s")
        );
        assert_eq!(
            (of("profile.spread").default.as_ref(), of("profile.spread").shown.as_str()),
            (None, "0.1")
        );
        assert!(settings.len() > 150, "{}", settings.len());
    }
}
