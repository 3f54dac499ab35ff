//! Tests identification end to end: recordings of an emulated Qube give the profile with which they
//! were made, and the first rollouts of a session or run are compared with the Qube's profile.

use std::path::Path;
use std::process::Output;
use std::sync::Arc;

use firmware_protocol::scaling::{motor_counts, motor_voltage_mv};
use qube_hil::policy::{ClassicalController, ClassicalGains, Policy};
use qube_hil::qube::{Nonideality, Profile, Quantity, applied_voltage_mv};
use qube_hil::rig::{DeviceChoice, RigSettings};
use qube_hil::session::{Extent, Session, SessionFolder, SessionSettings};
use serde_json::Value;

use crate::program;

/// Runs the program, which must succeed.
#[track_caller]
fn qube_hil(directory: &Path, arguments: &[&str]) -> Output {
    let output = program::qube_hil(directory, arguments);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    output
}

fn json(output: &Output) -> Value {
    let text = String::from_utf8_lossy(&output.stdout);
    serde_json::from_str(text.lines().last().unwrap()).unwrap()
}

fn lab_path() -> String {
    format!("{}/profiles/lab.toml", env!("CARGO_MANIFEST_DIR"))
}

#[test]
fn excitations_of_the_emulated_lab_give_its_profile_back() {
    let directory = tempfile::tempdir().unwrap();
    let excite = |shape: &str, volts: &str| {
        let run = ["run", "--excite", shape, "--volts", volts, "--profile", "lab"];
        let run = [&run[..], &["--clock", "virtual", "--out", shape]].concat();
        let excited = qube_hil(directory.path(), &run);
        let text = String::from_utf8_lossy(&excited.stdout).into_owned();
        assert!(text.contains("10.0 s recorded, usable by identify"), "{text}");
        format!("{shape}/rollout-0.mcap")
    };
    let two = |one: String, other: String| {
        // Excitations can be replayed like policies.
        qube_hil(directory.path(), &["replay", &one, &other]);
        let identify = ["identify", &one, &other, "--json", "--force"];
        assert_lab(&json(&qube_hil(directory.path(), &identify)));
    };
    two(excite("chirp", "1.5"), excite("steps", "1.5"));
    two(excite("slow-chirp", "0.75"), excite("pushes", "1.5"));
}

#[test]
fn play_between_motor_and_arm_is_named_after_a_chirp_and_pushes() {
    let directory = tempfile::tempdir().unwrap();
    let excite = |shape: &str, volts: &str| {
        let run =
            ["run", "--excite", shape, "--volts", volts, "--profile", "lab", "--seed", "1500"];
        let play = ["--play-deg", "1", "--clock", "virtual", "--out", shape];
        qube_hil(directory.path(), &[&run[..], &play].concat());
        format!("{shape}/rollout-0.mcap")
    };
    let files = [excite("chirp", "1.5"), excite("pushes", "1.05")];
    let found = json(&qube_hil(directory.path(), &["identify", &files[0], &files[1], "--json"]));
    assert_eq!(found["verdict"], "fits_but", "{found}");
    assert_eq!(found["doubts"][1], "play", "{found}");
    let profile = std::fs::read_to_string(directory.path().join("profile.toml")).unwrap();
    let doubts = Profile::parse(&profile).unwrap().provenance.unwrap().doubts;
    assert_eq!(doubts, ["unexplained", "play"]);
}

/// The motions of several rollouts of one policy are alike, and mostly balancing.
#[test]
fn rollouts_of_a_policy_alone_give_the_profile_back() {
    let directory = tempfile::tempdir().unwrap();
    let policy = format!("{}/policies/robust.safetensors", env!("CARGO_MANIFEST_DIR"));
    let run = ["run", "--policy", &policy, "--rollouts", "2", "--profile", "lab"];
    let run = [&run[..], &["--clock", "virtual", "--seed", "1002", "--out", "robust"]].concat();
    qube_hil(directory.path(), &run);
    let files = ["robust/rollout-0.mcap", "robust/rollout-1.mcap"];
    assert_lab(&json(&qube_hil(directory.path(), &["identify", files[0], files[1], "--json"])));
}

/// Under slow steps, the rest angle of the cable and unequal dead zones have similar effects.
#[test]
fn one_recording_under_slow_steps_gives_the_profile_back() {
    let directory = tempfile::tempdir().unwrap();
    let run = ["run", "--excite", "steps", "--volts", "0.6", "--profile", "lab"];
    let run = [&run[..], &["--clock", "virtual", "--seed", "1402", "--out", "steps"]].concat();
    qube_hil(directory.path(), &run);
    let found = qube_hil(directory.path(), &["identify", "steps/rollout-0.mcap", "--json"]);
    assert_lab(&json(&found));
}

