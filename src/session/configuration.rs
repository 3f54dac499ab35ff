//! Reads files of session settings: a session's own `session.toml` to show or resume it, or a file
//! that overrides a preset. A misspelt key is an error.

use std::path::Path;

use serde::Deserialize;
use toml::Spanned;
use toml::de::DeValue;

use super::located_entries::{LocatedEntries, entry_at, merge_into};
use super::retired::{Retired, rename_entries};
use super::setting_error::NEW_SESSION_ADVICE;
use super::{ConfigurationError, Extent, SessionSettings, take_retired};
use crate::estimation::ObserverSettings;
use crate::learning::Preset;
use crate::safety::Guard;
use crate::simulation::SensorModel;
use crate::storage::{SETTINGS_BYTES, read_text};

impl SessionSettings {
    /// Reads a session's complete configuration to show it. Entries that a file of an earlier
    /// version lacks get the values under which that version ran: a file without a guard selects
    /// the box alone, and a file without `verifies_incumbent` verifies only the recommendation.
    /// Other missing entries have their defaults or, in a table that is always written whole, are
    /// errors. Entries of earlier versions that this version lacks are ignored.
    ///
    /// # Errors
    /// The file cannot be read or is not a configuration, or a setting is unknown or out of its
    /// range.
    pub fn load(path: &Path) -> Result<Self, ConfigurationError> {
        let text = read(path)?;
        let loaded = Self::loaded(&text, path).map_err(|error| error.located(&text, ""));
        loaded.map(|(settings, _)| settings)
    }

    /// Reads a session's complete configuration like [`load`](Self::load) to resume the session.
    ///
    /// # Errors
    /// The errors of [`load`](Self::load), or the session depended on a setting or a guard that
    /// this version does not have.
    pub fn load_to_resume(path: &Path) -> Result<Self, ConfigurationError> {
        let text = read(path)?;
        let resumable = |(settings, retired): (Self, Vec<Retired>)| {
            let changed = retired.iter().find(|entry| entry.changed_something());
            let gone = changed.map(|entry| format!("{entry}: {NEW_SESSION_ADVICE}"));
            let refused = || settings.check_resumable().err().map(|error| error.to_string());
            match gone.or_else(refused) {
                Some(reason) => Err(out_of_range(path, reason)),
                None => Ok(settings),
            }
        };
        let loaded = Self::loaded(&text, path).and_then(resumable);
        loaded.map_err(|error| error.located(&text, ""))
    }

    /// Reads a complete configuration, and its retired entries apart from it.
    fn loaded(text: &str, path: &Path) -> Result<(Self, Vec<Retired>), ConfigurationError> {
        let mut entries = LocatedEntries::of(text, None, path)?;
        let retired = take_retired(entries.table.get_mut(), text);
        // A session writes its tables whole, so a table that lacks an entry is damaged.
        entries.read::<Self>()?;
        Ok((Self::of_oldest_files().with_overrides(&entries)?, retired))
    }

    /// The settings under which the oldest versions ran, for the entries that their files lack.
    fn of_oldest_files() -> Self {
        let oldest = Self { preset: None, ..Self::default() }.with_guard(Guard::Box);
        let extent = Extent { verifies_incumbent: false, ..oldest.extent };
        Self { extent, ..oldest }
    }

    /// Overrides these settings with the entries of a file. If the file names a preset, the preset
    /// comes first.
    ///
    /// # Errors
    /// The file cannot be read, or the errors of [`overridden_by_text`](Self::overridden_by_text).
    pub fn overridden_by(&self, path: &Path) -> Result<Self, ConfigurationError> {
        self.overridden_by_text(&read(path)?, path)
    }

    /// Configures a new session like [`overridden_by`](Self::overridden_by). If the file names an
    /// estimator only for the Qube or only for simulations, the estimator applies to both, because
    /// a policy should train on states that are estimated as they will be on the Qube. Simulations
    /// that show true states according to the file keep them.
    ///
    /// # Errors
    /// The errors of [`overridden_by`](Self::overridden_by).
    pub fn configured_by(&self, path: &Path) -> Result<Self, ConfigurationError> {
        let text = read(path)?;
        let settings = self.overridden_by_text(&text, path)?;
        let mut file = LocatedEntries::of(&text, None, path)?.table.into_inner();
        let is_for_qube = file.contains_key("estimator");
        let is_for_simulations = entry_at(&mut file, &["training", "simulation"])
            .is_some_and(|simulation| simulation.contains_key("sensors"));
        let estimator = match (is_for_qube, settings.training.simulation.sensors) {
            (true, _) if !is_for_simulations => settings.estimator,
            (false, SensorModel::Encoders { estimator }) if is_for_simulations => estimator,
            _ => return Ok(settings),
        };
        let settings = settings.seen_through(estimator);
        settings.checked(path).map_err(|error| error.located(&text, ""))
    }

