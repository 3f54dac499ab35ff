//! Tests the whole check with homing, and the rollout that follows it.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use qube_hil::control::HomingSettings;
use qube_hil::device::emulator::EmulatorSettings;
use qube_hil::estimation::Calibration;
use qube_hil::policy::Policy;
use qube_hil::preflight::OtherSigns;
use qube_hil::qube::QubeModel;
use qube_hil::rig::{Rig, RigSettings, RolloutPlan};
use qube_hil::storage::MachineDisk;
use qube_hil::telemetry::{Ending, Fault};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::rigs::{DEFECTS, FIRST_SEED, number, of_each, rig, signs_of};

fn connected(emulator: EmulatorSettings, signs: Calibration) -> Rig {
    let homing = HomingSettings { signs, ..HomingSettings::default() };
    let settings = RigSettings { homing, ..RigSettings::emulated(emulator) };
    Rig::connect(&settings, &Arc::new(AtomicBool::new(false))).unwrap()
}

/// The checks that failed, each with its message.
fn refusals(rig: &mut Rig) -> Vec<(String, String)> {
    let found = rig.check(OtherSigns::Fail).unwrap();
    let failed = found.results.into_iter().filter(|result| result.failed());
    failed.map(|result| (result.name, result.value)).collect()
}

fn rollout(rig: &Rig, seed: u64) -> Ending {
    let plan = RolloutPlan { seed, ..RolloutPlan::single("test", "test") };
    let name = ["robust", "nominal"][(seed % 2) as usize];
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("policies/{name}.safetensors"));
    let policy = Policy::load(&path).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("rollout.mcap");
    rig.rollout(&MachineDisk, &path, plan.header(), &policy.to_bytes()).unwrap().outcome.ending
}

/// Describes a rig in a test's output.
fn about(seed: u64, emulator: &EmulatorSettings) -> String {
    let QubeModel { parameters, nonidealities } = &emulator.model;
    format!(
        "{seed} (gap {}, friction {:.1e} N m and {:.1e} N m s, play {:.2} degrees)",
        [0.5, 1.0, 1.5][(seed / 8 % 3) as usize],
        nonidealities.coulomb_torque_n_m,
        parameters.rotary_damping_n_m_s,
        emulator.play_rad.to_degrees(),
    )
}

/// The failures of a healthy rig's check, or else the fault of its first rollout, in words; `None`
/// without either.
fn false_faults(seed: u64) -> Option<String> {
    let emulator = rig(seed);
    let mut opened = connected(emulator, signs_of(emulator.wiring));
    let refused = refusals(&mut opened);
    if !refused.is_empty() {
        return Some(format!("check {}: {refused:?}", about(seed, &emulator)));
    }
    match rollout(&opened, seed) {
        Ending::Fault(fault) => Some(format!("rollout {}: {fault}", about(seed, &emulator))),
        _ => None,
    }
}

/// The defects that may begin during a check. Each has the name of the examination's check that may
/// name the defect, and the faults with which homing may name it.
const LATER: [(&str, &str, &[Fault]); 4] = [
    // If the count freezes while the arm rests, homing reports `ArmHeld`, which names both causes.
    ("frozen-theta", "arm", &[Fault::EncoderFrozen, Fault::ArmHeld]),
    ("frozen-alpha", "pendulum", &[Fault::PendulumFrozen]),
    ("dead-motor", "motor", &[Fault::MotorDead]),
    ("blocked-arm", "stall", &[Fault::ArmHeld, Fault::Stall]),
];

/// Returns whether a check fails for one reason, under one of these names.
fn names(told: &[(String, String)], of_the_examination: &str, of_homing: &[Fault]) -> bool {
    match told {
        [(name, value)] if name == "homing" => {
            of_homing.iter().any(|fault| *value == fault.to_string())
        }
        [(name, _)] => name == of_the_examination,
        _ => false,
    }
}

/// The verdicts on one rig with each single defect. The defect exists from the start or begins
/// during the check.
#[derive(Default)]
struct Verdicts {
    /// The checks that do not name the defect from the start, in words.
    from_the_start: Vec<String>,
    /// The checks that name another defect than the later one, in words.
    later: Vec<String>,
    /// Number of checks that name the later defect.
    later_named: usize,
}

