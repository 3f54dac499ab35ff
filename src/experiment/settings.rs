use std::path::Path;

use serde::{Deserialize, Serialize};
use toml::Spanned;
use toml::de::{DeTable, DeValue, Deserializer};

use super::folder::check_name;
use super::seal::Seal;
use super::{ExperimentError, ExperimentSettingError, MethodSettings, Plant, Recipe};
use crate::qube::PlantModel;
use crate::session::{Retired, SettingError, entry_at, take_retired, toml_message};
use crate::storage::{SETTINGS_BYTES, read_text};

/// The settings of an experiment, as `experiment.toml` contains them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ExperimentSettings {
    /// Name of the experiment.
    pub name: String,
    /// Seed from which every random number follows.
    pub seed: u64,
    /// Number of policies for each recipe, 1 to 1000, each trained with its own seed.
    pub policies: u32,
    /// Number of rollouts of each policy on each plant, 1 to 1000.
    pub rollouts: u32,
    /// Number of fresh starts from which a policy's return in simulation is evaluated, 1 to
    /// 100 000.
    pub simulated_starts: u32,
    /// Checksum of the Qube's profile that the guard had when the experiment began, or `none` if
    /// the Qube's file named no profile; `None` in files that lack the entry.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub guard_profile: Option<String>,
    /// Plants on which policies run; a recipe's search for psi runs on the first, without its
    /// `vary`. A real Qube is the only plant of its experiment.
    pub plants: Vec<Plant>,
    /// Recipes that are compared.
    pub recipes: Vec<Recipe>,
    /// Methods that are compared instead of recipes. They start from one recipe and run on one
    /// emulated plant, or at fixed budgets on one or more. Up to `policies` policies with
    /// `rollouts` rollouts each score a recommendation; at fixed budgets it is one policy with
    /// `rollouts` rollouts.
    #[serde(default, rename = "strategies", skip_serializing_if = "Option::is_none")]
    pub methods: Option<MethodSettings>,
}

impl ExperimentSettings {
    /// Reads an `experiment.toml` of any version, to show finished work.
    ///
    /// # Errors
    /// The file cannot be read or is not an experiment.
    pub fn load(path: &Path) -> Result<Self, ExperimentError> {
        Self::parsed(path, &text_of(path)?).map(|(settings, _)| settings)
    }

    /// Reads an `experiment.toml` to resume the experiment.
    ///
    /// # Errors
    /// The file cannot be read, is not an experiment, was changed since the experiment began, or
    /// names a guard, or a setting with an effect, that this version does not offer.
    pub fn load_to_resume(path: &Path) -> Result<Self, ExperimentError> {
        let text = text_of(path)?;
        let (settings, retired) = Self::parsed(path, &text)?;
        let changed = (!Seal::EXPERIMENT.is_unchanged(&text)).then(|| {
            "it was changed since this experiment began: restore it, or begin a new experiment with these settings"
                .to_owned()
        });
        let retired = retired
            .iter()
            .find(|entry| entry.changed_something())
            .map(|entry| format!("{entry}: an experiment keeps the settings that it began with"));
        let unsupported = settings.recipes.iter().find_map(|recipe| {
            let refused = recipe.settings.check_resumable().err()?;
            Some(format!("recipe {}: {refused}", recipe.name))
        });
        match changed.or(unsupported).or(retired) {
            Some(reason) => Err(ExperimentError::NotResumable { path: path.to_owned(), reason }),
            None => Ok(settings),
        }
    }

    /// Reads and checks the settings; also returns the retired entries of the file.
    fn parsed(path: &Path, text: &str) -> Result<(Self, Vec<Retired>), ExperimentError> {
        let unreadable =
            |reason: String| ExperimentError::Settings { path: path.to_owned(), reason };
        let invalid = |mut error: toml::de::Error| {
            error.set_input(Some(text));
            unreadable(toml_message(&error))
        };
        let mut table = DeTable::parse(text).map_err(invalid)?;
        let retired = taken_from_recipes(table.get_mut(), text);
        let settings = Self::deserialize(Deserializer::from(table)).map_err(invalid)?;
        settings.check().map_err(|refused| unreadable(refused.to_string()))?;
        Ok((settings, retired))
    }

    /// The model of the plant that all recipes simulate and drive; the Qube's without any recipe.
    #[must_use]
    pub fn plant(&self) -> &PlantModel {
        self.recipes.first().map_or(&PlantModel::QUBE, |recipe| recipe.settings.plant())
    }

