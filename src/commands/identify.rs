mod json;
mod pictures;
mod predictions;
mod text;

use std::fmt::Write;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::time::Instant;

use serde_json::json;

use self::pictures::plot_folder;
use self::predictions::Predictions;
use super::destination::OutputFile;
use super::exit::Failure;
use super::output::Output;
use super::plant_file::PlantArgument;
use super::printable::print_message;
use super::profile;
use crate::identification::{Recordings, Unknown, identify, next_excitations, read_recordings};
use crate::session::IdentificationSettings;
use crate::storage::Existing;

/// Identify the Qube, or another plant, that made recordings: parameters, friction, dead zone,
/// cable and delay
///
/// `run --excite chirp` and `--excite steps` make such recordings; swing-ups, balancing and
/// rollouts of policies can be used as well, in any mixture. All must be of the same plant: a .mcap
/// names its plant; a .csv is taken to be of --plant, else of the plant of the recordings before
/// it, else of the Qube. The result is a profile, which --profile reads: `train`, `replay` and
/// `report` simulate that Qube, and `run`, `session`, `experiment` and `emulate` emulate it. For a
/// real Qube, name the profile in its qube.toml.
///
/// Verify a profile with recordings that it was not fitted to (--holdout). Recordings that are too
/// short, or in which too little moves, are named and not used.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    qube-hil identify chirp-[12].mcap --holdout chirp-3.mcap --out mine.toml\n  \
    qube-hil identify *.csv --plot plots --fix L_p --fix L_r\n  \
    qube-hil identify --plant furuta.toml motion.csv --out mine.toml")]
pub struct Arguments {
    /// Recordings to fit: .mcap of this program, or .csv with the columns time_s, theta_rad,
    /// alpha_rad, theta_dot_rad_s, alpha_dot_rad_s, voltage_v
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,

    /// Recordings to verify the fit with; they are not fitted
    #[arg(long, value_name = "FILE", num_args = 1..)]
    holdout: Vec<PathBuf>,

    /// File for the profile
    #[arg(long, value_name = "FILE", default_value = "profile.toml")]
    out: PathBuf,

    /// Replace the file of --out, if it exists
    #[arg(long)]
    force: bool,

    /// Name of the Qube in the profile
    #[arg(long, default_value = "identified")]
    name: String,

    #[command(flatten)]
    plant: PlantArgument,

    /// Profile with the values at which the fit starts and which --fix keeps [default: the nominal
    /// plant]
    #[arg(long, value_name = "FILE")]
    from: Option<PathBuf>,

    /// Keep this quantity fixed (R_m, L_p, cable_rest_rad ...); may be repeated
    #[arg(long, value_name = "NAME")]
    fix: Vec<String>,

    /// Also draw each recording with the model's simulation, and the correlations of the errors
    /// (profile-correlations.svg), as SVG into this folder
    #[arg(long, value_name = "DIR")]
    plot: Option<PathBuf>,
}

/// Voltages that `run --volts` accepts, V.
const RUN_VOLTS: RangeInclusive<f64> = 0.1..=3.0;

/// Refuses an --out that is one of the recordings, which the profile would replace.
fn refuse_an_input(arguments: &Arguments) -> Result<(), Failure> {
    let Ok(out) = arguments.out.canonicalize() else { return Ok(()) };
    let mut inputs = arguments.files.iter().chain(&arguments.holdout);
    if inputs.any(|file| file.canonicalize().is_ok_and(|file| file == out)) {
        return Err(Failure::usage(format!(
            "--out {} is one of the recordings: name another file for the profile",
            arguments.out.display()
        )));
    }
    Ok(())
}

