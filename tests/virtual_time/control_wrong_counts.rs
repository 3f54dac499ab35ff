//! Tests that counts that are gained or lost during a rollout are found and void it.

use std::sync::atomic::AtomicBool;

use qube_hil::clock::{Clock, VirtualClock};
use qube_hil::control::{Homing, HomingSettings, Tick, drive};
use qube_hil::device::emulator::{EmulatorFault, EmulatorSettings};
use qube_hil::device::{Device, SerialLink};
use qube_hil::policy::{ClassicalController, ClassicalGains};
use qube_hil::rig::RolloutPlan;
use qube_hil::safety::{MotorHeat, SafetyBox};
use qube_hil::telemetry::{Ending, Fault, TickRules, TickSettings};

/// A rollout of the classical controller on the nominal Qube, in the box alone.
struct Rollout {
    ending: Ending,
    /// Start and end, s since the Qube was switched on.
    began_s: f64,
    ended_s: f64,
}

fn rollout(fault: Option<EmulatorFault>) -> Rollout {
    rollout_by(TickRules::NEWEST, SafetyBox::THESIS, fault)
}

fn rollout_by(rules: TickRules, safety_box: SafetyBox, fault: Option<EmulatorFault>) -> Rollout {
    let clock = VirtualClock::default();
    let now_s = || clock.now_ns() as f64 * 1e-9;
    let emulator = EmulatorSettings { fault, seed: 1000, ..EmulatorSettings::default() };
    let mut device = SerialLink::in_process(emulator, clock.clone());
    device.hello().unwrap();
    let stop = AtomicBool::new(false);
    let mut homing = Homing::new(&HomingSettings::default());
    let homed =
        drive(&mut device, &clock, &mut homing, &mut MotorHeat::default(), None, &stop).unwrap();
    assert_eq!(homed.outcome.ending, Ending::Completed);
    let settings = TickSettings {
        calibration: homing.measured().unwrap().calibration,
        safety_box,
        rules,
        ..RolloutPlan::single("counts", "classical").header().settings
    };
    let policy = ClassicalController::new(ClassicalGains::default());
    let began_s = now_s();
    let mut tick = Tick::new(&settings, policy);
    let report =
        drive(&mut device, &clock, &mut tick, &mut MotorHeat::default(), None, &stop).unwrap();
    Rollout { ending: report.outcome.ending, began_s, ended_s: now_s() }
}

#[test]
fn a_count_that_drifts_away_from_its_tachometer_is_found() {
    let Rollout { began_s, ending, .. } = rollout(None);
    assert_eq!(ending, Ending::Completed);
    for counts_s in [-300, -150, 150, 300] {
        let after_s = began_s + 2.0;
        let fault = EmulatorFault::DriftingTheta { after_s, counts_s };
        let Rollout { ending, ended_s, .. } = rollout(Some(fault));
        assert_eq!(ending, Ending::Fault(Fault::EncoderDrifts), "{counts_s}");
        let found_s = ended_s - after_s;
        assert!(found_s < 5.0, "{counts_s}: {found_s} s");
    }
}

#[test]
fn a_jump_of_the_pendulums_count_is_a_fault_also_where_the_box_brakes_because_of_it() {
    let Rollout { began_s, ended_s, ending } = rollout(None);
    assert_eq!(ending, Ending::Completed);
    let mut instant_s = began_s + 1.5;
    let (mut rollouts, mut named, mut by_box) = (0, 0, 0);
    while instant_s < ended_s - 1.0 {
        for counts in [-150, 150] {
            let fault = EmulatorFault::JumpAlpha { after_s: instant_s, counts };
            let Rollout { ending, .. } = rollout(Some(fault));
            // A jump may look as if the arm's encoder were frozen: the rollout is void either way.
            assert!(matches!(ending, Ending::Fault(_)), "{instant_s} s, {counts}: {ending:?}");
            named += u32::from(ending == Ending::Fault(Fault::PendulumJump));
            rollouts += 1;
            let earlier =
                rollout_by(TickRules::HeatByGuardedSpeed, SafetyBox::THESIS, Some(fault)).ending;
            by_box += u32::from(matches!(earlier, Ending::LeftBox(_)));
        }
        instant_s += 0.37;
    }
    println!("{named} of {rollouts} jumps are named; by earlier rules {by_box} made the box brake");
    assert!(rollouts > 20 && 4 * named >= 3 * rollouts, "{named} of {rollouts}");
    assert!(by_box > 0, "no jump made the box brake");
}

#[test]
fn a_pendulum_that_freezes_in_a_swing_voids_the_rollout() {
    let Rollout { began_s, ended_s, .. } = rollout(None);
    // With a narrow box, or with a guard that notices the freeze, the brake begins before the
    // freeze is known.
    let narrow = SafetyBox { theta: 0.6, ..SafetyBox::default() };
    let (mut rollouts, mut void, mut void_by_earlier_rules) = (0, 0, 0);
    let mut instant_s = began_s + 0.3;
    while instant_s < ended_s - 1.0 {
        let fault = Some(EmulatorFault::FrozenAlpha { after_s: instant_s });
        let is_void = |rules: TickRules| {
            let Rollout { ending, ended_s, .. } = rollout_by(rules, narrow, fault);
            let has_frozen = ended_s > instant_s + 0.3;
            (has_frozen, u32::from(matches!(ending, Ending::Fault(_))))
        };
        let (has_frozen, now) = is_void(TickRules::NEWEST);
        let (_, earlier) = is_void(TickRules::DoubtKept);
        assert!(now >= earlier, "{instant_s} s");
        if has_frozen {
            void += now;
            void_by_earlier_rules += earlier;
            rollouts += 1;
        }
        instant_s += 0.19;
    }
    println!(
        "{void} of {rollouts} freezes void the rollout; by earlier rules {void_by_earlier_rules}"
    );
    assert!(void > void_by_earlier_rules, "{void} and {void_by_earlier_rules} of {rollouts}");
}
