use std::path::{Path, PathBuf};

use super::predictions::Predictions;
use crate::charts::{correlations_svg, motion_svg};
use crate::commands::destination::OutputFolder;
use crate::commands::exit::Failure;
use crate::commands::picture_names::picture_names;
use crate::commands::printable::print_message;
use crate::identification::{Recordings, start_state};
use crate::qube::Correlations;
use crate::replay::simulate_from;
use crate::storage::{MachineDisk, write_whole};

/// Endings of file names that a folder of pictures does not have.
const FILE_ENDINGS: [&str; 4] = ["svg", "png", "pdf", "html"];

/// Makes the folder of `--plot` and returns it. Refuses the name of a file.
pub fn plot_folder(folder: &Path) -> Result<OutputFolder, Failure> {
    let ending = folder.extension().map(|ending| ending.to_string_lossy().to_lowercase());
    if ending.is_some_and(|ending| FILE_ENDINGS.contains(&ending.as_str())) && !folder.is_dir() {
        return Err(Failure::usage(format!(
            "--plot {}: --plot takes a folder, in which each recording gets a picture: give a name without an ending",
            folder.display()
        )));
    }
    OutputFolder::of_option("--plot", folder)
}

/// Draws each recording with its open-loop simulation, and the correlations of the profile, into a
/// folder. A recording that cannot be simulated is left out with a warning. Returns a line with the
/// number of recordings that were drawn.
pub fn draw(
    folder: &Path,
    recordings: &Recordings<2>,
    predictions: &Predictions,
    correlations: Option<&Correlations>,
) -> Result<String, Failure> {
    let files: Vec<&Path> = recordings.files.iter().flatten().map(PathBuf::as_path).collect();
    let models = predictions.fitted_models.iter().chain(&predictions.held_out_models);
    let pictures = files.iter().zip(picture_names(&files));
    let mut drawn = 0;
    for (((path, name), log), model) in pictures.zip(recordings.groups.iter().flatten()).zip(models)
    {
        match simulate_from(log, model, start_state(log, model)) {
            Ok(open_loop) => {
                let svg = motion_svg(&name, log, &open_loop).map_err(Failure::failed)?;
                write_picture(folder, &format!("{name}.svg"), &svg)?;
                drawn += 1;
            }
            Err(error) => {
                print_message(&format!("warning: not drawn: {}: {error}", path.display()));
            }
        }
    }
    if let Some(correlations) = correlations {
        write_picture(folder, CORRELATIONS, &correlations_svg(correlations))?;
    }
    let and = correlations.map_or(String::new(), |_| format!(" and {CORRELATIONS}"));
    let count = match drawn {
        0 => "no recording".to_owned(),
        1 => "one recording".to_owned(),
        count => format!("{count} recordings"),
    };
    Ok(format!("drew {count}{and} into {}", folder.display()))
}

/// File of the picture of the correlations.
const CORRELATIONS: &str = "profile-correlations.svg";

fn write_picture(folder: &Path, name: &str, svg: &str) -> Result<(), Failure> {
    write_whole(&MachineDisk, &folder.join(name), svg.as_bytes()).map_err(Failure::failed)
}
