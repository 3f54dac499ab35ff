use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::chosen_device::ChosenDevice;
use super::exit::Failure;
use super::number_arguments::between;
use super::profile;
use crate::device::emulator::Effects;
use crate::qube::{DomainParameter, MAX_CABLE_DRIFT_RAD_PER_MIN, PlantModel, QubeModel};
use crate::rig::QUBE_FILE;
use crate::session::EmulatedQubeSettings;

/// The arguments of the emulated Qube.
#[derive(Clone, Debug, Default, clap::Args)]
#[command(next_help_heading = "The emulated Qube")]
pub struct EmulatedArguments {
    /// `ideal` (the thesis's equations), `lab` (a real Qube, from published recordings), or a file
    /// that `identify` wrote [default: ideal; lab for a `session`, unless it has --preset thesis or
    /// --config names another]
    #[arg(long, value_name = "ideal|lab|FILE")]
    profile: Option<PathBuf>,

    /// Distance from the nominal Qube, as a multiple of the profile's: 0 is nominal, 2 is twice as
    /// far as the profile [default: 1]
    #[arg(long, value_name = "FACTOR", value_parser = factor)]
    gap: Option<f64>,

    /// Delay from command to motor, ms [default: the profile's]
    #[arg(long, value_name = "MS", value_parser = milliseconds)]
    delay_ms: Option<f64>,

    /// Largest deviation of a single command's delay, ms [default: 0]
    #[arg(long, value_name = "MS", value_parser = milliseconds)]
    jitter_ms: Option<f64>,

    /// Drift of the cable's rest angle while the Qube is on, rad/min; needs a profile with a cable,
    /// such as `lab` [default: the profile's cable_drift_rad_per_min, mostly 0]
    #[arg(long, value_name = "RAD/MIN", value_parser = drift, allow_negative_numbers = true)]
    cable_drift: Option<f64>,

    /// Backlash between motor and arm, degrees: the angle in which one turns without the other; the
    /// encoder is on the arm's side [default: 0]
    #[arg(long, value_name = "DEGREES", value_parser = play)]
    play_deg: Option<f64>,

    /// Effect that the simulations of training and identification lack: presliding_rad, stribeck,
    /// hysteresis_n_m, slack, warming_per_w, eccentricity_rad, tilt_rad, ripple,
    /// pendulum_friction_n_m or cubic_n_m_rad3 (docs/hardware.md), for instance
    /// presliding_rad=0.02; may be repeated
    #[arg(long, value_name = "NAME=VALUE", value_parser = effect)]
    effect: Vec<(String, f64)>,

    /// Multiply a parameter (R_m, k_m, D_r, D_p, M_r, M_p, L_r, L_p or g) by 0.1 to 10, for
    /// instance M_p=1.1; may be repeated
    #[arg(long, value_name = "NAME=FACTOR", value_parser = scaling)]
    scale: Vec<(DomainParameter, f64)>,
}

/// An emulated Qube, described by an entry of a file of plants. Keys that the entry leaves out have
/// the defaults of the command line.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlantEntry {
    /// Name of the plant in tables.
    pub name: String,
    profile: Option<PathBuf>,
    gap: Option<f64>,
    delay_ms: Option<f64>,
    jitter_ms: Option<f64>,
    cable_drift_rad_per_min: Option<f64>,
    play_deg: Option<f64>,
    #[serde(default)]
    effects: BTreeMap<String, f64>,
    #[serde(default)]
    scale: BTreeMap<String, f64>,
    #[serde(default)]
    /// Relative half width of the range from which each policy's own Qube is drawn, 0 to 0.2; 0
    /// gives all policies the same Qube.
    pub vary: f64,
}

impl EmulatedArguments {
    /// Returns the arguments of an entry in a file, checked by the rules of the command line.
    ///
    /// # Errors
    /// Describes the first invalid value.
    pub fn of_entry(entry: &PlantEntry) -> Result<Self, String> {
        let number = |name: &str, value: Option<f64>, rule: fn(&str) -> Result<f64, String>| {
            let check = |value: f64| {
                rule(&value.to_string()).map_err(|why| format!("{name} = {value}: {why}"))
            };
            value.map(check).transpose()
        };
        let effects = entry.effects.iter().map(|(name, value)| {
            effect(&format!("{name}={value}"))
                .map_err(|why| format!("effects.{name} = {value}: {why}"))
        });
        let scale = entry.scale.iter().map(|(name, factor)| {
            scaling(&format!("{name}={factor}"))
                .map_err(|why| format!("scale.{name} = {factor}: {why}"))
        });
        Ok(Self {
            profile: entry.profile.clone(),
            gap: number("gap", entry.gap, factor)?,
            delay_ms: number("delay_ms", entry.delay_ms, milliseconds)?,
            jitter_ms: number("jitter_ms", entry.jitter_ms, milliseconds)?,
            cable_drift: number("cable_drift_rad_per_min", entry.cable_drift_rad_per_min, drift)?,
            play_deg: number("play_deg", entry.play_deg, play)?,
            effect: effects.collect::<Result<_, _>>()?,
            scale: scale.collect::<Result<_, _>>()?,
        })
    }