    /// The settings as TOML.
    ///
    /// # Errors
    /// A number has no TOML form.
    pub fn to_toml(&self) -> Result<String, ExperimentError> {
        Ok(toml::to_string_pretty(self)?)
    }

    /// Checks the settings.
    ///
    /// # Errors
    /// The first invalid setting.
    pub fn check(&self) -> Result<(), ExperimentSettingError> {
        for (name, value, most) in [
            ("policies", self.policies, 1000.0),
            ("rollouts", self.rollouts, 1000.0),
            ("simulated_starts", self.simulated_starts, 100_000.0),
        ] {
            SettingError::in_range(name, value.into(), [1.0, most])?;
        }
        if self.recipes.is_empty() || self.plants.is_empty() {
            return Err(ExperimentSettingError::Empty);
        }
        check_names("recipes", &self.recipe_names())?;
        check_names("plants", &self.plant_names())?;
        for recipe in &self.recipes {
            let (of_recipe, first) = (recipe.settings.plant(), self.plant());
            let recipe_name = || recipe.name.clone();
            if of_recipe != first {
                return Err(ExperimentSettingError::OtherPlant {
                    recipe: recipe_name(),
                    plant: of_recipe.name.to_string(),
                    first: first.name.to_string(),
                });
            }
            recipe.settings.check_limits().map_err(|source| ExperimentSettingError::Recipe {
                recipe: recipe_name(),
                source,
            })?;
            if recipe.settings.identification.is_some() {
                return Err(ExperimentSettingError::Identifies { recipe: recipe_name() });
            }
        }
        for Plant { name, emulated, vary } in &self.plants {
            emulated
                .check()
                .map_err(|source| ExperimentSettingError::Plant { plant: name.clone(), source })?;
            SettingError::in_range("vary", *vary, [0.0, 0.5])
                .map_err(|source| ExperimentSettingError::Vary { plant: name.clone(), source })?;
        }
        match &self.methods {
            Some(methods) => self.check_methods(methods),
            None => Ok(()),
        }
    }

    /// Checks the settings of an experiment that begins. Its folder may be copied to a file system
    /// that takes `Lab` and `lab` for the same name, so names that differ in case only are refused;
    /// experiments that have such names can be resumed and shown. A method to which no budget
    /// allows a recommendation is refused in the same way.
    ///
    /// # Errors
    /// The first invalid setting.
    pub fn check_new(&self) -> Result<(), ExperimentSettingError> {
        self.check()?;
        check_folders("recipes", &self.recipe_names())?;
        check_folders("plants", &self.plant_names())?;
        self.check_largest_budget()
    }

    /// Checks that the largest budget allows each method a recommendation.
    fn check_largest_budget(&self) -> Result<(), ExperimentSettingError> {
        let (Some(methods), Some(recipe)) = (&self.methods, self.recipes.first()) else {
            return Ok(());
        };
        let Some(&largest) = methods.budgets.last() else { return Ok(()) };
        for &method in &methods.methods {
            let least = method.first_budget(recipe.settings.extent.rollouts);
            if least > largest {
                return Err(ExperimentSettingError::NoRecommendation { method, least, largest });
            }
        }
        Ok(())
    }

    /// Checks that one real Qube can run the policies of all recipes: it is homed once for all.
    ///
    /// # Errors
    /// Two recipes differ in their homing.
    pub fn check_for_one_rig(&self) -> Result<(), ExperimentSettingError> {
        let mut recipes = self.recipes.iter();
        let Some(first) = recipes.next() else { return Ok(()) };
        match recipes.find(|it| it.settings.homing != first.settings.homing) {
            Some(other) => Err(ExperimentSettingError::Homing {
                recipe: other.name.clone(),
                first: first.name.clone(),
            }),
            None => Ok(()),
        }
    }

    fn check_methods(&self, methods: &MethodSettings) -> Result<(), ExperimentSettingError> {
        methods.check()?;
        let [recipe] = self.recipes.as_slice() else {
            return Err(ExperimentSettingError::SeveralModels);
        };
        let searches = methods.methods.iter().find(|method| method.searches_psi());
        if let (Some(&method), false) = (searches, recipe.model.is_searched()) {
            return Err(ExperimentSettingError::NoPsi { method, model: recipe.model });
        }
        if self.plants.len() > 1 && !methods.has_budgets() {
            return Err(ExperimentSettingError::SeveralPlants);
        }
        Ok(())
    }

