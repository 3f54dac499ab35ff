//! Reads `session.toml` over a preset and reports every misspelt key.

use std::path::{Path, PathBuf};

use thiserror::Error;
use toml::de::{DeTable, DeValue};
use toml::{Table, Value};

use super::qube_file::LARGEST_OFFSET_RAD;
use super::retired::{earlier_name, rename_entries};
use super::{SessionSettings, take_retired};
use crate::learning::{Preset, TrainError};
use crate::qube::MAX_STEPS;
use crate::safety::{Guard, SafetyBox};
use crate::simulation::{ProfileSettings, PsiTarget, SensorModel, box_file};
use crate::storage::{SETTINGS_BYTES, WriteError, read_text};

/// An error in a configuration.
#[derive(Debug, Error)]
pub enum ConfigurationError {
    /// The file cannot be read.
    #[error("{path} cannot be read: {source}")]
    Unreadable {
        /// Path of the file.
        path: PathBuf,
        /// Cause of the failure.
        source: std::io::Error,
    },
    /// The file is not TOML, has an unknown key, or a value of the wrong type.
    #[error("{path}: {}", source.to_string().trim_end())]
    Invalid {
        /// Path of the file.
        path: PathBuf,
        /// Cause with its line.
        source: Box<toml::de::Error>,
    },
    /// A value is out of range.
    #[error("{path}{}: {reason}", at_line(*line))]
    OutOfRange {
        /// Path of the file.
        path: PathBuf,
        /// Line of the value, from 1, if the file names it.
        line: Option<usize>,
        /// Name of the value and its range.
        reason: String,
    },
    /// The settings cannot be written as TOML.
    #[error("the configuration cannot be written: {0}")]
    Unwritable(#[from] toml::ser::Error),
    /// The file could not be written.
    #[error("the settings could not be written: {0}")]
    NotWritten(WriteError),
}

impl ConfigurationError {
    /// Adds to the error the line of the wrong value, which the file has below the key `above`.
    #[must_use]
    pub fn located(self, text: &str, above: &str) -> Self {
        match self {
            Self::OutOfRange { path, reason, .. } => {
                // A reason begins with the key that it is about.
                let is_of_key = |letter: char| letter.is_alphanumeric() || "._".contains(letter);
                let key: String = reason.chars().take_while(|&letter| is_of_key(letter)).collect();
                let line = line_of(text, &format!("{above}{}", key.trim_end_matches('.')));
                Self::OutOfRange { path, line, reason }
            }
            other => other,
        }
    }
}

fn at_line(line: Option<usize>) -> String {
    line.map_or_else(String::new, |line| format!(", line {line}"))
}

/// The line in which a TOML text gives this key its value, from 1.
fn line_of(text: &str, key: &str) -> Option<usize> {
    let document = DeTable::parse(text).ok()?;
    let mut table = document.get_ref();
    let mut parts = key.split('.').peekable();
    while let Some(part) = parts.next() {
        // A file may name a limit without its unit, or a setting by its earlier name.
        let is_it = |name: &str| name == part || Some(name) == earlier_name(part);
        let (_, value) = table.iter().find(|(name, _)| is_it(name.get_ref()))?;
        match value.get_ref() {
            DeValue::Table(below) if parts.peek().is_some() => table = below,
            _ => return Some(1 + text[..value.span().start].matches('\n').count()),
        }
    }
    None
}

impl SessionSettings {
    /// Reads a complete configuration to resume its session. A file that names no guard selects the box
    /// alone.
    ///
    /// # Errors
    /// The file cannot be read, is not a configuration, or has a setting that no longer exists.
    pub fn load(path: &Path) -> Result<Self, ConfigurationError> {
        let text = read(path)?;
        Self::loaded(text.clone(), path).map_err(|error| error.located(&text, ""))
    }