    /// Overrides these settings with the text of a file; `path` only appears in errors. The text
    /// may be of any origin, also an untrusted one.
    ///
    /// # Errors
    /// The text is not TOML, or holds a setting that is unknown, out of its range, only of earlier
    /// versions, or not allowed in the file of a new session.
    pub fn overridden_by_text(&self, text: &str, path: &Path) -> Result<Self, ConfigurationError> {
        self.overridden_by_part(text, None, path)
    }

    /// Overrides these settings like [`overridden_by_text`](Self::overridden_by_text), but only
    /// with the table `part` of the text; `None` means the whole text.
    ///
    /// # Errors
    /// The errors of [`overridden_by_text`](Self::overridden_by_text).
    pub fn overridden_by_part(
        &self,
        text: &str,
        part: Option<&str>,
        path: &Path,
    ) -> Result<Self, ConfigurationError> {
        let above = part.map_or_else(String::new, |part| format!("{part}."));
        self.overridden(text, part, path).map_err(|error| error.located(text, &above))
    }

    fn overridden(
        &self,
        text: &str,
        part: Option<&str>,
        path: &Path,
    ) -> Result<Self, ConfigurationError> {
        let mut entries = LocatedEntries::of(text, part, path)?;
        if let Some(entry) = take_retired(entries.table.get_mut(), text).first() {
            return Err(out_of_range(path, format!("{entry}: leave it out")));
        }
        let mut settings = self.with_overrides(&entries)?;
        settings.preset = Some(Preset::of(&settings.training));
        settings.check_begun().map_err(|refused| out_of_range(path, refused.to_string()))?;
        Ok(settings)
    }

    fn with_overrides(&self, above: &LocatedEntries<'_>) -> Result<Self, ConfigurationError> {
        let SelectedPreset { preset } = above.read()?;
        let below = match preset {
            Some(preset) => self.clone().trained_with(preset),
            None => self.clone(),
        };
        let text = toml::to_string(&below)?;
        let observer = toml::to_string(&ObserverSettings::default())?;
        let mut all = LocatedEntries::of(&text, None, above.path)?;
        let mut table = above.table.clone();
        rename_entries(table.get_mut());
        for place in OBSERVERS {
            let is_named =
                entry_at(table.get_mut(), place).is_some_and(|it| it.contains_key("observer"));
            if let (true, Some(below)) = (is_named, entry_at(all.table.get_mut(), place))
                && !below.contains_key("observer")
            {
                let entries = LocatedEntries::of(&observer, None, above.path)?.table;
                let (span, entries) = (entries.span(), entries.into_inner());
                let name = Spanned::new(span.clone(), "observer".into());
                below.insert(name, Spanned::new(span, DeValue::Table(entries)));
            }
        }
        merge_into(all.table.get_mut(), table.into_inner());
        // The places of the file's entries refer to its own text.
        let settings: Self = LocatedEntries { text: above.text, ..all }.read()?;
        settings.checked(above.path)
    }

