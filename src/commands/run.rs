use std::fmt::Write;
use std::path::{Path, PathBuf};

use clap::ValueEnum;
use serde_json::{Value, json};

use super::command_hints::{self, unidentified};
use super::destination::OutputFolder;
use super::device_arguments::{CheckArguments, DeviceArguments};
use super::emulated_arguments::EmulatedArguments;
use super::estimator_arguments::EstimatorArguments;
use super::exit::Failure;
use super::guard_argument::{ConsentArgument, GuardArgument, guard_parser};
use super::keyboard::Keyboard;
use super::number_arguments::between;
use super::output::Output;
use super::printable::tell;
use super::stop::Stop;
use super::{
    failures, heat_line, observer_resets_line, quietness_line, timing_lines, warn_without_realtime,
};
use crate::control::HomingMethod;
use crate::identification::{Unfit, check_recording};
use crate::policy::{
    ClassicalController, ClassicalGains, EXCITATION_STEPS, Excitation, ExcitationShape, Policy,
    SimulatedSensors,
};
use crate::qube::{MAX_STEPS, PlantModel, Profile, QubeModel};
use crate::recording::{Recording, read};
use crate::replay::MotionLog;
use crate::rig::{MAX_NOT_BEGUN, Recorded, Rig, RigError, RigSettings};
use crate::safety::SafetyBox;
use crate::scoring::{Latencies, Quietness, Verdict, score_recording};
use crate::session::{DRIFT_ROLLOUTS, Drift, RolloutPlan};
use crate::storage::MachineDisk;
use crate::telemetry::{Ending, Fault};

/// Run a policy on the Qube and record it: homing, then for each rollout settling, six seconds of policy,
/// braking; or excite the Qube for `identify`
///
/// Exit code 0 also when a rollout left the safety box, which is a result; 4 when a fault ended the last
/// rollout.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    qube-hil run --policy classical              # a swing-up without any training\n  \
    qube-hil run --policy policies/robust.safetensors --rollouts 5\n  \
    qube-hil run --policy best.safetensors --device /dev/ttyACM0 --out logs/monday\n  \
    qube-hil run --policy best.safetensors --profile lab --clock virtual\n  \
    qube-hil run --excite chirp --rollouts 4 --out logs/chirps      # for identify\n  \
    qube-hil run --policy classical --qube qube.toml     # from check --write")]
pub struct Arguments {
    /// Policy file, or `classical` for the built-in energy swing-up with balance; this or --excite is
    /// required
    #[arg(long, value_name = "FILE|classical", required_unless_present = "excite")]
    policy: Option<String>,

    /// Instead of a policy, apply a voltage for 10 s that makes a recording for `identify`; consecutive
    /// rollouts start in opposite directions. Box and guard apply as for a policy
    #[arg(long, value_enum, conflicts_with = "policy")]
    excite: Option<ExciteArgument>,

    /// Largest voltage of the excitation, 0.1 to 3
    #[arg(long, value_name = "V", default_value_t = 1.5, value_parser = volts, requires = "excite")]
    volts: f64,

    /// Number of rollouts
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    rollouts: u32,

    /// Folder for the recordings [default: logs/run-DATE-TIME]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,

    /// Seed of the arm's start angles and of the emulated Qube
    #[arg(long, default_value_t = 0)]
    seed: u64,

    /// Guard that may end a rollout: foresight of the brake, or the box only
    #[arg(long, value_parser = guard_parser(), default_value = "foresight")]
    guard: GuardArgument,

    #[command(flatten)]
    consent: ConsentArgument,

    #[command(flatten)]
    estimator: EstimatorArguments,

    #[command(flatten)]
    device: DeviceArguments,

    #[command(flatten)]
    emulated: EmulatedArguments,

    #[command(flatten)]
    check: CheckArguments,
}

