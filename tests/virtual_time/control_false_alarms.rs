//! Tests that a healthy Qube raises no fault: rollouts in virtual time, with the classical
//! controller, a trained policy, and untrained policies.

use std::path::Path;
use std::sync::atomic::AtomicBool;

use qube_hil::clock::VirtualClock;
use qube_hil::control::{Homing, HomingSettings, Tick, drive};
use qube_hil::device::emulator::{Effects, EmulatorSettings};
use qube_hil::device::{Device, SerialLink};
use qube_hil::policy::{ClassicalController, ClassicalGains, Controller, Policy};
use qube_hil::qube::{Profile, State};
use qube_hil::rig::RolloutPlan;
use qube_hil::safety::{Limit, MotorHeat};
use qube_hil::telemetry::{Ending, TickSettings};

/// An untrained policy, different for each seed.
struct Untrained {
    seed: f64,
}

impl Controller for Untrained {
    fn voltage_v(&mut self, state: &State) -> f64 {
        let mix = |phase: f64| {
            (1.7 * self.seed + phase + state.theta + 2.0 * state.alpha + 0.1 * state.theta_dot
                - 0.07 * state.alpha_dot)
                .sin()
        };
        8.0 * mix(0.0) * mix(2.0 + self.seed)
    }
}

/// Homes a Qube of this seed and runs one rollout on it.
fn rollout(seed: u64, controller: impl Controller) -> Ending {
    rollout_on(EmulatorSettings { seed, ..EmulatorSettings::default() }, controller)
}

/// Homes this Qube and runs one rollout on it.
fn rollout_on(settings: EmulatorSettings, controller: impl Controller) -> Ending {
    let clock = VirtualClock::default();
    let seed = settings.seed;
    let mut device = SerialLink::in_process(settings, clock.clone());
    device.hello().expect("an emulated Qube answers");
    let stop = AtomicBool::new(false);
    let mut homing = Homing::new(&HomingSettings::default());
    let homed = drive(&mut device, &clock, &mut homing, &mut MotorHeat::default(), None, &stop)
        .expect("an armed board");
    assert_eq!(
        homed.outcome.ending,
        Ending::Completed,
        "homing, seed {seed}, {:?}",
        settings.effects
    );
    let settings = TickSettings {
        calibration: homing.measured().expect("a homed Qube").calibration,
        start_theta_rad: 0.1 * (seed as f64).sin(),
        ..RolloutPlan::single("test", "test").header().settings
    };
    let mut tick = Tick::new(&settings, controller);
    drive(&mut device, &clock, &mut tick, &mut MotorHeat::default(), None, &stop)
        .expect("an armed board")
        .outcome
        .ending
}

/// Endings of rollouts with the three kinds of policy in turn.
fn endings(seeds: std::ops::Range<u64>) -> Vec<(u64, Ending)> {
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("policies/nominal.safetensors");
    let trained = Policy::load(&shipped).expect("the shipped policy");
    seeds
        .map(|seed| {
            let ending = match seed % 3 {
                0 => rollout(seed, ClassicalController::new(ClassicalGains::default())),
                1 => rollout(seed, trained.clone()),
                _ => rollout(seed, Untrained { seed: seed as f64 }),
            };
            (seed, ending)
        })
        .collect()
}

fn no_fault(seeds: std::ops::Range<u64>) {
    let endings = endings(seeds);
    let count = |is_counted: fn(&Ending) -> bool| {
        endings.iter().filter(|(_, ending)| is_counted(ending)).count()
    };
    println!(
        "{} rollouts: {} completed, {} ended by foresight, {} faults",
        endings.len(),
        count(|ending| *ending == Ending::Completed),
        count(|ending| *ending == Ending::LeftBox(Limit::Foresight)),
        count(|ending| matches!(ending, Ending::Fault(_)))
    );
    assert!(
        count(|ending| *ending == Ending::Completed) > 0,
        "no rollout was completed: {endings:?}"
    );
    for (seed, ending) in endings {
        assert!(!matches!(ending, Ending::Fault(_)), "seed {seed}: {ending:?}");
    }
}

#[test]
fn a_healthy_qube_raises_no_fault_whatever_its_policy_does() {
    no_fault(0..24);
}

#[test]
#[ignore = "takes a minute: scripts/adversary runs it"]
fn a_thousand_rollouts_on_healthy_qubes_raise_no_fault() {
    no_fault(0..1000);
}

/// Effects that the program's equations omit, up to these sizes, raise no fault while a Qube of the
/// profile `lab` is homed and runs the policy `robust`.
#[test]
fn effects_beyond_the_equations_raise_no_fault() {
    let robust = Path::new(env!("CARGO_MANIFEST_DIR")).join("policies/robust.safetensors");
    let robust = Policy::load(&robust).expect("the shipped policy");
    let model = Profile::lab().model();
    let none = Effects::NONE;
    let each = [
        Effects { tilt_rad: 0.009, ..none },
        Effects { ripple: 0.2, ..none },
        Effects { pendulum_friction_n_m: 5e-5, ..none },
        Effects { cubic_n_m_rad3: 1e-4, ..none },
        Effects { presliding_rad: 0.03, stribeck: 0.5, ..none },
        Effects { hysteresis_n_m: 5e-4, slack: 1.0, ..none },
        Effects { warming_per_w: 0.3, eccentricity_rad: 0.02, ..none },
    ];
    for effects in each {
        for seed in 1000..1004 {
            let settings = EmulatorSettings { model, effects, seed, ..EmulatorSettings::default() };
            let ending = rollout_on(settings, robust.clone());
            assert!(!matches!(ending, Ending::Fault(_)), "seed {seed}, {effects:?}: {ending:?}");
        }
    }
}
