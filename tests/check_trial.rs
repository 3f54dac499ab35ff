//! The check on rigs of all kinds, in virtual time: a healthy one passes, its signs are learned, and a
//! single defect is named and nothing else.
//!
//! A rig is drawn by its seed: all eight ways to wire it, 0.5, 1 and 1.5 times the gap of the profile
//! `lab`, parameters within 10 %, 1 to 4 times the friction, up to 1 degree of play. Half of the rigs
//! lie in the corners of that domain. Figures are told of seeds from 1000 on; nothing was tuned on them.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use qube_hil::clock::VirtualClock;
use qube_hil::control::HomingSettings;
use qube_hil::device::emulator::{EmulatorFault, EmulatorSettings, Wiring};
use qube_hil::device::{Device, SerialLink};
use qube_hil::estimation::Calibration;
use qube_hil::preflight::{Examination, ExaminationSettings, examine};
use qube_hil::qube::{DomainParameter, HARD_STOP_RAD, Profile, QubeModel, State};
use qube_hil::safety::HardwareLimits;
use qube_hil::session::{ClockChoice, DeviceChoice, Rig, RigSettings};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Nothing was tuned on rigs from here on.
const FIRST_SEED: u64 = 1000;

/// Parameters are within this part of the profile's.
const SPREAD: f64 = 0.1;

const MOST_PLAY_DEG: f64 = 1.0;

/// One rig of the domain.
fn rig(seed: u64) -> EmulatorSettings {
    let text = include_str!("../profiles/lab.toml");
    let lab = Profile::parse(text).unwrap().model();
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let at_a_corner = random.random_range(0..2) == 0;
    let mut between = |low: f64, high: f64| {
        let share = random.random_range(0.0..=1.0);
        low + (high - low) * if at_a_corner { f64::round(share) } else { share }
    };
    let mut model = lab.scaled([0.5, 1.0, 1.5][(seed / 8 % 3) as usize]);
    for parameter in DomainParameter::ALL {
        let value = model.parameters.get(parameter);
        if parameter != DomainParameter::Gravity {
            model.parameters.set(parameter, value * between(1.0 - SPREAD, 1.0 + SPREAD));
        }
    }
    let friction = between(1.0, 4.0);
    model.gap.coulomb_torque_n_m *= friction;
    let damping = model.parameters.rotary_damping_n_m_s;
    model.parameters.rotary_damping_n_m_s = damping * friction;
    EmulatorSettings {
        model,
        play_rad: between(0.0, MOST_PLAY_DEG).to_radians(),
        wiring: Wiring {
            theta_inverted: seed & 1 != 0,
            alpha_inverted: seed & 2 != 0,
            motor_inverted: seed & 4 != 0,
        },
        seed,
        ..EmulatorSettings::default()
    }
}

/// The signs of a rig that is wired like this.
fn signs_of(wiring: Wiring) -> Calibration {
    Calibration {
        theta_inverted: wiring.theta_inverted,
        alpha_inverted: wiring.alpha_inverted,
        voltage_inverted: wiring.motor_inverted,
        ..Calibration::IDENTITY
    }
}

/// An examination, and the largest speed at which the arm touched a stop meanwhile.
fn examined(
    settings: EmulatorSettings,
    signs: Calibration,
    learn_signs: bool,
) -> (Examination, f64) {
    let clock = VirtualClock::default();
    let mut link = SerialLink::in_process(settings, clock.clone());
    let identity = link.hello().unwrap();
    let examination = ExaminationSettings { signs, learn_signs, identity };
    let stop = AtomicBool::new(false);
    let found = examine(&mut link, &clock, &stop, &examination).unwrap().unwrap();
    let touch_rad_s = link.transport().board().plant().hardest_touch_rad_s();
    (found, touch_rad_s)
}

fn failed(found: &Examination) -> Vec<&str> {
    found
        .results
        .iter()
        .filter(|result| result.failed())
        .map(|result| result.name.as_str())
        .collect()
}

