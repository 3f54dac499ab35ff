//! Tests a rotary pendulum that is no Qube, described by a file: 30 % larger in every length and
//! mass, with finer encoders and an arm that turns 1.8 rad to either side. The program's own
//! commands train a policy for it and run it.

use std::path::Path;
use std::sync::Arc;

use qube_hil::device::emulator::{EmulatorFault, EmulatorSettings};
use qube_hil::policy::Policy;
use qube_hil::qube::PlantModel;
use qube_hil::recording::{Recording, read};
use qube_hil::replay::rerun;
use qube_hil::rig::{Rig, RigSettings};
use qube_hil::safety::SafetyBox;
use qube_hil::telemetry::{Ending, Fault, Phase};

use crate::program::program;

/// Writes the shipped example with a largest voltage of 4.5 V, which differs from a Qube's 5 V.
fn plant_file(directory: &Path) -> PlantModel {
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("plants/furuta-130.toml");
    let text = std::fs::read_to_string(shipped).unwrap();
    let text = text.replace("largest_voltage_v = 5.0", "largest_voltage_v = 4.5");
    std::fs::write(directory.join("larger.toml"), &text).unwrap();
    PlantModel::parse(&text).unwrap()
}

fn trained(directory: &Path, policy: &str, arguments: &[&str]) {
    let train = ["train", "--preset", "quick", "--sensors", "encoders", "--seed", "3", "--out"];
    program(directory).args(train).arg(policy).args(arguments).assert().success();
}

/// The farthest angle of the arm in a recording by its counts, rad, and the largest voltage, mV.
fn farthest_and_largest(recording: &Recording) -> (f64, u16) {
    let calibration = &recording.header.settings.calibration;
    let samples = recording.ticks.iter().filter_map(|tick| tick.measurement.as_ref());
    let farthest_rad = samples.map(|sample| calibration.angles_rad(sample).0.abs());
    let largest_mv = recording.ticks.iter().map(|tick| tick.voltage_mv.unsigned_abs());
    (farthest_rad.fold(0.0, f64::max), largest_mv.max().unwrap())
}

#[test]
fn a_larger_pendulum_is_trained_for_run_within_its_limits_and_replayed() {
    let directory = tempfile::tempdir().unwrap();
    let directory = directory.path();
    let plant = plant_file(directory);
    trained(directory, "larger.safetensors", &["--plant", "larger.toml"]);
    let Policy::Network(policy) = Policy::load(&directory.join("larger.safetensors")).unwrap()
    else {
        panic!("train writes networks")
    };
    assert_eq!(policy.training.plant, plant);

    let run = ["run", "--plant", "larger.toml", "--clock", "virtual", "--rollouts", "3"];
    program(directory)
        .args(run)
        .args(["--policy", "larger.safetensors", "--out", "recordings"])
        .assert()
        .success();
    program(directory)
        .args(run)
        .args(["--excite", "steps", "--volts", "2.5", "--out", "excited"])
        .assert()
        .success();
    let narrow = SafetyBox::THESIS.within_travel(&plant);
    assert!(narrow.theta < 1.8 && narrow.theta > 1.6, "{narrow:?}");
    for folder in ["recordings", "excited"] {
        for rollout in 0..3 {
            let path = directory.join(format!("{folder}/rollout-{rollout}.mcap"));
            let recording = read(&path).unwrap();
            let settings = &recording.header.settings;
            assert_eq!((settings.plant, settings.calibration.encoders), (plant, plant.encoders));
            let stops = settings.stops.unwrap();
            assert!((stops.travel_rad() - 3.6).abs() < 0.03, "{stops:?}");
            assert!(settings.safety_box.theta <= narrow.theta, "{:?}", settings.safety_box);
            let (farthest_rad, largest_mv) = farthest_and_largest(&recording);
            assert!(farthest_rad < 1.8, "{farthest_rad} rad");
            assert!(largest_mv <= 4500, "{largest_mv} mV");
            let ending = recording.outcome.as_ref().unwrap().ending;
            assert!(matches!(ending, Ending::Completed | Ending::LeftBox(_)), "{ending:?}");
            let running = recording.ticks.iter().filter(|tick| tick.phase == Phase::Running);
            assert!(running.count() > 10);
            let policy = Policy::from_bytes(&recording.policy).unwrap();
            let replayed = rerun(&recording, policy);
            assert!(replayed.actions_compared > 10 && replayed.actions_different == 0);
            assert_eq!((replayed.not_compared, replayed.ending), (0, Some(ending)));
        }
    }
    let replay = ["replay", "--simulate", "recordings/rollout-0.mcap"];
    program(directory).args(replay).assert().success();
    check_refusals(directory);
}

