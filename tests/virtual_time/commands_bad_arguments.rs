//! Tests the messages for bad arguments: one clear sentence on stderr (the error, its place, the
//! remedy), the documented exit code, and nothing on stdout.

use std::io::Write;
use std::path::Path;

use crate::program::{has_refused, qube_hil, refused, succeeds};

#[test]
fn names_that_are_no_ports_are_refused() {
    let directory = tempfile::tempdir().unwrap();
    let run = |port: &str, words: &[&str]| {
        let arguments = ["run", "--policy", "classical", "--device", port];
        refused(directory.path(), &arguments, 2, words);
    };
    run("/dev/ttyNOWHERE", &["no such port", "/dev/ttyNOWHERE", "plugged in"]);
    run("/dev/null", &["/dev/null"]);
    // The program prints this sentence only, and announces no motion.
    for command in [&["session"][..], &["check"], &["run", "--policy", "classical"]] {
        for (port, words) in [("/dev/ttyNOWHERE", "no such port"), ("/tmp", "not a serial port")] {
            let output = qube_hil(directory.path(), &[command, &["--device", port]].concat());
            let told = String::from_utf8(output.stderr).unwrap();
            assert!(told.contains(words) && told.lines().count() == 1, "{command:?}: {told}");
        }
        let output = qube_hil(directory.path(), &[command, &["--device", "hil:none@7"]].concat());
        let told = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(2), "{command:?}: {told}");
        assert!(!told.contains("pushed") && !told.contains("homed"), "{command:?}: {told}");
        assert!(!told.contains("looks for its stops"), "{command:?}: {told}");
    }
    assert!(!directory.path().join("logs/session").exists());
}

#[test]
fn a_qube_file_for_another_board_is_refused_with_the_emulated_qube() {
    let directory = tempfile::tempdir().unwrap();
    std::fs::write(directory.path().join("qube.toml"), "board = \"B2\"\n").unwrap();
    let run = ["run", "--policy", "classical", "--qube", "qube.toml", "--device", "emulated"];
    let words = ["the emulated Qube is board", "B2"];
    refused(directory.path(), &[&run[..], &["--clock", "virtual"]].concat(), 2, &words);
}

#[test]
fn a_resumed_session_or_experiment_says_that_it_keeps_its_settings() {
    let directory = tempfile::tempdir().unwrap();
    for (arguments, advice) in [
        (["session", "--resume", "s", "--candidates", "2"], "begin a new one with --config"),
        (["session", "--seed", "2", "--resume", "s"], "begin a new one with --config"),
        (["experiment", "--resume", "s", "--policies", "2"], "an experiment keeps its settings"),
    ] {
        refused(directory.path(), &arguments, 2, &["cannot be used with", "--resume", advice]);
    }
}

#[test]
fn the_name_of_a_picture_is_no_folder_of_plots() {
    let directory = tempfile::tempdir().unwrap();
    let excite =
        ["run", "--excite", "chirp", "--profile", "lab", "--clock", "virtual", "--out", "r"];
    succeeds(directory.path(), &excite);
    let identify = ["identify", "r/rollout-0.mcap", "--plot", "plots"];
    let told = succeeds(directory.path(), &identify);
    assert!(told.contains("drew one recording and profile-correlations.svg into plots"), "{told}");
    assert!(directory.path().join("plots/profile-correlations.svg").exists());
    for name in ["mine.svg", "mine.PNG", "plots/mine.html"] {
        let identify = ["identify", "none.mcap", "--out", "new.toml", "--plot", name];
        refused(directory.path(), &identify, 2, &[name, "--plot takes a folder"]);
        assert!(!directory.path().join(name).exists());
    }
}

#[test]
fn the_help_of_a_command_states_its_own_defaults() {
    let directory = tempfile::tempdir().unwrap();
    let help = |command: &str| {
        let help = succeeds(directory.path(), &[command, "--help"]);
        help.split_whitespace().collect::<Vec<_>>().join(" ")
    };
    for command in ["run", "train", "experiment"] {
        let help = help(command);
        assert!(
            !help.contains("--config says") && !help.contains("`experiment` without"),
            "{help}"
        );
    }
    let session = help("session");
    for default in ["filter", "200"] {
        assert!(
            session.contains(&format!("[default: {default}, or as --config says]")),
            "{session}"
        );
    }
    assert!(help("experiment").contains("[default: 50 as published; with --preset robust 200]"));
}