    fn recipe_names(&self) -> Vec<&str> {
        self.recipes.iter().map(|recipe| recipe.name.as_str()).collect()
    }

    fn plant_names(&self) -> Vec<&str> {
        self.plants.iter().map(|plant| plant.name.as_str()).collect()
    }
}

/// Removes retired entries from the settings of all recipes of an experiment's file and returns
/// them.
fn taken_from_recipes(experiment: &mut DeTable<'_>, text: &str) -> Vec<Retired> {
    let Some(DeValue::Array(recipes)) = experiment.get_mut("recipes").map(Spanned::get_mut) else {
        return Vec::new();
    };
    let tables = recipes.iter_mut().filter_map(|recipe| match recipe.get_mut() {
        DeValue::Table(recipe) => entry_at(recipe, &["settings"]),
        _ => None,
    });
    tables.flat_map(|settings| take_retired(settings, text)).collect()
}

/// Checks that the names are valid and that no two are equal; `kind` names them in the error.
fn check_names(kind: &'static str, names: &[&str]) -> Result<(), ExperimentSettingError> {
    for (index, name) in names.iter().enumerate() {
        check_name(kind, name)?;
        if names[..index].contains(name) {
            return Err(ExperimentSettingError::SameName { kind, name: (*name).to_owned() });
        }
    }
    Ok(())
}

/// Checks that no two names differ in case only; `kind` names them in the error.
fn check_folders(kind: &'static str, names: &[&str]) -> Result<(), ExperimentSettingError> {
    for (index, other) in names.iter().enumerate() {
        if let Some(name) = names[..index].iter().find(|it| it.eq_ignore_ascii_case(other)) {
            let (name, other) = ((*name).to_owned(), (*other).to_owned());
            return Err(ExperimentSettingError::SameFolder { kind, name, other });
        }
    }
    Ok(())
}