    fn loaded(mut text: String, path: &Path) -> Result<Self, ConfigurationError> {
        let mut table: Table = parsed(&text, path)?;
        let retired = take_retired(&mut table);
        let out_of_range =
            |reason| ConfigurationError::OutOfRange { path: path.to_owned(), line: None, reason };
        if let Some(entry) = retired.iter().find(|entry| entry.changed_something()) {
            return Err(out_of_range(format!("{entry}: {BEGIN_ANEW}")));
        }
        if !retired.is_empty() {
            text = toml::to_string(&table)?;
        }
        let oldest = Self { preset: None, ..Self::default() }.with_guard(Guard::Box);
        let settings = oldest.laid_under(&text, path)?;
        settings.check_resumable().map_err(out_of_range)?;
        Ok(settings)
    }

    /// Overrides these settings with the entries of a file.
    ///
    /// # Errors
    /// The file cannot be read, or holds an unknown setting.
    pub fn overridden_by(&self, path: &Path) -> Result<Self, ConfigurationError> {
        let text = read(path)?;
        self.overridden_by_text(&text, path).map_err(|error| error.located(&text, ""))
    }

    /// Configures a new session like [`overridden_by`](Self::overridden_by). An estimator that the file
    /// names for the machine alone or for simulations alone applies to both, because a policy should train
    /// on the states that it will see.
    ///
    /// # Errors
    /// The file cannot be read, or holds an unknown setting.
    pub fn configured_by(&self, path: &Path) -> Result<Self, ConfigurationError> {
        let text = read(path)?;
        let settings = self.overridden_by(path)?;
        let file: Table = parsed(&text, path)?;
        let simulation = file.get("training").and_then(|training| training.get("simulation"));
        let simulated = simulation.and_then(|simulation| simulation.get("sensors"));
        let estimator = match (file.get("estimator"), settings.training.simulation.sensors) {
            (Some(_), _) if simulated.is_none() => settings.estimator,
            (None, SensorModel::Encoders { estimator }) if simulated.is_some() => estimator,
            _ => return Ok(settings),
        };
        let settings = settings.seen_through(estimator);
        settings.checked(path)
    }

    /// Overrides these settings with the text of a file; `path` only appears in errors. Safe for text of
    /// any origin.
    ///
    /// # Errors
    /// The text holds an unknown setting, or one that no longer exists.
    pub fn overridden_by_text(&self, text: &str, path: &Path) -> Result<Self, ConfigurationError> {
        let out_of_range =
            |reason| ConfigurationError::OutOfRange { path: path.to_owned(), line: None, reason };
        if let Some(entry) = take_retired(&mut parsed(text, path)?).first() {
            return Err(out_of_range(format!("{entry}: leave it out")));
        }
        let mut settings = self.laid_under(text, path)?;
        settings.preset = Some(Preset::of(&settings.training));
        settings.check_begun().map_err(out_of_range)?;
        Ok(settings)
    }

    fn laid_under(&self, text: &str, path: &Path) -> Result<Self, ConfigurationError> {
        let invalid = |source| ConfigurationError::Invalid {
            path: path.to_owned(),
            source: Box::new(source),
        };
        // Parsed alone first, so that an error names the file's own line.
        let alone: Self = toml::from_str(text).map_err(invalid)?;
        let below = match alone.preset {
            Some(preset) => self.clone().trained_with(preset),
            None => self.clone(),
        };
        let mut table: Table = Table::try_from(below)?;
        let mut above: Table = toml::from_str(text).map_err(invalid)?;
        rename_entries(&mut above);
        lay_over(&mut table, above);
        let settings: Self = table.try_into().map_err(invalid)?;
        settings.checked(path)
    }

    fn checked(self, path: &Path) -> Result<Self, ConfigurationError> {
        match self.check() {
            Ok(()) => Ok(self),
            Err(reason) => {
                Err(ConfigurationError::OutOfRange { path: path.to_owned(), line: None, reason })
            }
        }
    }

    /// The whole configuration as TOML.
    ///
    /// # Errors
    /// A number has no TOML form.
    pub fn to_toml(&self) -> Result<String, ConfigurationError> {
        Ok(toml::to_string_pretty(self)?)
    }

