//! Tests the check on random rigs, in virtual time: a healthy rig passes, its signs are found, and
//! a single defect is named and nothing else.

mod rigs;
mod whole;

use std::sync::atomic::AtomicBool;

use qube_hil::clock::VirtualClock;
use qube_hil::device::emulator::EmulatorSettings;
use qube_hil::device::{Device, SerialLink};
use qube_hil::estimation::Calibration;
use qube_hil::preflight::{Examination, ExaminationSettings, OtherSigns, examine};
use qube_hil::qube::{HARD_STOP_RAD, QubeModel, State};
use qube_hil::safety::MotorHeat;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rigs::{DEFECTS, FIRST_SEED, failed, number, of_each, rig, signs_of};

/// Runs an examination; returns it, and the largest speed at which the arm touched a stop
/// meanwhile, rad/s.
fn examined(
    settings: EmulatorSettings,
    signs: Calibration,
    other_signs: OtherSigns,
) -> (Examination, f64) {
    let clock = VirtualClock::default();
    let mut link = SerialLink::in_process(settings, clock.clone());
    let identity = link.hello().unwrap();
    let examination = ExaminationSettings {
        signs,
        other_signs,
        identity,
        plant: qube_hil::qube::PlantModel::QUBE,
    };
    let stop = AtomicBool::new(false);
    let found = examine(&mut link, &clock, &mut MotorHeat::default(), &stop, &examination)
        .unwrap()
        .unwrap();
    let touch_rad_s = link.transport().board().plant().hardest_touch_rad_s();
    (found, touch_rad_s)
}

/// The number of verdicts on one rig, and the wrong verdicts and signs in words. Also checks that
/// no stop is touched at 2 rad/s or faster.
fn wrong_verdicts(seed: u64) -> (u32, Vec<String>) {
    let rig = rig(seed);
    let mut wrong = Vec::new();
    let mut verdicts = 0;
    let mut compare = |name: &str, found: &Examination, expected: &[&str]| {
        verdicts += 1;
        if failed(found) != expected {
            let failed = found.results.iter().filter(|result| result.failed());
            let told: Vec<String> =
                failed.map(|result| format!("{}: {}", result.name, result.value)).collect();
            wrong.push(format!("{seed} {name}: {told:?} instead of {expected:?}"));
        }
    };
    let (found, touch_rad_s) = examined(rig, signs_of(rig.wiring), OtherSigns::Fail);
    compare("healthy", &found, &[]);
    assert!(touch_rad_s < 2.0, "{seed}: a stop was touched at {touch_rad_s} rad/s");

    // The examination starts from random signs and must find the right ones, or all three of them
    // inverted, which describe the same Qube in a mirror.
    let mut random = ChaCha8Rng::seed_from_u64(seed + 1_000_000);
    let unknown = Calibration {
        theta_inverted: random.random_range(0..2) == 0,
        alpha_inverted: random.random_range(0..2) == 0,
        voltage_inverted: random.random_range(0..2) == 0,
        ..Calibration::IDENTITY
    };
    let (found, touch_rad_s) = examined(rig, unknown, OtherSigns::Adopt);
    compare("learn", &found, &[]);
    assert!(touch_rad_s < 2.0, "{seed} learn: a stop was touched at {touch_rad_s} rad/s");
    let differences = [
        found.signs.theta_inverted != rig.wiring.theta_inverted,
        found.signs.alpha_inverted != rig.wiring.alpha_inverted,
        found.signs.voltage_inverted != rig.wiring.motor_inverted,
    ];
    let are_right = differences == [false; 3] || differences == [true; 3];
    for defect in DEFECTS {
        let (rig, signs) = defect.of(rig);
        let (found, touch_rad_s) = examined(rig, signs, OtherSigns::Fail);
        let name = format!("{defect:?}");
        compare(&name, &found, &[defect.name()]);
        assert!(touch_rad_s < 2.0, "{seed} {name}: a stop was touched at {touch_rad_s} rad/s");
    }
    if !are_right {
        wrong.push(format!("{seed} learn: wrong signs, {differences:?}"));
    }
    (verdicts, wrong)
}

fn trial(seeds: std::ops::Range<u64>) {
    let rigs = seeds.end - seeds.start;
    let (mut verdicts, mut wrong) = (0, Vec::new());
    for (of_rig, wrong_of_rig) in of_each(seeds, wrong_verdicts) {
        verdicts += of_rig;
        wrong.extend(wrong_of_rig);
    }
    let mut kinds = std::collections::BTreeMap::<String, u32>::new();
    for line in &wrong {
        let kind = line.split([' ', ':']).nth(1).unwrap_or_default();
        *kinds.entry(kind.to_owned()).or_default() += 1;
    }
    println!("{rigs} rigs, {verdicts} verdicts, {} wrong: {kinds:?}", wrong.len());
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn no_verdict_is_wrong_on_216_rigs() {
    trial(FIRST_SEED..FIRST_SEED + 216);
}

/// The variables `RIGS` and `SEED` give the number of rigs and the first seed:
/// `cargo test --test virtual_time wrong_on_many_rigs -- --ignored --nocapture`.
#[test]
#[ignore = "takes minutes"]
fn no_verdict_is_wrong_on_many_rigs() {
    let first = number("SEED", FIRST_SEED);
    trial(first..first + number("RIGS", 2000));
}

/// Examines arms at a stop or up to 0.3 rad from it, with both encoders alive or one of them dead;
/// the assumed signs are right on some rigs and wrong on others. Each of the eight wirings meets
/// either stop at each distance, and half of these rigs are nominal.
#[test]
fn the_probe_touches_no_stop_hard() {
    for seed in 0..64 {
        // The last three bits of the seed give the wiring.
        let mut settings = rig(seed);
        if (seed + seed / 16) % 2 == 0 {
            settings.model = QubeModel::NOMINAL;
        }
        let side = if seed / 8 % 2 == 0 { 1.0 } else { -1.0 };
        let away_rad = [0.0, 0.03, 0.1, 0.3][(seed / 16) as usize];
        let theta = side * (HARD_STOP_RAD - away_rad);
        settings.start = Some(State { theta, ..State::default() });
        for fault in ["none", "frozen-theta@0", "frozen-alpha@0"] {
            let fault = (fault != "none").then(|| fault.parse().unwrap());
            let settings = EmulatorSettings { fault, ..settings };
            let (found, touch_rad_s) = examined(settings, Calibration::IDENTITY, OtherSigns::Fail);
            assert!(
                touch_rad_s < 2.0,
                "{seed} {fault:?}: {touch_rad_s} rad/s, {:#?}",
                found.results
            );
        }
    }
}