/// The excitations by name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum ExciteArgument {
    /// A cosine from 5 Hz down to 1 Hz
    Chirp,
    /// Voltages held for 0.05 to 0.2 s in a pseudo-random order
    Steps,
}

impl From<ExciteArgument> for ExcitationShape {
    fn from(argument: ExciteArgument) -> Self {
        match argument {
            ExciteArgument::Chirp => Self::Chirp,
            ExciteArgument::Steps => Self::Steps,
        }
    }
}

/// The controller of the rollouts: its name for the header, and the bytes of its file for each rollout.
struct RunController {
    name: String,
    files: Vec<Vec<u8>>,
    steps: u32,
    /// Note for the operator before the first rollout.
    note: Option<String>,
    /// Policy of a file; `None` for an excitation.
    policy: Option<Policy>,
}

impl RunController {
    fn chosen(arguments: &Arguments) -> Result<Self, Failure> {
        if let Some(argument) = arguments.excite {
            let shape = ExcitationShape::from(argument);
            let excitation = |rollout| Excitation::of_rollout(shape, arguments.volts, rollout);
            let file = |rollout| Policy::Excitation(excitation(rollout)).to_bytes();
            return Ok(Self {
                name: format!("excitation by {}", format!("{shape:?}").to_lowercase()),
                files: [0, 1].map(file).into(),
                steps: EXCITATION_STEPS,
                note: None,
                policy: None,
            });
        }
        let name = arguments.policy.clone().unwrap_or_default();
        let policy = policy(&name)?;
        let note = trained_on_true_states(&policy).then(|| {
            format!(
                "note: {name} was trained on true states, which no Qube shows: encoders and estimator may \
                 make it fall at once. `train --preset robust` makes policies for a Qube"
            )
        });
        let files = vec![policy.to_bytes()];
        Ok(Self { files, name, steps: MAX_STEPS as u32, note, policy: Some(policy) })
    }

    /// Checks that the policy was made for this plant.
    fn check_plant(&self, plant: &PlantModel) -> Result<(), Failure> {
        let checked = self.policy.as_ref().map_or(Ok(()), |policy| policy.check_plant(plant));
        checked.map_err(|other| Failure::usage(format!("{}: {other}", self.name)))
    }

    /// The file of a rollout.
    fn file(&self, rollout: u32) -> &[u8] {
        &self.files[rollout as usize % self.files.len()]
    }
}

/// Runs the rollouts and prints their returns, whatever ends them.
pub fn run(arguments: Arguments, output: &Output) -> Result<(), Failure> {
    let controller = RunController::chosen(&arguments)?;
    let stop = Stop::on_signals()?;

    let device = arguments.device.choose()?;
    let plant = device.plant;
    controller.check_plant(&plant)?;
    let estimator = arguments.estimator.settings(&plant)?.unwrap_or_default();
    let profile = device.profile.as_ref().map(Profile::model);
    let emulated = arguments.emulated.of_plant(&plant)?;
    let emulator = emulated.emulator(arguments.seed);
    let guard = arguments.guard.into();
    let safety_box = SafetyBox { guard, ..SafetyBox::default() }.within_travel(&plant);
    let safety_box = device.safety_box(safety_box);
    let consent = arguments.consent.beside(Some(arguments.guard))?;
    let settings = RigSettings {
        limits: device.limits("--guard", &safety_box, consent)?,
        ..device.rig_settings(emulator, estimator, arguments.check)
    };
    let folder = OutputFolder::make(arguments.out.as_deref(), "run")?;
    folder.check_for_recordings(arguments.rollouts.into())?;
    let directory = folder.path().to_owned();
    if let Some(note) = &controller.note {
        tell(note);
    }
    let keyboard = Keyboard::watch(&stop);
    eprintln!("{}", keyboard.hint());
    if let Some(warning) = device.power_warning() {
        eprintln!("warning: {warning}");
    }
    if let Some(warning) = unidentified(&settings, safety_box.guard) {
        eprintln!("warning: {warning}");
    }
    if settings.checks() {
        eprintln!("checking the Qube: the arm is pushed a little (--skip-check leaves it out)");
    }
    if settings.homing.method == HomingMethod::Stops {
        eprintln!("homing: the arm looks for its stops");
    }
    let plan = RolloutPlan {
        seed: arguments.seed,
        estimator,
        safety_box,
        steps: controller.steps,
        ..RolloutPlan::single("run", &controller.name)
    };
    let mut results = Results { excited: arguments.excite.is_some(), ..Results::default() };
    let mut series =
        Series { settings, plan, controller, directory, stop: &stop, keyboard: &keyboard };
    let ended = series.run(arguments.rollouts, &mut results);
    drop(keyboard);

    if let Some(profile) = profile.filter(|_| !results.first.is_empty()) {
        results.compare(&profile);
    }
    match &ended {
        Err(failure) if failure.is_usage() && results.returns.is_empty() => {}
        _ => {
            let mut json = results.json();
            json["ended_by"] = json!(ended.as_ref().err().map(Failure::ended_by));
            output.print(&results.text(), &json);
        }
    }
    ended
}