#[test]
fn a_run_without_a_controller_names_both_ways_to_choose_one() {
    let directory = tempfile::tempdir().unwrap();
    refused(directory.path(), &["run"], 2, &["--policy", "--excite"]);
    let output = qube_hil(directory.path(), &["run", "--json"]);
    let json = String::from_utf8(output.stdout).unwrap();
    assert!(json.contains("--policy") && json.contains("--excite"), "{json}");
    let both = ["run", "--policy", "classical", "--excite", "chirp"];
    refused(directory.path(), &both, 2, &["--policy", "cannot be used with", "--excite"]);
}

#[test]
fn invalid_estimator_options_are_refused() {
    let directory = tempfile::tempdir().unwrap();
    let run = |flags: &[&str], words: &[&str]| {
        let arguments = [&["run", "--policy", "classical", "--clock", "virtual"], flags].concat();
        refused(directory.path(), &arguments, 2, words);
    };
    run(&["--estimator", "observer", "--filter", "50"], &["--filter", "--estimator filter"]);
    run(&["--estimator-delay-ms", "5"], &["--estimator-delay-ms", "--estimator observer"]);
    run(&["--estimator", "observer", "--estimator-profile", "none.toml"], &["none.toml"]);
    let path = directory.path().join("my.toml");
    std::fs::write(&path, "[estimator.observer]\nreset_error_rad = -1.0\n").unwrap();
    let arguments = ["session", "--clock", "virtual", "--config", "my.toml", "--out", "session"];
    refused(
        directory.path(),
        &arguments,
        2,
        &["my.toml", "estimator.observer.reset_error_rad = -1"],
    );
}

#[test]
fn an_invalid_psi_is_refused() {
    let directory = tempfile::tempdir().unwrap();
    let mut file = std::fs::File::create(directory.path().join("psi.toml")).unwrap();
    let text = "mean_M_p = -0.5\nstd_M_p = 0.001\nmean_M_r = 0.1\nstd_M_r = 0.001\n\
                mean_L_p = 0.13\nstd_L_p = 0.001\nmean_L_r = 0.08\nstd_L_r = 0.001\n";
    file.write_all(text.as_bytes()).unwrap();
    let arguments = ["train", "--model", "psi", "--psi", "psi.toml"];
    refused(directory.path(), &arguments, 2, &["psi.toml", "mean_M_p", "-0.5", "above 0"]);
    refused(directory.path(), &["train", "--model", "psi"], 2, &["--psi"]);
    let text = text.replace("-0.5", "0.02") + "filter = 120.0\n";
    std::fs::write(directory.path().join("psi.toml"), text).unwrap();
    let without = [&arguments[..], &["--sensors", "true"]].concat();
    refused(directory.path(), &without, 2, &["--psi names a filter", "--sensors encoders"]);
    let twice = [&arguments[..], &["--sensors", "encoders", "--filter", "50"]].concat();
    refused(directory.path(), &twice, 2, &["--psi names a filter", "--filter"]);
}

#[test]
fn invalid_simulation_options_are_refused() {
    let directory = tempfile::tempdir().unwrap();
    let cases: [(&[&str], &[&str]); 8] = [
        (&["--profile", "nowhere.toml"], &["nowhere.toml"]),
        (&["--profile", "lab", "--model", "robust"], &["--profile", "--model"]),
        (&["--profile", "lab", "--spread", "1.5"], &["--spread", "from 0 to 1"]),
        (&["--spread", "0.1"], &["--profile"]),
        (&["--delay-ms", "16..3"], &["--delay-ms", "0..16"]),
        (&["--delay-ms", "50"], &["--delay-ms", "from 0 to 40"]),
        (&["--history", "5"], &["--history", "5"]),
        (&["--preset", "thesis", "--filter", "50"], &["--sensors encoders"]),
    ];
    for (arguments, words) in cases {
        let arguments = [&["train"], arguments].concat();
        refused(directory.path(), &arguments, 2, words);
    }
}

