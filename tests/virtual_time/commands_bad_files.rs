//! Tests the messages for bad files and folders: one clear sentence on stderr (the file, its place,
//! the remedy), the documented exit code, and nothing on stdout.

use std::path::Path;

use qube_hil::identification::Unknown;
use qube_hil::recording::read;

use crate::program::{has_refused, qube_hil, refused, succeeds};
use crate::shared::command_in;

#[test]
fn files_that_are_no_policies_are_refused() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("bad.safetensors");
    let run = |words: &[&str]| {
        let arguments = ["run", "--policy", "bad.safetensors", "--clock", "virtual"];
        refused(directory.path(), &arguments, 2, words);
    };
    run(&["bad.safetensors"]);
    std::fs::write(&path, b"not a policy at all").unwrap();
    run(&["bad.safetensors"]);

    // A shipped policy with its first number turned into NaN, and one whose header gives a layer
    // another width.
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("policies/nominal.safetensors");
    let whole = std::fs::read(shipped).unwrap();
    let header = 8 + u64::from_le_bytes(whole[..8].try_into().unwrap()) as usize;
    let mut with_nan = whole.clone();
    with_nan[header..header + 4].copy_from_slice(&f32::NAN.to_le_bytes());
    std::fs::write(&path, &with_nan).unwrap();
    run(&["bad.safetensors", "NaN"]);
    let text = String::from_utf8_lossy(&whole[..header]).replace("[64,64]", "[63,64]");
    let mut other_shape = text.into_bytes();
    other_shape.extend_from_slice(&whole[header..]);
    std::fs::write(&path, &other_shape).unwrap();
    run(&["bad.safetensors"]);
}

#[test]
fn an_excitation_is_no_policy() {
    let directory = tempfile::tempdir().unwrap();
    let directory = directory.path();
    let excite = ["run", "--excite", "steps", "--volts", "0.5", "--clock", "virtual"];
    succeeds(directory, &[&excite[..], &["--out", "r"]].concat());
    let recording = read(&directory.join("r/rollout-0.mcap")).unwrap();
    std::fs::write(directory.join("e.safetensors"), &recording.policy).unwrap();
    for command in ["run", "soak"] {
        let arguments = [command, "--policy", "e.safetensors", "--clock", "virtual"];
        refused(directory, &arguments, 2, &["e.safetensors", "--excite steps --volts 0.5"]);
    }
}

#[test]
fn a_link_in_a_folder_that_is_missing_is_named() {
    let directory = tempfile::tempdir().unwrap();
    let words = ["--link missing/qube", "the folder missing", "create it first"];
    refused(directory.path(), &["emulate", "--link", "missing/qube"], 2, &words);
}

#[test]
fn a_foreign_name_in_an_onnx_file_begins_no_line() {
    let directory = tempfile::tempdir().unwrap();
    let model = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/onnx/tanh.onnx");
    let mut bytes = std::fs::read(model).unwrap();
    for place in 0..bytes.len() - 3 {
        if &bytes[place..place + 4] == b"Tanh" {
            bytes[place..place + 4].copy_from_slice(b"T\nnh");
        }
    }
    std::fs::write(directory.path().join("model.onnx"), bytes).unwrap();
    let import = ["import", "model.onnx", "--action-scale", "5", "--filter", "0.5"];
    let output = qube_hil(directory.path(), &import);
    has_refused(&output, 2, &["model.onnx", "operator"]);
    let told = String::from_utf8(output.stderr).unwrap();
    assert_eq!(told.lines().count(), 1, "{told}");
}

#[test]
fn an_imported_file_with_the_wrong_conventions_is_refused_with_a_remedy() {
    let directory = tempfile::tempdir().unwrap();
    let foreign = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/onnx/tanh.onnx");
    let foreign = foreign.to_str().unwrap();
    refused(directory.path(), &["import", foreign, "--history", "2"], 2, &["--action-scale"]);
    // Single precision would round this scale to 0.
    let vanishing = ["import", foreign, "--action-scale", "1e-50"];
    refused(directory.path(), &vanishing, 2, &["1e-50", "at least 1e-6 V"]);
    let policy = Path::new(env!("CARGO_MANIFEST_DIR")).join("policies/robust.safetensors");
    let export = ["export", policy.to_str().unwrap(), "--onnx", "--out", "."];
    assert!(qube_hil(directory.path(), &export).status.success());
    for convention in [&["--history", "2"][..], &["--action-scale", "5"]] {
        let import = [&["import", "robust.onnx"], convention].concat();
        let words = ["robust.onnx", "names its conventions itself", "leave out"];
        refused(directory.path(), &import, 2, &words);
        assert!(!directory.path().join("policy.safetensors").exists(), "{convention:?}");
    }
}