/// Several rollouts of one policy.
struct Series<'a> {
    settings: RigSettings,
    plan: RolloutPlan,
    controller: RunController,
    directory: PathBuf,
    stop: &'a Stop,
    keyboard: &'a Keyboard,
}

impl Series<'_> {
    fn run(&mut self, rollouts: u32, results: &mut Results) -> Result<(), Failure> {
        let mut rig = self.open()?;
        warn_without_realtime(rig.realtime());
        std::fs::create_dir_all(&self.directory).map_err(|error| {
            Failure::usage(format!("--out {}: {error}", self.directory.display()))
        })?;
        for rollout in 0..rollouts {
            let recorded = self.rollout(&mut rig, rollout)?;
            results.add(&recorded.path)?;
            if self.stop.requested() {
                break;
            }
            let last = rollout + 1 == rollouts;
            if let Ending::Fault(fault) = recorded.outcome.ending
                && !last
            {
                rig = self.after_fault(rig, fault)?;
            }
        }
        if self.stop.requested() {
            return Err(self.stop.failure("stopped; the recordings are whole up to here"));
        }
        match results.fault {
            Some(fault) => Err(Failure::fault(told(fault)).of(Some(fault))),
            None => results.gaps(),
        }
    }

    /// Opens the rig. The operator may acknowledge a remembered doubt at a terminal.
    fn open(&mut self) -> Result<Rig, Failure> {
        let opened = match Rig::open(&self.settings, &self.stop.flag) {
            Err(RigError::InDoubt(doubt)) if self.keyboard.acknowledges(&doubt, self.stop) => {
                self.settings.recovery.acknowledged = true;
                Rig::open(&self.settings, &self.stop.flag)
            }
            opened => opened,
        };
        self.settings.recovery.acknowledged = false;
        opened.map_err(|error| failures::rig(error, self.stop))
    }

    fn rollout(&self, rig: &mut Rig, rollout: u32) -> Result<Recorded, Failure> {
        let plan = RolloutPlan { rollout, ..self.plan.clone() };
        let path = self.directory.join(format!("rollout-{rollout}.mcap"));
        let mut tries = 0;
        loop {
            match rig.rollout(&MachineDisk, &path, plan.header(), self.controller.file(rollout)) {
                Ok(recorded) => return Ok(recorded),
                Err(error @ RigError::NotBegun { .. }) if tries < MAX_NOT_BEGUN => {
                    tell(&format!("rollout {rollout} begins again: {error}"));
                    rig.start_again().map_err(|error| failures::rig(error, self.stop))?;
                    tries += 1;
                }
                Err(error) => return Err(failures::rig(error, self.stop)),
            }
        }
    }

    /// Restarts the rig after a fault, where the fault or the operator allows it.
    fn after_fault(&mut self, mut rig: Rig, fault: Fault) -> Result<Rig, Failure> {
        match rig.start_again() {
            Ok(()) => Ok(rig),
            Err(RigError::InDoubt(doubt)) if self.keyboard.acknowledges(&doubt, self.stop) => {
                drop(rig);
                self.settings.recovery.acknowledged = true;
                self.settings.recovery.doubt = Some(*doubt);
                let opened = self.open();
                self.settings.recovery.doubt = None;
                opened
            }
            Err(error @ (RigError::InDoubt(_) | RigError::Ended { .. })) => {
                Err(failures::rig(error, self.stop))
            }
            Err(error) => {
                let failure = failures::rig(error, self.stop);
                Err(failure.after(&format!("a fault ended the last rollout ({fault}), and then")))
            }
        }
    }
}