/// What can be wrong with a rig, one at a time.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Defect {
    ThetaSign,
    AlphaSign,
    MotorSign,
    DeadArmEncoder,
    DeadPendulumEncoder,
    HeldArm,
    DeadMotor,
    NoPendulum,
    HeldPendulum,
}

const DEFECTS: [Defect; 9] = [
    Defect::ThetaSign,
    Defect::AlphaSign,
    Defect::MotorSign,
    Defect::DeadArmEncoder,
    Defect::DeadPendulumEncoder,
    Defect::HeldArm,
    Defect::DeadMotor,
    Defect::NoPendulum,
    Defect::HeldPendulum,
];

impl Defect {
    /// The one check that must fail.
    fn name(self) -> &'static str {
        match self {
            Self::ThetaSign => "arm-sign",
            Self::AlphaSign => "pendulum-sign",
            Self::MotorSign => "motor-sign",
            Self::DeadArmEncoder => "arm",
            Self::DeadPendulumEncoder | Self::NoPendulum | Self::HeldPendulum => "pendulum",
            Self::HeldArm => "stall",
            Self::DeadMotor => "motor",
        }
    }

    /// A rig with this defect, and the signs that its file says.
    fn of(self, mut rig: EmulatorSettings) -> (EmulatorSettings, Calibration) {
        let mut signs = signs_of(rig.wiring);
        let after_s = 0.0;
        match self {
            Self::ThetaSign => signs.theta_inverted ^= true,
            Self::AlphaSign => signs.alpha_inverted ^= true,
            Self::MotorSign => signs.voltage_inverted ^= true,
            Self::DeadArmEncoder => rig.fault = Some(EmulatorFault::FrozenTheta { after_s }),
            Self::DeadPendulumEncoder => rig.fault = Some(EmulatorFault::FrozenAlpha { after_s }),
            Self::HeldArm => rig.fault = Some(EmulatorFault::BlockedArm { after_s }),
            Self::DeadMotor => rig.fault = Some(EmulatorFault::DeadMotor { after_s }),
            Self::NoPendulum | Self::HeldPendulum => {
                // Its shaft stays where the arm takes it; a pendulum that is held to the arm adds its
                // mass to it (J_r = M_r L_r^2 / 12).
                rig.fault = Some(EmulatorFault::FrozenAlpha { after_s });
                let parameters = &mut rig.model.parameters;
                if self == Self::HeldPendulum {
                    parameters.rotary_mass_kg += 12.0 * parameters.pendulum_mass_kg;
                }
                parameters.pendulum_mass_kg = 1e-6;
            }
        }
        (rig, signs)
    }
}

