use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::chosen_device::ChosenDevice;
use super::emulated_arguments::{EmulatedArguments, PlantEntry};
use super::exit::Failure;
use super::file_kind::FileKind;
use super::number_arguments::between;
use crate::experiment::Plant;
use crate::qube::PlantModel;
use crate::session::{LARGEST_VARY, PolicyPaths, toml_message};

/// Name in an experiment's settings of the plant that is a real Qube.
pub const REAL_QUBE: &str = "device";

/// The arguments of the emulated Qubes on which policies run.
#[derive(Clone, Debug, clap::Args)]
pub struct PlantArguments {
    #[command(flatten)]
    emulated: EmulatedArguments,

    /// Draw each policy's own Qube: each parameter, the friction, the dead zones, the cable's
    /// stiffness and the delay are uniform between 1 - PART and 1 + PART times their values; 0 to
    /// 0.2
    #[arg(long, value_name = "PART", default_value_t = 0.0, value_parser = part, conflicts_with = "resume")]
    vary: f64,

    /// Several Qubes: a TOML file with one table `[[plants]]` for each: name, profile, gap,
    /// delay_ms, jitter_ms, cable_drift_rad_per_min, play_deg, effects = { presliding_rad = 0.02 },
    /// scale = { M_p = 1.1 }, vary; psi is searched on the first
    #[arg(long, value_name = "FILE",
          conflicts_with_all = ["profile", "gap", "delay_ms", "jitter_ms", "cable_drift", "play_deg",
                              "effect", "scale", "vary", "resume"])]
    plants: Option<PathBuf>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct PlantsFile {
    plants: Vec<PlantEntry>,
}

impl PlantArguments {
    /// Returns whether an option other than `--vary` and `--plants` describes an emulated Qube.
    pub fn describe_qube(&self) -> bool {
        self.emulated.are_given()
    }

    /// Refuses arguments of emulated Qubes for a real one, which would not follow them.
    pub fn check_device(&self, device: &ChosenDevice) -> Result<(), Failure> {
        self.emulated.check_device(device)?;
        let option = if self.plants.is_some() { Some("--plants") } else { None };
        let option = option.or((self.vary > 0.0).then_some("--vary"));
        match (option, device.choice.name()) {
            (Some(option), Some(port)) => Err(Failure::usage(format!(
                "{option} describes emulated Qubes, and {port} is a real one: leave {option} out"
            ))),
            _ => Ok(()),
        }
    }

    /// Returns the emulated specimens of a plant on which policies run: the specimens in the file
    /// of `--plants`, or the one that the other options describe.
    pub fn plants(&self, plant: &PlantModel) -> Result<Vec<Plant>, Failure> {
        let Some(path) = &self.plants else {
            let emulated = self.emulated.of_plant(plant)?;
            let mut name = self.emulated.name();
            if self.vary > 0.0 {
                name += &format!("+vary{}%", 100.0 * self.vary);
            }
            check_name(&name).map_err(Failure::usage)?;
            return Ok(vec![Plant { name, emulated, vary: self.vary }]);
        };
        let wrong = |reason: String| Failure::usage(format!("{}: {reason}", path.display()));
        let text = crate::storage::read_text(path, crate::storage::SETTINGS_BYTES)
            .map_err(|error| wrong(error.to_string()))?;
        let file: PlantsFile = toml::from_str(&text).map_err(|error| {
            let message = format!("{}: {}", path.display(), toml_message(&error));
            FileKind::Plants.refused(path, message)
        })?;
        file.plants.into_iter().map(|entry| specimen(entry, path, plant)).collect()
    }
}

/// Returns the specimen of a plant that an entry of the file describes.
fn specimen(entry: PlantEntry, path: &Path, plant: &PlantModel) -> Result<Plant, Failure> {
    let place = format!("{}: plant {}:", path.display(), entry.name);
    let wrong = |reason: String| Failure::usage(format!("{place} {reason}"));
    check_name(&entry.name).map_err(wrong)?;
    let emulated = EmulatedArguments::of_entry(&entry)
        .map_err(wrong)?
        .of_plant(plant)
        .map_err(|failure| failure.preceded_by(&place))?;
    let vary = part(&entry.vary.to_string())
        .map_err(|why| wrong(format!("vary = {}: {why}", entry.vary)))?;
    Ok(Plant { name: entry.name, emulated, vary })
}

/// Refuses the name that stands for the real Qube, and, in letters of either case, the names of the
/// files in a policy's folder, beside which the plant's folder of recordings lies. The experiment
/// refuses all other names that are not valid for a folder.
fn check_name(name: &str) -> Result<(), String> {
    if name == REAL_QUBE {
        return Err(format!(
            "the name {REAL_QUBE} stands for the real Qube: give the emulated one another name"
        ));
    }
    let paths = PolicyPaths::numbered(Path::new(""), 0);
    let files = [paths.policy(), paths.curve(), paths.training_times()];
    let is_name = |file: &PathBuf| {
        file.file_name().is_some_and(|it| it.to_string_lossy().eq_ignore_ascii_case(name))
    };
    match files.iter().any(is_name) {
        true => Err(format!("{name} is the name of a file of each policy: give another name")),
        false => Ok(()),
    }
}

fn part(text: &str) -> Result<f64, String> {
    between(text, 0.0, LARGEST_VARY)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiment::PolicyFolders;

    fn from_file(directory: &Path, text: &str) -> Result<Vec<Plant>, Failure> {
        let path = directory.join("plants.toml");
        std::fs::write(&path, text).unwrap();
        let emulated = EmulatedArguments::default();
        PlantArguments { emulated, vary: 0.0, plants: Some(path) }.plants(&PlantModel::QUBE)
    }

    #[test]
    fn an_error_names_the_file_and_the_plant_or_the_line() {
        let directory = tempfile::tempdir().unwrap();
        for (line, expected) in [
            ("profile = \"absent.toml\"", ["plants.toml: plant odd: ", "absent.toml"]),
            ("gap = -3.0", ["plants.toml: plant odd: ", "gap = -3"]),
            ("gap = \"wide\"", ["plants.toml: TOML parse error at line 5", "expected a number"]),
        ] {
            let text = format!("[[plants]]\nname = \"good\"\n[[plants]]\nname = \"odd\"\n{line}\n");
            let refused = from_file(directory.path(), &text).unwrap_err();
            let cause = refused.cause();
            assert!(expected.iter().all(|part| cause.contains(part)), "{line}: {cause}");
        }
    }

    #[test]
    fn a_plant_that_has_the_name_of_a_file_beside_its_folder_is_refused() {
        let directory = tempfile::tempdir().unwrap();
        let named =
            |name: &str| from_file(directory.path(), &format!("[[plants]]\nname = {name:?}\n"));
        assert_eq!(named("lab").unwrap()[0].name, "lab");
        let folders = PolicyFolders::of_recommendation(directory.path(), 0);
        let paths = folders.policy(0);
        for file in [paths.policy(), paths.curve(), paths.training_times()] {
            let name = file.file_name().unwrap().to_str().unwrap();
            assert_eq!(folders.rollouts(0, name), file);
            for name in [name, &name.to_ascii_uppercase()] {
                let refused = named(name).unwrap_err();
                let cause = refused.cause();
                assert!(cause.contains(name) && cause.contains("give another name"), "{cause}");
            }
        }
    }
}