#[test]
fn invalid_configurations_are_refused_with_their_line() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("my.toml");
    let session = |text: &str, words: &[&str]| {
        std::fs::write(&path, text).unwrap();
        let arguments =
            ["session", "--clock", "virtual", "--config", "my.toml", "--out", "session"];
        refused(directory.path(), &arguments, 2, words);
        assert!(!directory.path().join("session").exists(), "a session was begun");
    };
    session("seed = 1\nsede = 2\n", &["my.toml", "line 2", "sede"]);
    session("[extent]\nrollouts = 0\n", &["my.toml", "extent.rollouts"]);
    session("[training]\nupdates = \"many\"\n", &["my.toml", "line 2"]);
    session("[training]\nupdates = 0\n", &["my.toml, line 2: training.updates = 0"]);
    session("[extent]\niterations = 4000000000\n", &["my.toml, line 2: extent.iterations"]);
    session("[safety_box]\ntheta = 1e300\n", &["my.toml, line 2: safety_box.theta = 1e300: "]);
    for (entry, named) in [
        ("discount = 7.0", "training.discount = 7"),
        ("num_envs = 0", "training.num_envs = 0"),
        // The name in files of earlier versions.
        ("pendulums = 0", "training.pendulums = 0"),
    ] {
        let recipe =
            format!("name = \"mine\"\nmodel = \"nominal\"\n[settings.training]\n{entry}\n");
        std::fs::write(&path, recipe).unwrap();
        let arguments = ["experiment", "--recipe", "my.toml", "--out", "session"];
        refused(directory.path(), &arguments, 2, &[&format!("my.toml, line 4: {named}")]);
        assert!(!directory.path().join("session").exists(), "{entry} was accepted");
    }
}

#[test]
fn output_names_need_not_be_utf_8() {
    use std::os::unix::ffi::OsStrExt;
    let directory = tempfile::tempdir().unwrap();
    let out = std::ffi::OsStr::from_bytes(b"r\xff");
    let run = |arguments: &[&str], file: &std::ffi::OsStr, more: &[&str]| {
        let mut command = command_in(directory.path());
        command.args(arguments).arg(file).args(more).arg("--json");
        let output = command.output().unwrap();
        let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success(), "{arguments:?}: {stderr}");
        let stdout = String::from_utf8(output.stdout).unwrap();
        serde_json::from_str::<serde_json::Value>(stdout.lines().last().unwrap()).unwrap()
    };
    let made = run(&["run", "--policy", "classical", "--clock", "virtual", "--out"], out, &[]);
    assert_eq!(made["recordings"][0], "r\u{fffd}/rollout-0.mcap");
    let recording = Path::new(out).join("rollout-0.mcap");
    std::fs::copy(directory.path().join(&recording), directory.path().join("r2.mcap")).unwrap();
    let replayed = run(&["replay"], recording.as_os_str(), &[]);
    assert_eq!(replayed["recordings"][0]["path"], made["recordings"][0]);
    run(&["export", "r2.mcap", "--out"], out, &[]);
    let recovered = run(&["recover"], recording.as_os_str(), &[]);
    assert_eq!(recovered["path"], made["recordings"][0]);

    let excite = ["run", "--excite", "chirp", "--clock", "virtual", "--out"];
    run(&excite, std::ffi::OsStr::new("chirp"), &[]);
    // One unknown, the pendulum's damping, is enough for a profile.
    let fixed = Unknown::all().map(Unknown::name).filter(|name| *name != "D_p");
    let identify: Vec<&str> = ["identify", "chirp/rollout-0.mcap"]
        .into_iter()
        .chain(fixed.flat_map(|name| ["--fix", name]))
        .chain(["--out"])
        .collect();
    let profile = std::ffi::OsStr::from_bytes(b"q\xff.toml");
    let identified = run(&identify, profile, &[]);
    assert_eq!(identified["profile"], "q\u{fffd}.toml");
    assert!(directory.path().join(profile).exists());
}