#[test]
fn a_high_resistance_motor_passes_and_is_found_when_dead() {
    let directory = tempfile::tempdir().unwrap();
    let directory = directory.path();
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("plants/furuta-130.toml");
    let shipped = std::fs::read_to_string(shipped).unwrap();
    for (resistance, back_emf) in [("18.0", "0.12"), ("25.0", "0.09")] {
        let text = shipped.replace("R_m = 3.8 ", &format!("R_m = {resistance} "));
        let text = text.replace("k_m = 0.042 ", &format!("k_m = {back_emf} "));
        std::fs::write(directory.join("motor.toml"), &text).unwrap();
        let plant = PlantModel::parse(&text).unwrap();
        assert_eq!(plant.parameters.motor_resistance_ohm, resistance.parse::<f64>().unwrap());
        let run = ["run", "--plant", "motor.toml", "--excite", "chirp", "--volts", "2"];
        program(directory)
            .args(run)
            .args(["--clock", "virtual", "--rollouts", "1", "--out", resistance])
            .assert()
            .success();

        // A disconnected motor is found, too.
        let fault = Some(EmulatorFault::DeadMotor { after_s: 0.0 });
        let dead = EmulatorSettings { model: plant.nominal(), fault, ..Default::default() };
        let settings = RigSettings { plant, ..RigSettings::emulated(dead.of_plant(&plant)) };
        let refused = Rig::open(&settings, &Arc::default()).map(drop).unwrap_err();
        assert_eq!(refused.fault(), Some(Fault::MotorDead), "{refused}");
    }
}

/// Checks that each policy is refused on the other plant, before anything is written.
fn check_refusals(directory: &Path) {
    let qube = Path::new(env!("CARGO_MANIFEST_DIR")).join("policies/nominal.safetensors");
    let qube = qube.to_str().unwrap();
    for (policy, arguments) in [
        ("larger.safetensors", &[][..]),
        (qube, &["--plant", "larger.toml"]),
        ("classical", &["--plant", "larger.toml"]),
    ] {
        let output = program(directory)
            .args(["run", "--clock", "virtual", "--out", "none", "--policy", policy])
            .args(arguments)
            .assert()
            .code(2);
        let told = String::from_utf8(output.get_output().stderr.clone()).unwrap();
        assert!(told.contains("furuta-130") && told.contains("plant qube"), "{told}");
        assert!(!directory.join("none").exists());
    }
}

#[test]
fn a_wrong_plant_file_is_refused_with_its_line() {
    let directory = tempfile::tempdir().unwrap();
    let directory = directory.path();
    plant_file(directory);
    let text = std::fs::read_to_string(directory.join("larger.toml")).unwrap();
    let line = 1 + text.lines().position(|line| line.starts_with("hard_stop_rad")).unwrap();
    std::fs::write(directory.join("wrong.toml"), text.replace("= 1.8 ", "= 18.0 ")).unwrap();
    let commands =
        [&["train"][..], &["run", "--excite", "chirp"], &["session"], &["emulate"], &["check"]];
    for command in commands {
        let plant = ["--plant", "wrong.toml"];
        let output = program(directory).args(command).args(plant).assert().code(2);
        let told = String::from_utf8(output.get_output().stderr.clone()).unwrap();
        for word in ["wrong.toml", &format!("line {line}"), "hard_stop_rad", "0.6 to 3.1"] {
            assert!(told.contains(word), "{command:?}: {word:?} is missing in {told}");
        }
    }
}

#[test]
fn hardware_obeys_a_plant_file_that_is_no_qubes_only_with_consent() {
    let directory = tempfile::tempdir().unwrap();
    let directory = directory.path();
    plant_file(directory);
    for command in [&["run", "--excite", "chirp"][..], &["session"], &["soak", "--hours", "1"]] {
        let output = program(directory)
            .args(command)
            .args(["--device", "/dev/none", "--plant", "larger.toml"])
            .assert()
            .code(2);
        let told = String::from_utf8(output.get_output().stderr.clone()).unwrap();
        assert!(told.contains("--accept-plant") && told.contains("furuta-130"), "{told}");
    }
    // With consent the command looks for its device, of which there is none.
    for command in [&["run", "--excite", "chirp"][..], &["session"]] {
        let output = program(directory)
            .args(command)
            .args(["--device", "/dev/none", "--plant", "larger.toml", "--accept-plant"])
            .assert()
            .code(2);
        let told = String::from_utf8(output.get_output().stderr.clone()).unwrap();
        assert!(told.contains("no such port: /dev/none"), "{command:?}: {told}");
    }
}

#[test]
fn a_session_searches_for_a_larger_pendulum_and_goes_on_with_it() {
    let directory = tempfile::tempdir().unwrap();
    let directory = directory.path();
    let plant = plant_file(directory);
    let tiny = "[extent]\ninitial_candidates = 2\niterations = 0\nrollouts = 1\n\
                verification_rollouts = 1\n\
                [training]\nupdates = 2\nnum_envs = 16\nepochs = 1\n";
    std::fs::write(directory.join("tiny.toml"), tiny).unwrap();
    program(directory)
        .args(["session", "--clock", "virtual", "--config", "tiny.toml", "--out", "s"])
        .args(["--plant", "larger.toml"])
        .assert()
        .success();
    let path = directory.join("s/candidates/000/policy.safetensors");
    let Policy::Network(policy) = Policy::load(&path).unwrap() else { panic!("a network") };
    assert_eq!(policy.training.plant, plant);
    // The search is around the length of the larger pendulum.
    let psi = policy.training.psi.unwrap();
    assert!((0.14..0.19).contains(&psi["mean_L_p"]), "{psi:?}");
    let resume = ["session", "--clock", "virtual", "--resume", "s"];
    program(directory).args(resume).assert().success();
    let text = std::fs::read_to_string(directory.join("larger.toml")).unwrap();
    let other = text.replace("furuta-130", "another");
    std::fs::write(directory.join("other.toml"), other).unwrap();
    program(directory).args(resume).args(["--plant", "other.toml"]).assert().code(2);
}
