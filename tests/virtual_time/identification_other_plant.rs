//! Tests the identification of a rotary pendulum that is no Qube: 30 % larger, with an arm that
//! turns 1.8 rad to either side.

use std::fmt::Write as _;
use std::path::Path;

use qube_hil::qube::{PlantModel, Profile, Quantity};
use qube_hil::replay::MotionLog;
use serde_json::Value;

use crate::program::{program, succeeds};

const LARGER: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/plants/furuta-130.toml");
const LAB: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/profiles/lab.toml");

fn larger() -> PlantModel {
    PlantModel::parse(&std::fs::read_to_string(LARGER).unwrap()).unwrap()
}

/// A specimen that differs from the plant's file as the Qube `lab` differs from the nominal Qube.
fn specimen() -> Profile {
    let lab = Profile::parse(&std::fs::read_to_string(LAB).unwrap()).unwrap();
    let model = larger().in_proportion(&lab.model());
    Profile { plant: larger().name, ..Profile::exact("specimen", &model) }
}

fn refused(directory: &Path, arguments: &[&str], words: &[&str]) {
    let output = program(directory).args(arguments).assert().code(2);
    let told = String::from_utf8(output.get_output().stderr.clone()).unwrap();
    for word in words {
        assert!(told.contains(word), "{arguments:?}: {word:?} is missing in {told}");
    }
}

/// Records two chirps and one rollout of steps of the specimen.
fn record(directory: &Path) {
    let text = toml::to_string(&specimen()).unwrap();
    assert!(text.contains("plant = \"furuta-130\""), "{text}");
    std::fs::write(directory.join("specimen.toml"), text).unwrap();
    for (shape, rollouts) in [("chirp", "2"), ("steps", "1")] {
        let run = ["run", "--plant", LARGER, "--profile", "specimen.toml", "--clock", "virtual"];
        let excited = ["--excite", shape, "--rollouts", rollouts, "--out", shape];
        let text = succeeds(directory, &[&run[..], &excited].concat());
        assert!(text.contains("10.0 s recorded, usable by identify"), "{text}");
    }
}

/// Writes the motion of a recording as a table with all digits.
fn write_table(recording: &Path, table: &Path) {
    let log = MotionLog::read(recording).unwrap();
    assert_eq!(log.plant, larger());
    let head = "time_s,theta_rad,alpha_rad,theta_dot_rad_s,alpha_dot_rad_s,voltage_v\n";
    let mut text = head.to_owned();
    for sample in &log.samples {
        let state = &sample.state;
        let _ = writeln!(
            text,
            "{},{},{},{},{},{}",
            sample.time_s,
            state.theta,
            state.alpha,
            state.theta_dot,
            state.alpha_dot,
            sample.voltage_v
        );
    }
    std::fs::write(table, text).unwrap();
}