fn text_of(path: &Path) -> Result<String, ExperimentError> {
    read_text(path, SETTINGS_BYTES).map_err(|error| ExperimentError::Settings {
        path: path.to_owned(),
        reason: error.to_string(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiment::{Method, RepetitionSeeds, RivalSettings};
    use crate::session::{EmulatedQubeSettings, SessionSettings};
    use crate::simulation::Model;

    fn settings() -> ExperimentSettings {
        let base = SessionSettings::thesis();
        ExperimentSettings {
            name: "table".into(),
            seed: 7,
            policies: 20,
            rollouts: 5,
            simulated_starts: 1000,
            guard_profile: None,
            plants: vec![Plant {
                name: "lab".into(),
                emulated: EmulatedQubeSettings::default(),
                vary: 0.1,
            }],
            recipes: Model::THESIS.map(|model| Recipe::of(model, &base)).into(),
            methods: None,
        }
    }

    fn of_methods() -> ExperimentSettings {
        let recipe = Recipe::of(Model::OptNominal, &SessionSettings::thesis());
        let methods = MethodSettings {
            methods: Method::all().collect(),
            repetitions: 10,
            recordings: 6,
            spread: 0.1,
            budgets: vec![0, 2, 5],
            trainings: 2,
            seeds: RepetitionSeeds::OfEachPlant,
            rivals: RivalSettings::default(),
        };
        ExperimentSettings { recipes: vec![recipe], methods: Some(methods), ..settings() }
    }

    #[test]
    fn a_written_file_reads_back_the_same() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("experiment.toml");
        for settings in [settings(), of_methods()] {
            std::fs::write(&path, settings.to_toml().unwrap()).unwrap();
            assert_eq!(ExperimentSettings::load(&path).unwrap(), settings);
        }
    }

    #[test]
    fn impossible_settings_are_named() {
        let wrong = |change: fn(&mut ExperimentSettings)| {
            let mut settings = settings();
            change(&mut settings);
            settings.check().unwrap_err().to_string()
        };
        assert!(wrong(|it| it.policies = 0).contains("policies"));
        assert!(wrong(|it| it.plants.clear()).contains("plant"));
        assert!(wrong(|it| it.plants[0].vary = 0.9).contains("vary"));
        assert!(
            wrong(|it| it.plants[0].emulated.effects.slack = 2.0).contains("effects.slack = 2")
        );
        assert!(wrong(|it| it.recipes[1].name = "nominal".into()).contains("nominal"));
        assert!(wrong(|it| it.recipes[1].name = "../up".into()).contains("../up"));
        let mixed = wrong(|it| {
            let larger = PlantModel::parse(include_str!("../../plants/furuta-130.toml")).unwrap();
            it.recipes[1].settings = it.recipes[1].settings.clone().of_plant(&larger);
        });
        assert!(mixed.contains("furuta-130") && mixed.contains("one plant"), "{mixed}");
    }

    #[test]
    fn a_method_that_no_budget_allows_a_recommendation_is_refused_in_a_new_experiment() {
        let with = |name: &str, budgets: &[u32]| {
            let mut settings = of_methods();
            let methods = settings.methods.as_mut().unwrap();
            methods.methods = vec![name.parse().unwrap()];
            methods.budgets = budgets.into();
            assert!(settings.check().is_ok(), "an older experiment is readable");
            settings.check_new()
        };
        let each = SessionSettings::thesis().extent.rollouts;
        for (name, budgets, least) in
            [("posterior", &[0][..], 1), ("sequential", &[0], 1), ("cem", &[0, each - 1], each)]
        {
            let message = with(name, budgets).unwrap_err().to_string();
            assert!(message.contains(&format!("{name} needs at least {least} ")), "{message}");
        }
        for (name, budgets) in
            [("posterior", &[0, 1][..]), ("cem", &[1, each]), ("robust", &[0]), ("so-cma", &[0])]
        {
            assert!(with(name, budgets).is_ok(), "{name} at {budgets:?}");
        }
    }

    #[test]
    fn names_that_differ_in_case_only_are_refused_in_a_new_experiment() {
        let mut settings = settings();
        assert!(settings.check_new().is_ok());
        settings.plants.push(Plant { name: "LAB".into(), ..settings.plants[0].clone() });
        assert!(settings.check_new().unwrap_err().to_string().contains("lab and LAB"));
        assert!(settings.check().is_ok(), "an older experiment is readable");
        settings.plants.pop();
        settings.recipes[1].name = "Nominal".into();
        assert!(settings.check_new().unwrap_err().to_string().contains("nominal and Nominal"));
    }

    #[test]
    fn recipes_with_different_homing_do_not_share_a_real_qube() {
        let mut settings = settings();
        assert!(settings.check_for_one_rig().is_ok());
        settings.recipes[2].settings.homing.theta_offset_rad = 0.1;
        assert!(settings.check().is_ok(), "an emulated Qube is homed for each rollout");
        let message = settings.check_for_one_rig().unwrap_err().to_string();
        for name in [&settings.recipes[0].name, &settings.recipes[2].name] {
            assert!(message.contains(name), "{message}");
        }
    }

    #[test]
    fn methods_that_cannot_be_compared_are_named() {
        let wrong = |change: fn(&mut ExperimentSettings)| {
            let mut settings = of_methods();
            change(&mut settings);
            settings.check().unwrap_err().to_string()
        };
        assert!(of_methods().check().is_ok());
        assert!(wrong(|it| it.recipes = settings().recipes).contains("one model"));
        let nominal = wrong(|it| it.recipes[0].model = Model::Nominal);
        assert!(
            nominal.contains("bayrn searches psi, and the model nominal has none")
                && nominal.contains("opt-robust"),
            "{nominal}"
        );
        let mut without_search = of_methods();
        without_search.recipes[0].model = Model::Robust;
        without_search.methods.as_mut().unwrap().methods.retain(|it| !it.searches_psi());
        assert!(without_search.check().is_ok());
        assert!(wrong(|it| it.methods.as_mut().unwrap().repetitions = 0).contains("repetitions"));
        let twice = wrong(|it| it.methods.as_mut().unwrap().methods.push(Method::Identify));
        assert!(twice.contains("identify is there twice"), "{twice}");
        let robust = wrong(|it| it.methods.as_mut().unwrap().budgets.clear());
        assert!(robust.contains("give budgets"), "{robust}");
        let falling = wrong(|it| it.methods.as_mut().unwrap().budgets = vec![2, 2]);
        assert!(falling.contains("larger than the one before"), "{falling}");
        let more = Plant { name: "more".into(), ..settings().plants[0].clone() };
        let mut two = of_methods();
        two.plants.push(more);
        assert!(two.check().is_ok());
        let methods = two.methods.as_mut().unwrap();
        methods.budgets.clear();
        methods.methods.retain(|method| !method.needs_budgets());
        assert!(two.check().unwrap_err().to_string().contains("one plant"));
    }
}
