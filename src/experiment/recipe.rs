use std::path::Path;

use serde::{Deserialize, Serialize};

use super::ExperimentError;
use super::settings::check_name;
use crate::learning::Origin;
use crate::session::{Model, SessionSettings};
use crate::simulation::{DomainDistribution, PsiError, SimulationSettings};
use crate::storage::{SETTINGS_BYTES, read_text};

/// The distribution from which a recipe's simulations are drawn (the thesis's section 5.2).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RecipeModel {
    /// The nominal values, always the same.
    Nominal,
    /// All nine parameters, with a fifth of nominal as standard deviation.
    Handcrafted,
    /// Masses and lengths as in `handcrafted`, the other five parameters nominal.
    NominalHandcrafted,
    /// A psi that a session searches; quantities that it does not shape are as in `handcrafted`.
    OptHandcrafted,
    /// A psi that a session searches; quantities that it does not shape are nominal.
    OptNominal,
    /// Parameters and nonidealities of a Qube that is not identified.
    Robust,
    /// Parameters and nonidealities around the identified Qube of `settings.profile`.
    Profile,
    /// A psi that a session searches; quantities that it does not shape are as in `robust`.
    OptRobust,
    /// A psi that a session searches; quantities that it does not shape are as in `profile`.
    OptProfile,
}

impl RecipeModel {
    /// Every model: the thesis's in the order of its table 5.3, then those with nonidealities.
    pub const ALL: [Self; 9] = [
        Self::Nominal,
        Self::Handcrafted,
        Self::NominalHandcrafted,
        Self::OptHandcrafted,
        Self::OptNominal,
        Self::Robust,
        Self::Profile,
        Self::OptRobust,
        Self::OptProfile,
    ];

    /// The thesis's five models.
    pub const THESIS: [Self; 5] = [
        Self::Nominal,
        Self::Handcrafted,
        Self::NominalHandcrafted,
        Self::OptHandcrafted,
        Self::OptNominal,
    ];

    /// The model's name.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Nominal => "nominal",
            Self::Handcrafted => "handcrafted",
            Self::NominalHandcrafted => "nominal-handcrafted",
            Self::Robust => "robust",
            Self::Profile => "profile",
            Self::OptHandcrafted | Self::OptNominal | Self::OptRobust | Self::OptProfile => {
                self.base().name()
            }
        }
    }

    /// A description for people.
    #[must_use]
    pub fn description(self) -> &'static str {
        match self {
            Self::Nominal => "The name plate's values, always the same",
            Self::Handcrafted => "All nine parameters vary by a fifth",
            Self::NominalHandcrafted => "Masses and lengths vary by a fifth",
            Self::OptHandcrafted => {
                "Masses and lengths by a psi that is searched, the others vary by a fifth"
            }
            Self::OptNominal => "Masses and lengths by a psi that is searched",
            Self::Robust => "Parameters and nonidealities as for a Qube that nobody has identified",
            Self::Profile => "Parameters and nonidealities around an identified Qube",
            Self::OptRobust => "Masses and lengths by a psi that is searched, the rest as robust",
            Self::OptProfile => "Masses and lengths by a psi that is searched, the rest as profile",
        }
    }

    /// Whether the model needs the Qube of `settings.profile`.
    #[must_use]
    pub fn needs_profile(self) -> bool {
        self.base() == Model::OptProfile
    }

    /// Whether a session searches for psi first.
    #[must_use]
    pub fn is_optimised(self) -> bool {
        matches!(self, Self::OptHandcrafted | Self::OptNominal | Self::OptRobust | Self::OptProfile)
    }

    /// The session's model for the search of psi, or with the same base distribution.
    fn base(self) -> Model {
        match self {
            Self::OptHandcrafted | Self::Handcrafted => Model::OptHandcrafted,
            Self::OptRobust | Self::Robust => Model::OptRobust,
            Self::OptProfile | Self::Profile => Model::OptProfile,
            Self::OptNominal | Self::Nominal | Self::NominalHandcrafted => Model::OptNominal,
        }
    }
}

/// A way to make policies for a Qube and to run them on it: distribution and settings of the training,
/// estimator and guard on the machine, and for optimised models the settings of the search for psi.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Recipe {
    /// Name of the recipe in tables and of its folder.
    pub name: String,
    /// Distribution of its simulations.
    pub model: RecipeModel,
    /// All other settings, as in a `session.toml`. Name, seed and emulated Qube come from the experiment;
    /// the extent is that of the search for psi.
    #[serde(default)]
    pub settings: SessionSettings,
}

