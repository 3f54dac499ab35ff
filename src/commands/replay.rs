use std::fmt::Write;
use std::path::{Path, PathBuf};

use serde::Serialize;
use serde_json::json;

use super::command_hints;
use super::destination::{OutputFile, OutputFolder};
use super::exit::Failure;
use super::output::{Output, path_as_text};
use super::picture_names::picture_names;
use super::printable::one_line;
use super::profile;
use crate::charts::{animation_svg, motion_svg};
use crate::qube::Profile;
use crate::recording::{Completeness, Recording, RecordingError, read};
use crate::replay::{
    AngleError, MotionLog, Rerun, SimulatedSpecimen, SimulationError, controller_of, rerun,
    simulate_from_first_state,
};
use crate::safety::{Contradiction, Foreseen};
use crate::scoring::{Verdict, score_recording};
use crate::storage::{Existing, MachineDisk, write_whole};
use crate::telemetry::RolloutOutcome;

/// Replay recordings: recompute the return, feed the recorded measurements to the tick that ran on
/// the Qube, and compare every voltage bit for bit
///
/// With --simulate, the simulator also gets the recorded voltages, and its motion is compared with
/// the recorded one. --simulate and --animate accept CSV files too, with the columns time_s,
/// theta_rad, alpha_rad, theta_dot_rad_s, alpha_dot_rad_s, voltage_v.
///
/// Exit code 3 when a part of a recording is missing, or its replay differs from it.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    qube-hil replay logs/monday/*.mcap\n  \
    qube-hil replay --simulate --plot plots logs/monday/rollout-0.mcap\n  \
    qube-hil replay --animate swing-up.svg logs/monday/rollout-0.mcap\n  \
    qube-hil replay --simulate --profile lab chirp.csv")]
pub struct Arguments {
    /// Recordings (.mcap), with --simulate or --animate also tables (.csv)
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,

    /// Simulate each recording's voltages in open loop and compare the motions
    #[arg(long)]
    simulate: bool,

    /// Qube to simulate, also without --simulate: `ideal`, `lab`, or a file that `identify` wrote
    /// [default: the nominal plant of each recording]
    #[arg(long, value_name = "ideal|lab|FILE")]
    profile: Option<PathBuf>,

    /// File for a moving picture (.svg) of the recording, for pages and slides: the pendulum and
    /// its angles
    #[arg(long, value_name = "FILE")]
    animate: Option<PathBuf>,

    /// Replace the file of --animate if it exists
    #[arg(long, requires = "animate")]
    force: bool,

    /// Folder for one picture (.svg) of each recording with its simulation
    #[arg(long, value_name = "DIR")]
    plot: Option<PathBuf>,
}

impl Arguments {
    /// Returns whether each recording's voltages are to be simulated: a profile and pictures
    /// require this, too.
    fn simulates(&self) -> bool {
        self.simulate || self.profile.is_some() || self.plot.is_some()
    }
}

/// The report on one file.
#[derive(Default, Serialize)]
struct Report {
    #[serde(serialize_with = "path_as_text")]
    path: PathBuf,
    return_recorded: Option<f64>,
    return_recomputed: Option<f64>,
    actions_compared: usize,
    actions_different: usize,
    /// Number of actions that could not be compared, because ticks before them are missing.
    #[serde(skip)]
    not_compared: usize,
    /// Reason why the rollout is void, if it is.
    #[serde(skip_serializing_if = "Option::is_none")]
    void: Option<String>,
    /// Note on the comparison, if any.
    #[serde(skip_serializing_if = "Option::is_none")]
    note: Option<&'static str>,
    /// Recomputed prediction for which foresight ended the rollout, if it did.
    #[serde(skip_serializing_if = "Option::is_none")]
    foreseen: Option<Foreseen>,
    /// Recomputed contradiction of the profile by which the rollout ended, if it did.
    #[serde(skip_serializing_if = "Option::is_none")]
    contradiction: Option<Contradiction>,
    /// Defect that was found, if any.
    problem: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    rmse: Option<Rmse>,
    /// Sentences about the simulation, for people.
    #[serde(skip)]
    simulation: Option<String>,
    /// File of the moving picture, once it is written.
    #[serde(skip)]
    picture: Option<PathBuf>,
}