/// Checks that `identify` has found the profile `lab`.
fn assert_lab(found: &Value) {
    // Nothing of the emulated rig is taken for an effect outside the equations.
    assert_eq!(found["verdict"], "fits", "{found}");
    let lab = Profile::lab();
    let expected = toml::Table::try_from(&lab).unwrap();
    let mut told = 0;
    for estimate in found["estimates"].as_array().unwrap() {
        let name = estimate["name"].as_str().unwrap();
        let number = |field: &str| estimate[field].as_f64().unwrap();
        let (value, standard_error) = (number("value"), number("standard_error"));
        let in_table = |table: &str| expected[table].get(name).and_then(toml::Value::as_float);
        let expected = in_table("parameters").or_else(|| in_table("gap")).unwrap();
        // The fitted delay begins with the sample, so it is longer than the profile's by the time
        // on the wire, at most 1.5 ms.
        let wire = if name == "command_delay_s" { 0.0015 } else { 0.0 };
        let off = (value - expected).abs();
        assert!(off < 4.0 * standard_error + wire, "{name} = {value}, not {expected}: {estimate}");
        told += u32::from(number("told_by_data") > 0.5);
    }
    assert!(told >= 6, "the recordings determine only {told} quantities");
}

/// A recording does not hold the commands that were on their way when it began; at a delay above
/// 10 ms there are two of them.
#[test]
fn a_delayed_qube_and_one_with_a_larger_gap_fit_their_models() {
    let directory = tempfile::tempdir().unwrap();
    let policy = format!("{}/policies/robust.safetensors", env!("CARGO_MANIFEST_DIR"));
    for plant in [["--delay-ms", "18"], ["--gap", "1.5"]] {
        let on = |out: &str, driven: &[&str]| {
            let place = ["--profile", "lab", "--clock", "virtual", "--out", out];
            qube_hil(directory.path(), &[&["run"], driven, &plant, &place].concat());
        };
        let (excited, driven) = (format!("excited{}", plant[0]), format!("driven{}", plant[0]));
        on(&excited, &["--excite", "chirp", "--unidentified"]);
        on(&driven, &["--policy", &policy, "--guard", "box", "--rollouts", "3"]);
        let files: Vec<String> = std::iter::once(format!("{excited}/rollout-0.mcap"))
            .chain((0..3).map(|number| format!("{driven}/rollout-{number}.mcap")))
            .collect();
        let mut arguments = vec!["identify", "--json", "--force"];
        arguments.extend(files.iter().map(String::as_str));
        let found = json(&qube_hil(directory.path(), &arguments));
        assert_eq!(found["verdict"], "fits", "{plant:?}: {found}");
    }
}

#[test]
fn an_identification_without_unknowns_is_refused() {
    let directory = tempfile::tempdir().unwrap();
    let names = qube_hil::identification::Unknown::all().map(|unknown| unknown.name());
    let fixed = names.flat_map(|name| ["--fix", name]);
    // The command is refused before it reads a recording: none.csv does not exist.
    let arguments: Vec<&str> = ["identify", "none.csv"].into_iter().chain(fixed).collect();
    let output = program::qube_hil(directory.path(), &arguments);
    assert_eq!(output.status.code(), Some(2), "{output:?}");
    let told = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(told.contains("--fix names every quantity"), "{told}");
    assert!(told.contains("leave out --fix for at least one"), "{told}");
    assert!(!directory.path().join("profile.toml").exists());
}

#[test]
fn a_recorded_voltage_is_rounded_as_the_firmware_rounds_it() {
    for commanded_mv in -5000..=5000 {
        let by_firmware = motor_voltage_mv(motor_counts(commanded_mv));
        assert_eq!(applied_voltage_mv(commanded_mv), by_firmware, "{commanded_mv} mV");
    }
}

