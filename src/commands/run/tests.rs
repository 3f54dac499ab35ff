//! Tests of the end of a run, in virtual time, so that the load of the computer does not matter,
//! and of the notes about a policy.

use std::path::Path;

use super::controller::{policy, trained_on_true_states};
use super::*;
use crate::commands::live::Live;
use crate::commands::screen::Progress;
use crate::control::{HomingMethod, HomingSettings};
use crate::device::emulator::{EmulatorFault, EmulatorSettings};
use crate::estimation::{EstimatorSettings, ObserverSettings};
use crate::policy::{Policy, SimulatedObserver, SimulatedSensors};
use crate::qube::QubeModel;
use crate::recording::read;
use crate::rig::{Doubt, DoubtStore, Recovery};
use crate::telemetry::{Fault, Preflight};

/// Returns the settings of an emulated Qube that is homed by hand and has this fault, if any.
fn settings(fault: Option<&str>) -> RigSettings {
    let fault = fault.map(|fault| fault.parse::<EmulatorFault>().unwrap());
    RigSettings {
        homing: HomingSettings { method: HomingMethod::Hand, ..HomingSettings::default() },
        ..RigSettings::emulated(EmulatorSettings { fault, seed: 5, ..EmulatorSettings::default() })
    }
}

/// Runs rollouts of the classical controller; returns how the run ended, and its results.
fn run(
    settings: RigSettings,
    directory: &Path,
    rollouts: u32,
) -> (Result<(), Failure>, RunResults) {
    run_within(SafetyBox::GUARDED, settings, directory, rollouts)
}

fn run_within(
    safety_box: SafetyBox,
    settings: RigSettings,
    directory: &Path,
    rollouts: u32,
) -> (Result<(), Failure>, RunResults) {
    let plan = RolloutPlan { safety_box, ..RolloutPlan::single("run", "classical") };
    let files = vec![policy(Path::new("classical")).unwrap().to_bytes()];
    let controller = RunController {
        name: "classical".into(),
        files,
        steps: plan.steps,
        notes: Vec::new(),
        policy: None,
    };
    let (stop, keyboard) = (Stop::default(), Keyboard::none());
    let directory = directory.to_owned();
    std::fs::create_dir_all(&directory).unwrap();
    let live = Live::default();
    let progress = Progress::lines();
    let mut series = RolloutSeries {
        settings,
        described: "the emulated Qube".into(),
        plan,
        controller,
        directory,
        stop: &stop,
        keyboard: &keyboard,
        live: &live,
        progress,
    };
    let mut results = RunResults::default();
    (series.run(rollouts, &mut results), results)
}

fn recordings(directory: &Path) -> usize {
    std::fs::read_dir(directory).map_or(0, Iterator::count)
}