#[test]
fn invalid_options_of_the_emulated_qube_are_refused() {
    let directory = tempfile::tempdir().unwrap();
    let cases: [(&[&str], &[&str]); 7] = [
        (&["--gap", "1.5"], &["--gap has no effect", "--profile"]),
        (&["--effect", "slack=0.5"], &["slack=0.5 changes nothing", "no cable"]),
        (&["--effect", "stribeck=0.5"], &["stribeck=0.5 changes nothing", "no dry friction"]),
        (&["--effect", "presliding_rad=0.02"], &["changes nothing", "no dry friction"]),
        (&["--cable-drift", "0.02"], &["--cable-drift", "no cable", "lab"]),
        (&["--profile", "lab", "--cable-drift", "-2"], &["--cable-drift", "from -1 to 1"]),
        (&["--profile", "lab", "--gap", "0", "--cable-drift", "0.02"], &["no cable"]),
    ];
    for (arguments, words) in cases {
        let run: &[&str] = &["run", "--policy", "classical", "--clock", "virtual"];
        refused(directory.path(), &[run, arguments].concat(), 2, words);
    }
}

#[test]
fn errors_about_values_with_a_dash_name_their_option() {
    let directory = tempfile::tempdir().unwrap();
    let run: &[&str] = &["run", "--policy", "classical", "--clock", "virtual"];
    let cases: [(&[&str], &[&str]); 4] = [
        (&["--seed", "-1"], &["'-1'", "--seed", "a whole number that is not below 0"]),
        (&["--gap", "-1"], &["'-1'", "--gap", "from 0 to 5"]),
        (&["--out", "-foo"], &["--out: ", "--out=-foo"]),
        (&["--nonsense"], &["--nonsense"]),
    ];
    for (arguments, words) in cases {
        refused(directory.path(), &[run, arguments].concat(), 2, words);
    }
}

/// With `--json`, the last line of stdout is a JSON object that names the cause of the failure.
#[test]
fn json_output_names_the_cause_of_a_failure() {
    let directory = tempfile::tempdir().unwrap();
    std::fs::write(directory.path().join("no.policy"), "nonsense").unwrap();
    let cases: [(&[&str], &str); 10] = [
        (&["run"], "--policy"),
        (&["run", "--nonsense"], "--nonsense"),
        (&["run", "--policy", "classical", "--seed", "-1"], "--seed"),
        (&["run", "--policy", "no.policy", "--clock", "virtual"], "no.policy"),
        (&["train", "--out", "missing/p"], "missing"),
        (&["session", "--device", "/dev/ttyNOWHERE"], "no such port"),
        (&["session", "--device", "/dev/ttyNOWHERE", "--profile", "lab"], "leave --profile out"),
        (&["run", "--policy", "classical", "--device", "/dev/null", "--gap", "2"], "--gap"),
        (&["replay", "missing.mcap"], "missing.mcap"),
        (&["check", "--device", "/dev/null", "--write", "missing/qube.toml"], "missing"),
    ];
    for (arguments, cause) in cases {
        let output = qube_hil(directory.path(), &[arguments, &["--json"]].concat());
        assert_eq!(output.status.code(), Some(2), "{arguments:?}");
        let stdout = String::from_utf8(output.stdout).unwrap();
        let told: serde_json::Value = serde_json::from_str(stdout.lines().last().unwrap()).unwrap();
        if told.get("recordings").is_none() {
            assert_eq!(told["ended_by"]["exit_code"], 2, "{arguments:?}: {told}");
        }
        assert!(told.to_string().contains(cause), "{arguments:?}: {told}");
        assert!(String::from_utf8_lossy(&output.stderr).contains(cause), "{arguments:?}");
    }
}

#[test]
fn a_seed_that_no_file_can_hold_is_refused() {
    let directory = tempfile::tempdir().unwrap();
    for command in ["session", "experiment"] {
        let arguments = [command, "--seed", "9223372036854775808"];
        refused(directory.path(), &arguments, 2, &["--seed", "9223372036854775807"]);
    }
}