#[test]
fn a_rollout_of_a_policy_gives_a_model_that_predicts_another_one() {
    let directory = tempfile::tempdir().unwrap();
    let policy = concat!(env!("CARGO_MANIFEST_DIR"), "/policies/robust.safetensors");
    let run = ["run", "--policy", policy, "--profile", "lab", "--clock", "virtual"];
    // Guarded by the box alone, so that foresight does not end the rollouts.
    let more = ["--guard", "box", "--seed", "2", "--rollouts", "2", "--out", "swing"];
    qube_hil(directory.path(), &[&run[..], &more].concat());
    let files = ["swing/rollout-0.mcap", "--holdout", "swing/rollout-1.mcap", "--json"];
    let found = json(&qube_hil(directory.path(), &[&["identify"][..], &files].concat()));
    let balance = &found["held_out_phases"][1];
    let number = |field: &str| balance[field].as_f64().unwrap();
    assert_eq!(balance["phase"], "balance");
    assert!(number("predictions") >= 20.0, "{balance}");
    assert!(number("theta_rad") < 0.005 && number("alpha_rad") < 0.01, "{balance}");
}

#[test]
fn the_first_rollouts_say_whether_the_rig_is_as_its_profile() {
    let directory = tempfile::tempdir().unwrap();
    let qube = format!("profile = {:?}\n", lab_path());
    std::fs::write(directory.path().join("qube.toml"), qube).unwrap();
    let mut shifted = Profile::lab();
    shifted.nonidealities.cable_rest_rad += 0.4;
    let shifted = toml::to_string(&shifted).unwrap();
    std::fs::write(directory.path().join("shifted.toml"), shifted).unwrap();

    let drift = |out: &str, more: &[&str]| {
        // The classical controller balances in a limit cycle, for which the fit of the delay may
        // converge elsewhere.
        let policy = concat!(env!("CARGO_MANIFEST_DIR"), "/policies/robust.safetensors");
        let common = ["run", "--policy", policy, "--qube", "qube.toml", "--device", "emulated"];
        // Guarded by the box alone, so that foresight does not end the rollouts. With some seeds
        // the fitted delay is up to 3 ms too long.
        let rest = [
            "--seed",
            "2",
            "--guard",
            "box",
            "--clock",
            "virtual",
            "--rollouts",
            "3",
            "--json",
            "--out",
            out,
        ];
        json(&qube_hil(directory.path(), &[&common, more, &rest].concat()))["drift"].clone()
    };
    let same = drift("same", &["--profile", "lab"]);
    for quantity in ["command_delay_s", "cable_rest_rad", "alpha_zero_rad"] {
        assert_eq!(same[quantity]["moved"], false, "{quantity}: {same}");
    }
    let late = drift("late", &["--profile", "lab", "--delay-ms", "17"]);
    assert_eq!(late["command_delay_s"]["moved"], true, "{late}");
    let today = late["command_delay_s"]["today"].as_f64().unwrap();
    assert!((today - 0.0175).abs() < 0.002, "{late}");
    let moved = drift("moved", &["--profile", "shifted.toml"]);
    assert_eq!(moved["cable_rest_rad"]["moved"], true, "{moved}");
    let today = moved["cable_rest_rad"]["today"].as_f64().unwrap();
    assert!((today - (Profile::lab().nonidealities.cable_rest_rad + 0.4)).abs() < 0.15, "{moved}");
}

#[test]
fn a_session_says_that_its_rig_has_moved() {
    let directory = tempfile::tempdir().unwrap();
    let qube = format!("profile = {:?}\n", lab_path());
    std::fs::write(directory.path().join("qube.toml"), qube).unwrap();
    // Three candidates and a verification without training: the session adopts the existing
    // policies.
    let mut emulated = Profile::lab();
    emulated.nonidealities.command_delay_s = 0.017;
    let mut configuration = SessionSettings::quick();
    configuration.extent = Extent {
        initial_candidates: 3,
        iterations: 0,
        rollouts: 1,
        verification_rollouts: 1,
        ..Extent::QUICK
    };
    configuration.emulated.model = emulated.model();
    let session = directory.path().join("one");
    let folder = SessionFolder::create(&session, &configuration.to_toml().unwrap()).unwrap();
    let rig = RigSettings::in_virtual_time(DeviceChoice::Emulated);
    drop(Session::open(folder, configuration, rig, Arc::default()).unwrap());
    let policy = Policy::Classical(ClassicalController::new(ClassicalGains::default())).to_bytes();
    for candidate in ["000", "001", "002", "003"] {
        let folder = session.join("candidates").join(candidate);
        std::fs::create_dir(&folder).unwrap();
        std::fs::write(folder.join("policy.safetensors"), &policy).unwrap();
    }
    let output = qube_hil(
        directory.path(),
        &[
            "session",
            "--resume",
            "one",
            "--clock",
            "virtual",
            "--qube",
            "qube.toml",
            "--device",
            "emulated",
        ],
    );
    let told = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(told.contains("from 3 rollouts") && told.contains("MOVED"), "{told}");
    assert!(told.contains("the rig has moved away from its profile"), "{told}");
}

