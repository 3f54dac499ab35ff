use std::path::PathBuf;
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use super::check_arguments::CheckArguments;
use super::chosen_device::ChosenDevice;
use super::command_hints::before_motion;
use super::destination::{OutputFolder, recording_of};
use super::device_arguments::DeviceArguments;
use super::exit::Failure;
use super::keyboard::{CtrlZ, Keyboard};
use super::number_arguments::positive;
use super::output::Output;
use super::printable::print_message;
use super::run::policy;
use super::screen::{Screen, left_in_words, time_left};
use super::stop::Stop;
use super::{failures, warn_without_realtime};
use crate::device::emulator::EmulatorSettings;
use crate::estimation::EstimatorSettings;
use crate::qube::CONTROL_PERIOD_NS;
use crate::recording::{Recording, read};
use crate::rig::{NotBegun, Rig, RolloutPlan};
use crate::safety::SafetyBox;
use crate::scoring::{Verdict, VoidReason, score_recording};
use crate::storage::MachineDisk;
use crate::telemetry::Ending;

/// Largest growth of the program's memory after the warm-up, bytes.
const MAX_GROWTH_BYTES: i64 = 5_000_000;

/// Shortest time between two lines of progress.
const LINE_INTERVAL: Duration = Duration::from_secs(30);

/// Largest number of lines of progress.
const LINES: u64 = 100;

/// Number of rollouts after which buffers, stacks and caches have their final size; the growth of
/// the memory counts from there.
const WARM_UP_ROLLOUTS: u64 = 20;

/// Run for hours: rollout after rollout of one policy, each recorded, read back and checked;
/// fails if a tick is lost, a fault ends a rollout, or the memory grows
///
/// With `--clock virtual` a day takes minutes. Exit code 3 when a tick was lost, 4 when a fault
/// ended a rollout, 1 when the memory grew by more than 5 MB after the first 20 rollouts.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    qube-hil soak --clock virtual                # 24 hours of ticks\n  \
    qube-hil soak --hours 1                      # an hour by the wall clock, over a pty\n  \
    qube-hil soak --hours 8 --device /dev/ttyACM0")]
pub struct Arguments {
    /// Hours of ticks
    #[arg(long, default_value_t = 24.0, value_parser = hours)]
    hours: f64,

    /// Policy file, or `classical` for the built-in energy swing-up with balance, which is for a
    /// Qube only
    #[arg(long, value_name = "FILE|classical", default_value = "classical")]
    policy: PathBuf,

    /// Seed of the arm's start angles and of the emulated Qube
    #[arg(long, default_value_t = 0)]
    seed: u64,

    /// Folder in which the recordings are kept; without it each is deleted once it is checked
    #[arg(long, value_name = "DIR")]
    keep: Option<PathBuf>,

    #[command(flatten)]
    device: DeviceArguments,

    #[command(flatten)]
    check: CheckArguments,
}

/// Parses a number of hours above 0, at most 10 000 (417 days).
fn hours(text: &str) -> Result<f64, String> {
    positive(text, 10_000.0)
}

/// Runs rollouts until the hours are over, a failure or a stop ends them, and prints the summary.
pub fn run(arguments: Arguments, output: &Output) -> Result<(), Failure> {
    let stop = Stop::on_signals()?;
    let policy = policy(&arguments.policy)?;
    let device = arguments.device.choose()?;
    policy.check_plant(&device.plant).map_err(|other| {
        Failure::usage(format!("--policy {}: {other}", arguments.policy.display()))
    })?;
    let folder = Folder::new(arguments.keep.clone())?;
    let keyboard =
        Keyboard::watch(&stop, &Screen::none().progress(), CtrlZ::with([&device.choice]));
    let started = Instant::now();
    let mut soaked = Soaked::default();
    let mut ended = soaked.soak(&arguments, &policy.to_bytes(), &device, &folder, &stop);
    drop(keyboard);
    if stop.requested() {
        let stopped = "stopped before the hours were over";
        ended = Err(match ended {
            Err(failure) if !failure.is_stop() => failure.preceded_by(&format!("{stopped}; but")),
            Err(_) | Ok(()) => match soaked.verdict() {
                Err(failure) => failure.preceded_by(&format!("{stopped}; but")),
                Ok(()) => stop.failure(stopped),
            },
        });
    }
    let ended = ended.and_then(|()| soaked.verdict());
    match &ended {
        Err(failure) if failure.is_usage() && soaked.rollouts == 0 => {}
        _ => {
            let mut result = soaked.json(&ended);
            result["wall_s"] = json!(started.elapsed().as_secs_f64());
            output.print(&soaked.text(), &result);
        }
    }
    ended
}