    /// Returns a name for these settings that is valid for a folder, such as `lab+gap1.5+10ms`.
    pub fn name(&self) -> String {
        let profile = self.profile.as_deref().unwrap_or(Path::new(profile::IDEAL));
        let stem = profile.file_stem().unwrap_or_default().to_string_lossy();
        let allowed = |letter: char| letter.is_ascii_alphanumeric() || "-_.".contains(letter);
        let mut name: String =
            stem.chars().map(|letter| if allowed(letter) { letter } else { '-' }).collect();
        if let Some(factor) = self.gap {
            name += &format!("+gap{factor}");
        }
        if let Some(milliseconds) = self.delay_ms {
            name += &format!("+{milliseconds}ms");
        }
        if let Some(milliseconds) = self.jitter_ms {
            name += &format!("+jitter{milliseconds}ms");
        }
        if let Some(drift) = self.cable_drift {
            name += &format!("+drift{drift}");
        }
        if let Some(degrees) = self.play_deg {
            name += &format!("+play{degrees}");
        }
        for (effect, value) in &self.effect {
            name += &format!("+{effect}{value}");
        }
        for (parameter, factor) in &self.scale {
            name += &format!("+{}x{factor}", parameter.symbol());
        }
        name
    }

    /// Returns the settings of an emulated Qube of this plant; nominal settings without any
    /// argument.
    pub fn of_plant(&self, plant: &PlantModel) -> Result<EmulatedQubeSettings, Failure> {
        let nominal =
            EmulatedQubeSettings { model: plant.nominal(), ..EmulatedQubeSettings::default() };
        self.applied_to(nominal, plant)
    }

    /// Returns whether any argument is given.
    pub fn are_given(&self) -> bool {
        self.first_given().is_some()
    }

    fn first_given(&self) -> Option<&'static str> {
        let given = [
            ("--profile", self.profile.is_some()),
            ("--gap", self.gap.is_some()),
            ("--delay-ms", self.delay_ms.is_some()),
            ("--jitter-ms", self.jitter_ms.is_some()),
            ("--cable-drift", self.cable_drift.is_some()),
            ("--play-deg", self.play_deg.is_some()),
            ("--effect", !self.effect.is_empty()),
            ("--scale", !self.scale.is_empty()),
        ];
        given.into_iter().find(|(_, is_given)| *is_given).map(|(option, _)| option)
    }

    /// Refuses arguments of the emulated Qube for a real one, which would not follow them.
    pub fn check_device(&self, device: &ChosenDevice) -> Result<(), Failure> {
        match (self.first_given(), device.choice.name()) {
            (Some(option), Some(port)) => Err(Failure::usage(format!(
                "{option} describes the emulated Qube, and {port} is a real one: leave {option} out. Name the profile \
                 of a real Qube in its file: profile = \"FILE\" at the top of {QUBE_FILE}"
            ))),
            _ => Ok(()),
        }
    }

    /// Returns the settings of an emulated Qube of this plant with the changes that the arguments
    /// describe.
    pub fn applied_to(
        &self,
        mut settings: EmulatedQubeSettings,
        plant: &PlantModel,
    ) -> Result<EmulatedQubeSettings, Failure> {
        let scaled: Vec<&str> = self.scale.iter().map(|(it, _)| it.symbol()).collect();
        named_once("--scale", &scaled)?;
        let effects: Vec<&str> = self.effect.iter().map(|(name, _)| name.as_str()).collect();
        named_once("--effect", &effects)?;
        let model = &mut settings.model;
        if let Some(name) = &self.profile {
            *model = profile::named(name, plant)?;
        }
        if let Some(factor) = self.gap {
            if *model == plant.nominal() {
                return Err(Failure::usage(
                    "--gap has no effect on the nominal Qube, which has no gap: give a --profile with it, such as lab",
                ));
            }
            *model = model.scaled_from(&plant.parameters, factor);
        }
        if let Some(milliseconds) = self.delay_ms {
            model.nonidealities.command_delay_s = 1e-3 * milliseconds;
        }
        if let Some(drift) = self.cable_drift {
            model.nonidealities.cable_drift_rad_per_min = drift;
        }
        if model.nonidealities.cable_drift_rad_per_min != 0.0
            && model.nonidealities.cable_stiffness_n_m_rad == 0.0
        {
            return Err(Failure::usage(
                "this Qube has no cable that could drift: with --cable-drift give a --profile whose \
                 cable_stiffness_n_m_rad is above 0, such as lab",
            ));
        }
        for &(parameter, factor) in &self.scale {
            model.parameters.set(parameter, factor * model.parameters.get(parameter));
        }
        if let Some(milliseconds) = self.jitter_ms {
            settings.command_jitter_s = 1e-3 * milliseconds;
        }
        if let Some(degrees) = self.play_deg {
            settings.play_rad = degrees.to_radians();
        }
        self.check_effects(model)?;
        for (name, value) in &self.effect {
            for (known, slot, _) in settings.effects.named() {
                if known == name {
                    *slot = *value;
                }
            }
        }
        Ok(settings)
    }

    /// Refuses effects that change a force which this model does not have.
    fn check_effects(&self, model: &QubeModel) -> Result<(), Failure> {
        let nonidealities = &model.nonidealities;
        for (name, value) in self.effect.iter().filter(|(_, value)| *value != 0.0) {
            let (has, force) = match name.as_str() {
                "presliding_rad" | "stribeck" => (nonidealities.coulomb_torque_n_m, "dry friction"),
                "slack" => (nonidealities.cable_stiffness_n_m_rad, "cable"),
                _ => continue,
            };
            if has == 0.0 {
                return Err(Failure::usage(format!(
                    "--effect {name}={value} changes nothing, because this Qube has no {force}: give a \
                     --profile that has, such as lab"
                )));
            }
        }
        Ok(())
    }
}