#[test]
fn names_of_policies_and_profiles_need_not_be_utf_8() {
    use std::ffi::OsStr;
    use std::os::unix::ffi::OsStrExt;
    let directory = tempfile::tempdir().unwrap();
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let (policy, profile) = (OsStr::from_bytes(b"p\xff"), OsStr::from_bytes(b"q\xff.toml"));
    let place = |name: &OsStr| directory.path().join(name);
    std::fs::copy(root.join("policies/robust.safetensors"), place(policy)).unwrap();
    std::fs::copy(root.join("profiles/lab.toml"), place(profile)).unwrap();
    let run = |arguments: &[&str], option: &str, name: &OsStr, more: &[&OsStr]| {
        let mut command = command_in(directory.path());
        command.args(arguments).arg(option).arg(name).args(more);
        let output = command.output().unwrap();
        (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
    };

    let driven = ["run", "--clock", "virtual", "--out", "out"];
    let with_profile = [OsStr::new("--profile"), profile];
    let (code, stderr) = run(&driven, "--policy", policy, &with_profile);
    assert_eq!(code, Some(0), "{stderr}");
    for used in [
        ["replay", "--simulate", "out/rollout-0.mcap"].as_slice(),
        &["report", "out/rollout-0.mcap"],
    ] {
        let (code, stderr) = run(used, "--profile", profile, &[]);
        assert_eq!(code, Some(0), "{used:?}: {stderr}");
    }

    // A file that is missing is refused by its name.
    let missing = OsStr::from_bytes(b"no\xff");
    let observed = ["run", "--policy", "classical", "--estimator", "observer"];
    for (arguments, option) in [
        (["train"].as_slice(), "--profile"),
        (&["emulate"], "--profile"),
        (&["soak"], "--policy"),
        (&observed, "--estimator-profile"),
    ] {
        let (code, stderr) = run(arguments, option, missing, &[]);
        assert_eq!(code, Some(2), "{arguments:?}: {stderr}");
        assert!(
            stderr.contains("no\u{fffd}") && !stderr.contains("UTF-8"),
            "{arguments:?}: {stderr}"
        );
    }
}

#[test]
fn replay_simulate_takes_a_profile_by_name() {
    let directory = tempfile::tempdir().unwrap();
    for (name, missing) in
        [("lab", "missing.mcap"), ("lap", "a profile that identify wrote, or one of the names")]
    {
        let replay = ["replay", "--simulate", "missing.mcap", "--profile", name];
        let output = qube_hil(directory.path(), &replay);
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{stderr}");
        assert!(stderr.contains(missing), "{stderr}");
    }
}

#[test]
fn nobody_is_told_to_delete_a_file_that_is_no_checkpoint() {
    let directory = tempfile::tempdir().unwrap();
    std::fs::write(directory.path().join("thesis.txt"), "a year of work").unwrap();
    let train = ["train", "--checkpoint", "thesis.txt"];
    let output = qube_hil(directory.path(), &train);
    let stderr = String::from_utf8_lossy(&output.stderr).to_lowercase();
    assert_eq!(output.status.code(), Some(2), "{stderr}");
    assert!(stderr.contains("thesis.txt is not a complete checkpoint"), "{stderr}");
    assert!(!stderr.contains("delete"), "{stderr}");
}

#[test]
fn a_replay_of_a_cut_or_a_changed_recording_does_not_succeed() {
    let directory = tempfile::tempdir().unwrap();
    let made = qube_hil(
        directory.path(),
        &["run", "--policy", "classical", "--clock", "virtual", "--out", "run"],
    );
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    let whole = std::fs::read(directory.path().join("run/rollout-0.mcap")).unwrap();
    let path = directory.path().join("changed.mcap");

    std::fs::write(&path, &whole[..whole.len() / 2]).unwrap();
    let torn = qube_hil(directory.path(), &["replay", "changed.mcap"]);
    assert_eq!(torn.status.code(), Some(3), "{}", String::from_utf8_lossy(&torn.stderr));

    let mut changed = whole.clone();
    changed[whole.len() / 2] ^= 0x20;
    std::fs::write(&path, &changed).unwrap();
    let changed = qube_hil(directory.path(), &["replay", "changed.mcap"]);
    let stderr = String::from_utf8_lossy(&changed.stderr);
    assert_eq!(changed.status.code(), Some(2), "{stderr}");
    assert!(stderr.contains("changed.mcap"), "{stderr}");
}

#[test]
fn unusable_folders_are_refused() {
    let directory = tempfile::tempdir().unwrap();
    std::fs::create_dir(directory.path().join("taken")).unwrap();
    std::fs::write(directory.path().join("taken/notes.txt"), "").unwrap();
    let out = ["session", "--clock", "virtual", "--out", "taken"];
    refused(directory.path(), &out, 2, &["taken", "exists", "another --out"]);
    let resume = ["session", "--clock", "virtual", "--resume", "taken"];
    refused(directory.path(), &resume, 2, &["taken", "no session"]);
    // A session that is killed before it has begun leaves such a folder.
    std::fs::create_dir_all(directory.path().join("left/candidates")).unwrap();
    let resume = ["session", "--clock", "virtual", "--resume", "left"];
    refused(directory.path(), &resume, 2, &["nothing to resume", "--out left"]);
    let port = ["session", "--clock", "virtual", "--device", "/dev/ttyUSB0", "--out", "new"];
    refused(directory.path(), &port, 2, &["--clock virtual", "/dev/ttyUSB0"]);
}

#[test]
fn a_recording_that_is_named_twice_is_refused() {
    let directory = tempfile::tempdir().unwrap();
    let run = ["run", "--excite", "chirp", "--clock", "virtual", "--out", "chirps"];
    assert!(qube_hil(directory.path(), &run).status.success());
    for again in ["chirps/rollout-0.mcap", "./chirps/../chirps/rollout-0.mcap"] {
        let identify = ["identify", "chirps/rollout-0.mcap", again, "--out", "mine.toml"];
        refused(directory.path(), &identify, 2, &["is named twice", "once"]);
        let identify = ["identify", "chirps/rollout-0.mcap", "--holdout", again, "--out", "m.toml"];
        refused(directory.path(), &identify, 2, &["is named twice"]);
    }
}

#[test]
fn a_folder_in_which_another_program_records_is_in_use() {
    use qube_hil::storage::Disk;
    let directory = tempfile::tempdir().unwrap();
    let runs = directory.path().join("runs");
    std::fs::create_dir(&runs).unwrap();
    let lock = qube_hil::storage::MachineDisk.lock_folder(&runs).unwrap();
    let run = ["run", "--policy", "classical", "--clock", "virtual", "--out", "runs"];
    refused(directory.path(), &run, 2, &["runs", "in use"]);
    drop(lock);
    assert!(qube_hil(directory.path(), &run).status.success());
}

#[test]
fn files_that_are_not_utf_8_are_refused_as_such() {
    let directory = tempfile::tempdir().unwrap();
    std::fs::write(directory.path().join("bytes"), [0xff, 0xfe, 0x00]).unwrap();
    let run = ["run", "--policy", "classical", "--clock", "virtual"];
    let cases: [&[&str]; 5] = [
        &["config", "check", "bytes"],
        &["identify", "bytes"],
        &["experiment", "--recipe", "bytes"],
        &["train", "--profile", "bytes"],
        &[&run[..], &["--plant", "bytes"]].concat(),
    ];
    for arguments in cases {
        refused(directory.path(), arguments, 2, &["bytes", "not a text file"]);
    }
}

#[test]
fn a_file_in_place_of_a_folder_is_refused_before_any_work() {
    let directory = tempfile::tempdir().unwrap();
    std::fs::write(directory.path().join("taken"), "mine").unwrap();
    let run = ["run", "--excite", "chirp", "--clock", "virtual", "--out", "chirp"];
    assert!(qube_hil(directory.path(), &run).status.success());
    refused(directory.path(), &["manual", "--out", "taken"], 2, &["--out taken is not a folder"]);
    refused(directory.path(), &["toy", "--out", "taken"], 2, &["--out taken is not a folder"]);
    let identify = ["identify", "chirp/rollout-0.mcap", "--plot", "taken"];
    refused(directory.path(), &identify, 2, &["--plot taken is not a folder"]);
    assert!(!directory.path().join("profile.toml").exists(), "the recordings were fitted");
    std::fs::create_dir(directory.path().join("folder")).unwrap();
    let train = ["train", "--preset", "quick", "--checkpoint", "folder"];
    refused(directory.path(), &train, 2, &["--checkpoint folder: it is not a file"]);
}

#[test]
fn another_plant_is_not_called_qube() {
    let directory = tempfile::tempdir().unwrap();
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("plants/furuta-130.toml");
    let text = std::fs::read_to_string(path).unwrap();
    let name = text.lines().find(|line| line.starts_with("name = ")).unwrap();
    std::fs::write(directory.path().join("p.toml"), text.replace(name, "name = \"qube\"")).unwrap();
    let run = ["run", "--plant", "p.toml", "--policy", "classical", "--clock", "virtual"];
    refused(directory.path(), &run, 2, &["p.toml", "the name `qube`", "a name of its own"]);
}

#[test]
fn a_spread_around_no_profile_is_refused() {
    let directory = tempfile::tempdir().unwrap();
    let train = ["train", "--model", "nominal", "--spread", "0.2", "--out", "p.safetensors"];
    refused(directory.path(), &train, 2, &["--spread", "--model"]);
}

#[test]
fn an_export_that_names_a_recording_twice_is_refused() {
    let directory = tempfile::tempdir().unwrap();
    let export = ["export", "one.mcap", "one.mcap"];
    refused(directory.path(), &export, 2, &["one.mcap is named twice", "once"]);
}

#[test]
fn a_number_in_any_file_is_refused_by_file_key_value_and_range() {
    let directory = tempfile::tempdir().unwrap();
    let run = ["run", "--policy", "classical", "--clock", "virtual"];
    let experiment = ["experiment", "--policies", "1", "--rollouts", "1"];
    let with = |command: &[&'static str], option: &'static str| {
        [command, &[option, "numbers.toml"]].concat()
    };
    let plants = with(&experiment, "--plants");
    let profile = with(&run, "--profile");
    let psi = with(&["train", "--model", "psi"], "--psi");
    let recipe = with(&experiment, "--recipe");
    let qube = with(&[&run[..], &["--device", "emulated"]].concat(), "--qube");
    let head = "name = \"mine\"\n";
    let plant = format!("[[plants]]\n{head}");
    let of_nominal = format!("{head}model = \"nominal\"\n");
    for value in ["nan", "inf", "1e300", "-1e300"] {
        for (command, text, key, range) in [
            (&plants, format!("{plant}vary = "), "vary", "from 0 to 0.2"),
            (&plants, format!("{plant}gap = "), "gap", "from 0 to 5"),
            (&plants, format!("{plant}[plants.effects]\nstribeck = "), "stribeck", "from 0 to 2"),
            (&plants, format!("{plant}[plants.scale]\nM_p = "), "scale.M_p", "from 0.1 to 10"),
            (&profile, format!("{head}[parameters]\nM_p = "), "parameters.M_p", ""),
            (&profile, format!("{head}[gap]\ncommand_delay_s = "), "command_delay_s", "to 0.1"),
            (&profile, format!("{head}[standard_errors]\nM_p = "), "errors.M_p", "to 0.24"),
            (&psi, "mean_M_p = ".to_owned(), "mean_M_p", "at most 10"),
            (
                &recipe,
                format!("{of_nominal}[settings.training]\ntarget_return = "),
                "training.target_return",
                "0 to 600",
            ),
            (
                &recipe,
                format!("{of_nominal}[settings.bayrn]\nbeta = "),
                "bayrn.beta",
                "from 0 to 1000",
            ),
            (&qube, "[limits]\ntheta_rad = ".to_owned(), "theta_rad", "above 0, at most"),
            (&qube, "[homing]\ntheta_offset_rad = ".to_owned(), "theta_offset_rad", "0.3"),
            (&qube, "[motor]\ncontinuous_a = ".to_owned(), "continuous_a", "at most 0.54"),
        ] {
            let file = directory.path().join("numbers.toml");
            std::fs::write(file, format!("{text}{value}\n")).unwrap();
            let shown = match value {
                // The message about a motor's rating names no value.
                _ if key == "continuous_a" => "",
                "nan" => "NaN",
                other => other,
            };
            refused(directory.path(), command, 2, &["numbers.toml", key, range, shown]);
        }
    }
}
