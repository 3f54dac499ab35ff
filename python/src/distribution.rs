//! The distributions from which simulated Qubes are drawn, as Python's arguments name them.

use std::collections::BTreeMap;
use std::path::PathBuf;

use pyo3::prelude::*;
use qube_hil::qube::{Distribution, MAX_VOLTAGE_V, PlantModel, Profile, Quantity};
use qube_hil::simulation::{
    DistributionError, DomainDistribution, Family, Model, ProfileSettings, PsiError,
    SimulationSettings, TRUNCATION, Trajectory, range_of_draws,
};
use qube_hil::storage::{SETTINGS_BYTES, read_text};

use crate::errors::{bad_settings, shown};
use crate::simulation::Lanes;

/// Number of Qubes of a distribution whose motions are checked.
const MOTIONS_CHECKED: usize = 64;

/// Control periods for which the motion of a Qube is checked.
const STEPS_CHECKED: usize = 40;

/// Control periods between two changes of the voltage's sign in this check.
const STEPS_OF_A_PUSH: usize = 10;

/// Name of the profile of the nominal specimen of each plant, as in the program's commands.
const IDEAL: &str = "ideal";

/// Name of the profile of the real Qube whose recordings are published, as in the program's
/// commands.
const LAB: &str = "lab";

/// The argument `profile` with its `spread`: an identified Qube around which others are drawn.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub struct Around {
    /// Name or path of the profile; `None` if `text` is given.
    path: Option<PathBuf>,
    /// The profile as TOML.
    text: Option<String>,
    /// Standard deviation of each quantity as a fraction of its value, in addition to the errors
    /// that the profile names.
    spread: f64,
}

impl Around {
    /// The profile of a specimen of this plant.
    fn profile(&self, plant: &PlantModel) -> PyResult<Profile> {
        let name = match &self.path {
            Some(path) if path.as_os_str() == IDEAL => {
                return Ok(Profile::exact(IDEAL, &plant.nominal()));
            }
            Some(path) if path.as_os_str() == LAB => LAB.to_owned(),
            Some(path) => path.display().to_string(),
            None => "the identified Qube".to_owned(),
        };
        let located =
            |error: &dyn std::fmt::Display| bad_settings(format!("profile: {name}: {error}"));
        let profile = match (&self.path, &self.text) {
            (Some(_), _) if name == LAB => Profile::lab(),
            (Some(path), _) => {
                let text = read_text(path, SETTINGS_BYTES).map_err(|error| {
                    located(&format!(
                        "{error}. Give a profile that identify wrote, or one of the names {IDEAL} and {LAB}"
                    ))
                })?;
                Profile::parse(&text).map_err(|error| located(&error))?
            }
            (None, text) => {
                let text = text.as_deref().unwrap_or_default();
                Profile::parse(text).map_err(|error| located(&error))?
            }
        };
        if profile.plant == plant.name {
            return Ok(profile);
        }
        Err(located(&format!(
            "the profile is of the plant {}, but the simulation is of the plant {}: give a profile of this plant",
            profile.plant, plant.name
        )))
    }
}

/// The distribution of the simulated Qubes, and its name for the record of a policy.
pub struct Qubes {
    pub distribution: DomainDistribution,
    /// Name of the model or profile, as the command `train` records it, with the names of the
    /// quantities whose distributions were replaced.
    pub origin: String,
}

/// Reads the distribution of the arguments `model` or `profile`, with some quantities'
/// distributions replaced by those in JSON. Without a model and a profile the Qubes are nominal.
pub fn read_qubes(
    model: Option<&str>,
    profile: Option<&Around>,
    replaced: &str,
    settings: &SimulationSettings,
) -> PyResult<Qubes> {
    let plant = &settings.plant;
    let (mut distribution, mut origin) = match (model, profile) {
        (Some(model), Some(_)) => {
            return Err(bad_settings(format!(
                "model = {model:?} beside profile: give one of them, because a profile names the Qubes itself"
            )));
        }
        (None, Some(around)) => around_profile(around, plant)?,
        (model, None) => {
            let model = read_model(model.unwrap_or(Model::Nominal.name()))?;
            let base = model.distribution(plant, Family::Normal, None, None).map_err(of_base)?;
            (base, model.name().to_owned())
        }
    };
    let replaced: BTreeMap<String, Distribution> = serde_json::from_str(replaced)
        .map_err(|error| bad_settings(format!("distributions: {error}")))?;
    for (name, own) in &replaced {
        let quantity = Quantity::from_name(name).ok_or_else(|| {
            let names: Vec<_> = Quantity::all().map(Quantity::name).collect();
            bad_settings(format!(
                "distributions: there is no quantity {name:?}: give one of {}",
                names.join(", ")
            ))
        })?;
        check_drawn_whole(quantity, own)?;
        distribution = distribution.with(quantity, *own).map_err(|error| refused(&error))?;
    }
    let names = replaced.into_keys().collect::<Vec<_>>().join(", ");
    let is_plain = names.is_empty() && profile.is_none();
    if !is_plain && !moves(&distribution, settings) {
        let of = if names.is_empty() { "this profile" } else { "these distributions" };
        let remedy = if names.is_empty() {
            "a smaller spread".to_owned()
        } else {
            format!("values nearer to those of a Qube for {names}")
        };
        return Err(bad_settings(format!(
            "a Qube of {of} cannot be simulated, its motion is not a finite number: give {remedy}"
        )));
    }
    if !names.is_empty() {
        origin += &format!(" with its own {names}");
    }
    Ok(Qubes { distribution, origin })
}