/// Refuses an option that is repeated for the same name.
fn named_once(option: &str, names: &[&str]) -> Result<(), Failure> {
    let mut numbered = names.iter().enumerate();
    match numbered.find(|(index, name)| names[..*index].contains(name)) {
        Some((_, name)) => {
            Err(Failure::usage(format!("{option} names {name} twice: name it once")))
        }
        None => Ok(()),
    }
}

fn factor(text: &str) -> Result<f64, String> {
    between(text, 0.0, 5.0)
}

fn milliseconds(text: &str) -> Result<f64, String> {
    between(text, 0.0, 100.0)
}

fn play(text: &str) -> Result<f64, String> {
    between(text, 0.0, EmulatedQubeSettings::LARGEST_PLAY_DEG)
}

fn drift(text: &str) -> Result<f64, String> {
    between(text, -MAX_CABLE_DRIFT_RAD_PER_MIN, MAX_CABLE_DRIFT_RAD_PER_MIN)
}

fn effect(text: &str) -> Result<(String, f64), String> {
    let (name, value) = text.split_once('=').ok_or("write it as presliding_rad=0.02")?;
    let mut effects = Effects::NONE;
    let named = effects.named();
    let Some((_, _, most)) = named.iter().find(|(known, ..)| *known == name) else {
        let known = named.map(|(known, ..)| known).join(", ");
        return Err(format!("there is no effect {name}; there are {known}"));
    };
    Ok((name.to_owned(), between(value, 0.0, *most)?))
}

fn scaling(text: &str) -> Result<(DomainParameter, f64), String> {
    let (symbol, factor) = text.split_once('=').ok_or("write it as M_p=1.1")?;
    let parameter = DomainParameter::from_symbol(symbol).ok_or_else(|| {
        let known = DomainParameter::ALL.map(DomainParameter::symbol).join(", ");
        format!("there is no parameter {symbol}; there are {known}")
    })?;
    Ok((parameter, between(factor, 0.1, 10.0)?))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::{Profile, QubeModel};

    #[test]
    fn options_change_the_qube_that_they_are_applied_to() {
        let lab = Profile::lab().model();
        let base = EmulatedQubeSettings { model: lab, ..EmulatedQubeSettings::default() };
        let model = |arguments: EmulatedArguments| {
            arguments.applied_to(base, &PlantModel::QUBE).unwrap().model
        };
        assert_eq!(model(EmulatedArguments::default()), lab);
        let nominal = model(EmulatedArguments { gap: Some(0.0), ..Default::default() });
        assert_eq!(nominal.parameters, QubeModel::NOMINAL.parameters);
        let farther = model(EmulatedArguments { gap: Some(1.5), ..Default::default() });
        assert_eq!(farther, lab.scaled_from(&PlantModel::QUBE.parameters, 1.5));
        let late = model(EmulatedArguments { delay_ms: Some(16.0), ..Default::default() });
        assert_eq!(late.parameters, lab.parameters);
        assert!((late.nonidealities.command_delay_s - 0.016).abs() < 1e-12);
        let ideal = EmulatedArguments { profile: Some("ideal".into()), ..Default::default() };
        assert_eq!(model(ideal), QubeModel::NOMINAL);
    }
}