#[test]
fn incomplete_recordings_are_named_with_the_seconds_that_are_used() {
    let directory = tempfile::tempdir().unwrap();
    let path = |name: &str| directory.path().join(name);
    let run = ["run", "--clock", "virtual", "--profile", "lab"];
    let chirps = ["--excite", "chirp", "--rollouts", "2", "--out", "chirp"];
    qube_hil(directory.path(), &[&run[..], &chirps].concat());
    let whole = std::fs::read(path("chirp/rollout-0.mcap")).unwrap();
    std::fs::write(path("cut.mcap"), &whole[..whole.len() / 2]).unwrap();
    // This file lacks only its last bytes; every tick is there.
    std::fs::write(path("index.mcap"), &whole[..whole.len() - 20]).unwrap();
    let recovered = program::qube_hil(directory.path(), &["recover", "cut.mcap"]);
    assert_eq!(recovered.status.code(), Some(3));

    let identify = |files: &[&str], out: &str| {
        let fixed = ["R_m", "k_m", "D_r", "M_r", "M_p", "L_r", "cable_rest_rad"];
        let fixed: Vec<&str> = fixed.into_iter().flat_map(|name| ["--fix", name]).collect();
        let output = ["--out", out, "--json"];
        qube_hil(directory.path(), &[&["identify"], files, &fixed, &output].concat())
    };
    let told = identify(&["index.mcap"], "whole.toml");
    assert_eq!(json(&told)["incomplete"], serde_json::json!([]));
    assert!(!String::from_utf8_lossy(&told.stderr).contains("complete"), "{told:?}");

    for (option, name) in [(None, "cut.mcap"), (Some("--holdout"), "cut.recovered.mcap")] {
        let files: Vec<&str> =
            [Some("chirp/rollout-1.mcap"), option, Some(name)].into_iter().flatten().collect();
        let told = identify(&files, &format!("{name}.toml"));
        let stderr = String::from_utf8_lossy(&told.stderr);
        let incomplete = json(&told)["incomplete"].clone();
        let entry = &incomplete[0];
        let used_s = entry["used_s"].as_f64().unwrap();
        assert!((3.0..7.0).contains(&used_s), "{incomplete}");
        assert_eq!(
            (&entry["file"], &entry["reason"]),
            (&name.into(), &"its end is missing".into())
        );
        let words = format!("{name} (its end is missing; {used_s:.2} s of it are used)");
        assert!(stderr.contains(&words), "{words:?} is missing in: {stderr}");
    }
}

#[test]
fn a_recording_that_says_too_little_is_left_out_and_named() {
    let directory = tempfile::tempdir().unwrap();
    let path = |name: &str| directory.path().join(name);
    let run = ["run", "--clock", "virtual", "--profile", "lab", "--excite", "chirp"];
    qube_hil(directory.path(), &[&run[..], &["--rollouts", "2", "--out", "chirp"]].concat());
    let whole = std::fs::read(path("chirp/rollout-0.mcap")).unwrap();
    // The arm settles in the first, and the excitation has begun in the second.
    std::fs::write(path("settles.mcap"), &whole[..whole.len() / 8]).unwrap();
    std::fs::write(path("short.mcap"), &whole[..whole.len() / 5]).unwrap();

    std::fs::copy(path("short.mcap"), path("held-out.mcap")).unwrap();
    let held_out = ["--holdout", "held-out.mcap", "chirp/rollout-1.mcap", "--plot", "plots"];
    let files = [&["short.mcap", "chirp/rollout-0.mcap", "settles.mcap"], &held_out[..]].concat();
    let told = qube_hil(directory.path(), &[&["identify", "--json"], &files[..]].concat());
    let found = json(&told);
    let left_out = &found["left_out"];
    assert_eq!(left_out.as_array().unwrap().len(), 3, "{left_out}");
    for (entry, (file, reason)) in left_out.as_array().unwrap().iter().zip([
        ("short.mcap", "it lasts"),
        ("settles.mcap", "fewer than two samples under the policy"),
        ("held-out.mcap", "it lasts"),
    ]) {
        assert_eq!(entry["file"], file);
        assert!(entry["reason"].as_str().unwrap().contains(reason), "{left_out}");
    }
    assert_eq!(found["incomplete"], serde_json::json!([]));
    assert_eq!(found["recordings"].as_array().unwrap().len(), 1);
    assert_eq!(found["recordings"][0]["file"], "chirp/rollout-0.mcap");
    assert!(found["held_out_phases"][0]["predictions"].as_u64().unwrap() > 50, "{found}");
    assert_eq!(std::fs::read_dir(path("plots")).unwrap().count(), 3);
    assert!(path("plots/profile-correlations.svg").exists());
    let stderr = String::from_utf8_lossy(&told.stderr);
    assert!(stderr.contains("warning: not used: short.mcap"), "{stderr}");

    // The command is refused if it can use none of its recordings, or no recording of --holdout.
    for files in [&["short.mcap"][..], &["chirp/rollout-0.mcap", "--holdout", "short.mcap"]] {
        let identify = [&["identify"], files, &["--out", "refused.toml"]].concat();
        let refused = program::qube_hil(directory.path(), &identify);
        assert_eq!(refused.status.code(), Some(2), "{files:?}");
        assert!(String::from_utf8_lossy(&refused.stderr).contains("short.mcap: it lasts"));
    }
}