#[test]
fn a_larger_pendulum_is_identified_within_its_intervals() {
    let directory = tempfile::tempdir().unwrap();
    let directory = directory.path();
    record(directory);
    let [chirp, steps] = ["chirp/rollout-0.mcap", "steps/rollout-0.mcap"];
    let held_out = ["--holdout", "chirp/rollout-1.mcap"];
    let identify = ["identify", chirp, steps, "--out", "found.toml", "--json"];
    let told = succeeds(directory, &[&identify[..], &held_out].concat());
    let found: Value = serde_json::from_str(told.lines().last().unwrap()).unwrap();
    assert_eq!(found["verdict"], "fits", "{found}");
    let truth = specimen().model();
    let mut of_data = 0;
    for estimate in found["estimates"].as_array().unwrap() {
        let quantity = Quantity::from_name(estimate["name"].as_str().unwrap()).unwrap();
        let number = |field: &str| estimate[field].as_f64().unwrap();
        // The fitted delay begins with the sample, so it is longer than the specimen's by the time
        // on the wire, at most 1.5 ms.
        let wire_s = if quantity.name() == "command_delay_s" { 0.0015 } else { 0.0 };
        let off = (number("value") - truth.get(quantity)).abs();
        let most = 4.0 * number("standard_error") + wire_s;
        assert!(off < most, "{}: {estimate}", truth.get(quantity));
        of_data += usize::from(number("told_by_data") > 0.5);
    }
    assert!(of_data >= 8, "{found}");

    let profile = std::fs::read_to_string(directory.join("found.toml")).unwrap();
    let profile = Profile::parse(&profile).unwrap();
    assert_eq!(profile.plant, larger().name);
    let error = |quantity: &str| {
        let quantity = Quantity::from_name(quantity).unwrap();
        profile.model().get(quantity) / truth.get(quantity) - 1.0
    };
    // The length alone decides how fast the pendulum swings.
    assert!(error("L_p").abs() < 0.01, "{}", error("L_p"));

    // The profile serves the recordings of its plant and no others.
    for command in [&["replay", "--simulate"][..], &["report", "--out", "page.html"]] {
        succeeds(directory, &[command, &["--profile", "found.toml", chirp]].concat());
    }
    for command in [&["replay", "--simulate"][..], &["report", "--out", "other.html"]] {
        refused(
            directory,
            &[command, &["--profile", "lab", chirp]].concat(),
            &["furuta-130", "qube"],
        );
    }
    let small = ["--sensors", "encoders", "--out", "p.safetensors"];
    let train = ["train", "--preset", "quick", "--profile", "found.toml"];
    refused(directory, &[&train[..], &small].concat(), &["found.toml", "furuta-130"]);
    succeeds(directory, &[&train[..], &small, &["--plant", LARGER]].concat());

    // A table names no plant; with its plant it gives the same values.
    write_table(&directory.join(chirp), &directory.join("motion.csv"));
    let of_one = |file: &str, more: &[&str]| {
        succeeds(directory, &[&["identify", file, "--force", "--out", "one.toml"], more].concat());
        let text = std::fs::read_to_string(directory.join("one.toml")).unwrap();
        let profile = Profile::parse(&text).unwrap();
        (profile.plant, profile.model())
    };
    assert_eq!(of_one("motion.csv", &["--plant", LARGER]), of_one(chirp, &[]));
}

#[test]
fn recordings_of_different_plants_are_not_identified_together() {
    let directory = tempfile::tempdir().unwrap();
    let directory = directory.path();
    for (out, plant) in [("qube", &[][..]), ("larger", &["--plant", LARGER])] {
        let run = ["run", "--excite", "chirp", "--clock", "virtual", "--out", out];
        succeeds(directory, &[&run[..], plant].concat());
    }
    let [qube, larger] = ["qube/rollout-0.mcap", "larger/rollout-0.mcap"];
    refused(directory, &["identify", qube, larger], &["furuta-130", "qube", "one plant at a time"]);
    refused(directory, &["identify", larger, "--holdout", qube], &["one plant at a time"]);
    refused(directory, &["identify", qube, "--plant", LARGER], &["one plant at a time"]);
    let weaker = std::fs::read_to_string(LARGER).unwrap();
    let weaker = weaker.replace("largest_voltage_v = 5.0", "largest_voltage_v = 4.5");
    std::fs::write(directory.join("weaker.toml"), weaker).unwrap();
    let described = ["identify", larger, "--plant", "weaker.toml"];
    refused(directory, &described, &["another description of the plant furuta-130"]);
    let from = ["identify", larger, "--from", LAB];
    refused(directory, &from, &["lab.toml", "furuta-130"]);
    assert!(!directory.join("profile.toml").exists());
}

