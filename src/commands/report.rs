use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde_json::json;

use super::destination::OutputFile;
use super::exit::Failure;
use super::experiment::ExperimentReport;
use super::failures;
use super::output::Output;
use super::printable::one_line;
use super::profile;
use super::replay::recording_failure;
use crate::device::emulator::EmulatorSettings;
use crate::experiment::{Experiment, ExperimentError, ExperimentFolder, ExperimentSettings};
use crate::jobs::starter::quoted;
use crate::qube::PlantModel;
use crate::recording::{Recording, read};
use crate::replay::SimulatedSpecimen;
use crate::report::{ReportError, SessionSource, is_report, recordings_page, session_page};
use crate::rig::RigSettings;
use crate::session::{RigSessions, ScoredCandidate, SessionPaths};
use crate::storage::{Existing, MachineDisk, write_whole};

/// Name of a report in the folder of its session or experiment.
const REPORT: &str = "report.html";

/// Write a session, an experiment or recordings as one page for a browser, with figures to zoom and
/// rollouts to play back
///
/// The page is one file that loads nothing: it can be opened from a disk, sent by mail, and
/// printed. The page of a session shows the outcome, the course of the search, every rollout beside
/// the simulator, the recommended distribution, the identification, the surrogate's posterior, the
/// trainings, timing, faults, and the commands to repeat it. `session` and `experiment` write it at
/// their end.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    qube-hil report logs/monday                    # writes logs/monday/report.html\n  \
    qube-hil report logs/monday/candidates/002/*.mcap --out five.html\n  \
    qube-hil report --profile logs/monday/profile-1.toml rollout-0.mcap")]
pub struct Arguments {
    /// Folder of a session or of an experiment, or recordings (.mcap)
    #[arg(required = true, value_name = "DIR|FILE")]
    paths: Vec<PathBuf>,

    /// File for the page [default: report.html in the folder of the session or experiment; beside
    /// the first recording, with its name; a report there is replaced, another file is not]
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,

    /// Replace the file of --out if it exists
    #[arg(long, requires = "out")]
    force: bool,

    /// The Qube to simulate beside recordings: `ideal`, `lab`, or a file that `identify` wrote
    /// [default: the nominal plant of each recording; a session's identified Qube]
    #[arg(long, value_name = "ideal|lab|FILE")]
    profile: Option<PathBuf>,
}

/// Writes the page and prints its path.
pub fn run(arguments: &Arguments, output: &Output) -> Result<(), Failure> {
    let folder = folder_asked(arguments)?;
    let (path, file) = place(arguments, folder)?;
    let (page, problems) = match folder {
        Some(folder) if ExperimentFolder::is_in(folder) => (of_experiment(folder)?, Vec::new()),
        Some(folder) => of_session(folder)?,
        None => of_recordings(&arguments.paths, arguments.profile.as_deref())?,
    };
    file.write(page.as_bytes())?;
    let shown = path.display().to_string();
    let kilobytes = page.len().div_ceil(1000);
    let text = format!("report in {shown} ({kilobytes} kB); open it in a browser");
    let written = json!({ "report": shown, "bytes": page.len(), "problems": problems });
    output.print(&text, &written);
    first_of(&problems).map_or(Ok(()), Err)
}

/// Returns the failure of a page that was written although these sentences report lost or changed
/// data; `None` without any.
fn first_of(problems: &[String]) -> Option<Failure> {
    let (first, more) = problems.split_first()?;
    Some(Failure::data_lost(match more.len() {
        0 => first.clone(),
        more => format!("{first} (and {more} more, which the page names)"),
    }))
}

/// Returns the folder of the session or experiment that the page is about; `None` for recordings.
fn folder_asked(arguments: &Arguments) -> Result<Option<&Path>, Failure> {
    let folders = arguments.paths.iter().filter(|path| path.is_dir()).count();
    match &arguments.paths[..] {
        [folder] if folders == 1 => {
            if arguments.profile.is_some() {
                return Err(Failure::usage(
                    "--profile goes with recordings, and a folder has its own Qubes: leave --profile out, or give recordings",
                ));
            }
            if RigSessions::exist_in(folder) {
                return Err(Failure::usage(format!(
                    "{} has the sessions of several Qubes: give the folder of one, as {}",
                    folder.display(),
                    RigSessions::folder(folder, 1).display()
                )));
            }
            Ok(Some(folder))
        }
        _ if folders > 0 => Err(Failure::usage("give either one folder, or recordings")),
        _ => Ok(None),
    }
}

/// Returns the place of the page, checked before the work: the path of `--out`, else a path that
/// follows from the folder or from the first recording, at which only a report is replaced.
fn place(arguments: &Arguments, folder: Option<&Path>) -> Result<(PathBuf, OutputFile), Failure> {
    if let Some(path) = &arguments.out {
        let existing = Existing::replaced_if(arguments.force);
        return Ok((path.clone(), OutputFile::prepare(path, existing)?));
    }
    // A missing recording is reported rather than the missing folder of its page.
    if let Some(missing) = arguments.paths.iter().find(|path| !path.exists()) {
        read(missing).map_err(|error| recording_failure(&error))?;
    }
    let path = match folder {
        Some(folder) => folder.join(REPORT),
        None => arguments.paths[0].with_extension("html"),
    };
    check_replaceable(&path).map_err(|why| {
        Failure::usage(format!("{why}: name another file by --out, or move this one away"))
    })?;
    let file = OutputFile::prepare(&path, Existing::Replace)?;
    Ok((path, file))
}

/// Checks that a page at this path would replace nothing but a report.
///
/// # Errors
/// A file is there that is not a report; the text says so.
fn check_replaceable(path: &Path) -> Result<(), String> {
    if path.symlink_metadata().is_err() || is_report(&MachineDisk, path) {
        return Ok(());
    }
    Err(format!("{} exists already and is not a report of this program", path.display()))
}

/// Writes a page into its folder; an older report there is replaced.
///
/// # Errors
/// A file is there that is not a report, or the page cannot be written; the text says which.
fn write_into(folder: &Path, page: &str) -> Result<PathBuf, String> {
    let path = folder.join(REPORT);
    check_replaceable(&path)?;
    write_whole(&MachineDisk, &path, page.as_bytes()).map_err(|error| error.to_string())?;
    Ok(path)
}

/// Writes the report of a session into its folder, and returns its path.
///
/// # Errors
/// A file cannot be read or written; the text says which and why.
pub fn write_into_session(folder: &Path) -> Result<PathBuf, String> {
    let (page, _) = of_session(folder).map_err(|failure| failure.cause().to_owned())?;
    write_into(folder, &page)
}

/// Writes the report of an experiment into its folder, and returns its path.
///
/// # Errors
/// A file cannot be read or written; the text says which and why.
pub fn write_into_experiment(
    results: &ExperimentReport,
    experiment: &Experiment,
) -> Result<PathBuf, String> {
    write_into(experiment.folder().root(), &page_of_experiment(results, experiment)?)
}

fn page_of_experiment(
    results: &ExperimentReport,
    experiment: &Experiment,
) -> Result<String, String> {
    let root = path_word(experiment.folder().root());
    let resumed = ExperimentSettings::load_to_resume(&experiment.folder().settings_path());
    let first = match resumed.err() {
        Some(error @ ExperimentError::NotResumable { .. }) => (
            format!("{}. Print the table of the finished work:", one_line(&error.to_string())),
            format!("qube-hil experiment --resume {root} --table"),
        ),
        _ => (
            "Continue; for a real Qube add the --device and --qube of its beginning:".to_owned(),
            format!("qube-hil experiment --resume {root}"),
        ),
    };
    let commands = [
        first,
        (
            "Draw the figures as files, and write the table for a spreadsheet:".to_owned(),
            format!(
                "qube-hil experiment --resume {root} --table --figures figures --csv table.csv"
            ),
        ),
    ];
    results.page(experiment, &commands)
}

/// Returns the page of the finished work of an experiment. Nothing is driven: the settings of an
/// emulated rig are there only because [`Experiment::new`] takes some.
fn of_experiment(folder: &Path) -> Result<String, Failure> {
    let folder = ExperimentFolder::open(folder).map_err(Failure::usage)?;
    let settings = ExperimentSettings::load(&folder.settings_path()).map_err(Failure::usage)?;
    let rig = RigSettings::emulated(EmulatorSettings::default());
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    let experiment = Experiment::new(folder, settings, rig, threads, Arc::default());
    let results = ExperimentReport::read(&experiment).map_err(Failure::data_lost)?;
    page_of_experiment(&results, &experiment).map_err(Failure::failed)
}

/// Returns the page of a session, with a sentence for each part of its data that cannot be read or
/// was changed.
fn of_session(folder: &Path) -> Result<(String, Vec<String>), Failure> {
    let source = SessionSource::read(&MachineDisk, folder).map_err(failure)?;
    let name = folder.canonicalize().ok();
    let name = name.as_deref().unwrap_or(folder).file_name().unwrap_or(folder.as_os_str());
    let commands = session_commands(&source, folder);
    let page = session_page(&source, &name.to_string_lossy(), &commands).map_err(failure)?;
    let lost_policy = source.policy_lost().map(|reason| {
        format!(
            "the best policy is lost: {reason}. Each recording of its rollouts has it attached, as policy.safetensors"
        )
    });
    let changed = source.settings_changed().then(|| {
        format!(
            "{} was changed after the session began: restore it, because parts of the page may not describe the session",
            SessionPaths::new(folder).configuration().display()
        )
    });
    let problems = source.problems().iter().cloned().chain(lost_policy).chain(changed);
    Ok((page, problems.map(|it| one_line(&it).into_owned()).collect()))
}

/// Returns the page of some recordings, with a sentence for each one that lacks a part.
fn of_recordings(
    files: &[PathBuf],
    profile: Option<&Path>,
) -> Result<(String, Vec<String>), Failure> {
    let known = match profile {
        Some(name) => profile::named_of_any_plant(name)?.map(|known| (name, known)),
        None => None,
    };
    let mut recordings: Vec<(String, Recording)> = Vec::new();
    for path in files {
        let recording = read(path).map_err(|error| recording_failure(&error))?;
        if let Some((name, known)) = &known {
            profile::check_plant(name, known, &recording.header.settings.plant)
                .map_err(|why| Failure::usage(format!("{}: --profile {why}", path.display())))?;
        }
        recordings.push((path.to_string_lossy().into_owned(), recording));
    }
    let shown: Vec<String> = files.iter().map(|path| path_word(path)).collect();
    let commands = [(
        "Check that the replay reproduces every recorded voltage:".to_owned(),
        format!("qube-hil replay {}", shown.join(" ")),
    )];
    let specimen =
        known.map(|(name, known)| SimulatedSpecimen::of_profile(&known, &name.to_string_lossy()));
    let page = recordings_page(&recordings, specimen.as_ref(), &commands).map_err(failure)?;
    let read = files.iter().zip(&recordings);
    let lacking = read.filter_map(|(file, (_, it))| {
        Some(failures::incomplete(file, &it.loss()?).cause().to_owned())
    });
    Ok((page, lacking.collect()))
}

/// Returns the commands that use and repeat a session, each with its purpose. Those that need a
/// lost policy or changed settings are left out, and so is the repetition of a session that several
/// rigs share, because its settings alone do not begin another.
fn session_commands(source: &SessionSource, folder: &Path) -> Vec<(String, String)> {
    let paths = SessionPaths::new(folder);
    let root = path_word(folder);
    let mut commands = Vec::new();
    if !source.is_finished() && !source.settings_changed() {
        commands.push((
            "Continue this session; for a real Qube add the --device and --qube of its beginning:"
                .into(),
            format!("qube-hil session --resume {root}"),
        ));
    }
    if let Some(best) = ScoredCandidate::best_verified(source.candidates())
        && source.policy_lost().is_none()
    {
        let number = source.candidates()[best].candidate.number;
        commands.push(run_command(&paths.candidate(number).policy(), source.plant()));
    }
    let recordings = format!("qube-hil replay {root}/candidates/*/*.mcap");
    commands.push(("Check that the replay reproduces every recorded voltage:".into(), recordings));
    if source.settings_changed() || source.is_shared() {
        return commands;
    }
    let settings = path_word(&paths.configuration());
    let (clock, same) = if source.is_of_computed_time() {
        (" --clock virtual", "Repeat this session; the same program gives the same results:")
    } else {
        (
            "",
            "Repeat this session; in real time its results differ a little; for a real Qube add the --device and --qube \
             of its beginning:",
        )
    };
    let again = path_word(&again_beside(folder));
    let repeat = format!("qube-hil session --config {settings}{clock} --out {again}");
    commands.push((same.into(), repeat));
    commands
}