fn verdicts(seed: u64) -> Verdicts {
    let healthy = rig(seed);
    let mut verdicts = Verdicts::default();
    for defect in DEFECTS {
        let (emulator, signs) = defect.of(healthy);
        let told = refusals(&mut connected(emulator, signs));
        if !names(&told, defect.name(), &[]) {
            verdicts.from_the_start.push(format!("{seed} {defect:?}: {told:?}"));
        }
    }
    let with = |text: &str| {
        let emulator = EmulatorSettings { fault: Some(text.parse().unwrap()), ..healthy };
        refusals(&mut connected(emulator, signs_of(healthy.wiring)))
    };
    let told = with("weak-motor@0.3");
    if !names(&told, "motor", &[Fault::MotorWeak]) {
        let about = about(seed, &healthy);
        verdicts.from_the_start.push(format!("{about} weak motor: {told:?}"));
    }
    let mut random = ChaCha8Rng::seed_from_u64(seed + 2_000_000);
    for (fault, of_the_examination, of_homing) in LATER {
        // An examination takes 4 to 15 s, homing 15 to 30 s, so some defects begin too late to be
        // seen.
        let text = format!("{fault}@{:.2}", random.random_range(3.0..25.0));
        let told = with(&text);
        if names(&told, of_the_examination, of_homing) {
            verdicts.later_named += 1;
        } else if !told.is_empty() {
            verdicts.later.push(format!("{} {text}: {told:?}", about(seed, &healthy)));
        }
    }
    verdicts
}

/// Accepted wrong names for each 100 defects that may begin during a check. If the counts of both
/// encoders are constant, only the order in which they became so tells which one failed.
const LATER_PERCENT: usize = 8;

/// Least number of rightly named defects for each 100 that may begin during a check. A check takes
/// at least 19 s, so that seven in ten of them begin before its end.
const LEAST_NAMED_PERCENT: usize = 40;

fn single_defects_are_named(seeds: std::ops::Range<u64>) {
    let rigs = (seeds.end - seeds.start) as usize;
    let found = of_each(seeds, verdicts);
    let all = |of: fn(&Verdicts) -> &Vec<String>| {
        found.iter().flat_map(of).cloned().collect::<Vec<String>>()
    };
    let (from_the_start, later) =
        (all(|verdicts| &verdicts.from_the_start), all(|verdicts| &verdicts.later));
    let later_named: usize = found.iter().map(|verdicts| verdicts.later_named).sum();
    println!(
        "misnamed: {} of {} defects from the start, {} of {} that may begin during the check, of \
         which {later_named} are named\n{}",
        from_the_start.len(),
        rigs * (DEFECTS.len() + 1),
        later.len(),
        rigs * LATER.len(),
        later.join("\n")
    );
    assert!(from_the_start.is_empty(), "{}", from_the_start.join("\n"));
    assert!(100 * later.len() <= LATER_PERCENT * rigs * LATER.len());
    assert!(100 * later_named >= LEAST_NAMED_PERCENT * rigs * LATER.len(), "{later_named} named");
}

fn healthy_rigs_open(seeds: std::ops::Range<u64>) {
    let rigs = seeds.end - seeds.start;
    let wrong: Vec<String> = of_each(seeds, false_faults).into_iter().flatten().collect();
    println!("{rigs} healthy rigs, {} end in a false fault", wrong.len());
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn healthy_rigs_pass_the_whole_check_and_give_a_rollout() {
    healthy_rigs_open(FIRST_SEED..FIRST_SEED + 24);
}

/// The variables `RIGS` and `SEED` give the number of rigs and the first seed:
/// `cargo test --test virtual_time many_healthy -- --ignored --nocapture`.
#[test]
#[ignore = "takes minutes"]
fn many_healthy_rigs_pass_the_whole_check_and_give_a_rollout() {
    let first = number("SEED", FIRST_SEED);
    healthy_rigs_open(first..first + number("RIGS", 200));
}

#[test]
fn the_whole_check_names_a_single_defect() {
    single_defects_are_named(FIRST_SEED..FIRST_SEED + 24);
}

/// The variables `RIGS` and `SEED` give the number of rigs and the first seed:
/// `cargo test --test virtual_time many_single -- --ignored --nocapture`.
#[test]
#[ignore = "takes minutes"]
fn many_single_defects_are_named_by_the_whole_check() {
    let first = number("SEED", FIRST_SEED);
    single_defects_are_named(first..first + number("RIGS", 200));
}
