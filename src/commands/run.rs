mod controller;
mod results;
mod series;
#[cfg(test)]
mod tests;

use std::path::PathBuf;

use clap::{ArgGroup, ValueEnum};
use serde_json::json;

pub use self::controller::policy;
use self::controller::{RunController, randomisation};
use self::results::RunResults;
use self::series::RolloutSeries;
use super::check_arguments::CheckArguments;
use super::chosen_device::ChosenDevice;
use super::command_hints::before_motion;
use super::destination::OutputFolder;
use super::device_arguments::DeviceArguments;
use super::emulated_arguments::EmulatedArguments;
use super::estimator_arguments::EstimatorArguments;
use super::exit::Failure;
use super::guard_argument::{ConsentArgument, GuardArgument, guard_parser};
use super::keyboard::{CtrlZ, Keyboard};
use super::live::LiveArguments;
use super::number_arguments::between;
use super::output::Output;
use super::printable::print_message;
use super::screen::ScreenArgument;
use super::stop::Stop;
use crate::policy::ExcitationShape;
use crate::rig::{RigSettings, RolloutPlan};
use crate::safety::SafetyBox;

/// Run a policy on the Qube and record it: homing, then for each rollout settling, six seconds of
/// policy, braking; or excite the Qube for `identify`
///
/// Exit code 0 also if the box or the guard ended a rollout, because such a rollout has a result; 4
/// if a fault ended the command, or the last rollout is void.
#[derive(Debug, clap::Args)]
#[command(group = ArgGroup::new("controller").args(["policy", "excite"]).required(true))]
#[command(after_help = "Examples:\n  \
    qube-hil run --policy classical              # a swing-up without training, for the ideal Qube\n  \
    qube-hil run --policy policies/robust.safetensors --rollouts 5\n  \
    qube-hil run --policy best.safetensors --device /dev/ttyACM0 --out logs/monday\n  \
    qube-hil run --policy best.safetensors --profile lab --clock virtual\n  \
    qube-hil run --excite chirp --rollouts 4 --out logs/chirps      # for identify\n  \
    qube-hil run --policy classical --qube qube.toml     # from check --write")]
pub struct Arguments {
    /// Policy file, or `classical` for the built-in energy swing-up with balance, which is tuned
    /// for the ideal Qube: with friction, cable and delay (--profile lab, a real Qube) it may fail;
    /// this or --excite is required
    #[arg(long, value_name = "FILE|classical")]
    policy: Option<PathBuf>,

    /// Instead of a policy, apply a voltage for 10 s that makes a recording for `identify`;
    /// consecutive rollouts start in opposite directions. Box and guard apply as for a policy
    #[arg(long, value_enum, conflicts_with = "policy")]
    excite: Option<ExciteArgument>,

    /// Largest voltage of the excitation itself, 0.1 to 3; if the arm does not move under it, a
    /// test push of 0.4 V more in each tick comes on top until the count moves
    #[arg(long, value_name = "V", default_value_t = 1.5, value_parser = volts, requires = "excite",
          conflicts_with = "policy")]
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

    #[command(flatten)]
    live: LiveArguments,

    #[command(flatten)]
    screen: ScreenArgument,
}

/// The excitations by name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum ExciteArgument {
    /// A cosine from 5 Hz down to 1 Hz
    Chirp,
    /// A cosine from 2 Hz down to 0.5 Hz, for small voltages
    SlowChirp,
    /// Voltages held for 0.05 to 0.2 s in a pseudo-random order
    Steps,
    /// Pushes that raise the pendulum to about 75 degrees and calm it again
    Pushes,
}

impl From<ExciteArgument> for ExcitationShape {
    fn from(argument: ExciteArgument) -> Self {
        match argument {
            ExciteArgument::Chirp => Self::Chirp,
            ExciteArgument::SlowChirp => Self::SlowChirp,
            ExciteArgument::Steps => Self::Steps,
            ExciteArgument::Pushes => Self::Pushes,
        }
    }
}

fn volts(text: &str) -> Result<f64, String> {
    between(text, 0.1, 3.0)
}