/// Folder of the recordings. Dropping the value deletes the folder, unless the recordings are kept.
struct Folder {
    path: PathBuf,
    keeps: bool,
}

impl Folder {
    fn new(keep: Option<PathBuf>) -> Result<Self, Failure> {
        let keeps = keep.is_some();
        let name = format!("qube-hil-soak-{}", std::process::id());
        let path = keep.unwrap_or_else(|| std::env::temp_dir().join(name));
        // The soak deletes its temporary folder in the end, so the folder must be new: `create_dir`
        // refuses one that another program has created.
        let made = if keeps { std::fs::create_dir_all(&path) } else { std::fs::create_dir(&path) };
        made.map_err(|error| failures::not_written(&path, &error))?;
        OutputFolder::make(Some(&path), "soak")?.check_for_recordings(u64::MAX)?;
        Ok(Self { path, keeps })
    }

    /// Deletes a recording that is checked, unless the recordings are kept.
    fn delete_unless_kept(&self, recording: &std::path::Path) -> Result<(), Failure> {
        if self.keeps {
            return Ok(());
        }
        std::fs::remove_file(recording).map_err(|error| {
            Failure::failed(format!("{} cannot be deleted: {error}", recording.display()))
        })
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        if !self.keeps {
            let _ = std::fs::remove_dir_all(&self.path);
        }
    }
}

/// The statistics of the rollouts so far. Their size does not grow with the number of rollouts, so
/// they add nothing to the growth of the memory.
#[derive(Debug, Default)]
struct Soaked {
    rollouts: u64,
    ticks: u64,
    /// Number of ticks missing in the recordings, and 1 for each recording without an end.
    lost: u64,
    missed_deadlines: u64,
    void: u64,
    last_was_void: bool,
    last_void_reason: Option<VoidReason>,
    largest_lateness_ns: u64,
    memory_at_start_bytes: Option<i64>,
    memory_bytes: i64,
}

impl Soaked {
    /// Runs rollouts until the hours are over or a stop is requested.
    fn soak(
        &mut self,
        arguments: &Arguments,
        policy: &[u8],
        device: &ChosenDevice,
        folder: &Folder,
        stop: &Stop,
    ) -> Result<(), Failure> {
        let failed = |error| failures::rig(error, stop);
        let estimator = EstimatorSettings::default();
        let model = device.plant.nominal();
        let emulator =
            EmulatorSettings { model, seed: arguments.seed, ..EmulatorSettings::default() };
        let settings = device.rig_settings(emulator, estimator, arguments.check);
        let safety_box = device.safety_box(SafetyBox::default());
        for warning in before_motion(device.power_warning(), &settings, safety_box.guard) {
            print_message(&format!("warning: {warning}"));
        }
        let mut rig = Rig::open(&settings, &stop.flag).map_err(failed)?;
        warn_without_realtime(rig.realtime());

        let ticks_wanted = (arguments.hours * 3600e9 / CONTROL_PERIOD_NS as f64).ceil() as u64;
        let began = Instant::now();
        // Time and tick of the last line of progress.
        let mut last_line = (began, 0);
        let mut not_begun = NotBegun::default();
        while self.ticks < ticks_wanted && !stop.requested() {
            let rollout = self.rollouts as u32;
            let path = recording_of(&folder.path, rollout);
            let plan = RolloutPlan {
                rollout,
                seed: arguments.seed,
                estimator,
                safety_box,
                ..RolloutPlan::single("soak", &arguments.policy.to_string_lossy())
            };
            match rig.rollout(&MachineDisk, &path, plan.header(), policy) {
                Ok(_) => not_begun.reset(),
                Err(error) if not_begun.may_repeat(&error) => {
                    rig.start_again().map_err(failed)?;
                    continue;
                }
                Err(error) => return Err(failed(error)),
            }
            self.add(&read(&path).map_err(|error| failures::recording(&error))?);
            folder.delete_unless_kept(&path)?;
            let ticks = self.ticks;
            if last_line.0.elapsed() >= LINE_INTERVAL
                && (ticks - last_line.1) * LINES >= ticks_wanted
            {
                last_line = (Instant::now(), ticks);
                let to_do = ticks_wanted.saturating_sub(ticks);
                let left = left_in_words(time_left(began.elapsed(), ticks as f64, to_do as f64));
                print_message(&format!("{:.2} h of {} h{left}", self.hours(), arguments.hours));
            }
            if self.last_was_void && !stop.requested() {
                rig.start_again().map_err(failed)?;
            }
        }
        rig.check_off().map_err(failed)
    }