/// The verdicts of one rig that are wrong, in words.
fn wrong_verdicts(seed: u64) -> (u32, Vec<String>) {
    let rig = rig(seed);
    let mut wrong = Vec::new();
    let mut verdicts = 0;
    let mut judge = |name: &str, found: &Examination, expected: &[&str]| {
        verdicts += 1;
        if failed(found) != expected {
            let failed = found.results.iter().filter(|result| result.failed());
            let told: Vec<String> =
                failed.map(|result| format!("{}: {}", result.name, result.value)).collect();
            wrong.push(format!("{seed} {name}: {told:?} instead of {expected:?}"));
        }
    };
    let (found, touch_rad_s) = examined(rig, signs_of(rig.wiring), false);
    judge("healthy", &found, &[]);
    assert!(touch_rad_s < 2.0, "{seed}: a stop was touched at {touch_rad_s} rad/s");

    // From signs that nobody knows.
    let mut random = ChaCha8Rng::seed_from_u64(seed + 1_000_000);
    let unknown = Calibration {
        theta_inverted: random.random_range(0..2) == 0,
        alpha_inverted: random.random_range(0..2) == 0,
        voltage_inverted: random.random_range(0..2) == 0,
        ..Calibration::IDENTITY
    };
    let (found, _) = examined(rig, unknown, true);
    judge("learn", &found, &[]);
    let differences = [
        found.signs.theta_inverted != rig.wiring.theta_inverted,
        found.signs.alpha_inverted != rig.wiring.alpha_inverted,
        found.signs.voltage_inverted != rig.wiring.motor_inverted,
    ];
    let are_right = differences == [false; 3] || differences == [true; 3];
    for defect in DEFECTS {
        let (rig, signs) = defect.of(rig);
        let (found, touch_rad_s) = examined(rig, signs, false);
        let name = format!("{defect:?}");
        judge(&name, &found, &[defect.name()]);
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
    let threads = std::thread::available_parallelism().map_or(1, |count| count.get());
    let of_threads = std::thread::scope(|scope| {
        let each = |first: u64| seeds.clone().skip(first as usize).step_by(threads);
        let start = |first: u64| scope.spawn(move || each(first).map(wrong_verdicts).collect());
        let running: Vec<_> = (0..threads as u64).map(start).collect();
        running.into_iter().map(|thread| thread.join().unwrap()).collect::<Vec<Vec<_>>>()
    });
    for (of_rig, wrong_of_rig) in of_threads.into_iter().flatten() {
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
fn no_verdict_is_wrong_on_two_hundred_rigs() {
    trial(FIRST_SEED..FIRST_SEED + 216);
}

/// `RIGS` rigs from `SEED` on: `cargo test --test check_trial -- --ignored --nocapture`.
#[test]
#[ignore = "minutes"]
fn no_verdict_is_wrong_on_many_rigs() {
    let number = |name: &str, default: u64| {
        std::env::var(name).ok().and_then(|text| text.parse().ok()).unwrap_or(default)
    };
    let first = number("SEED", FIRST_SEED);
    trial(first..first + number("RIGS", 2000));
}

/// Beside a stop, each of its encoders dead or alive, whatever signs the file says.
#[test]
fn the_probe_touches_no_stop_hard() {
    for seed in 0..48 {
        let mut settings = rig(seed);
        if seed % 2 == 0 {
            settings.model = QubeModel::NOMINAL;
        }
        let side = if seed % 4 < 2 { 1.0 } else { -1.0 };
        let away_rad = [0.0, 0.03, 0.1, 0.3][(seed / 4 % 4) as usize];
        let theta = side * (HARD_STOP_RAD - away_rad);
        settings.start = Some(State { theta, ..State::default() });
        for fault in ["none", "frozen-theta@0", "frozen-alpha@0"] {
            let fault = (fault != "none").then(|| fault.parse().unwrap());
            let settings = EmulatorSettings { fault, ..settings };
            let (found, touch_rad_s) = examined(settings, Calibration::IDENTITY, false);
            assert!(
                touch_rad_s < 2.0,
                "{seed} {fault:?}: {touch_rad_s} rad/s, {:#?}",
                found.results
            );
        }
    }
}

/// The whole check of healthy rigs, homing included: `RIGS` from `SEED` on.
#[test]
#[ignore = "minutes"]
fn healthy_rigs_pass_the_whole_check() {
    let number = |name: &str, default: u64| {
        std::env::var(name).ok().and_then(|text| text.parse().ok()).unwrap_or(default)
    };
    let first = number("SEED", FIRST_SEED);
    let rigs = number("RIGS", 50);
    let mut refused = Vec::new();
    for seed in first..first + rigs {
        let emulator = rig(seed);
        let settings = RigSettings {
            device: DeviceChoice::Emulated,
            clock: ClockChoice::Virtual,
            emulator,
            homing: HomingSettings {
                signs: signs_of(emulator.wiring),
                ..HomingSettings::default()
            },
            skip_check: false,
            board: None,
            recovery: Default::default(),
            limits: HardwareLimits::default(),
        };
        let stop = Arc::new(AtomicBool::new(false));
        let found = Rig::connect(&settings, &stop).unwrap().check(false).unwrap();
        for result in found.results.iter().filter(|result| result.failed()) {
            refused.push(format!("{seed} {}: {}", result.name, result.value));
        }
    }
    println!("{rigs} healthy rigs, {} did not pass", refused.len());
    assert!(refused.is_empty(), "{}", refused.join("\n"));
}