impl Report {
    /// Returns the report for people, a line for each finding.
    fn text(&self) -> String {
        let mut lines = Vec::new();
        if let (Some(recorded), Some(recomputed)) = (self.return_recorded, self.return_recomputed) {
            let same = self.actions_compared - self.actions_different;
            let all = self.actions_compared + self.not_compared;
            lines.push(format!(
                "return {recorded:.2}, recomputed {recomputed:.2}; {same} of {all} actions are the same bit for bit"
            ));
        }
        let without_result =
            |reason| format!("the rollout is void, its return does not count: {reason}");
        lines.extend(self.void.as_ref().map(without_result));
        lines.extend(self.foreseen.as_ref().map(foreseen_text));
        let against = |it: Contradiction| format!("the guard ended the policy: {it}");
        lines.extend(self.contradiction.map(against));
        lines.extend(self.note.map(str::to_owned));
        lines.extend(self.simulation.clone());
        let picture = self.picture.as_ref().map(|picture| picture.display());
        lines.extend(picture.map(|picture| format!("its motion is drawn in {picture}")));
        let path = self.path.display().to_string();
        lines.into_iter().map(|line| format!("{}: {line}\n", one_line(&path))).collect()
    }
}

/// Note on a recording that braked under the speed envelope, a guard that this program does not
/// have.
const ENVELOPE_NOTE: &str = "this rollout ran under the speed envelope, a guard that this program does not \
     have: it is compared up to its first braking tick, and its end is taken from the file";

/// A defect of one file, and the failure that it causes.
struct Problem {
    failure: fn(String) -> Failure,
    message: String,
}

impl Problem {
    fn usage(message: impl ToString) -> Self {
        Self { failure: |message| Failure::usage(message), message: message.to_string() }
    }

    fn failed(message: impl ToString) -> Self {
        Self { failure: |message| Failure::failed(message), message: message.to_string() }
    }

    fn data_lost(message: impl ToString) -> Self {
        Self { failure: |message| Failure::data_lost(message), message: message.to_string() }
    }
}

#[derive(Clone, Copy, Serialize)]
struct Rmse {
    theta_rad: f64,
    alpha_rad: f64,
}

/// Replays every file and prints the results; the first defect decides the exit code.
pub fn run(arguments: &Arguments, output: &Output) -> Result<(), Failure> {
    let profile = match &arguments.profile {
        Some(name) => profile::named_of_any_plant(name)?,
        None => None,
    };
    let _plots = arguments
        .plot
        .as_deref()
        .map(|folder| OutputFolder::of_option("--plot", folder))
        .transpose()?;
    if arguments.animate.is_some() && arguments.files.len() > 1 {
        return Err(Failure::usage("--animate draws one recording: name one file"));
    }
    if let Some(picture) = &arguments.animate {
        OutputFile::of_option("--animate", picture, Existing::replaced_if(arguments.force))?;
        if !has_ending(picture, "svg") {
            return Err(Failure::usage(format!(
                "--animate {}: the picture is an SVG file: name a file that ends with .svg",
                picture.display()
            )));
        }
    }
    let mut reports = Vec::new();
    let mut problems = Vec::new();
    let files: Vec<&Path> = arguments.files.iter().map(PathBuf::as_path).collect();
    for (path, name) in arguments.files.iter().zip(picture_names(&files)) {
        let mut report = Report { path: path.clone(), ..Report::default() };
        if let Err(problem) = replay_file(arguments, profile.as_ref(), &name, &mut report) {
            report.problem = Some(problem.message.clone());
            problems.push(problem);
        }
        reports.push(report);
    }
    let errors: Vec<Rmse> = reports.iter().filter_map(|report| report.rmse).collect();
    let rmse = overall(&errors);
    let result = match rmse {
        Some(rmse) => json!({ "recordings": reports, "rmse": rmse }),
        None => json!({ "recordings": reports }),
    };
    let mut text: String = reports.iter().map(Report::text).collect();
    if text.is_empty() {
        text.push_str("nothing was replayed");
    }
    if let Some(rmse) = rmse.filter(|_| errors.len() > 1) {
        let Rmse { theta_rad, alpha_rad } = rmse;
        let _ = writeln!(
            text,
            "all: the simulations are off by {}",
            angles_text(AngleError { theta_rad, alpha_rad })
        );
    }
    output.print(&text, &result);
    let all: Vec<&str> = problems.iter().map(|problem| problem.message.as_str()).collect();
    match problems.first() {
        Some(first) => Err((first.failure)(all.join("\n"))),
        None => Ok(()),
    }
}

