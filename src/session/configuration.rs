//! Reads files of session settings: a session's own `session.toml` to resume it, or a file that
//! overrides a preset. A misspelt key is an error.

use std::path::Path;

use toml::{Table, Value};

use super::retired::rename_entries;
use super::settings_check::NEW_SESSION_ADVICE;
use super::{ConfigurationError, SessionSettings, take_retired};
use crate::learning::Preset;
use crate::safety::Guard;
use crate::simulation::SensorModel;
use crate::storage::{SETTINGS_BYTES, read_text};

impl SessionSettings {
    /// Reads a session's complete configuration to resume the session. Settings that the file lacks
    /// have their defaults, except that a file without a guard selects the box alone.
    ///
    /// # Errors
    /// The file cannot be read or is not a configuration, a setting is unknown or out of its range,
    /// or the session depended on a setting or a guard that this version does not have.
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
            return Err(out_of_range(format!("{entry}: {NEW_SESSION_ADVICE}")));
        }
        if !retired.is_empty() {
            text = toml::to_string(&table)?;
        }
        let oldest = Self { preset: None, ..Self::default() }.with_guard(Guard::Box);
        let settings = oldest.with_overrides(&text, path)?;
        settings.check_resumable().map_err(out_of_range)?;
        Ok(settings)
    }

    /// Overrides these settings with the entries of a file. If the file names a preset, the preset
    /// comes first.
    ///
    /// # Errors
    /// The file cannot be read, or the errors of [`overridden_by_text`](Self::overridden_by_text).
    pub fn overridden_by(&self, path: &Path) -> Result<Self, ConfigurationError> {
        let text = read(path)?;
        self.overridden_by_text(&text, path).map_err(|error| error.located(&text, ""))
    }

    /// Configures a new session like [`overridden_by`](Self::overridden_by). If the file names an
    /// estimator only for the Qube or only for simulations, it applies to both, because a policy
    /// should train on states that are estimated as they will be on the Qube. Simulations that show
    /// true states, as the file says, continue to do so.
    ///
    /// # Errors
    /// The errors of [`overridden_by`](Self::overridden_by).
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

    /// Overrides these settings with the text of a file; `path` only appears in errors. The text
    /// may be of any origin, also an untrusted one.
    ///
    /// # Errors
    /// The text is not TOML, or holds a setting that is unknown, out of its range, only of earlier
    /// versions, or not allowed in the file of a new session.
    pub fn overridden_by_text(&self, text: &str, path: &Path) -> Result<Self, ConfigurationError> {
        let out_of_range =
            |reason| ConfigurationError::OutOfRange { path: path.to_owned(), line: None, reason };
        if let Some(entry) = take_retired(&mut parsed(text, path)?).first() {
            return Err(out_of_range(format!("{entry}: leave it out")));
        }
        let mut settings = self.with_overrides(text, path)?;
        settings.preset = Some(Preset::of(&settings.training));
        settings.check_begun().map_err(out_of_range)?;
        Ok(settings)
    }

    fn with_overrides(&self, text: &str, path: &Path) -> Result<Self, ConfigurationError> {
        let invalid = |source| ConfigurationError::Invalid {
            path: path.to_owned(),
            source: Box::new(source),
        };
        // The text is parsed alone first, so that an error names a line of the file.
        let alone: Self = toml::from_str(text).map_err(invalid)?;
        let below = match alone.preset {
            Some(preset) => self.clone().trained_with(preset),
            None => self.clone(),
        };
        let mut table: Table = Table::try_from(below)?;
        let mut above: Table = toml::from_str(text).map_err(invalid)?;
        rename_entries(&mut above);
        merge_into(&mut table, above);
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
}

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

fn merge_into(below: &mut Table, above: Table) {
    for (key, value) in above {
        match (below.get_mut(&key), value) {
            (Some(Value::Table(below)), Value::Table(above)) => merge_into(below, above),
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
    use crate::session::SharedRig;
    use crate::session::retired::table_at;
    use crate::simulation::PsiSpace;

    fn overridden(text: &str) -> Result<SessionSettings, ConfigurationError> {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("my.toml");
        std::fs::write(&path, text).unwrap();
        SessionSettings::thesis().overridden_by(&path)
    }

    #[test]
    fn earlier_names_of_settings_override_the_preset_too() {
        let text = "[training]\npendulums = 32\ntrace_decay = 0.9\nenough = 450.0";
        let training = overridden(text).unwrap().training;
        assert_eq!((training.num_envs, training.gae_lambda), (32, 0.9));
        assert_eq!(training.target_return, Some(450.0));
        let sensors = "[training.simulation.sensors]\ntype = \"encoders\"";
        let observer = "estimator.observer]\nastray_rad = 0.2";
        let text = format!("{sensors}\n[training.simulation.sensors.{observer}\n[{observer}");
        let settings = overridden(&text).unwrap();
        let SensorModel::Encoders { estimator } = settings.training.simulation.sensors else {
            panic!("the sensors are encoders");
        };
        for estimator in [settings.estimator, estimator] {
            assert_eq!(estimator.observer.unwrap().reset_error_rad, 0.2);
        }
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

        // The numbers of a preset may change after a session began; a file of a version that did
        // not record the preset names none.
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
    fn a_new_session_has_its_rigs_from_the_command_line_alone() {
        let rig = SharedRig {
            device: "emulated".into(),
            emulated: Default::default(),
            homing_method: None,
        };
        let shared = SessionSettings { rigs: vec![rig], ..SessionSettings::thesis() };
        let text = shared.to_toml().unwrap();
        let message = overridden(&text).unwrap_err().to_string();
        assert!(message.contains("rigs: the command line names"), "{message}");
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("session.toml");
        std::fs::write(&path, text).unwrap();
        assert_eq!(SessionSettings::load(&path).unwrap().rigs, shared.rigs);
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
}