/// The message for a fault that ended the last rollout, with the operator's step.
fn told(fault: Fault) -> String {
    let then = if fault.leaves_doubt() {
        ". Then start again with --acknowledge: the Qube is examined first"
    } else {
        ""
    };
    let step = fault.operator_step().trim_end_matches('.');
    format!("the last rollout was ended by a fault: {fault}. {step}{then}")
}

fn policy(name: &str) -> Result<Policy, Failure> {
    if name == "classical" {
        return Ok(Policy::Classical(ClassicalController::new(ClassicalGains::default())));
    }
    Policy::load(Path::new(name)).map_err(|error| failures::policy(&error))
}

fn trained_on_true_states(policy: &Policy) -> bool {
    matches!(policy, Policy::Network(it) if it.training.sensors == SimulatedSensors::TrueState)
}

/// Whether `identify` can use the recording of an excitation, as a sentence.
fn fitness(recording: &Recording) -> String {
    let Some(log) = MotionLog::of_recording(recording) else {
        return "no motion: `identify` cannot use it".into();
    };
    let duration_s = log.samples.last().map_or(0.0, |last| last.time_s);
    match check_recording(&log) {
        Ok(()) => format!("{duration_s:.1} s recorded, fit for identify"),
        Err(unfit) => format!("{duration_s:.1} s recorded, but not fit for identify: {unfit}"),
    }
}

fn volts(text: &str) -> Result<f64, String> {
    between(text, 0.1, 3.0)
}

/// The results of the rollouts, read from their recordings.
#[derive(Debug, Default)]
struct Results {
    lines: String,
    /// Whether an excitation drove the Qube, so that `identify`'s use of it is reported.
    excited: bool,
    /// Returns; `None` for a rollout without a result.
    returns: Vec<Option<f64>>,
    ended_early: Vec<Option<String>>,
    success: Vec<bool>,
    recordings: Vec<PathBuf>,
    latencies: Latencies,
    /// Quietness of balancing, if the policy balanced.
    quietness: Quietness,
    /// Number of observer resets.
    observer_resets: u64,
    /// Largest load of the motor; `None` if no recording has it.
    largest_motor_load: Option<f64>,
    /// Fault that ended the last rollout, if one did.
    fault: Option<Fault>,
    /// Reason why the last rollout is void without a fault.
    void: Option<String>,
    /// Recordings of the first rollouts with a result.
    first: Vec<Recording>,
    /// Drift of the rig from its profile, or the reason why it cannot be estimated.
    drift: Option<Result<Drift, Unfit>>,
}