fn replay_file(
    arguments: &Arguments,
    profile: Option<&Profile>,
    name: &str,
    report: &mut Report,
) -> Result<(), Problem> {
    let path = report.path.clone();
    let is_csv = is_csv(&path);
    if is_csv && !arguments.simulates() && arguments.animate.is_none() {
        return Err(Problem::usage(format!(
            "{}: a table has no policy to run again; add --simulate to compare it with the simulator, or --animate to draw its motion",
            path.display()
        )));
    }
    let mut problem = None;
    let log = if is_csv {
        MotionLog::read(&path).map_err(Problem::usage)?
    } else {
        let recording = read(&path).map_err(|error| recording_problem(&error))?;
        problem = if recording.policy.is_empty() {
            Some(Problem::data_lost(format!(
                "{}: its policy was lost, so that its decisions cannot be replayed; --simulate and --animate need none",
                one_line(&path.display().to_string())
            )))
        } else {
            rerun_recording(&recording, report)?
        };
        match MotionLog::of_recording(&recording) {
            Some(log) => log,
            // Without ticks of the policy there is nothing to simulate or draw: settling failed, or
            // the file was truncated before the policy started.
            None if arguments.simulates() || arguments.animate.is_some() => {
                return Err(problem.unwrap_or_else(|| {
                    Problem::usage(format!(
                        "{}: the policy drove for less than two ticks, so there is no motion to simulate or draw",
                        path.display()
                    ))
                }));
            }
            None => return problem.map_or(Ok(()), Err),
        }
    };
    let shown = draw_and_simulate(arguments, profile, name, &log, report);
    match (problem, shown) {
        (Some(first), Err(second)) => {
            Err(Problem { message: format!("{}\n{}", first.message, second.message), ..first })
        }
        (Some(problem), Ok(())) => Err(problem),
        (None, shown) => shown,
    }
}

/// Draws the motion for `--animate`, and simulates it if [`Arguments::simulates`].
fn draw_and_simulate(
    arguments: &Arguments,
    profile: Option<&Profile>,
    name: &str,
    log: &MotionLog,
    report: &mut Report,
) -> Result<(), Problem> {
    if let Some(picture) = &arguments.animate {
        let svg = animation_svg(name, log);
        write_whole(&MachineDisk, picture, svg.as_bytes()).map_err(Problem::failed)?;
        report.picture = Some(picture.clone());
    }
    if !arguments.simulates() {
        return Ok(());
    }
    let specimen = match profile {
        Some(profile) => {
            // A CSV file does not name its plant.
            if let (Some(name), false) = (&arguments.profile, is_csv(&report.path)) {
                let path = report.path.display();
                profile::check_plant(name, profile, &log.plant)
                    .map_err(|why| Problem::usage(format!("{path}: --profile {why}")))?;
            }
            let name = arguments.profile.as_deref().unwrap_or(Path::new("")).display();
            SimulatedSpecimen::of_profile(profile, &one_line(&name.to_string()))
        }
        None => SimulatedSpecimen::nominal(&log.plant),
    };
    simulate(arguments, &specimen, name, log, report)
}

fn is_csv(path: &Path) -> bool {
    has_ending(path, "csv")
}

/// Returns whether the name of a file ends with this extension, in letters of either case.
fn has_ending(path: &Path, ending: &str) -> bool {
    path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case(ending))
}

