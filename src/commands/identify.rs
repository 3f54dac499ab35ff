use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::time::Instant;

use serde_json::{Value, json};

use super::destination::{OutputFile, OutputFolder};
use super::exit::Failure;
use super::output::Output;
use super::picture_names::picture_names;
use super::plant_file::PlantArgument;
use super::printable::print_message;
use super::profile;
use crate::charts::{correlations_svg, motion_svg};
use crate::identification::{
    Blind, Estimate, ExpectedExcitation, HorizonError, Identified, IncompleteRecording, LeftOut,
    ModelVerdict, PredictionBand, Recordings, Regime, Unknown, comes_upright, horizon_error,
    identify, next_excitations, prediction_errors, read_recordings, regime_error, series_of,
    start_state,
};
use crate::qube::QubeModel;
use crate::replay::{MotionLog, simulate_from};
use crate::session::IdentificationSettings;
use crate::storage::{MachineDisk, write_whole};

/// Horizons at which the table shows the predictions of recordings whose pendulum stays down, such
/// as chirps and steps, s. The longest is the rest of an excitation of 10 s after the 0.2 s from
/// which the start state is estimated.
const HORIZONS_S: [f64; 3] = [0.01, 0.5, 9.8];

/// Identify the Qube, or another plant, that made recordings: parameters, friction, dead zone, cable and delay
///
/// `run --excite chirp` and `--excite steps` make such recordings; swing-ups, balancing and rollouts of policies
/// can be used as well, in any mixture. All must be of the same plant: a .mcap names its plant; a .csv is taken to
/// be of --plant, else of the plant of the recordings before it, else of the Qube. The result is a profile, which
/// --profile reads: `train`, `replay` and `report` simulate that Qube, and `run`, `session`, `experiment` and `emulate`
/// emulate it. A real Qube is known by it if qube.toml names it. Verify it with recordings
/// that it was not fitted to (--holdout): every 0.1 s a start state is estimated from 0.2 s of the recording, and the
/// model then receives only the voltages. The cable rests as in the fitted recordings of the same series; the names
/// of a series differ in the last number only. A recording whose pendulum comes upright is predicted piece by piece:
/// 0.5 s of its swing, 0.1 s of its balance. Recordings that are too short, or in which too little moves, are named and
/// not used.
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

    /// Profile with the values at which the fit starts and which --fix keeps [default: the nominal plant]
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