    /// Checks the settings; describes the first invalid one.
    fn check(&self) -> Result<(), String> {
        self.check_limits()?;
        self.estimator.check().map_err(|error| format!("estimator.{error}"))?;
        if let Some(ProfileSettings { spread, .. }) = self.profile
            && !(0.0..=1.0).contains(&spread)
        {
            return Err(format!("profile.spread = {spread}: give a number from 0 to 1"));
        }
        self.base_distribution().map_err(|error| error.to_string())?;
        let sees_truth = self.training.simulation.sensors == SensorModel::TrueState;
        if self.psi.has(PsiTarget::Filter) && sees_truth {
            return Err("psi has filter, but training.simulation.sensors shows true states: \
                        make it type = \"encoders\""
                .into());
        }
        let counts = [
            ("extent.initial_candidates", self.extent.initial_candidates, 1..=1000),
            ("extent.iterations", self.extent.iterations, 0..=1000),
            ("extent.rollouts", self.extent.rollouts, 1..=1000),
            ("extent.verification_rollouts", self.extent.verification_rollouts, 1..=1000),
            ("extent.steps", self.extent.steps, 1..=MAX_STEPS as u32),
            ("extent.repetitions", self.extent.repetitions, 0..=1000),
        ];
        for (name, value, range) in counts {
            if !range.contains(&value) {
                let (least, most) = range.into_inner();
                return Err(format!("{name} = {value}: give a number from {least} to {most}"));
            }
        }
        self.training.check().map_err(|error| match error {
            TrainError::Setting { name, value, bound } => {
                format!("training.{name} = {value}: it must be {bound}")
            }
            TrainError::Estimator(error) => {
                format!("training.simulation.sensors.estimator.{error}")
            }
            other => other.to_string(),
        })?;
        self.search().map(drop).map_err(|error| error.to_string())
    }
}

impl SessionSettings {
    /// Checks that no limit is invalid or wider than the task's; no file may widen a limit, whatever Qube
    /// it is used with.
    ///
    /// # Errors
    /// Describes the first invalid limit.
    pub fn check_limits(&self) -> Result<(), String> {
        let of_the_task = SafetyBox::GUARDED;
        self.safety_box.check_within(&of_the_task).map_err(of_file)?;
        let simulated = &self.training.simulation.safety_box;
        simulated
            .check_within(&of_the_task)
            .map_err(|error| format!("training.simulation.{}", of_file(error)))?;
        let offset_rad = self.homing.theta_offset_rad;
        if !(-LARGEST_OFFSET_RAD..=LARGEST_OFFSET_RAD).contains(&offset_rad) {
            return Err(format!(
                "homing.theta_offset_rad = {offset_rad}: give -{LARGEST_OFFSET_RAD} to \
                 {LARGEST_OFFSET_RAD}, or the box would reach beyond a stop"
            ));
        }
        self.homing.estimator.check().map_err(|error| format!("homing.estimator.{error}"))
    }

    /// Checks that a session with these settings can be resumed.
    ///
    /// # Errors
    /// The session ran under a guard that only serves to replay recordings.
    pub fn check_resumable(&self) -> Result<(), String> {
        let simulated = self.training.simulation.safety_box.guard;
        for (key, guard) in
            [("safety_box", self.safety_box.guard), ("training.simulation.safety_box", simulated)]
        {
            if let Err(gone) = guard.check_driven() {
                return Err(format!("{key}.{gone}: {BEGIN_ANEW}"));
            }
        }
        Ok(())
    }

