use std::path::Path;

use super::exit::Failure;
use super::file_kind::FileKind;
use crate::identification::MissingEffect;
use crate::qube::{PlantModel, Profile, QubeModel};
use crate::storage::{SETTINGS_BYTES, read_text};

/// Name of the nominal specimen of a plant: it has the parameters of the plant's description (for a
/// Qube, of its name plate), and no friction, cable or delay.
pub const IDEAL: &str = "ideal";

/// Name of the profile of a real Qube that is part of the program.
const LAB: &str = "lab";

/// Returns the model of a specimen of a plant, by its name: `ideal`, `lab`, or the path of a
/// profile file.
pub fn named(name: &Path, plant: &PlantModel) -> Result<QubeModel, Failure> {
    Ok(named_profile(name, plant)?.model())
}

/// Returns the profile of a specimen of a plant, by its name: `ideal`, `lab`, or the path of a
/// profile file.
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
            let profile = read(name, OR_NAMES)?;
            check_plant(name, &profile, plant).map_err(Failure::usage)?;
            profile
        }
    })
}

/// Returns the profile with this name, of a specimen of any plant: `lab`, or the path of a profile
/// file. `None` for `ideal`, which means the nominal specimen of each plant.
pub fn named_of_any_plant(name: &Path) -> Result<Option<Profile>, Failure> {
    match name.to_str() {
        Some(IDEAL) => Ok(None),
        Some(LAB) => named_profile(name, &PlantModel::QUBE).map(Some),
        _ => read(name, OR_NAMES).map(Some),
    }
}

/// Returns a note on a profile whose fit `identify` doubted; `None` for any other.
pub fn doubts_note(profile: &Profile) -> Option<String> {
    let doubts = profile.provenance.as_ref().map_or(&[][..], |it| &it.doubts);
    let in_words = |name: &String| {
        let known = MissingEffect::ALL.into_iter().find(|effect| effect.name() == name);
        known.map_or_else(|| name.clone(), |effect| effect.to_string())
    };
    let words: Vec<String> = doubts.iter().map(in_words).collect();
    (!words.is_empty()).then(|| {
        format!(
            "`identify` doubted that the model describes this Qube ({}), so a policy that is trained around it may \
             fail on the Qube: compare it there with one of `train --model robust --preset robust`, as `session` does",
            words.join("; ")
        )
    })
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

/// End of an error's sentence where the names `ideal` and `lab` are accepted, too.
const OR_NAMES: &str = ", or one of the names ideal and lab";

/// Reads a profile file of a specimen of any plant; `names` ends the sentence that says which file
/// to give.
fn read(path: &Path, names: &str) -> Result<Profile, Failure> {
    let text = read_text(path, SETTINGS_BYTES).map_err(|error| {
        let shown = path.display();
        Failure::usage(format!("{shown}: {error}. Give a profile that identify wrote{names}"))
    })?;
    Profile::parse(&text)
        .map_err(|error| FileKind::Profile.refused(path, format!("{}: {error}", path.display())))
}

/// Reads a profile file of a specimen of this plant.
pub fn load(path: &Path, plant: &PlantModel) -> Result<Profile, Failure> {
    let profile = read(path, "")?;
    check_plant(path, &profile, plant).map_err(Failure::usage)?;
    Ok(profile)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_profile_whose_fit_was_doubted_has_a_note_with_the_doubts_in_words() {
        let mut profile = Profile::lab();
        assert_eq!(doubts_note(&profile), None);
        let provenance = profile.provenance.as_mut().unwrap();
        provenance.doubts = vec!["warming".into(), "of a later version".into()];
        let note = doubts_note(&profile).unwrap();
        let words = "(a motor that changes with time (does it warm?); of a later version)";
        assert!(note.contains(words), "{note}");
    }
}