/// Fits, verifies, and writes the profile.
pub fn run(arguments: &Arguments, output: &Output) -> Result<(), Failure> {
    let unknowns = unknowns(&arguments.fix)?;
    let out = OutputFile::prepare(&arguments.out, arguments.force)?;
    let plots = arguments.plot.as_deref().map(plot_folder).transpose()?;
    let groups = [&arguments.files[..], &arguments.holdout[..]];
    let recordings = read_recordings(groups, arguments.plant.given()?).map_err(Failure::usage)?;
    let Recordings { groups: [fitted, held_out], files, left_out, plant, boards, incomplete } =
        recordings;
    let [fitted_files, held_out_files] = &files;
    for recording in &left_out {
        print_message(&format!("warning: not used: {}", recording.why));
    }
    if !incomplete.is_empty() {
        let parts: Vec<String> = incomplete.iter().map(ToString::to_string).collect();
        print_message(&format!("warning: not every recording is complete: {}", parts.join("; ")));
    }
    let first_guess = match &arguments.from {
        Some(path) => profile::load(path, &plant)?.model(),
        None => plant.nominal(),
    };

    let started = Instant::now();
    let mut identified = identify(&fitted, &unknowns, &first_guess).map_err(Failure::usage)?;
    let seconds = started.elapsed().as_secs_f64();
    let held_out_noise_ratio = identified.hold_out(&held_out);
    let models = |files: &[PathBuf], fits: &dyn Fn(&Path, &Path) -> bool| {
        let one = |path: &PathBuf| {
            let places = fitted_files.iter().enumerate();
            let alike: Vec<usize> =
                places.filter(|(_, fitted)| fits(fitted, path)).map(|(place, _)| place).collect();
            identified.model_of(&alike)
        };
        files.iter().map(one).collect::<Vec<_>>()
    };
    let own_models = models(fitted_files, &|fitted, path| fitted == path);
    let held_out_models =
        models(held_out_files, &|fitted, path| series_of(fitted) == series_of(path));
    let errors = [
        Errors::of("fitted", &fitted, &own_models),
        Errors::of("held out", &held_out, &held_out_models),
    ];
    let [_, held_out_errors] = &errors;
    let [.., long] = held_out_errors.horizons;

    let names = fitted_files.iter().map(|path| file_name(path)).collect();
    let mut profile = identified.profile(&arguments.name, names, boards);
    if let Some(provenance) = profile.provenance.as_mut().filter(|_| long.predictions > 0) {
        provenance.held_out_rms_rad = Some([long.rms.theta_rad, long.rms.alpha_rad]);
    }
    let toml = toml::to_string_pretty(&profile).map_err(Failure::failed)?;
    out.write(toml.as_bytes())?;
    let mut drawn = String::new();
    if let Some(folder) = &plots {
        let files: Vec<&Path> =
            fitted_files.iter().chain(held_out_files).map(PathBuf::as_path).collect();
        let logs = fitted.iter().chain(&held_out);
        let models = own_models.iter().chain(&held_out_models);
        let pictures = files.iter().zip(picture_names(&files));
        for (((path, name), log), model) in pictures.zip(logs).zip(models) {
            plot(folder.path(), path, &name, log, model)?;
        }
        if let Some(correlations) = &profile.correlations {
            let svg = correlations_svg(correlations).map_err(Failure::failed)?;
            let picture = folder.path().join("profile-correlations.svg");
            write_whole(&MachineDisk, &picture, svg.as_bytes()).map_err(Failure::failed)?;
        }
        let and = profile.correlations.as_ref().map_or("", |_| " and profile-correlations.svg");
        let count = match files.len() {
            1 => "one recording".to_owned(),
            count => format!("{count} recordings"),
        };
        drawn = format!("\ndrew {count}{and} into {}", folder.path().display());
    }

    let mut text = table(&identified);
    text += &correlated(&identified);
    text += &rests(&identified, fitted_files);
    for errors in &errors {
        text += &errors.lines();
    }
    let pooled = |logs: &[MotionLog], models: &[QubeModel]| {
        let pairs = logs.iter().zip(models);
        pairs.flat_map(|(log, model)| prediction_errors(log, model)).collect::<Vec<_>>()
    };
    let band = PredictionBand::of(&pooled(&fitted, &own_models));
    let within = band.filter(|_| !held_out.is_empty()).map(|band| {
        let errors = pooled(&held_out, &held_out_models);
        (band.shares_within(&errors), errors.len())
    });
    text += &band_lines(band, within);
    let _ = write!(text, "\n{}", assessment(&identified));
    let largest_v = plant.volts_like(IdentificationSettings::DEFAULT.excitation_v);
    let next = next_excitations(&profile, &plant, largest_v);
    text += &next_line(&next);
    let _ = write!(text, "\nwrote {} after a fit of {seconds:.1} s", arguments.out.display());
    text += &drawn;
    let mut result = result(&identified, &errors, fitted_files, seconds, arguments);
    result["prediction_band"] = band_json(band, within);
    result["held_out_noise_ratio"] = json!(held_out_noise_ratio);
    result["next_excitations"] = next.iter().map(excitation_json).collect();
    result["left_out"] = left_out.iter().map(left_out_json).collect();
    result["incomplete"] = incomplete.iter().map(incomplete_json).collect();
    output.print(&text, &result);
    Ok(())
}

/// Endings of file names that a folder of pictures does not have.
const FILE_ENDINGS: [&str; 4] = ["svg", "png", "pdf", "html"];