    fn add(&mut self, recording: &Recording) {
        self.rollouts += 1;
        self.ticks += recording.ticks.len() as u64;
        let numbered = recording.ticks.last().map_or(0, |last| u64::from(last.tick) + 1);
        let reported_lost = recording.outcome.as_ref().map_or(0, |outcome| outcome.records_lost);
        self.lost += reported_lost.max(numbered - recording.ticks.len() as u64);
        let missed = recording.outcome.as_ref().map_or(0, |outcome| outcome.missed_deadlines);
        self.missed_deadlines += u64::from(missed);
        let latest = recording.ticks.iter().map(|tick| tick.lateness_ns).max();
        self.largest_lateness_ns = self.largest_lateness_ns.max(latest.unwrap_or(0));
        let stopped = recording.outcome.as_ref().is_some_and(|it| it.ending == Ending::Stopped);
        self.last_was_void = match score_recording(recording) {
            Verdict::Void { reason } => {
                self.void += 1;
                self.last_void_reason = Some(reason);
                true
            }
            Verdict::Result { .. } => false,
            Verdict::Unfinished => {
                // The recording has no end, although no stop was requested.
                self.lost += u64::from(!stopped);
                false
            }
        };
        self.memory_bytes = resident_bytes();
        if self.rollouts == WARM_UP_ROLLOUTS {
            self.memory_at_start_bytes = Some(self.memory_bytes);
        }
    }

    fn hours(&self) -> f64 {
        (self.ticks * CONTROL_PERIOD_NS) as f64 / 3600e9
    }

    /// Growth of the program's memory since the warm-up, bytes; `None` before its end.
    fn growth_bytes(&self) -> Option<i64> {
        let start = self.memory_at_start_bytes.filter(|_| self.rollouts > WARM_UP_ROLLOUTS);
        start.map(|start| self.memory_bytes - start)
    }

    fn verdict(&self) -> Result<(), Failure> {
        if self.lost > 0 {
            return Err(Failure::data_lost(format!("{} ticks were lost", self.lost)));
        }
        if let Some(reason) = &self.last_void_reason {
            let void = self.void;
            return Err(Failure::fault(format!("{void} rollouts are void, last: {reason}")));
        }
        match self.growth_bytes() {
            Some(growth) if growth > MAX_GROWTH_BYTES => Err(Failure::failed(format!(
                "the memory grew by {growth} bytes, more than {MAX_GROWTH_BYTES}"
            ))),
            _ => Ok(()),
        }
    }

    fn text(&self) -> String {
        let growth = match self.growth_bytes() {
            Some(growth) => format!("{:+.2} MB", growth as f64 * 1e-6),
            None => format!("not measured in {WARM_UP_ROLLOUTS} rollouts or fewer"),
        };
        format!(
            "{} ticks ({:.2} h) in {} rollouts: {} lost, {} missed deadlines, {} rollouts void\n\
             latest wake-up {:.0} us; memory {:.1} MB, growth {growth}",
            self.ticks,
            self.hours(),
            self.rollouts,
            self.lost,
            self.missed_deadlines,
            self.void,
            self.largest_lateness_ns as f64 * 1e-3,
            self.memory_bytes as f64 * 1e-6,
        )
    }

    /// The statistics for scripts, with the reason why the command fails, if it does.
    fn json(&self, ended: &Result<(), Failure>) -> Value {
        json!({
            "ended_by": ended.as_ref().err().map(Failure::ended_by),
            "ticks": self.ticks,
            "hours": self.hours(),
            "rollouts": self.rollouts,
            "lost": self.lost,
            "missed_deadlines": self.missed_deadlines,
            "void": self.void,
            "memory_bytes": self.memory_bytes,
            "growth_bytes": self.growth_bytes(),
        })
    }
}

/// Resident memory of this process, bytes, from the line `VmRSS:  1234 kB` of /proc/self/status; 0
/// if the file cannot be read.
fn resident_bytes() -> i64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    let kilobytes = line.and_then(|text| text.split_whitespace().next()?.parse::<i64>().ok());
    kilobytes.unwrap_or(0) * 1024
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scripts_get_the_reason_why_a_soak_that_ran_to_its_end_fails() {
        let lost = Soaked { lost: 2, ..Soaked::default() };
        let void =
            Soaked { void: 1, last_void_reason: Some(VoidReason::LostTicks), ..Soaked::default() };
        for (soaked, exit_code) in [(lost, 3), (void, 4)] {
            let ended_by = &soaked.json(&soaked.verdict())["ended_by"];
            assert_eq!(ended_by["exit_code"], exit_code, "{ended_by}");
        }
        let well = Soaked::default();
        assert!(well.json(&well.verdict())["ended_by"].is_null());
    }
}