#[test]
fn a_message_about_a_whole_number_names_no_type_of_the_program() {
    let directory = tempfile::tempdir().unwrap();
    for (settings, words) in [
        ("seed = -1", "a whole number from 0 on"),
        ("[training]\nnum_envs = 100000000", "from 0 to 65 535"),
        ("[training]\nupdates = -3", "from 0 to 4 294 967 295"),
    ] {
        std::fs::write(directory.path().join("c.toml"), settings).unwrap();
        refused(directory.path(), &["config", "check", "c.toml"], 2, &["c.toml", words]);
    }
}

#[test]
fn a_travel_outside_its_range_is_refused() {
    let directory = tempfile::tempdir().unwrap();
    for travel in ["nan", "-1", "1e300", "0"] {
        let settings = format!("[homing]\ntravel_rad = {travel}\n");
        std::fs::write(directory.path().join("c.toml"), settings).unwrap();
        let session = ["session", "--config", "c.toml", "--clock", "virtual"];
        refused(directory.path(), &session, 2, &["homing.travel_rad", "3.60 to 6.00"]);
    }
}

#[test]
fn options_that_do_not_fit_are_refused_before_anything_else_is_said() {
    let directory = tempfile::tempdir().unwrap();
    let run: &[&str] = &["run", "--policy", "classical"];
    let plant = Path::new(env!("CARGO_MANIFEST_DIR")).join("plants/furuta-130.toml");
    let plant = plant.to_str().unwrap();
    for (command, arguments, words) in [
        (run, &["--device", "/dev/null", "--clock", "virtual"][..], &["/dev/null", "--clock"][..]),
        (run, &["--device", "/dev/ttyNOWHERE"], &["no such port"]),
        (run, &["--device", "/dev/null"], &["/dev/null"]),
        (&["session"], &["--device", "/dev/null"], &["/dev/null"]),
        (run, &["--clock", "virtual", "--volts", "2"], &["--volts", "--policy"]),
        (run, &["--clock", "virtual", "--scale", "M_p=2", "--scale", "M_p=3"], &["M_p twice"]),
        (run, &["--rollouts", "0.5"], &["--rollouts", "a whole number above 0"]),
        (&["doctor"], &["--seconds", "0.1"], &["'0.1'", "a whole number above 0"]),
        (&["doctor"], &["--seconds=0.1"], &["'0.1'", "a whole number above 0"]),
        (
            &["soak"],
            &["--clock", "virtual", "--plant", plant],
            &["--policy classical", "furuta-130"],
        ),
    ] {
        let arguments = [command, arguments].concat();
        println!("{arguments:?}");
        let output = qube_hil(directory.path(), &arguments);
        has_refused(&output, 2, words);
        let told = String::from_utf8_lossy(&output.stderr);
        for early in ["homing:", "checking", "warning:", "Ctrl-C", "session with"] {
            assert!(!told.contains(early), "{early:?} is said before the refusal: {told}");
        }
    }
}

#[test]
fn infinite_and_too_large_numbers_are_refused() {
    let directory = tempfile::tempdir().unwrap();
    for hours in ["1e300", "inf", "0"] {
        let soak = ["soak", "--clock", "virtual", "--hours", hours];
        refused(directory.path(), &soak, 2, &["--hours", "above 0, at most 10000"]);
    }
    let run = ["run", "--policy", "classical", "--clock", "virtual", "--filter", "1e300"];
    refused(directory.path(), &run, 2, &["--filter", "at most 1000000"]);
}

#[test]
fn options_that_together_give_no_qube_begin_no_session() {
    let directory = tempfile::tempdir().unwrap();
    let pair = ["session", "--clock", "virtual", "--device", "emulated", "--device", "emulated"];
    let far = ["--vary", "0.2", "--delay-ms", "100", "--out", "pair"];
    let far = [&pair[..], &far].concat();
    refused(directory.path(), &far, 2, &["command_delay_s", "from 0 to 0.1"]);
    assert!(!directory.path().join("pair").exists(), "a session was begun");
}