/// Feeds the measurements of a recording to the tick again, and enters the comparison into
/// `report`. Returns the problem of a decision, an ending or its reason that differs, or of a
/// recording with missing parts.
///
/// # Errors
/// The recording cannot be replayed.
fn rerun_recording(recording: &Recording, report: &mut Report) -> Result<Option<Problem>, Problem> {
    let path = report.path.display().to_string();
    let policy = controller_of(recording).map_err(|error| {
        Problem::usage(one_line(&format!("{path}: its policy cannot be run: {error}")))
    })?;
    let rerun = rerun(recording, policy);
    report.return_recorded = Some(rerun.return_recorded);
    report.return_recomputed = Some(rerun.return_recomputed);
    report.actions_compared = rerun.actions_compared;
    report.actions_different = rerun.actions_different;
    report.not_compared = rerun.not_compared;
    report.foreseen = rerun.foreseen;
    report.contradiction = rerun.contradiction;
    if let Verdict::Void { reason } = score_recording(recording) {
        report.void = Some(reason.to_string());
    }
    report.note = rerun.ending_of_the_file.then_some(ENVELOPE_NOTE);
    Ok(findings(recording, &rerun)
        .map(|message| Problem::data_lost(one_line(&format!("{path}: {message}")))))
}

/// Describes the first defect of a recording or its replay, if any.
fn findings(recording: &Recording, rerun: &Rerun) -> Option<String> {
    if let Some(first) = &rerun.first_difference {
        let (recorded, recomputed) = (&first.recorded, &first.recomputed);
        let difference = if recorded.voltage_mv == recomputed.voltage_mv {
            "the voltage is the same, but phase, state or wanted voltage are not".to_owned()
        } else {
            format!("recorded {} mV, recomputed {} mV", recorded.voltage_mv, recomputed.voltage_mv)
        };
        return Some(format!(
            "{} of {} actions differ, first in tick {}: {difference}",
            rerun.actions_different, rerun.actions_compared, recorded.tick,
        ));
    }
    if rerun.not_compared > 0 {
        return Some(format!(
            "ticks are missing; the {} after them cannot be compared",
            rerun.not_compared
        ));
    }
    match (&recording.completeness, &recording.outcome) {
        (Completeness::CutOff { lost_bytes, reason }, _) => Some(format!(
            "cut off, {lost_bytes} bytes lost ({reason}). `qube-hil recover` saves the intact part"
        )),
        (Completeness::Recovered, None) => {
            Some("recovered; how the rollout ended is not known".to_owned())
        }
        (Completeness::Whole, None) => Some("how the rollout ended is not known".to_owned()),
        (Completeness::Recovered, Some(_)) if rerun.ending.is_none() => {
            Some("recovered; its last ticks are missing".to_owned())
        }
        (_, Some(outcome)) if rerun.ending != Some(outcome.ending) => {
            Some(format!("recorded ending {:?}, recomputed {:?}", outcome.ending, rerun.ending))
        }
        (_, Some(RolloutOutcome { foreseen: Some(recorded), .. }))
            if rerun.foreseen != Some(*recorded) =>
        {
            Some(format!(
                "recorded prediction of foresight {recorded:?}, recomputed {:?}",
                rerun.foreseen
            ))
        }
        (_, Some(RolloutOutcome { contradiction: Some(recorded), .. }))
            if rerun.contradiction != Some(*recorded) =>
        {
            Some(format!(
                "recorded contradiction of the profile {recorded:?}, recomputed {:?}",
                rerun.contradiction
            ))
        }
        _ => None,
    }
}

/// Returns the prediction for which foresight ended a rollout, in a sentence for people.
fn foreseen_text(foreseen: &Foreseen) -> String {
    let Foreseen { identified, particle, beyond_rad } = foreseen;
    let whose =
        if *identified { "the belief from its profile" } else { "the belief about any Qube" };
    let reach = beyond_rad.map_or_else(
        || "would have moved without bounds".to_owned(),
        |beyond_rad| {
            format!("would have come {beyond_rad:.3} rad closer to its stop than foresight allows")
        },
    );
    format!(
        "foresight ended the policy: with a brake one tick later, the arm of particle {particle} of {whose} {reach}"
    )
}