/// A recipe as a file contains it; settings that it does not name are those of the base.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RecipeFile {
    name: String,
    model: RecipeModel,
    #[serde(default)]
    settings: toml::Table,
}

impl Recipe {
    /// A recipe with a model's name. Where the model has a delay, policies observe their last commands.
    #[must_use]
    pub fn of(model: RecipeModel, base: &SessionSettings) -> Self {
        let mut settings = base.clone();
        if matches!(model.base(), Model::OptRobust | Model::OptProfile) {
            let history = SimulationSettings::robust().history;
            settings.training.simulation.history = history;
        }
        Self::new(model.name().to_owned(), model, settings)
    }

    /// Reads a recipe from a TOML file: `name`, `model`, and in `[settings]` the differences from the base,
    /// by the names of a `session.toml`.
    ///
    /// # Errors
    /// The file cannot be read or is not a recipe.
    pub fn load(path: &Path, base: &SessionSettings) -> Result<Self, ExperimentError> {
        let unreadable = |reason: String| ExperimentError::Recipe { path: path.to_owned(), reason };
        let text =
            read_text(path, SETTINGS_BYTES).map_err(|error| unreadable(error.to_string()))?;
        let file: RecipeFile = toml::from_str(&text)
            .map_err(|error| unreadable(error.to_string().trim_end().to_owned()))?;
        check_name("name", &file.name).map_err(unreadable)?;
        let overrides =
            toml::to_string(&file.settings).map_err(|error| unreadable(error.to_string()))?;
        let settings = base
            .overridden_by_text(&overrides, path)
            .map_err(|error| error.located(&text, "settings."))?;
        Ok(Self::new(file.name, file.model, settings))
    }

    fn new(name: String, model: RecipeModel, mut settings: SessionSettings) -> Self {
        settings.model = model.base();
        // The session only searches for psi; the experiment runs the policies afterwards.
        settings.extent.verifies_incumbent = false;
        Self { name, model, settings }
    }

    /// The distribution in which the recipe's policies are trained and evaluated; `psi` is the result of
    /// the search, for optimised models.
    ///
    /// # Errors
    /// The psi is invalid.
    pub fn distribution(&self, psi: &[f64]) -> Result<DomainDistribution, PsiError> {
        let family = self.settings.family;
        Ok(match self.model {
            RecipeModel::Nominal => DomainDistribution::nominal(),
            RecipeModel::Handcrafted => DomainDistribution::handcrafted(family),
            RecipeModel::NominalHandcrafted => DomainDistribution::nominal_handcrafted(family),
            RecipeModel::Robust | RecipeModel::Profile => self.settings.base_distribution()?,
            RecipeModel::OptHandcrafted
            | RecipeModel::OptNominal
            | RecipeModel::OptRobust
            | RecipeModel::OptProfile => self.settings.distribution(psi)?,
        })
    }

    /// The simulation settings besides the distribution.
    ///
    /// # Errors
    /// The psi is invalid.
    pub fn simulation(&self, psi: &[f64]) -> Result<SimulationSettings, PsiError> {
        if self.model.is_optimised() {
            self.settings.simulation(psi)
        } else {
            Ok(self.settings.training.simulation)
        }
    }

    /// The origin that a policy's file records.
    #[must_use]
    pub fn origin(&self, psi: &[f64]) -> Origin {
        Origin {
            model: self.model.name().to_owned(),
            psi: self.model.is_optimised().then(|| self.settings.psi.with_names(psi)),
            ..self.settings.origin(psi)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_changes_what_it_names_and_leaves_the_rest() {
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
        assert_eq!(recipe.origin(&[]).model, "opt-handcrafted");
        for (text, words) in [
            ("name = \"a\"\nmodel = \"nominl\"\n", "nominl"),
            ("name = \"a/b\"\nmodel = \"nominal\"\n", "a/b"),
            ("model = \"nominal\"\n", "name"),
            ("name = \"a\"\nmodel = \"nominal\"\n[settings]\nfamly = \"normal\"\n", "famly"),
        ] {
            let message = load(text).unwrap_err().to_string();
            assert!(message.contains(words) && message.contains("recipe.toml"), "{message}");
        }
    }

    #[test]
    fn names_stand_where_their_models_do() {
        for model in RecipeModel::ALL {
            let toml = toml::to_string(&Recipe::of(model, &SessionSettings::quick())).unwrap();
            let again: Recipe = toml::from_str(&toml).unwrap();
            assert_eq!((again.model, again.name.as_str()), (model, model.name()));
        }
    }
}
