use std::path::Path;

use serde::{Deserialize, Serialize};

use super::ExperimentError;
use super::folder::check_name;
use crate::learning::Origin;
use crate::session::SessionSettings;
use crate::simulation::{DomainDistribution, Model, Psi, PsiError, SimulationSettings};
use crate::storage::{SETTINGS_BYTES, read_text};

/// A way to make policies and to run them on a Qube: distribution and settings of the training,
/// estimator and guard of the rollouts, and for optimised models the settings of the search for
/// psi.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Recipe {
    /// Name of the recipe in tables and of its folder.
    pub name: String,
    /// Named distribution of the recipe's simulations.
    pub model: Model,
    /// All other settings, as in a `session.toml`. Name, seed and emulated Qube come from the
    /// experiment. The extent describes the search for psi; its steps and repetitions also hold for
    /// the policies' rollouts.
    #[serde(default)]
    pub settings: SessionSettings,
}

/// A recipe as a file contains it. `settings` has only the settings that the file names; the base
/// of the recipe gives the others.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RecipeFile {
    name: String,
    model: Model,
    #[serde(default)]
    settings: toml::Table,
}

impl Recipe {
    /// A recipe with a model's name and the settings of `base`. If the model has nonidealities, and
    /// so a delay, policies observe their last two commands.
    #[must_use]
    pub fn of(model: Model, base: &SessionSettings) -> Self {
        let mut settings = base.clone();
        if model.has_nonidealities() {
            let history = SimulationSettings::robust().history;
            settings.training.simulation.history = history;
        }
        Self::new(model.name().to_owned(), model, settings)
    }

    /// Reads a recipe from a TOML file: `name`, `model`, and in `[settings]` the differences from
    /// `base`, with the names of a `session.toml`.
    ///
    /// # Errors
    /// The file cannot be read or is not a recipe, or its settings are invalid.
    pub fn load(path: &Path, base: &SessionSettings) -> Result<Self, ExperimentError> {
        let unreadable = |reason: String| ExperimentError::Recipe { path: path.to_owned(), reason };
        let text =
            read_text(path, SETTINGS_BYTES).map_err(|error| unreadable(error.to_string()))?;
        let file: RecipeFile = toml::from_str(&text)
            .map_err(|error| unreadable(error.to_string().trim_end().to_owned()))?;
        check_name("name", &file.name).map_err(|refused| unreadable(refused.to_string()))?;
        for (key, remedy) in [
            ("name", "give `name` at the top of the file, outside of [settings]"),
            ("model", "give `model` at the top of the file, outside of [settings]"),
            ("seed", "leave it out, because the experiment gives it"),
            ("emulated", "leave it out, because the experiment gives it"),
        ] {
            if file.settings.contains_key(key) {
                let reason = format!("settings.{key} has no effect in a recipe: {remedy}");
                return Err(unreadable(reason));
            }
        }
        let settings = base.overridden_by_part(&text, Some("settings"), path)?;
        Ok(Self::new(file.name, file.model, settings))
    }

    fn new(name: String, model: Model, mut settings: SessionSettings) -> Self {
        settings.model = model.searched();
        // The session only searches for psi; the experiment runs the policies afterwards.
        settings.extent.verifies_incumbent = false;
        Self { name, model, settings }
    }

    /// The distribution in which the recipe's policies are trained and evaluated. For searched
    /// models, `psi` is the result of the search.
    ///
    /// # Errors
    /// The psi of a searched model or a profile is missing, or a value of the profile or the plant
    /// cannot be simulated.
    pub fn distribution(&self, psi: Option<&Psi>) -> Result<DomainDistribution, PsiError> {
        let SessionSettings { family, profile, .. } = &self.settings;
        self.model.distribution(self.settings.plant(), *family, profile.as_ref(), psi)
    }

    /// The simulation settings besides the distribution, with the velocity filter's corner of psi
    /// if psi names one.
    #[must_use]
    pub fn simulation(&self, psi: Option<&Psi>) -> SimulationSettings {
        let simulation = &self.settings.training.simulation;
        psi.map_or(*simulation, |psi| simulation.shaped_by(psi))
    }

    /// The origin that a policy's file records.
    #[must_use]
    pub fn origin(&self, psi: Option<&Psi>) -> Origin {
        Origin {
            model: self.model.name().to_owned(),
            psi: psi.cloned(),
            preset: self.settings.preset().name().to_owned(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_changes_the_settings_that_it_names_and_no_others() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("recipe.toml");
        let base = SessionSettings::thesis();
        let load = |text: &str| {
            std::fs::write(&path, text).unwrap();
            Recipe::load(&path, &base)
        };
        let text = "name = \"fast-filter\"\nmodel = \"opt-handcrafted\"\n\
                    [settings.estimator]\ncorner_rad_s = 123.0\n";
        let recipe = load(text).unwrap();
        assert_eq!(recipe.settings.estimator.corner_rad_s, 123.0);
        assert_eq!(recipe.settings.training, base.training);
        assert_eq!(recipe.settings.model, Model::OptHandcrafted);
        assert_eq!(recipe.origin(None).model, "opt-handcrafted");
        let reward = "name = \"a\"\nmodel = \"nominal\"\n\
                      [settings.training.simulation.reward]\nvoltage = 0.01\n";
        let mut expected = base.training.simulation;
        expected.reward.voltage = 0.01;
        assert_eq!(load(reward).unwrap().settings.training.simulation, expected);
        for (text, words) in [
            (&*format!("{reward}volt = 0.01\n"), "line 5,"),
            (&*reward.replace("0.01", "nan"), "line 4: training.simulation.reward.voltage"),
            ("name = \"a\"\nmodel = \"nominal\"\n\n[settings]\nfamly = \"normal\"\n", "line 5,"),
            ("name = \"a\"\nmodel = \"nominl\"\n", "nominl"),
            ("name = \"a\"\nmodel = \"nominal\"\n[settings]\nseed = 3\n", "settings.seed"),
            (
                "name = \"a\"\nmodel = \"nominal\"\n[settings]\nmodel = \"robust\"\n",
                "give `model` at the top",
            ),
            (
                "name = \"a\"\nmodel = \"nominal\"\n[settings.emulated.model.gap]\ncommand_delay_s = 0.03\n",
                "settings.emulated",
            ),
            ("name = \"a/b\"\nmodel = \"nominal\"\n", "a/b"),
            ("model = \"nominal\"\n", "name"),
            ("name = \"a\"\nmodel = \"nominal\"\n[settings]\nfamly = \"normal\"\n", "famly"),
        ] {
            let message = load(text).unwrap_err().to_string();
            assert!(message.contains(words) && message.contains("recipe.toml"), "{message}");
        }
    }

    #[test]
    fn a_written_recipe_keeps_its_model_and_its_name() {
        for model in Model::ALL {
            let toml = toml::to_string(&Recipe::of(model, &SessionSettings::quick())).unwrap();
            let again: Recipe = toml::from_str(&toml).unwrap();
            assert_eq!((again.model, again.name.as_str()), (model, model.name()));
        }
    }
}