fn simulate(
    arguments: &Arguments,
    specimen: &SimulatedSpecimen,
    name: &str,
    log: &MotionLog,
    report: &mut Report,
) -> Result<(), Problem> {
    let path = report.path.display().to_string();
    let open_loop = simulate_from_first_state(log, &specimen.model)
        .map_err(|error| Problem::usage(format!("{path}: {error}")))?;
    let AngleError { theta_rad, alpha_rad } = open_loop.rmse;
    report.rmse = Some(Rmse { theta_rad, alpha_rad });
    let error = SimulationError::of(log, &open_loop);
    report.simulation = Some(simulation_text(&specimen.name, error, arguments.profile.is_some()));
    if let Some(folder) = &arguments.plot {
        let picture = folder.join(format!("{name}.svg"));
        let svg = motion_svg(name, log, &open_loop).map_err(Problem::failed)?;
        write_whole(&MachineDisk, &picture, svg.as_bytes()).map_err(Problem::failed)?;
    }
    Ok(())
}

/// Returns the error of a simulation in open loop, with the name of the simulated specimen;
/// `is_chosen` says whether the user has named the specimen.
fn simulation_text(name: &str, error: SimulationError, is_chosen: bool) -> String {
    let whole = angles_text(error.whole);
    let mut text = format!("the simulation of {name} in open loop is off by {whole}");
    if let Some(before) = error.until_upright {
        let before = angles_text(before);
        text.push_str(&format!("; until the pendulum is first upright, by {before}"));
    }
    if error.falls {
        text.push_str(". Near upright a small error grows, so that the simulated pendulum falls");
    }
    if !is_chosen {
        text.push_str(". --profile simulates another specimen");
    }
    text
}

fn angles_text(AngleError { theta_rad, alpha_rad }: AngleError) -> String {
    format!("{theta_rad:.3} rad in theta and {alpha_rad:.3} rad in alpha (RMS)")
}

/// Returns the RMS error over several recordings, all with the same weight; `None` without a
/// recording.
fn overall(errors: &[Rmse]) -> Option<Rmse> {
    let mean = |angle: fn(&Rmse) -> f64| {
        let squares: f64 = errors.iter().map(|rmse| angle(rmse).powi(2)).sum();
        (squares / errors.len() as f64).sqrt()
    };
    (!errors.is_empty()).then(|| Rmse {
        theta_rad: mean(|rmse| rmse.theta_rad),
        alpha_rad: mean(|rmse| rmse.alpha_rad),
    })
}

fn recording_problem(error: &RecordingError) -> Problem {
    let message = one_line(&command_hints::recording(error)).into_owned();
    if is_bad_input(error) { Problem::usage(message) } else { Problem::failed(message) }
}

/// Returns the failure for an error of a recording that the user named: a file that cannot be
/// created, is missing, unreadable or damaged is bad input; other errors, such as a full disk, are
/// failures.
pub fn recording_failure(error: &RecordingError) -> Failure {
    let Problem { failure, message } = recording_problem(error);
    failure(message)
}

/// Returns whether the error lies in the place or the content of the file; errors of writing it do
/// not.
fn is_bad_input(error: &RecordingError) -> bool {
    match error {
        RecordingError::Create { .. }
        | RecordingError::Read { .. }
        | RecordingError::Missing { .. }
        | RecordingError::CutOff { .. }
        | RecordingError::Unreadable { .. } => true,
        RecordingError::DiskFull { .. }
        | RecordingError::Write { .. }
        | RecordingError::UnreadableRecord { .. }
        | RecordingError::Stopped { .. } => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_error_of_a_simulation_comes_with_the_name_of_its_specimen() {
        let angles = |theta_rad, alpha_rad| AngleError { theta_rad, alpha_rad };
        let error = SimulationError {
            whole: angles(8.475, 3.1),
            until_upright: Some(angles(0.02, 0.1)),
            falls: true,
        };
        let text = simulation_text("the nominal Qube", error, false);
        for words in [
            "the simulation of the nominal Qube in open loop is off by 8.475 rad in theta",
            "until the pendulum is first upright, by 0.020 rad in theta",
            "the simulated pendulum falls. --profile simulates",
        ] {
            assert!(text.contains(words), "{text}");
        }
        let hanging = SimulationError { until_upright: None, falls: false, ..error };
        let text = simulation_text("the Qube of the profile lab", hanging, true);
        assert!(text.ends_with("3.100 rad in alpha (RMS)"), "{text}");
    }
}
