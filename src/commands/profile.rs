use std::path::Path;

use super::exit::Failure;
use crate::qube::{PlantModel, Profile, QubeModel};
use crate::storage::{SETTINGS_BYTES, read_text};

/// Name of the nominal specimen of a plant: it has the parameters of the plant's description (for a
/// Qube, of its name plate), and no friction, cable or delay.
pub const IDEAL: &str = "ideal";

/// Name of the profile of a real Qube that is part of the program.
const LAB: &str = "lab";

/// The model of a specimen of a plant, by its name: `ideal`, `lab`, or the path of a profile file.
pub fn named(name: &Path, plant: &PlantModel) -> Result<QubeModel, Failure> {
    Ok(named_profile(name, plant)?.model())
}

/// The profile of a specimen of a plant, by its name: `ideal`, `lab`, or the path of a profile
/// file.
pub fn named_profile(name: &Path, plant: &PlantModel) -> Result<Profile, Failure> {
    Ok(match name.to_str() {
        Some(IDEAL) => Profile::exact(IDEAL, &plant.nominal()),
        Some(LAB) if !plant.name.is_qube() => {
            return Err(Failure::usage(format!(
                "lab is the profile of a Qube, and this is the plant {}: give ideal, or a profile that identify wrote \
                 for this plant",
                plant.name
            )));
        }
        Some(LAB) => Profile::lab(),
        _ => {
            let profile = read(name, AND_NAMES)?;
            check_plant(name, &profile, plant).map_err(Failure::usage)?;
            profile
        }
    })
}

/// The profile with this name, of a specimen of any plant: `lab`, or the path of a profile file.
/// `None` for `ideal`, which means the nominal specimen of each plant.
pub fn named_of_any_plant(name: &Path) -> Result<Option<Profile>, Failure> {
    match name.to_str() {
        Some(IDEAL) => Ok(None),
        Some(LAB) => named_profile(name, &PlantModel::QUBE).map(Some),
        _ => read(name, AND_NAMES).map(Some),
    }
}

/// Checks that a profile describes a specimen of this plant.
///
/// # Errors
/// A sentence that begins with `name` and says which plant the profile describes.
pub fn check_plant(name: &Path, profile: &Profile, plant: &PlantModel) -> Result<(), String> {
    if profile.plant == plant.name {
        return Ok(());
    }
    Err(format!(
        "{}: the profile is of the plant {}, but this is the plant {}: give a profile of this plant",
        name.display(),
        profile.plant,
        plant.name
    ))
}

/// The end of an error's sentence where a name stands for a profile, too.
const AND_NAMES: &str = ", or one of the names ideal and lab";

/// Reads a profile file of a specimen of any plant; `names` ends the sentence that says what to
/// give.
fn read(path: &Path, names: &str) -> Result<Profile, Failure> {
    let text = read_text(path, SETTINGS_BYTES).map_err(|error| {
        let shown = path.display();
        Failure::usage(format!("{shown}: {error}. Give a profile that identify wrote{names}"))
    })?;
    Profile::parse(&text).map_err(|error| Failure::usage(format!("{}: {error}", path.display())))
}

/// Reads a profile file of a specimen of this plant.
pub fn load(path: &Path, plant: &PlantModel) -> Result<Profile, Failure> {
    let profile = read(path, "")?;
    check_plant(path, &profile, plant).map_err(Failure::usage)?;
    Ok(profile)
}