    fn checked(self, path: &Path) -> Result<Self, ConfigurationError> {
        match self.check() {
            Ok(()) => Ok(self),
            Err(refused) => Err(out_of_range(path, refused.to_string())),
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

fn out_of_range(path: &Path, reason: String) -> ConfigurationError {
    ConfigurationError::OutOfRange { path: path.to_owned(), line: None, reason }
}

/// The tables that may have an `observer`, which is absent by default. If a file names some entries
/// of an observer, the others have their defaults.
const OBSERVERS: [&[&str]; 3] =
    [&["estimator"], &["homing", "estimator"], &["training", "simulation", "sensors", "estimator"]];

/// The entry of a settings file that selects the other settings' defaults.
#[derive(Deserialize)]
struct SelectedPreset {
    preset: Option<Preset>,
}

#[cfg(test)]
mod tests {
    use toml::de::DeTable;

    use super::*;
    use crate::estimation::{EstimatorSettings, ObserverSettings};
    use crate::qube::{Nonideality, QubeModel};
    use crate::session::SharedRig;
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
            panic!("the sensors are not encoders");
        };
        for estimator in [settings.estimator, estimator] {
            assert_eq!(estimator.observer.unwrap().reset_error_rad, 0.2);
        }
    }

    #[test]
    fn a_file_replaces_the_entries_that_it_names_and_keeps_the_rest_of_the_preset() {
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
    fn a_file_of_a_version_without_an_entry_keeps_the_value_of_that_version() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("session.toml");
        let written = SessionSettings::thesis().to_toml().unwrap();
        let verified = "verifies_incumbent = true\n";
        assert!(written.contains(verified));
        for (text, verifies) in [(written.clone(), true), (written.replace(verified, ""), false)] {
            std::fs::write(&path, text).unwrap();
            let extent = SessionSettings::load(&path).unwrap().extent;
            assert_eq!(extent, Extent { verifies_incumbent: verifies, ..Extent::THESIS });
        }
    }

    #[test]
    fn a_seed_of_64_bits_is_read_again() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("session.toml");
        let settings = SessionSettings { seed: u64::MAX, ..SessionSettings::quick() };
        std::fs::write(&path, settings.to_toml().unwrap()).unwrap();
        assert_eq!(SessionSettings::load(&path).unwrap(), settings);
        assert_eq!(SessionSettings::load_to_resume(&path).unwrap(), settings);
        let older = settings.to_toml().unwrap();
        let older = older.replace("[training]\n", "[training]\nwidening = 0.6\n");
        std::fs::write(&path, older).unwrap();
        assert_eq!(
            SessionSettings::load(&path).unwrap().seed,
            u64::MAX,
            "the seed is read beside a retired entry"
        );
        std::fs::write(&path, "seed = 18446744073709551615\n").unwrap();
        let refused = SessionSettings::quick().configured_by(&path).unwrap_err().to_string();
        assert!(
            refused.contains("line 1: seed = 18446744073709551615: give"),
            "a new session takes seeds as --seed does: {refused}"
        );
    }