/// The model with this name.
fn read_model(name: &str) -> PyResult<Model> {
    let plain = [Model::Nominal, Model::Handcrafted, Model::NominalHandcrafted, Model::Robust];
    plain.into_iter().find(|known| known.name() == name).ok_or_else(|| {
        let names = plain.map(Model::name).join(", ");
        let is_profile = [IDEAL, LAB].contains(&name) || name.contains(['/', '.']);
        let hint = if is_profile {
            format!(
                ". For the profile of an identified Qube give profile={name:?} in place of model"
            )
        } else {
            String::new()
        };
        bad_settings(format!("there is no model {name:?}: give one of {names}{hint}"))
    })
}

/// The distribution around a profile, as the command `train` makes it, and its name.
fn around_profile(around: &Around, plant: &PlantModel) -> PyResult<(DomainDistribution, String)> {
    let profile = around.profile(plant)?;
    let settings = ProfileSettings::of(&profile, plant, around.spread);
    let distribution = Model::Profile
        .distribution(plant, Family::Normal, Some(&settings), None)
        .map_err(of_base)?;
    let name = around.path.as_ref().map(|path| path.display().to_string());
    Ok((distribution, format!("around {}", name.unwrap_or(profile.name))))
}

/// The exception for a distribution of a model or profile that cannot be simulated.
fn of_base(error: PsiError) -> PyErr {
    match error {
        PsiError::Base(error) => refused(&error),
        other => bad_settings(other),
    }
}

/// The exception for a distribution that is refused, with the quantity's name in `distributions`.
fn refused(error: &DistributionError) -> PyErr {
    let named = |symbol: &'static str| Quantity::from_symbol(symbol).map_or(symbol, Quantity::name);
    bad_settings(match error {
        DistributionError::Mean { symbol, mean, bound } => {
            let (name, mean) = (named(symbol), shown(*mean));
            format!("the mean of {name} is {mean}, which cannot be simulated: give a value {bound}")
        }
        DistributionError::StandardDeviation { symbol, standard_deviation, mean, largest } => {
            let [deviation, mean, largest] =
                [standard_deviation, mean, largest].map(|value| shown(*value));
            format!(
                "the standard deviation of {} is {deviation}: with the mean {mean} give a value from 0 to {largest}",
                named(symbol)
            )
        }
    })
}

/// Checks that draws reach to both ends of a uniform distribution, which the library narrows where
/// they do not.
fn check_drawn_whole(quantity: Quantity, distribution: &Distribution) -> PyResult<()> {
    let &Distribution::Uniform { mean, standard_deviation } = distribution else { return Ok(()) };
    let half_width = 3.0_f64.sqrt() * standard_deviation;
    let (lower, upper) = (mean - half_width, mean + half_width);
    let (smallest, largest) = range_of_draws(quantity, mean);
    let rounding = 1e-9 * half_width;
    if lower >= smallest - rounding && upper <= largest + rounding {
        return Ok(());
    }
    let name = quantity.name();
    let given = format!("{name}: Uniform({}, {})", shown(lower), shown(upper));
    Err(bad_settings(match quantity {
        Quantity::Parameter(_) if mean > 0.0 => format!(
            "{given} is too wide: a parameter is drawn between {:.1} and {:.1} times the mean, here between {} and {}. \
             Give ends whose ratio is at most {:.0}",
            1.0 - TRUNCATION,
            1.0 + TRUNCATION,
            shown(smallest),
            shown(largest),
            (1.0 + TRUNCATION) / (1.0 - TRUNCATION)
        ),
        Quantity::Parameter(_) => format!("{given} has values below 0: give values above 0"),
        Quantity::Nonideality(_) => {
            let (smallest, largest) = (shown(smallest), shown(largest));
            format!("{given} cannot be simulated: give values from {smallest} to {largest}")
        }
    }))
}

/// Returns whether the motion of some Qubes of a distribution, which the full voltage pushes to and
/// fro, is a finite number.
fn moves(distribution: &DomainDistribution, settings: &SimulationSettings) -> bool {
    let mut tried = Lanes::new(MOTIONS_CHECKED, settings);
    for lane in 0..MOTIONS_CHECKED {
        tried.pendulums.restart(lane, &Trajectory::draw(distribution, 0, lane as u64));
    }
    (0..STEPS_CHECKED).all(|step| {
        let sign = if (step / STEPS_OF_A_PUSH).is_multiple_of(2) { 1.0 } else { -1.0 };
        tried.voltages_v.fill(sign * MAX_VOLTAGE_V as f32);
        tried.step();
        tried.first_not_finite(MOTIONS_CHECKED).is_none()
    })
}