/// The friction near rest is so stiff that the integration steps for `lab` would be too long.
#[test]
fn a_qube_with_five_times_the_friction_of_lab_gives_dead_zones_and_cable_rest_back() {
    let directory = tempfile::tempdir().unwrap();
    let text = "name = \"stiff\"\n[parameters]\ng = 9.81\nR_m = 7.6\nk_m = 0.045\nD_r = 1e-5\n\
                D_p = 3e-6\nM_r = 0.1\nM_p = 0.026\nL_r = 0.09\nL_p = 0.14\n[gap]\n\
                coulomb_torque_n_m = 0.0022\npositive_dead_zone_v = 0.3\n\
                negative_dead_zone_v = 0.1\ncable_stiffness_n_m_rad = 0.0004\n\
                cable_rest_rad = 0.4\ncommand_delay_s = 0.006\n";
    std::fs::write(directory.path().join("stiff.toml"), text).unwrap();
    let truth = Profile::parse(text).unwrap().model();
    let run = ["run", "--clock", "virtual", "--profile", "stiff.toml", "--excite", "chirp"];
    let chirps = ["--rollouts", "2", "--seed", "31521", "--out", "c"];
    qube_hil(directory.path(), &[&run[..], &chirps].concat());
    let files = ["c/rollout-0.mcap", "c/rollout-1.mcap", "--out", "found.toml"];
    qube_hil(directory.path(), &[&["identify"], &files[..]].concat());
    let found = std::fs::read_to_string(directory.path().join("found.toml")).unwrap();
    let found = Profile::parse(&found).unwrap();
    for quantity in
        [Nonideality::PositiveDeadZone, Nonideality::NegativeDeadZone, Nonideality::CableRest]
    {
        let quantity = Quantity::from(quantity);
        let off = found.model().get(quantity) - truth.get(quantity);
        let errors = off / found.standard_error(quantity);
        assert!(errors.abs() < 3.5, "{}: {errors:.1} standard errors off", quantity.name());
    }
}

#[test]
fn a_copy_of_a_recording_is_no_new_evidence() {
    let directory = tempfile::tempdir().unwrap();
    let path = |name: &str| directory.path().join(name);
    let run = ["run", "--clock", "virtual", "--profile", "lab", "--excite", "chirp"];
    qube_hil(directory.path(), &[&run[..], &["--out", "chirp"]].concat());
    std::fs::copy(path("chirp/rollout-0.mcap"), path("copy.mcap")).unwrap();
    qube_hil(directory.path(), &["export", "chirp/rollout-0.mcap", "--out", "tables"]);
    let whole = std::fs::read(path("chirp/rollout-0.mcap")).unwrap();
    std::fs::write(path("cut.mcap"), &whole[..whole.len() * 3 / 4]).unwrap();
    for copy in ["copy.mcap", "tables/rollout-0.csv", "cut.mcap"] {
        for option in [&[][..], &["--holdout"]] {
            let identify = [&["identify", "chirp/rollout-0.mcap"], option, &[copy]].concat();
            let refused = program::qube_hil(directory.path(), &identify);
            let told = String::from_utf8_lossy(&refused.stderr).into_owned();
            assert_eq!(refused.status.code(), Some(2), "{copy} {option:?}: {told}");
            let words = format!("{copy} holds the same motion as chirp/rollout-0.mcap");
            assert!(told.contains(&words), "{told}");
        }
    }
}