/// The folder of `--plot`, which is made. Refuses the name of a file.
fn plot_folder(folder: &Path) -> Result<OutputFolder, Failure> {
    let ending = folder.extension().map(|ending| ending.to_string_lossy().to_lowercase());
    if ending.is_some_and(|ending| FILE_ENDINGS.contains(&ending.as_str())) && !folder.is_dir() {
        return Err(Failure::usage(format!(
            "--plot {}: --plot takes a folder, in which each recording gets a picture: give a name without an ending",
            folder.display()
        )));
    }
    OutputFolder::of_option("--plot", folder)
}

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

fn incomplete_json(recording: &IncompleteRecording) -> Value {
    let IncompleteRecording { path, why, used_s } = recording;
    json!({ "file": path.to_string_lossy(), "reason": why.to_string(), "used_s": used_s })
}

fn left_out_json(LeftOut { path, why }: &LeftOut) -> Value {
    json!({ "file": path.to_string_lossy(), "reason": why.to_string() })
}

fn file_name(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

fn plot(
    folder: &Path,
    path: &Path,
    name: &str,
    log: &MotionLog,
    model: &QubeModel,
) -> Result<(), Failure> {
    let open_loop = simulate_from(log, model, start_state(log, model))
        .map_err(|error| Failure::failed(format!("{}: {error}", path.display())))?;
    let svg = motion_svg(name, log, &open_loop).map_err(Failure::failed)?;
    let picture = folder.join(format!("{name}.svg"));
    write_whole(&MachineDisk, &picture, svg.as_bytes()).map_err(Failure::failed)
}

fn table(identified: &Identified) -> String {
    let mut text = format!(
        "{:24} {:>11} {:>11} {:9} {:>13}\n",
        "quantity", "value", "std. error", "unit", "from data"
    );
    for estimate in &identified.estimates {
        let Estimate { unknown, value, standard_error, variance_removed } = *estimate;
        let mark = if estimate.is_determined() { "" } else { "  from the prior" };
        let percent = 100.0 * variance_removed;
        let (name, unit) = (unknown.name(), unknown.0.unit());
        let _ = writeln!(
            text,
            "{name:24} {value:11.4e} {standard_error:11.1e} {unit:9} {percent:11.0} %{mark}"
        );
    }
    if !identified.blind.is_empty() {
        text += "\nThe recordings do not determine these combinations (in units of the prior):\n";
    }
    for direction in &identified.blind {
        let _ = writeln!(text, "  {}", combination(direction));
    }
    text
}

/// Absolute correlation from which two estimates are listed as hard to tell apart.
const STRONG_CORRELATION: f64 = 0.8;

/// The pairs of estimates that the recordings hardly tell apart, as lines for people; empty without
/// any.
fn correlated(identified: &Identified) -> String {
    let mut text = String::new();
    let name = |index: usize| identified.estimates[index].unknown.name();
    for (one, row) in identified.correlations.iter().enumerate() {
        for (other, &correlation) in row[..one].iter().enumerate() {
            if correlation.abs() >= STRONG_CORRELATION {
                let also = if correlation > 0.0 { "more" } else { "less" };
                let _ = writeln!(
                    text,
                    "  more {} looks like {also} {} ({correlation:+.2})",
                    name(other),
                    name(one)
                );
            }
        }
    }
    if text.is_empty() { text } else { format!("\nStrongly correlated estimates:\n{text}") }
}

/// The cable's rest angle in each recording; empty if the angle does not scatter between
/// recordings.
fn rests(identified: &Identified, files: &[PathBuf]) -> String {
    let scatter_rad = identified.scatter.cable_rest_rad;
    if scatter_rad == 0.0 {
        return String::new();
    }
    let mut text = format!(
        "\nThe cable's rest angle by recording (scatter {scatter_rad:.2} rad, part of its standard error):\n"
    );
    for (index, path) in files.iter().enumerate() {
        let rest_rad = identified.model_of(&[index]).nonidealities.cable_rest_rad;
        let _ = writeln!(text, "  {rest_rad:+.2} rad  {}", path.display());
    }
    text
}

/// The verdict on the model in words, with a note if the standard errors are larger than noise
/// alone explains.
fn assessment(identified: &Identified) -> String {
    let tests = &identified.assessment;
    let doubts: Vec<String> = tests.doubts.iter().map(ToString::to_string).collect();
    let doubts = doubts.join("; ");
    let verdict = match tests.verdict {
        ModelVerdict::Fits => "The model describes this Qube.".to_owned(),
        ModelVerdict::FitsBut => format!("The model describes this Qube except for {doubts}."),
        ModelVerdict::DoesNotFit => format!("The model does not describe this Qube: {doubts}."),
    };
    let widened = if identified.inflation > 1.05 {
        let factor = identified.inflation;
        format!(
            " Standard errors are {factor:.1} times those of noise alone, because parts of the recordings disagree."
        )
    } else {
        String::new()
    };
    format!("{verdict}{widened}\n")
}

/// The shares of the errors of theta and alpha within a band, and the number of predictions.
type Within = ([f64; 2], usize);

/// The band of the predictions and the share of held-out errors within it, as lines for people.
fn band_lines(band: Option<PredictionBand>, within: Option<Within>) -> String {
    let Some(PredictionBand { half_widths_rad: [theta, alpha], .. }) = band else {
        return String::new();
    };
    let mut text = format!(
        "\nAfter 0.5 s, 90 % of the fitted recordings are within theta {theta:.4} and alpha {alpha:.4} rad of a prediction.\n"
    );
    if let Some(([theta, alpha], count)) = within.filter(|(_, count)| *count > 0) {
        let [theta, alpha] = [100.0 * theta, 100.0 * alpha];
        let _ = writeln!(
            text,
            "Of the {count} predictions of held-out recordings, {theta:.0} % (theta) and {alpha:.0} % (alpha) are."
        );
    }
    text
}

fn band_json(band: Option<PredictionBand>, within: Option<Within>) -> Value {
    let Some(PredictionBand { half_widths_rad: [theta, alpha], predictions }) = band else {
        return Value::Null;
    };
    let shares = within.filter(|(_, count)| *count > 0).map(
        |([theta, alpha], count)| json!({ "theta": theta, "alpha": alpha, "predictions": count }),
    );
    json!({ "theta_rad": theta, "alpha_rad": alpha, "predictions": predictions, "held_out": shares })
}

/// The excitations with the most and with the least expected information, as a line for people;
/// empty without any.
fn next_line(next: &[ExpectedExcitation]) -> String {
    let (Some(most), Some(least)) = (next.first(), next.last()) else { return String::new() };
    format!(
        "To learn more about it: run --excite {} --volts {:.2} (expected: {:.1} nats; from a {} of {:.2} V: {:.1}).\n",
        most.shape.name(),
        most.voltage_v,
        most.information_nats,
        least.shape.name(),
        least.voltage_v,
        least.information_nats
    )
}

fn excitation_json(excitation: &ExpectedExcitation) -> Value {
    let ExpectedExcitation { shape, voltage_v, information_nats } = excitation;
    json!({ "shape": shape.name(), "voltage_v": voltage_v, "information_nats": information_nats })
}

/// A combination such as `+0.71 R_m -0.70 k_m`.
fn combination(direction: &Blind) -> String {
    let term = |(unknown, weight): &(Unknown, f64)| format!("{weight:+.2} {}", unknown.name());
    direction.iter().map(term).collect::<Vec<_>>().join(" ")
}

/// The errors of the predictions of a group of recordings.
struct Errors {
    name: &'static str,
    /// Errors of the recordings whose pendulum never comes upright, in the order of
    /// [`HORIZONS_S`].
    horizons: [HorizonError; 3],
    /// Errors of the other recordings, in the order of [`Regime::ALL`].
    regimes: [(Regime, HorizonError); 2],
}

impl Errors {
    /// Predicts each recording with its own model.
    fn of(name: &'static str, logs: &[MotionLog], models: &[QubeModel]) -> Self {
        let pairs = || logs.iter().zip(models);
        let horizon = |horizon_s: f64| {
            let hanging = pairs().filter(|(log, _)| !comes_upright(log));
            let parts: Vec<HorizonError> = hanging
                .map(|(log, model)| horizon_error(std::slice::from_ref(log), model, horizon_s))
                .collect();
            HorizonError::pooled(horizon_s, &parts)
        };
        let regime = |regime: Regime| {
            let parts: Vec<HorizonError> = pairs()
                .map(|(log, model)| regime_error(std::slice::from_ref(log), model, regime))
                .collect();
            let [_, horizon_s] = regime.times_s();
            (regime, HorizonError::pooled(horizon_s, &parts))
        };
        Self { name, horizons: HORIZONS_S.map(horizon), regimes: Regime::ALL.map(regime) }
    }

    fn lines(&self) -> String {
        let horizons = self.horizons.iter().map(|error| ("", error));
        let regimes = self.regimes.iter().map(|(regime, error)| (regime.name(), error));
        let errors: Vec<_> =
            horizons.chain(regimes).filter(|(_, error)| error.predictions > 0).collect();
        if errors.is_empty() {
            return String::new();
        }
        let mut text = format!("\n{:9} RMS error of predictions, rad\n", self.name);
        for (phase, error) in errors {
            let (theta, alpha) = (error.rms.theta_rad, error.rms.alpha_rad);
            let _ = writeln!(
                text,
                "{phase:8}{:5} s  theta {theta:.4}  alpha {alpha:.4}  ({} predictions)",
                error.horizon_s, error.predictions
            );
        }
        text
    }
}

fn result(
    identified: &Identified,
    [fitted, held_out]: &[Errors; 2],
    files: &[PathBuf],
    seconds: f64,
    arguments: &Arguments,
) -> Value {
    let recording = |(index, path): (usize, &PathBuf)| {
        json!({
            "file": path.to_string_lossy(),
            "cable_rest_rad": identified.model_of(&[index]).nonidealities.cable_rest_rad,
            "alpha_zero_rad": identified.offsets[index].alpha_zero_rad,
        })
    };
    let estimate = |estimate: &Estimate| {
        json!({
            "name": estimate.unknown.name(),
            "value": estimate.value,
            "standard_error": estimate.standard_error,
            "told_by_data": estimate.variance_removed,
        })
    };
    let horizon = |error: &HorizonError| {
        json!({
            "horizon_s": error.horizon_s,
            "theta_rad": error.rms.theta_rad,
            "alpha_rad": error.rms.alpha_rad,
            "predictions": error.predictions,
        })
    };
    let phases = |errors: &Errors| {
        let of = |(regime, error): &(Regime, HorizonError)| {
            let mut value = horizon(error);
            value["phase"] = json!(regime.name());
            value
        };
        errors.regimes.iter().map(of).collect::<Vec<_>>()
    };
    json!({
        "estimates": identified.estimates.iter().map(estimate).collect::<Vec<_>>(),
        "recordings": files.iter().enumerate().map(recording).collect::<Vec<_>>(),
        "cable_rest_scatter_rad": identified.scatter.cable_rest_rad,
        "blind": identified.blind.iter().map(combination).collect::<Vec<_>>(),
        "fitted": fitted.horizons.iter().map(horizon).collect::<Vec<_>>(),
        "held_out": held_out.horizons.iter().map(horizon).collect::<Vec<_>>(),
        "fitted_phases": phases(fitted),
        "held_out_phases": phases(held_out),
        "wall_s": seconds,
        "verdict": identified.assessment.verdict.name(),
        "doubts": identified.assessment.doubts.iter().map(|doubt| doubt.name()).collect::<Vec<_>>(),
        "noise_ratio": identified.assessment.noise_ratio,
        "whiteness": identified.assessment.whiteness,
        "growth": identified.assessment.growth,
        "inflation": identified.inflation,
        "profile": arguments.out.to_string_lossy(),
    })
}