    #[test]
    fn a_file_that_cannot_be_resumed_can_be_shown() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("session.toml");
        let written = SessionSettings::quick().to_toml().unwrap();
        for (older, words) in [
            (written.replace("guard = \"foresight\"", "guard = \"envelope\""), "safety_box.guard"),
            (written.replace("[training]\n", "[training]\nwidening = 0.6\n"), "training.widening"),
        ] {
            assert_ne!(older, written);
            std::fs::write(&path, older).unwrap();
            let refused = SessionSettings::load_to_resume(&path).unwrap_err().to_string();
            assert!(refused.contains(words), "{refused}");
            let shown = SessionSettings::load(&path).unwrap();
            assert_eq!(shown.training, SessionSettings::quick().training);
        }
        std::fs::write(&path, &written).unwrap();
        assert_eq!(SessionSettings::load_to_resume(&path).unwrap(), SessionSettings::quick());
    }

    #[test]
    fn a_table_keeps_the_entries_of_the_preset_that_a_file_does_not_name() {
        let thesis = SessionSettings::thesis();
        let changed = |change: fn(&mut SessionSettings)| {
            let mut settings = thesis.clone();
            change(&mut settings);
            settings.preset = Some(Preset::of(&settings.training));
            settings
        };
        let of_observer = "estimator.observer.model.parameters]\nR_m = 9.0\n";
        for (text, expected) in [
            (
                "[training.simulation.reward]\nvoltage = 0.01\n".to_owned(),
                changed(|it| it.training.simulation.reward.voltage = 0.01),
            ),
            (
                "[homing.signs]\ntheta_inverted = true\n".to_owned(),
                changed(|it| it.homing.signs.theta_inverted = true),
            ),
            ("[emulated]\nplay_rad = 0.01\n".to_owned(), changed(|it| it.emulated.play_rad = 0.01)),
            (
                "[emulated.model.parameters]\nM_p = 0.03\n".to_owned(),
                changed(|it| it.emulated.model.parameters.pendulum_mass_kg = 0.03),
            ),
            (
                "[emulated.model.gap]\ncommand_delay_s = 0.01\n".to_owned(),
                changed(|it| it.emulated.model.nonidealities.command_delay_s = 0.01),
            ),
            (
                "[emulated.effects]\nslack = 0.2\n".to_owned(),
                changed(|it| it.emulated.effects.slack = 0.2),
            ),
            (
                format!("[{of_observer}"),
                changed(|it| {
                    let observer = it.estimator.observer.get_or_insert_default();
                    observer.model.parameters.motor_resistance_ohm = 9.0;
                }),
            ),
            (
                "[homing.estimator.observer]\nastray_rad = 0.2\n".to_owned(),
                changed(|it| {
                    it.homing.estimator.observer.get_or_insert_default().reset_error_rad = 0.2;
                }),
            ),
        ] {
            assert_eq!(overridden(&text).unwrap(), expected, "{text}");
        }
        let simulated = overridden(&format!("[training.simulation.sensors.{of_observer}")).unwrap();
        let SensorModel::Encoders { estimator } = simulated.training.simulation.sensors else {
            panic!("the sensors are not encoders");
        };
        let mut observer = ObserverSettings::default();
        observer.model.parameters.motor_resistance_ohm = 9.0;
        assert_eq!(estimator, EstimatorSettings::observer(observer));
        // A profile is absent by default: it describes one Qube and has to be whole.
        let message = overridden("[profile]\nspread = 0.1\n").unwrap_err().to_string();
        assert!(message.contains("line 1") && message.contains("`model`"), "{message}");
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
        let SensorModel::Encoders { estimator } = sensors else {
            panic!("the sensors are not encoders");
        };
        assert_eq!(estimator.corner_rad_s, 50.0);
        assert!(settings.search().is_ok());
    }

    #[test]
    fn an_estimator_that_a_file_names_once_applies_to_machine_and_simulation() {
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
            let mut entries = DeTable::parse(&written).unwrap();
            let limits = entry_at(entries.get_mut(), path).unwrap();
            let names: Vec<&str> = limits.keys().map(|name| &**name.get_ref()).collect();
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
        for (text, line, name) in [
            ("[extent]\nrolouts = 8\n", 2, "rolouts"),
            ("[training.simulation.reward]\nvoltage = 0.01\nvolt = 0.01\n", 3, "volt"),
            (
                "[training.simulation.sensors]\ntype = \"encoders\"\n\n\
              [training.simulation.sensors.estimator]\ncorner = 1.0\n",
                5,
                "corner",
            ),
            ("[emulated.model.parameters]\nM_p = 0.03\nM_x = 0.03\n", 3, "M_x"),
        ] {
            let message = overridden(text).unwrap_err().to_string();
            let place = format!("line {line},");
            assert!(message.contains(&place) && message.contains(name), "{place} {message}");
        }
    }

    #[test]
    fn the_names_in_place_of_a_misspelt_key_are_the_present_ones() {
        for (text, present, earlier) in [
            (
                "[training]\nupdate = 8\n",
                ["num_envs", "gae_lambda", "target_return"].as_slice(),
                ["pendulums", "trace_decay", "enough"].as_slice(),
            ),
            ("[safety_box]\nbeta = 8\n", &["theta_rad", "alpha_dot_rad_s"], &["theta", "alpha"]),
            ("[training.simulation.reward]\nbeta = 8\n", &["theta", "alpha_dot"], &[]),
        ] {
            let message = overridden(text).unwrap_err().to_string();
            let lists = |name: &&str| message.contains(&format!("`{name}`"));
            assert!(present.iter().all(lists), "{message}");
            assert!(!earlier.iter().any(lists), "{message}");
        }
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
    fn an_impossible_value_is_an_error_with_its_line() {
        for (text, line, name) in [
            ("[training]\nupdates = 0\n", 2, "training.updates = 0"),
            ("[training]\n\nlearning_rate = nan\n", 3, "training.learning_rate = NaN"),
            ("training.discount = 7.0\n", 1, "training.discount = 7"),
            ("seed = 1\n[training]\npendulums = 0\n", 3, "training.pendulums = 0"),
            ("[training]\nnum_envs = 20\n", 2, "training.num_envs"),
            ("seed = 1\nmodel = \"opt-profile\"\n", 2, "model = \"opt-profile\""),
            (
                "[[psi]]\nname = \"std_delay\"\n[[psi]]\nname = \"filter\"\nupper = 1e9\n",
                5,
                "psi[2].upper = 1000000000",
            ),
            ("[extent]\niterations = 4000000000\n", 2, "extent.iterations = 4000000000"),
            ("[extent]\nrepetitions = 4000000000\n", 2, "extent.repetitions = 4000000000"),
            ("seed = 1\n[safety_box]\ntheta = 1e300\n", 3, "safety_box.theta = "),
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
        let deep = format!("seed = 1\n{} = 1\nname = \"a\"\n", ["a"; 100].join("."));
        let message = overridden(&deep).unwrap_err().to_string();
        assert!(message.contains("my.toml, line 2: a key has too many parts"), "{message}");
    }

    #[test]
    fn a_wrong_dimension_of_psi_is_named_with_its_own_line() {
        let first = "seed = 1\n[[psi]]\nname = \"mean_M_p\"\n[[psi]]\n";
        for (second, words) in [
            ("name = \"filtr\"\n", "filtr is no entry of psi"),
            ("name = \"mean_M_p\"\n", "mean_M_p twice"),
            ("name = \"filter\"\nlower = 5.0\nupper = 1.0\n", "range of filter"),
        ] {
            let message = overridden(&format!("{first}{second}")).unwrap_err().to_string();
            assert!(message.contains("line 4,") && message.contains(words), "{message}");
        }
    }
}