#[test]
fn a_stall_ends_a_run_and_nothing_moves_before_somebody_has_acknowledged_it() {
    let directory = tempfile::tempdir().unwrap();
    let directory = directory.path();
    let doubts = Some(DoubtStore::new(directory.join("state")));
    let remembering = |fault, acknowledged| {
        let recovery = Recovery { doubts: doubts.clone(), acknowledged, ..Recovery::default() };
        RigSettings { recovery, skip_check: true, ..settings(fault) }
    };
    // The stall comes after the end of the first rollout and before the end of the fifth.
    let (ended, results) = run(remembering(Some("stall@27"), false), &directory.join("one"), 6);
    let ended_by = ended.unwrap_err().ended_by();
    // The results so far are printed, with the reason why there are no more.
    let returns: Vec<Option<f64>> = results.rollouts.iter().map(|it| it.return_).collect();
    assert!(returns.len() >= 2 && returns.len() < 6, "{returns:?}");
    assert!(returns[0].is_some() && returns.last().unwrap().is_none(), "{returns:?}");
    assert_eq!(results.json()["returns"].as_array().unwrap().len(), returns.len());
    assert_eq!(ended_by["fault"], "stall_error", "{ended_by}");
    assert_eq!(ended_by["consequence"], "examine", "{ended_by}");
    assert_eq!(ended_by["exit_code"], 4, "{ended_by}");
    let cause = ended_by["cause"].as_str().unwrap();
    assert!(cause.contains("reports a stall") && cause.contains("--acknowledge"), "{cause}");
    assert!(!cause.contains("amplifier"), "{cause}");
    let kept = recordings(&directory.join("one"));
    assert_eq!(kept, returns.len(), "a rollout that never began has left a file");

    // A new start without acknowledgement is refused before anything moves.
    let (ended, _) = run(remembering(None, false), &directory.join("two"), 1);
    let ended_by = ended.unwrap_err().ended_by();
    let cause = ended_by["cause"].as_str().unwrap();
    assert!(cause.contains("doubt") && cause.contains("reports a stall"), "{cause}");
    let order = ["somebody has checked the Qube", "start again with", "is examined before"];
    let places = order.map(|words| cause.find(words));
    assert!(places.is_sorted() && places[0].is_some(), "{cause}");
    assert_eq!((&ended_by["fault"], &ended_by["exit_code"]), (&json!("stall_error"), &json!(4)));
    assert_eq!(recordings(&directory.join("two")), 0);

    // With acknowledgement the Qube is examined in spite of `skip_check`, and runs.
    let (ended, _) = run(remembering(None, true), &directory.join("three"), 1);
    ended.unwrap();
    let preflight = read(&directory.join("three/rollout-0.mcap")).unwrap().header.preflight;
    assert!(matches!(preflight, Preflight::Done(_)), "{preflight:?}");
    // A passed examination ends the doubt.
    let (ended, _) = run(remembering(None, false), &directory.join("four"), 1);
    ended.unwrap();
    let preflight = read(&directory.join("four/rollout-0.mcap")).unwrap().header.preflight;
    assert!(!matches!(preflight, Preflight::Done(_)), "{preflight:?}");
}

#[test]
fn a_fault_in_the_check_leaves_its_doubt_and_no_failed_watchdog_is_driven_unexamined() {
    let directory = tempfile::tempdir().unwrap();
    let doubts = DoubtStore::new(directory.path().join("state"));
    let board = format!("{:016x}", 5);
    let failed = |fault: &str| {
        // An emulated Qube is examined only after an acknowledged doubt.
        doubts.store(&Doubt {
            fault: Some(Fault::EncoderJump),
            board: board.clone(),
            unix_s: None,
        });
        let doubts = Some(doubts.clone());
        let recovery = Recovery { doubts, acknowledged: true, ..Recovery::default() };
        let settings = RigSettings { recovery, ..settings(Some(fault)) };
        run(settings, &directory.path().join("rollouts"), 1).0.unwrap_err().ended_by()
    };
    let cause = |ended_by: &serde_json::Value| ended_by["cause"].as_str().unwrap().to_owned();

    // The stall comes during a push of the check.
    let ended_by = failed("stall@3.6");
    assert_eq!((&ended_by["fault"], &ended_by["exit_code"]), (&json!("stall_error"), &json!(4)));
    let message = cause(&ended_by);
    assert!(message.contains("--acknowledge") && !message.contains("--skip-check"), "{message}");
    assert_eq!(doubts.load(&board).unwrap().fault, Some(Fault::StallError));

    for (fault, may_be_skipped) in [("stuck-output@0:3", false), ("dead-motor@0", true)] {
        let ended_by = failed(fault);
        assert_eq!((&ended_by["fault"], &ended_by["exit_code"]), (&json!(null), &json!(1)));
        let message = cause(&ended_by);
        assert_eq!(message.contains("--skip-check"), may_be_skipped, "{message}");
        assert_eq!(doubts.load(&board).unwrap().fault, Some(Fault::EncoderJump));
    }
}