impl Results {
    fn add(&mut self, path: &Path) -> Result<(), Failure> {
        let recording = read(path).map_err(|error| failures::recording(&error))?;
        self.latencies.add(&recording.ticks);
        self.quietness.add(&recording.ticks);
        let outcome = recording.outcome.as_ref();
        self.observer_resets += outcome.map_or(0, |outcome| u64::from(outcome.observer_resets));
        // `None` is less than any number.
        let load = outcome.and_then(|outcome| outcome.largest_motor_load);
        if self.largest_motor_load < load {
            self.largest_motor_load = load;
        }
        let rollout = self.returns.len();
        (self.fault, self.void) = (None, None);
        let _ = match score_recording(&recording) {
            Verdict::Result { return_, success, outcome } => {
                let ended_early = match outcome.ending {
                    Ending::LeftBox(limit) => Some(format!("left the box: {limit}")),
                    _ => None,
                };
                let word = match &ended_early {
                    _ if self.excited => fitness(&recording),
                    Some(reason) => format!("{reason} after {} steps", outcome.steps),
                    None if success => "success".into(),
                    None => "not balancing at the end".into(),
                };
                self.returns.push(Some(return_));
                self.ended_early.push(ended_early);
                self.success.push(success);
                if self.excited {
                    writeln!(self.lines, "rollout {rollout}: {word}")
                } else {
                    writeln!(self.lines, "rollout {rollout}: return {return_:6.1}  {word}")
                }
            }
            Verdict::Void { reason } => {
                match outcome.map(|outcome| outcome.ending) {
                    Some(Ending::Fault(fault)) => self.fault = Some(fault),
                    _ => self.void = Some(reason.clone()),
                }
                self.no_result(format!("void: {reason}"))
            }
            Verdict::Unfinished => self.no_result("stopped".into()),
        };
        self.recordings.push(path.to_owned());
        if self.fault.is_none() && self.void.is_none() && self.first.len() < DRIFT_ROLLOUTS {
            self.first.push(recording);
        }
        Ok(())
    }

    /// Checks that the last rollout is not void without a fault.
    fn gaps(&self) -> Result<(), Failure> {
        match &self.void {
            Some(reason) => Err(Failure::fault(format!("the last rollout is void: {reason}"))),
            None => Ok(()),
        }
    }

    /// Compares the first rollouts with the profile.
    fn compare(&mut self, profile: &QubeModel) {
        self.drift = Some(Drift::of(&self.first, profile));
    }

    fn no_result(&mut self, why: String) -> std::fmt::Result {
        let rollout = self.returns.len();
        self.returns.push(None);
        self.success.push(false);
        self.ended_early.push(Some(why.clone()));
        writeln!(self.lines, "rollout {rollout}: {why}")
    }

    fn text(&self) -> String {
        let directory = self.recordings.first().and_then(|path| path.parent());
        let directory = directory.unwrap_or(Path::new(".")).display();
        let astray = observer_resets_line(self.observer_resets);
        let next = if self.excited {
            format!("\nqube-hil identify {directory}/*.mcap says which Qube this is")
        } else {
            String::new()
        };
        if self.recordings.is_empty() {
            return "no rollout was run".into();
        }
        let quietness = quietness_line(&self.quietness);
        let heat = heat_line(self.largest_motor_load);
        let timing = timing_lines(&self.latencies);
        let drift = match &self.drift {
            Some(Ok(drift)) => format!("{}\n", command_hints::drift(drift)),
            Some(Err(unfit)) => {
                format!("these rollouts say nothing of how the rig is today: {unfit}\n")
            }
            None => String::new(),
        };
        format!(
            "{}{astray}{quietness}{heat}{drift}{timing}recordings in {directory}{next}",
            self.lines
        )
    }

    fn json(&self) -> Value {
        json!({
            "returns": self.returns,
            "ended_early": self.ended_early,
            "success": self.success,
            "times_astray": self.observer_resets,
            "balancing": self.quietness.figures(),
            "largest_motor_load": self.largest_motor_load,
            "missed_deadlines": self.latencies.missed_deadlines(),
            "lateness_us": self.latencies.lateness_us(),
            "sample_to_act_us": self.latencies.sample_to_act_us(),
            "recordings": self.recordings.iter().map(|path| path.to_string_lossy()).collect::<Vec<_>>(),
            "drift": self.drift.as_ref().and_then(|drift| drift.as_ref().ok()),
        })
    }
}

#[cfg(test)]
mod tests;