/// Returns the command that runs a policy on an emulated plant, with its purpose.
fn run_command(policy: &Path, plant: &PlantModel) -> (String, String) {
    let run = format!("qube-hil run --policy {}", path_word(policy));
    if plant.is_qube() {
        return (
            "Run the best policy, here on the emulated Qube; add --device PORT for a real one:"
                .into(),
            run,
        );
    }
    let purpose = format!(
        "Run the best policy, here on the emulated plant; FILE is the file that describes the plant {}; add --device \
         PORT for the real one:",
        plant.name
    );
    (purpose, format!("{run} --plant FILE"))
}

/// Returns the folder for the repetition of a session: the path of the session's folder with
/// `-again` after its name, also if the path ends with `/` or is `.`.
fn again_beside(folder: &Path) -> PathBuf {
    let plain: PathBuf = folder.components().collect();
    let named = if plain.file_name().is_some() { None } else { plain.canonicalize().ok() };
    let mut again = named.unwrap_or(plain).into_os_string();
    again.push("-again");
    again.into()
}

/// Returns a path as one word for a shell, in quotes if it needs them.
fn path_word(path: &Path) -> String {
    quoted(&path.to_string_lossy())
}

fn failure(error: ReportError) -> Failure {
    let message = one_line(&error.to_string()).into_owned();
    match error {
        ReportError::Folder(_) => Failure::usage(format!(
            "{message}. Give the folder of a session or experiment, or recordings"
        )),
        ReportError::Configuration(_) => Failure::usage(message),
        ReportError::Ledger(_) | ReportError::LedgerLost { .. } => Failure::data_lost(message),
        ReportError::Data(_) => Failure::failed(message),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::session::{SessionSettings, SharedRig};

    #[test]
    fn a_page_of_another_origin_keeps_its_place_in_a_folder() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join(REPORT), "my own page").unwrap();
        let why = write_into(folder.path(), "<p>new</p>").unwrap_err();
        assert!(why.ends_with("report.html exists already and is not a report of this program"));
        assert_eq!(std::fs::read(folder.path().join(REPORT)).unwrap(), b"my own page");
    }

    #[test]
    fn a_place_that_is_taken_is_refused_before_the_recording_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let recording = folder.path().join("rollout-0.mcap");
        std::fs::write(&recording, "no recording").unwrap();
        std::fs::write(folder.path().join("rollout-0.html"), "my own page").unwrap();
        let arguments = |path: &Path| Arguments {
            paths: vec![path.to_owned()],
            out: None,
            force: false,
            profile: None,
        };
        let why = run(&arguments(&recording), &Output::new(false)).unwrap_err();
        assert!(why.cause().contains("name another file by --out"), "{why}");
        let missing = folder.path().join("nowhere/rollout-0.mcap");
        let why = run(&arguments(&missing), &Output::new(false)).unwrap_err();
        assert!(why.cause().contains("rollout-0.mcap"), "{why}");
    }

    #[test]
    fn a_shared_session_has_no_command_that_repeats_it() {
        let folder = tempfile::tempdir().unwrap();
        let commands = |rigs: Vec<SharedRig>| {
            let settings = SessionSettings { rigs, ..SessionSettings::thesis() };
            let path = SessionPaths::new(folder.path()).configuration();
            std::fs::write(path, settings.to_toml().unwrap()).unwrap();
            let source = SessionSource::read(&MachineDisk, folder.path()).unwrap();
            let lines = session_commands(&source, folder.path()).into_iter();
            lines.map(|(_, command)| command).collect::<Vec<_>>().join("\n")
        };
        assert!(commands(Vec::new()).contains("session --config"));
        let rig = SharedRig {
            device: "emulated".into(),
            emulated: Default::default(),
            homing_method: None,
        };
        let shared = commands(vec![rig]);
        assert!(shared.contains("session --resume") && !shared.contains("--config"), "{shared}");
    }

    #[test]
    fn a_policy_of_another_plant_runs_with_the_file_of_the_plant() {
        let policy = Path::new("s/policy.safetensors");
        let (_, of_qube) = run_command(policy, &PlantModel::QUBE);
        assert_eq!(of_qube, "qube-hil run --policy s/policy.safetensors");
        let mut other = PlantModel::QUBE;
        other.limits.largest_voltage_v = 4.0;
        let (purpose, of_other) = run_command(policy, &other);
        assert_eq!(of_other, "qube-hil run --policy s/policy.safetensors --plant FILE");
        assert!(purpose.contains("FILE is the file that describes the plant"), "{purpose}");
    }

    #[test]
    fn a_repetition_lies_beside_its_session_for_every_spelling_of_the_path() {
        for spelling in ["logs/monday", "logs/monday/", "logs//monday/."] {
            assert_eq!(again_beside(Path::new(spelling)), Path::new("logs/monday-again"));
        }
        let here = std::env::current_dir().unwrap().canonicalize().unwrap();
        let again = again_beside(Path::new("."));
        assert_eq!(again.parent(), here.parent());
        assert!(again.to_string_lossy().ends_with("-again"), "{again:?}");
    }
}
