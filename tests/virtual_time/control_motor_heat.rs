//! Tests the motor's heat in virtual time: consecutive rollouts warm the motor without a warning, a
//! policy that wastes current is braked at the computed time, and a pause cools the motor.

use std::path::Path;
use std::sync::atomic::AtomicBool;

use qube_hil::clock::VirtualClock;
use qube_hil::control::{Homing, HomingSettings, Tick, drive};
use qube_hil::device::emulator::EmulatorSettings;
use qube_hil::device::{Device, SerialLink};
use qube_hil::policy::{ClassicalController, ClassicalGains, Controller, Policy};
use qube_hil::qube::{Profile, QubeModel, State};
use qube_hil::rig::RolloutPlan;
use qube_hil::safety::{LARGEST_LOAD, Limit, MotorHeat, WARNING_LOAD};
use qube_hil::telemetry::{Ending, RolloutOutcome, TickSettings};

/// An emulated Qube after homing, with its motor's heat.
struct Rig {
    device: SerialLink<qube_hil::device::InProcessWire>,
    clock: VirtualClock,
    homing: Homing,
    heat: MotorHeat,
}

impl Rig {
    fn homed(model: QubeModel, seed: u64) -> Self {
        let clock = VirtualClock::default();
        let emulator = EmulatorSettings { model, seed, ..EmulatorSettings::default() };
        let mut device = SerialLink::in_process(emulator, clock.clone());
        device.hello().expect("an emulated Qube answers");
        let mut homing = Homing::new(&HomingSettings::default());
        let mut heat = MotorHeat::default();
        let stop = AtomicBool::new(false);
        let report = drive(&mut device, &clock, &mut homing, &mut heat, None, &stop).unwrap();
        assert_eq!(report.outcome.ending, Ending::Completed, "homing");
        Self { device, clock, homing, heat }
    }

    /// Runs the next rollout without a pause; returns its outcome.
    fn rollout(
        &mut self,
        controller: impl Controller,
        seed: u64,
        max_steps: u32,
    ) -> RolloutOutcome {
        let settings = TickSettings {
            calibration: self.homing.measured().expect("a homed Qube").calibration,
            max_steps,
            start_theta_rad: 0.1 * (seed as f64).sin(),
            ..RolloutPlan::single("test", "test").header().settings
        };
        let mut tick = Tick::new(&settings, controller);
        let stop = AtomicBool::new(false);
        drive(&mut self.device, &self.clock, &mut tick, &mut self.heat, None, &stop)
            .expect("an armed board")
            .outcome
    }
}

/// Full voltage that changes its sign every second tick: the arm moves by a few counts, and the
/// winding carries 5 V / 8.4 ohm.
#[derive(Default)]
struct Trembling {
    ticks: u32,
}

impl Controller for Trembling {
    fn voltage_v(&mut self, _: &State) -> f64 {
        self.ticks += 1;
        if (self.ticks / 2).is_multiple_of(2) { 5.0 } else { -5.0 }
    }
}

fn policy(file: &str) -> Policy {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("policies").join(file);
    Policy::load(&path).expect("a shipped policy")
}

/// The profile `lab`, scaled in its distance from the nominal Qube.
fn lab(gap: f64) -> QubeModel {
    Profile::lab().model().scaled(gap)
}

/// Smallest number of consecutive rollouts of each policy on each Qube; by then the motor is close
/// to its highest load.
const LEAST_ROLLOUTS: u64 = 12;