/// Fits, verifies, writes the profile and prints the result. If a picture cannot be written, it
/// returns the failure after that.
pub fn run(arguments: &Arguments, output: &Output) -> Result<(), Failure> {
    let unknowns = unknowns(&arguments.fix)?;
    let out = OutputFile::prepare(&arguments.out, Existing::replaced_if(arguments.force))?;
    refuse_an_input(arguments)?;
    let plots = arguments.plot.as_deref().map(plot_folder).transpose()?;
    let groups = [&arguments.files[..], &arguments.holdout[..]];
    let recordings = read_recordings(groups, arguments.plant.given()?).map_err(Failure::usage)?;
    warn(&recordings);
    let [fitted, held_out] = &recordings.groups;
    let [fitted_files, _] = &recordings.files;
    let first_guess = match &arguments.from {
        Some(path) => profile::load(path, &recordings.plant)?.model(),
        None => recordings.plant.nominal(),
    };

    print_message("fitting the model to the recordings");
    let started = Instant::now();
    let mut identified = identify(fitted, &unknowns, &first_guess).map_err(Failure::usage)?;
    let seconds = started.elapsed().as_secs_f64();
    print_message("predicting the recordings by the model");
    let held_out_noise_ratio = identified.hold_out(held_out);
    let predictions = Predictions::of(&identified, [fitted, held_out], &recordings.files);

    let names = fitted_files.iter().map(|path| file_name(path)).collect();
    let mut profile = identified.profile(&arguments.name, names, recordings.boards.clone());
    let [_, held_out_errors] = &predictions.errors;
    if let (Some(provenance), Some(error)) = (&mut profile.provenance, held_out_errors.longest()) {
        provenance.held_out_rms_rad = Some([error.rms.theta_rad, error.rms.alpha_rad]);
    }
    out.write(toml::to_string_pretty(&profile).map_err(Failure::failed)?.as_bytes())?;
    let correlations = profile.correlations.as_ref();
    let drawn = plots
        .map(|folder| pictures::draw(folder.path(), &recordings, &predictions, correlations))
        .transpose();

    let plant = &recordings.plant;
    let like_a_qube_v = plant.volts_like(IdentificationSettings::DEFAULT.excitation_v);
    let mut next = next_excitations(&profile, plant, like_a_qube_v.min(*RUN_VOLTS.end()));
    next.retain(|excitation| RUN_VOLTS.contains(&excitation.voltage_v));
    let mut text = text::text(&identified, fitted_files, &predictions, &next, plant);
    let _ = write!(text, "\nwrote {} after a fit of {seconds:.1} s", arguments.out.display());
    if let Ok(Some(drawn)) = &drawn {
        let _ = write!(text, "\n{drawn}");
    }
    let mut result = json::result(&identified, &recordings, &predictions, &next);
    result["wall_s"] = json!(seconds);
    result["profile"] = json!(arguments.out.to_string_lossy());
    result["held_out_noise_ratio"] = json!(held_out_noise_ratio);
    output.print(&text, &result);
    drawn.map(|_| ())
}

/// Prints a warning for recordings that are not used, or only in part.
fn warn(recordings: &Recordings<2>) {
    for recording in &recordings.left_out {
        print_message(&format!("warning: not used: {}", recording.why));
    }
    if !recordings.incomplete.is_empty() {
        let parts: Vec<String> = recordings.incomplete.iter().map(ToString::to_string).collect();
        print_message(&format!("warning: not every recording is complete: {}", parts.join("; ")));
    }
}

/// Returns the quantities that the fit moves: all but the fixed ones.
fn unknowns(fixed: &[String]) -> Result<Vec<Unknown>, Failure> {
    let names: Vec<&str> = Unknown::all().map(Unknown::name).collect();
    if let Some(name) = fixed.iter().find(|name| !names.contains(&name.as_str())) {
        let known = names.join(", ");
        return Err(Failure::usage(format!(
            "--fix {name}: there is no such quantity; there are {known}"
        )));
    }
    let moves = |unknown: &Unknown| !fixed.iter().any(|name| name == unknown.name());
    let unknowns: Vec<Unknown> = Unknown::all().filter(moves).collect();
    if unknowns.is_empty() {
        return Err(Failure::usage(
            "--fix names every quantity, so that there is nothing to identify: leave out --fix for at least \
             one, or compare the recordings with a profile by replay --simulate",
        ));
    }
    Ok(unknowns)
}

fn file_name(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}