/// Runs the rollouts and prints their results, also after a failure or a stop, unless the command
/// was refused before the first rollout ended.
pub fn run(arguments: Arguments, output: &Output) -> Result<(), Failure> {
    let controller = RunController::chosen(&arguments)?;
    let stop = Stop::on_signals()?;

    let device = arguments.device.choose()?;
    controller.check_plant(&device.plant)?;
    let profile = device.profile.clone();
    let (settings, plan) = settings_and_plan(&arguments, &device)?;
    let folder = OutputFolder::make(arguments.out.as_deref(), "run")?;
    let _lock = folder.lock()?;
    folder.check_for_recordings(arguments.rollouts.into())?;
    device.check_port_exists()?;
    let directory = folder.path().to_owned();
    let estimator_note = controller.estimator_note(&plan.estimator);
    controller.notes.iter().chain(&estimator_note).for_each(|note| print_message(note));
    let randomisation = controller.policy.as_ref().and_then(randomisation).map(|it| json!(it));
    let title = format!("qube-hil run: {} in {}", controller.name, directory.display());
    let screen = arguments.screen.open(&title, output, &stop);
    let live = arguments.live.serve("run", &stop)?;
    let viewers = screen.viewer().into_iter().chain(live.viewer()).collect();
    screen.progress().update(|state| state.live = live.url());
    let settings = RigSettings { viewers, ..settings };
    let keyboard = Keyboard::watch(&stop, &screen.progress(), CtrlZ::with([&settings.device]));
    // The screen shows its own line of keys.
    if !screen.progress().has_screen() {
        print_message(&keyboard.hint());
    }
    for warning in before_motion(device.power_warning(), &settings, plan.safety_box.guard) {
        print_message(&format!("warning: {warning}"));
    }
    let plan = RolloutPlan { steps: controller.steps, policy: controller.name.clone(), ..plan };
    let mut results = RunResults::new(arguments.excite.map(|_| device.described()));
    let mut series = RolloutSeries {
        settings,
        described: device.described(),
        plan,
        controller,
        directory,
        stop: &stop,
        keyboard: &keyboard,
        live: &live,
        progress: screen.progress(),
    };
    let ended = series.run(arguments.rollouts, &mut results);
    drop(keyboard);
    drop(screen);

    if let Some(profile) = &profile {
        results.compare(profile);
    }
    match &ended {
        Err(failure) if failure.is_usage() && results.is_empty() => {}
        _ => {
            let mut json = results.json();
            json["randomisation"] = json!(randomisation);
            json["ended_by"] = json!(ended.as_ref().err().map(Failure::ended_by));
            output.print(&results.text(), &json);
        }
    }
    ended
}

/// Returns the settings of the rig and the plan of the rollouts, without the controller.
fn settings_and_plan(
    arguments: &Arguments,
    device: &ChosenDevice,
) -> Result<(RigSettings, RolloutPlan), Failure> {
    let plant = device.plant;
    let estimator = arguments.estimator.settings(&plant)?.unwrap_or_default();
    arguments.emulated.check_device(device)?;
    let emulator = arguments.emulated.of_plant(&plant)?.emulator(arguments.seed);
    let guard = arguments.guard.into();
    let safety_box = SafetyBox { guard, ..SafetyBox::default() }.within_travel(&plant);
    let safety_box = device.safety_box(safety_box);
    let consent = arguments.consent.with_guard(Some(arguments.guard))?;
    let settings = RigSettings {
        limits: device.limits("--guard", &safety_box, consent)?,
        ..device.rig_settings(emulator, estimator, arguments.check)
    };
    let seed = arguments.seed;
    let plan = RolloutPlan { seed, estimator, safety_box, ..RolloutPlan::single("run", "") };
    Ok((settings, plan))
}

/// Returns the settings of the rig and the plan of the rollouts for a controller of the caller.
pub fn for_external(arguments: &Arguments) -> Result<(RigSettings, RolloutPlan), Failure> {
    settings_and_plan(arguments, &arguments.device.choose()?)
}