#[test]
fn a_cable_that_is_plugged_in_again_voids_one_rollout_and_the_run_goes_on() {
    let directory = tempfile::tempdir().unwrap();
    // Without foresight a rollout lasts until the cable is pulled.
    let settings = settings(Some("unplug@9+3"));
    let (ended, results) = run_within(SafetyBox::THESIS, settings, directory.path(), 3);
    ended.unwrap();
    let void: Vec<usize> =
        (0..3).filter(|number| results.rollouts[*number].return_.is_none()).collect();
    let [void] = void[..] else {
        panic!("not exactly one rollout is void: {:?}", results.rollouts)
    };
    let why = results.rollouts[void].ended_early.as_ref().unwrap();
    assert!(void < 2 && why.contains("unplugged"), "{why}");
}

#[test]
fn a_cable_that_stays_out_is_a_fault_and_the_results_so_far_are_kept() {
    let directory = tempfile::tempdir().unwrap();
    let recovery = Recovery { link_patience_s: 2.0, ..Recovery::default() };
    let settings = RigSettings { recovery, ..settings(Some("unplug@16")) };
    let (ended, results) = run(settings, directory.path(), 9);
    let ended_by = ended.unwrap_err().ended_by();
    assert_eq!((&ended_by["fault"], &ended_by["exit_code"]), (&json!("link_gone"), &json!(4)));
    let cause = ended_by["cause"].as_str().unwrap();
    assert!(cause.contains("did not come back within 2 s"), "{cause}");
    let rollouts = &results.rollouts;
    assert!(rollouts.len() >= 2 && rollouts[0].return_.is_some(), "{rollouts:?}");
    assert_eq!(recordings(directory.path()), rollouts.len());
}

#[test]
fn an_estimator_that_differs_from_the_training_is_noted() {
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("policies/robust.safetensors");
    let Policy::Network(network) = policy(&shipped).unwrap() else {
        panic!("the policy is no network")
    };
    let observer = EstimatorSettings::observer(ObserverSettings::of(QubeModel::NOMINAL));
    let note = |sensors, used| {
        let mut network = network.clone();
        network.training.sensors = sensors;
        let controller = RunController {
            name: "mine".into(),
            files: Vec::new(),
            steps: 1,
            notes: Vec::new(),
            policy: Some(Policy::Network(network)),
        };
        controller.estimator_note(&used)
    };
    let own = network.training.sensors;
    assert_eq!(note(own, EstimatorSettings::default()), None);
    assert_eq!(note(SimulatedSensors::TrueState, EstimatorSettings::filter(20.0)), None);
    for (used, words) in
        [(EstimatorSettings::filter(20.0), "filter of 20 rad/s"), (observer, "an observer")]
    {
        let message = note(own, used).unwrap();
        assert!(message.contains("mine") && message.contains("filter of 200 rad/s"), "{message}");
        assert!(message.contains(words) && message.contains("--filter 200 "), "{message}");
    }

    let model = QubeModel::NOMINAL;
    let simulated = SimulatedObserver {
        model,
        theta_noise_rad_s2: 1.0,
        alpha_noise_rad_s2: 1.0,
        reset_error_rad: 1.0,
    };
    let observed = SimulatedSensors::Encoders {
        corner_rad_s: 200.0,
        counts_per_revolution: 2048,
        observer: Some(simulated),
    };
    assert_eq!(note(observed, observer), None);
    let message = note(observed, EstimatorSettings::default()).unwrap();
    assert!(message.contains("--estimator observer"), "{message}");
}

#[test]
fn a_policy_of_true_states_is_recognised_by_its_file() {
    assert!(!trained_on_true_states(&policy(Path::new("classical")).unwrap()));
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("policies/robust.safetensors");
    let robust = policy(&shipped).unwrap();
    assert!(!trained_on_true_states(&robust));
    let Policy::Network(mut network) = robust else { panic!("the policy is no network") };
    network.training.sensors = SimulatedSensors::TrueState;
    assert!(trained_on_true_states(&Policy::Network(network)));
}
