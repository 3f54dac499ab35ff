//! Tests in virtual time that a computer that stalls again and again raises no doubt about a
//! healthy Qube: a motion that a stall ends has a fault after which the rollout may be repeated.

use std::path::Path;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex, PoisonError};

use qube_hil::clock::{Clock, Nanoseconds, VirtualClock};
use qube_hil::control::{HomingMethod, HomingSettings};
use qube_hil::device::emulator::EmulatorSettings;
use qube_hil::device::{DeviceError, SerialLink};
use qube_hil::policy::{ClassicalController, ClassicalGains, Policy};
use qube_hil::qube::Profile;
use qube_hil::rig::{Connect, DeviceChoice, Rig, RigError, RigSettings, RolloutPlan, TimedDevice};
use qube_hil::storage::MachineDisk;
use qube_hil::telemetry::{Ending, Fault};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Mean times between stalls, s.
const EVERY_S: [f64; 3] = [0.5, 1.0, 2.0];

/// Longest durations of a stall, s: one late tick, nearly the longest that a motion survives, and
/// longer.
const LONGEST_S: [f64; 3] = [0.012, 0.034, 0.06];

/// Shortest duration of a stall, s.
const SHORTEST_S: f64 = 0.004;

/// A clock on which waits end late now and then, at random times.
#[derive(Debug)]
struct LateClock {
    time: VirtualClock,
    late: Mutex<Late>,
}

#[derive(Debug)]
struct Late {
    random: ChaCha8Rng,
    every_s: f64,
    longest_s: f64,
    next_ns: Nanoseconds,
}

impl Clock for LateClock {
    fn now_ns(&self) -> Nanoseconds {
        self.time.now_ns()
    }

    fn sleep_until(&self, deadline_ns: Nanoseconds) {
        self.time.sleep_until(deadline_ns);
        let mut late = self.late.lock().unwrap_or_else(PoisonError::into_inner);
        if self.time.now_ns() < late.next_ns {
            return;
        }
        let longest_s = late.longest_s;
        let stall_s = late.random.random_range(SHORTEST_S..longest_s);
        self.time.advance((stall_s * 1e9) as Nanoseconds);
        let pause_s = -late.every_s * late.random.random_range(1e-3_f64..1.0).ln();
        late.next_ns = self.time.now_ns() + (pause_s * 1e9) as Nanoseconds;
    }

    fn passes_by_itself(&self) -> bool {
        self.time.passes_by_itself()
    }
}

/// A computer with an emulated Qube and a clock whose stalls are drawn from this seed.
#[derive(Debug)]
struct LateComputer(u64);

impl Connect for LateComputer {
    fn connect(&self, emulator: &EmulatorSettings) -> Result<TimedDevice, DeviceError> {
        let time = VirtualClock::default();
        let link = SerialLink::in_process(*emulator, time.clone());
        let mut random = ChaCha8Rng::seed_from_u64(self.0);
        let (every_s, longest_s) =
            (EVERY_S[random.random_range(0..3)], LONGEST_S[random.random_range(0..3)]);
        let late = Late { random, every_s, longest_s, next_ns: 0 };
        Ok((Box::new(link), Arc::new(LateClock { time, late: Mutex::new(late) })))
    }

    fn is_hardware(&self) -> bool {
        false
    }
}

fn settings(seed: u64) -> RigSettings {
    let lab = Profile::lab().model();
    let lab = EmulatorSettings { model: lab, ..EmulatorSettings::default() };
    let emulator = if seed.is_multiple_of(2) { EmulatorSettings::default() } else { lab };
    let method =
        if (seed / 2).is_multiple_of(2) { HomingMethod::Hand } else { HomingMethod::Stops };
    RigSettings {
        emulator: EmulatorSettings { seed, ..emulator },
        homing: HomingSettings { method, ..HomingSettings::default() },
        ..RigSettings::in_virtual_time(DeviceChoice::Other(Arc::new(LateComputer(seed))))
    }
}

fn rollout(rig: &Rig, seed: u64, path: &Path) -> Result<Ending, RigError> {
    let plan = RolloutPlan { seed, ..RolloutPlan::single("test", "test") };
    let policy = if seed.is_multiple_of(3) {
        let root = Path::new(env!("CARGO_MANIFEST_DIR"));
        Policy::load(&root.join("policies/robust.safetensors")).unwrap()
    } else {
        Policy::Classical(ClassicalController::new(ClassicalGains::default()))
    };
    Ok(rig.rollout(&MachineDisk, path, plan.header(), &policy.to_bytes())?.outcome.ending)
}

/// The fault of an error; its text if it is not in the table of faults.
fn fault_of(error: &RigError) -> Result<Fault, String> {
    error.fault().ok_or_else(|| error.to_string())
}

/// The faults, and the errors without a fault, that ended the homing or a rollout, in up to four
/// rollouts.
fn faults(seed: u64, folder: &Path) -> Vec<Result<Fault, String>> {
    let mut faults = Vec::new();
    let mut rig = match Rig::open(&settings(seed), &Arc::new(AtomicBool::new(false))) {
        Ok(rig) => rig,
        Err(error) => return vec![fault_of(&error)],
    };
    for number in 0..4 {
        match rollout(&rig, seed, &folder.join(format!("{seed}-{number}.mcap"))) {
            Ok(Ending::Fault(fault)) => faults.push(Ok(fault)),
            Ok(_) => continue,
            Err(error) => faults.push(fault_of(&error)),
        }
        if let Err(error) = rig.start_again() {
            faults.push(fault_of(&error));
            break;
        }
    }
    faults
}

/// A number from an environment variable; `default` if the variable is absent or no number.
fn number(name: &str, default: u64) -> u64 {
    std::env::var(name).ok().and_then(|text| text.parse().ok()).unwrap_or(default)
}

/// Drives as many Qubes as the environment variable `RIGS` gives, 40 by default, with seeds from
/// `SEED` on, 1000 by default.
#[test]
fn a_computer_that_stands_still_now_and_then_leaves_no_doubt_about_a_healthy_qube() {
    let folder = tempfile::tempdir().unwrap();
    let (mut late, mut wrong) = (0, Vec::new());
    let first = number("SEED", 1000);
    for seed in first..first + number("RIGS", 40) {
        for ended in faults(seed, folder.path()) {
            match ended {
                Ok(fault) if fault.may_be_repeated() => late += 1,
                Ok(fault) => wrong.push(format!("{seed}: {fault}")),
                Err(error) => wrong.push(format!("{seed}: {error}")),
            }
        }
    }
    println!("{late} motions ended by a late computer");
    assert!(late > 0, "no late computer ended a motion");
    assert!(wrong.is_empty(), "{} faults of a healthy Qube:\n{}", wrong.len(), wrong.join("\n"));
}