#[test]
fn a_session_identifies_a_larger_pendulum_and_ends_with_a_policy() {
    let directory = tempfile::tempdir().unwrap();
    let directory = directory.path();
    let tiny = "seed = 5\n\
                [extent]\nrepetitions = 3\nverification_rollouts = 1\n\
                [identification]\ncandidates = 2\n\
                [training]\nupdates = 2\nnum_envs = 16\nepochs = 1\n";
    std::fs::write(directory.join("tiny.toml"), tiny).unwrap();
    std::fs::write(directory.join("specimen.toml"), toml::to_string(&specimen()).unwrap()).unwrap();
    let session =
        ["session", "--clock", "virtual", "--config", "tiny.toml", "--out", "s", "--json"];
    let of_plant = ["--plant", LARGER, "--profile", "specimen.toml"];
    let told = succeeds(directory, &[&session[..], &of_plant].concat());
    let told: Value = serde_json::from_str(&told).unwrap();
    let verdict = told["identification"]["verdict"].as_str().unwrap_or_else(|| panic!("{told}"));
    assert!(verdict.starts_with("fits"), "{told}");
    let profile = std::fs::read_to_string(directory.join("s/profile-1.toml")).unwrap();
    let profile = Profile::parse(&profile).unwrap();
    assert_eq!(profile.plant, larger().name);
    let length_m = profile.parameters.pendulum_length_m;
    let true_m = specimen().parameters.pendulum_length_m;
    assert!((length_m / true_m - 1.0).abs() < 0.02, "{length_m} m instead of {true_m} m");
    let policy = told["best"]["policy"].as_str().unwrap_or_else(|| panic!("{told}"));
    assert!(directory.join(policy).exists(), "{policy}");
    // The session can be resumed and reported like a Qube's.
    succeeds(directory, &["session", "--clock", "virtual", "--resume", "s"]);
    succeeds(directory, &["report", "s"]);
}

#[test]
fn an_experiment_compares_recipes_and_methods_on_a_larger_pendulum() {
    let directory = tempfile::tempdir().unwrap();
    let directory = directory.path();
    for (name, model) in [("tiny", "robust"), ("searched", "opt-robust")] {
        let recipe = format!(
            "name = \"{name}\"\nmodel = \"{model}\"\n\
             [settings.training]\nupdates = 2\nnum_envs = 16\nepochs = 1\n"
        );
        std::fs::write(directory.join(format!("{name}.toml")), recipe).unwrap();
    }
    std::fs::write(directory.join("specimen.toml"), toml::to_string(&specimen()).unwrap()).unwrap();
    let common = ["experiment", "--plant", LARGER, "--profile", "specimen.toml"];
    let recipe = ["--recipe", "tiny.toml", "--policies", "1", "--rollouts", "1", "--out", "table"];
    succeeds(directory, &[&common[..], &recipe].concat());
    let folder = directory.join("table/policies/tiny/000");
    let recording = folder.join("specimen/rollout-0-attempt-0.mcap");
    let recording = qube_hil::recording::read(&recording).unwrap();
    let settings = &recording.header.settings;
    assert_eq!((settings.plant, settings.calibration.encoders), (larger(), larger().encoders));
    assert!(settings.safety_box.theta < 1.8, "{:?}", settings.safety_box);
    assert!((settings.stops.unwrap().travel_rad() - 3.6).abs() < 0.03);

    // The experiment goes on with its own plant and no other.
    succeeds(directory, &["experiment", "--resume", "table"]);
    let other = std::fs::read_to_string(LARGER).unwrap().replace("furuta-130", "another");
    std::fs::write(directory.join("other.toml"), other).unwrap();
    let resume = ["experiment", "--resume", "table", "--plant", "other.toml"];
    refused(directory, &resume, &["furuta-130", "leave --plant out"]);
    let lab = ["experiment", "--plant", LARGER, "--profile", "lab", "--models", "nominal"];
    refused(directory, &lab, &["lab", "furuta-130"]);

    // A method identifies the specimen, and a rival learns about it.
    let methods = ["--strategies", "posterior,simopt", "--budgets", "1", "--repetitions", "1"];
    let compared = ["--recipe", "searched.toml", "--out", "methods"];
    succeeds(directory, &[&common[..], &methods, &compared].concat());
    let found = directory.join("methods/budgets/specimen/posterior/000/identified-1.toml");
    let found = Profile::parse(&std::fs::read_to_string(found).unwrap()).unwrap();
    assert_eq!(found.plant, larger().name);
    let length = found.parameters.pendulum_length_m / specimen().parameters.pendulum_length_m;
    assert!((length - 1.0).abs() < 0.02, "{length}");
}