    /// Checks that a new session may begin with these settings; describes the reason why not.
    fn check_begun(&self) -> Result<(), String> {
        if !self.training.simulation.safety_box.guard.is_box() {
            return Err(
                "training.simulation.safety_box.guard: simulations know no guard beside the \
                        box: leave it out"
                    .into(),
            );
        }
        let give = "give guard = \"foresight\" or leave it out";
        self.safety_box.guard.check_driven().map_err(|gone| format!("safety_box.{gone}: {give}"))
    }
}

/// Advice for settings of an earlier version in a session to resume.
const BEGIN_ANEW: &str = "it continues with the settings that it began with, so begin a new one";

/// Reads the text of a configuration.
pub(super) fn read(path: &Path) -> Result<String, ConfigurationError> {
    read_text(path, SETTINGS_BYTES)
        .map_err(|source| ConfigurationError::Unreadable { path: path.to_owned(), source })
}

fn parsed(text: &str, path: &Path) -> Result<Table, ConfigurationError> {
    toml::from_str(text).map_err(|source| ConfigurationError::Invalid {
        path: path.to_owned(),
        source: Box::new(source),
    })
}

/// Describes the defect of a box, with the names of the file's entries.
fn of_file(wrong: impl ToString) -> String {
    let wrong = wrong.to_string();
    let renamed = box_file::NAMES.iter().find_map(|(bare, name)| {
        let value = wrong.strip_prefix(&format!("safety_box.{bare} "))?;
        Some(format!("safety_box.{name} {value}"))
    });
    renamed.unwrap_or(wrong)
}

fn lay_over(below: &mut Table, above: Table) {
    for (key, value) in above {
        match (below.get_mut(&key), value) {
            (Some(Value::Table(below)), Value::Table(above)) => lay_over(below, above),
            (_, value) => {
                below.insert(key, value);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimation::{EstimatorSettings, ObserverSettings};
    use crate::qube::{Nonideality, QubeModel};
    use crate::session::retired::table_at;
    use crate::simulation::PsiSpace;

    fn overridden(text: &str) -> Result<SessionSettings, ConfigurationError> {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("my.toml");
        std::fs::write(&path, text).unwrap();
        SessionSettings::thesis().overridden_by(&path)
    }

    #[test]
    fn earlier_names_of_training_settings_override_the_preset_too() {
        let text = "[training]\npendulums = 32\ntrace_decay = 0.9\nenough = 450.0";
        let training = overridden(text).unwrap().training;
        assert_eq!((training.num_envs, training.gae_lambda), (32, 0.9));
        assert_eq!(training.target_return, Some(450.0));
    }

    #[test]
    fn a_file_replaces_what_it_names_and_leaves_the_rest_of_the_preset() {
        let settings = overridden("seed = 7\n[extent]\nrollouts = 3\n").unwrap();
        let thesis = SessionSettings::thesis();
        assert_eq!(settings.seed, 7);
        assert_eq!(settings.extent.rollouts, 3);
        assert_eq!(settings.extent.iterations, thesis.extent.iterations);
        assert_eq!(settings.training, thesis.training);
    }

    #[test]
    fn a_file_selects_a_preset_and_a_session_keeps_the_one_that_it_began_with() {
        let preset = |text: &str| {
            let settings = overridden(text).unwrap();
            (settings.preset, settings.training.updates)
        };
        assert_eq!(preset("seed = 1\n"), (Some(Preset::Thesis), 100));
        assert_eq!(preset("preset = \"quick\"\n"), (Some(Preset::Quick), 60));
        let custom = "preset = \"quick\"\n[training]\nupdates = 7\n";
        assert_eq!(preset(custom), (Some(Preset::Custom), 7));

        // The numbers of a preset may change after a session began; a file of a version that did not record
        // the preset names none.
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("session.toml");
        let origin = |text: &str| {
            std::fs::write(&path, text).unwrap();
            let settings = SessionSettings::load(&path).unwrap();
            let psi = settings.psi.psi(&settings.psi.lower()).unwrap();
            settings.origin(&psi).preset
        };
        let mut began = SessionSettings::thesis();
        began.training.updates = 99;
        let written = began.to_toml().unwrap();
        assert_eq!(origin(&written), "thesis");
        assert_eq!(origin(&written.replace("preset = \"thesis\"\n", "")), "custom");
        let older = SessionSettings::thesis().to_toml().unwrap();
        assert_eq!(origin(&older.replace("preset = \"thesis\"\n", "")), "thesis");
    }

    #[test]
    fn a_written_file_reads_back_the_same() {
        for settings in [SessionSettings::quick(), SessionSettings::thesis()] {
            let again = overridden(&settings.to_toml().unwrap()).unwrap();
            assert_eq!(again, settings);
        }
    }

    #[test]
    fn psi_is_the_thesiss_eight_or_any_list() {
        assert_eq!(overridden("seed = 1\n").unwrap().psi, PsiSpace::thesis());
        let text = "model = \"opt-robust\"\n[[psi]]\nname = \"mean_delay\"\nupper = 0.03\n\
                    [[psi]]\nname = \"filter\"\n";
        let settings = overridden(text).unwrap();
        assert_eq!(settings.psi.names().collect::<Vec<_>>(), ["mean_delay", "filter"]);
        assert_eq!(settings.psi.upper(), [0.03, 500.0]);
        let again = overridden(&settings.to_toml().unwrap()).unwrap();
        assert_eq!(again, settings);
        let point = [0.02, 50.0];
        let psi = settings.psi.psi(&point).unwrap();
        let delay = settings.distribution(&psi).unwrap().get(Nonideality::CommandDelay);
        assert_eq!(delay.mean(), 0.02);
        let sensors = settings.simulation(&psi).sensors;
        let SensorModel::Encoders { estimator } = sensors else { panic!("{sensors:?}") };
        assert_eq!(estimator.corner_rad_s, 50.0);
        assert!(settings.search().is_ok());
    }

    #[test]
    fn an_estimator_that_a_file_names_for_one_is_that_of_machine_and_simulation() {
        let configured = |text: &str| {
            let directory = tempfile::tempdir().unwrap();
            let path = directory.path().join("my.toml");
            std::fs::write(&path, text).unwrap();
            SessionSettings::quick().configured_by(&path).unwrap()
        };
        let corners = |settings: &SessionSettings| match settings.training.simulation.sensors {
            SensorModel::Encoders { estimator } => {
                (settings.estimator.corner_rad_s, Some(estimator.corner_rad_s))
            }
            SensorModel::TrueState => (settings.estimator.corner_rad_s, None),
        };
        let machine = "[estimator]\ncorner_rad_s = 50.0\n";
        let simulated = "[training.simulation.sensors]\ntype = \"encoders\"\n\
                         [training.simulation.sensors.estimator]\ncorner_rad_s = 70.0\n";
        let truth = "[training.simulation.sensors]\ntype = \"true_state\"\n";
        for (text, expected) in [
            ("seed = 1\n".to_owned(), (200.0, Some(200.0))),
            (machine.to_owned(), (50.0, Some(50.0))),
            (simulated.to_owned(), (70.0, Some(70.0))),
            (format!("{machine}{simulated}"), (50.0, Some(70.0))),
            (truth.to_owned(), (200.0, None)),
            (format!("{machine}{truth}"), (50.0, None)),
        ] {
            assert_eq!(corners(&configured(&text)), expected, "{text}");
        }
        let observer = EstimatorSettings::observer(ObserverSettings::of(QubeModel::NOMINAL));
        let observed = configured(machine).seen_through(observer);
        let simulated = SensorModel::Encoders { estimator: observer };
        assert_eq!(
            (observed.estimator, observed.training.simulation.sensors),
            (observer, simulated)
        );
        // A session resumes its own file unchanged.
        assert_eq!(configured(&observed.to_toml().unwrap()), observed);
    }

    #[test]
    fn limits_are_written_with_their_units_and_read_without_too() {
        let written = SessionSettings::quick().to_toml().unwrap();
        let paths: [&[&str]; 2] = [&["safety_box"], &["training", "simulation", "safety_box"]];
        for path in paths {
            let mut table: Table = toml::from_str(&written).unwrap();
            let limits = table_at(&mut table, path).unwrap();
            let names: Vec<&str> = limits.keys().map(String::as_str).collect();
            let expected =
                ["alpha_dot_rad_s", "alpha_rad", "guard", "theta_dot_rad_s", "theta_rad"];
            assert!(expected.iter().all(|name| names.contains(name)), "{names:?}");
            assert_eq!(names.len(), expected.len());
            let section = path.join(".");
            for name in ["theta", "theta_rad"] {
                let settings = overridden(&format!("[{section}]\n{name} = 1.5\n")).unwrap();
                let simulated = settings.training.simulation.safety_box.theta;
                let found = if path.len() == 1 { settings.safety_box.theta } else { simulated };
                assert_eq!(found, 1.5, "{section}.{name}");
            }
            let twice = overridden(&format!("[{section}]\ntheta = 1.5\ntheta_rad = 1.5\n"));
            let message = twice.unwrap_err().to_string();
            assert!(message.contains("duplicate") && message.contains("theta_rad"), "{message}");
        }
    }

    #[test]
    fn a_misspelt_key_is_an_error_with_its_line() {
        let message = overridden("seed = 7\nsed = 8\n").unwrap_err().to_string();
        assert!(message.contains("my.toml") && message.contains("line 2"), "{message}");
        let message = overridden("[extent]\nrolouts = 8\n").unwrap_err().to_string();
        assert!(message.contains("rolouts") && message.contains("line 2"), "{message}");
    }

    #[test]
    fn a_value_that_cannot_be_is_an_error_with_its_line() {
        for (text, line, name) in [
            ("[training]\nupdates = 0\n", 2, "training.updates = 0"),
            ("[training]\n\nlearning_rate = nan\n", 3, "training.learning_rate = NaN"),
            ("training.discount = 7.0\n", 1, "training.discount = 7"),
            ("seed = 1\n[training]\npendulums = 0\n", 3, "training.num_envs = 0"),
            ("[training]\nnum_envs = 20\n", 2, "training.num_envs"),
            ("[extent]\niterations = 4000000000\n", 2, "extent.iterations = 4000000000"),
            ("[extent]\nrepetitions = 4000000000\n", 2, "extent.repetitions = 4000000000"),
            ("seed = 1\n[safety_box]\ntheta = 1e300\n", 3, "safety_box.theta_rad"),
            ("[safety_box]\ntheta_dot_rad_s = 99.0\n", 2, "safety_box.theta_dot_rad_s = 99"),
            (
                "training = { simulation = { sensors = { type = \"encoders\",\n\
                 estimator = { corner_rad_s = 0.0 } } } }\n",
                2,
                "training.simulation.sensors.estimator.corner_rad_s",
            ),
        ] {
            let message = overridden(text).unwrap_err().to_string();
            let place = format!("my.toml, line {line}: {name}");
            assert!(message.contains(&place), "{place:?} is missing in: {message}");
        }
    }

    #[test]
    fn values_that_cannot_be_are_named() {
        for (text, name) in [
            ("[estimator]\ncorner_rad_s = 0.0\n", "estimator.corner_rad_s"),
            ("[safety_box]\ntheta = nan\n", "safety_box.theta"),
            ("[extent]\nrollouts = 0\n", "extent.rollouts"),
            ("model = \"opt-profile\"\n", "[profile]"),
            ("model = \"nominal\"\n", "nominal has no psi to search"),
            ("preset = \"fast\"\n", "fast"),
            ("[[psi]]\nname = \"mean_M_x\"\n", "mean_M_x"),
            ("psi = []\n", "no entry"),
            (
                "[[psi]]\nname = \"filter\"\n[training.simulation.sensors]\ntype = \"true_state\"\n",
                "filter",
            ),
        ] {
            let message = overridden(text).unwrap_err().to_string();
            assert!(message.contains(name), "{message}");
        }
    }
}