/// Runs `rollouts` rollouts of the classical controller and of two trained policies on three Qubes,
/// prints the motors' loads, and checks that they stay below the warning. After a fault the Qube
/// would need a new homing, so the fault ends the rollouts of this policy on this Qube; at least
/// [`LEAST_ROLLOUTS`] of them, or all, must run.
fn rollouts_back_to_back(rollouts: u64) {
    let classical = || Policy::Classical(ClassicalController::new(ClassicalGains::default()));
    let mut warmest: f64 = 0.0;
    for (plant, model) in
        [("nominal", QubeModel::NOMINAL), ("lab", lab(1.0)), ("lab, gap 1.5", lab(1.5))]
    {
        for (name, policy) in [
            ("classical", classical()),
            ("nominal", policy("nominal.safetensors")),
            ("robust", policy("robust.safetensors")),
        ] {
            let mut rig = Rig::homed(model, 0);
            let (homed, mut largest, mut sum) = (rig.heat.load, 0.0_f64, 0.0);
            let mut executed = 0;
            for seed in 0..rollouts {
                let outcome = rig.rollout(policy.clone(), seed, 600);
                let overheated = outcome.ending == Ending::LeftBox(Limit::MotorLoad);
                assert!(!overheated, "{name} on {plant}, rollout {seed}");
                let load = outcome.largest_motor_load.unwrap();
                (largest, sum) = (largest.max(load), sum + load);
                executed += 1;
                if matches!(outcome.ending, Ending::Fault(_)) {
                    println!("{name} on {plant}, rollout {seed}: {:?}", outcome.ending);
                    break;
                }
            }
            let least = rollouts.min(LEAST_ROLLOUTS);
            assert!(executed >= least, "{name} on {plant}: {executed} rollouts");
            let mean = sum / executed as f64;
            println!(
                "{name:9} on {plant:12}: after homing {homed:.3}; largest of a rollout {mean:.3} \
                 in the mean, {largest:.3} of all {executed}"
            );
            warmest = warmest.max(largest);
        }
    }
    assert!(warmest < WARNING_LOAD, "{warmest}");
    assert!(warmest > 0.01, "nothing was measured");
}

#[test]
fn ordinary_rollouts_back_to_back_never_warn() {
    rollouts_back_to_back(LEAST_ROLLOUTS);
}

#[test]
#[ignore = "takes two minutes"]
fn up_to_a_thousand_rollouts_of_each_kind_back_to_back_never_warn() {
    rollouts_back_to_back(1000);
}

#[test]
fn a_policy_that_burns_current_is_braked_in_the_computed_time() {
    let mut rig = Rig::homed(QubeModel::NOMINAL, 1);
    rig.heat = MotorHeat::default();
    let outcome = rig.rollout(Trembling::default(), 0, 6000);
    assert_eq!(outcome.ending, Ending::LeftBox(Limit::MotorLoad));
    // The steps do not include settling, which hardly warms the motor. By the closed formula, the
    // motor reaches the limit after 17.6 s at 0.595 A.
    let heating = (5.0_f64 / 8.4 / 0.54).powi(2);
    let computed_s = -rig.heat.time_constant_s() * (1.0 - LARGEST_LOAD / heating).ln();
    let burnt_s = f64::from(outcome.steps) * 0.01;
    assert!((burnt_s - computed_s).abs() < 0.5, "{burnt_s} s, computed {computed_s} s");
    let largest = outcome.largest_motor_load.unwrap();
    assert!((LARGEST_LOAD..LARGEST_LOAD + 0.02).contains(&largest), "{largest}");
}

#[test]
fn heat_carries_over_to_the_next_rollout_and_a_pause_takes_it_away() {
    let mut rig = Rig::homed(QubeModel::NOMINAL, 2);
    let tremble = |rig: &mut Rig| rig.rollout(Trembling::default(), 0, 600);
    let mut rollouts = 0;
    let ending = loop {
        let outcome = tremble(&mut rig);
        rollouts += 1;
        if outcome.ending != Ending::Completed || rollouts > 20 {
            break outcome.ending;
        }
    };
    assert_eq!(ending, Ending::LeftBox(Limit::MotorLoad));
    assert!(rollouts > 1, "6 s alone overheated the motor");

    let mut rig = Rig::homed(QubeModel::NOMINAL, 2);
    for _ in 0..20 {
        assert_eq!(tremble(&mut rig).ending, Ending::Completed);
        rig.heat = rig.heat.cooled(30.0);
    }
}
