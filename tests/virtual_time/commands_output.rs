//! Tests the places of results: a bad place is refused before a training or a motion, existing
//! files are not lost, and a result that cannot be printed is a failure.

use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};

use crate::program::{has_refused, qube_hil, refused, succeeds};
use crate::shared::{command_in, isolate};

/// A port that does not exist: the message about it shows that `--out` was accepted.
const PORT: &str = "/dev/ttyNOWHERE";

#[test]
fn a_policy_or_a_profile_replaces_nothing_unless_asked() {
    let directory = tempfile::tempdir().unwrap();
    let mine = directory.path().join("mine");
    std::fs::write(&mine, "precious").unwrap();
    std::os::unix::fs::symlink(&mine, directory.path().join("link")).unwrap();
    for out in ["mine", "link"] {
        let train = ["train", "--preset", "thesis", "--out", out];
        refused(directory.path(), &train, 2, &["--out", out, "exists", "--force"]);
        let identify = ["identify", "no.mcap", "--out", out];
        refused(directory.path(), &identify, 2, &["--out", out, "exists", "--force"]);
        let forced = ["identify", "no.mcap", "--out", out, "--force"];
        refused(directory.path(), &forced, 2, &["no.mcap"]);
    }
    for command in [&["train", "--preset", "thesis"][..], &["identify", "no.mcap"]] {
        let device = [command, &["--out", "/dev/null", "--force"]].concat();
        refused(directory.path(), &device, 2, &["/dev/null", "not a file"]);
    }
    assert_eq!(std::fs::read_to_string(&mine).unwrap(), "precious");
}

#[test]
fn a_profile_does_not_replace_a_table_that_it_would_be_fitted_to() {
    let directory = tempfile::tempdir().unwrap();
    let table = directory.path().join("motion.csv");
    std::fs::write(&table, "precious").unwrap();
    for identify in [
        &["identify", "motion.csv", "--out", "./motion.csv", "--force"][..],
        &["identify", "no.mcap", "--holdout", "motion.csv", "--out", "motion.csv", "--force"],
    ] {
        refused(directory.path(), identify, 2, &["motion.csv", "is one of the recordings"]);
    }
    assert_eq!(std::fs::read_to_string(&table).unwrap(), "precious");
}

#[test]
fn a_benchmark_replaces_no_results_unless_asked() {
    let directory = tempfile::tempdir().unwrap();
    std::fs::create_dir(directory.path().join("benchmark")).unwrap();
    let numbers = directory.path().join("benchmark/noise.json");
    std::fs::write(&numbers, "precious").unwrap();
    let benchmark = ["benchmark", "noise", "--repetitions", "1"];
    refused(directory.path(), &benchmark, 2, &["benchmark/noise.json exists", "--force"]);
    assert_eq!(std::fs::read_to_string(&numbers).unwrap(), "precious");
}

#[test]
fn a_benchmark_of_a_size_that_no_memory_holds_is_bad_usage() {
    let directory = tempfile::tempdir().unwrap();
    for option in ["--evaluations", "--repetitions"] {
        let benchmark = ["benchmark", "regret", option, "4294967295"];
        refused(directory.path(), &benchmark, 2, &[option, "1.."]);
    }
}

#[test]
fn a_place_that_cannot_be_written_is_bad_usage() {
    let directory = tempfile::tempdir().unwrap();
    std::fs::write(directory.path().join("file"), "").unwrap();
    std::fs::create_dir(directory.path().join("folder")).unwrap();
    let run = ["run", "--policy", "classical", "--device", PORT];
    let commands: [&[&str]; 5] = [
        &["train", "--preset", "thesis"],
        &["identify", "no.mcap"],
        &run,
        &["session", "--device", PORT],
        &["experiment", "--device", PORT, "--models", "nominal"],
    ];
    for command in commands {
        // Not even root can create a file in the first folder; the second folder is a file.
        for (out, name) in [("/proc/nowhere/out", "nowhere"), ("file/out", "file")] {
            refused(directory.path(), &[command, &["--out", out]].concat(), 2, &[name]);
        }
    }
    for command in &commands[..2] {
        let missing = [command, &["--out", "missing/out"][..]].concat();
        refused(directory.path(), &missing, 2, &["missing", "create it first"]);
        let folder = [command, &["--out", "folder"][..]].concat();
        refused(directory.path(), &folder, 2, &["folder", "not a file"]);
    }
    let checkpoint = ["train", "--preset", "thesis", "--checkpoint", "missing/half"];
    refused(directory.path(), &checkpoint, 2, &["missing", "create it first"]);
    let soak = ["soak", "--device", PORT, "--keep", "file/out"];
    refused(directory.path(), &soak, 2, &["file"]);
}

#[test]
fn a_full_disk_is_found_before_the_work() {
    let directory = tempfile::tempdir().unwrap();
    let run = format!("run --policy classical --device {PORT} --out new/run");
    for command in ["train --preset thesis --out p.safetensors", "identify no.mcap", &run] {
        // A limit on file sizes stands for a full disk. Its signal must not end the program.
        let script = format!("ulimit -f 8; exec {} {command}", binary());
        let mut shell = Command::new("sh");
        shell.args(["-c", &script]).current_dir(directory.path()).stdin(Stdio::null());
        isolate(&mut shell, directory.path());
        let output = shell.output().unwrap();
        has_refused(&output, 1, &["cannot be written"]);
    }
    assert_eq!(std::fs::read_dir(directory.path()).unwrap().count(), 0, "a file was left");
}

fn binary() -> &'static str {
    env!("CARGO_BIN_EXE_qube-hil")
}

#[test]
fn recordings_of_another_run_are_found_before_the_port_is_touched() {
    let directory = tempfile::tempdir().unwrap();
    let folder = directory.path().join("taken");
    std::fs::create_dir(&folder).unwrap();
    std::fs::write(folder.join("rollout-2.mcap"), "precious").unwrap();
    let run = |rollouts: &str| {
        let out = ["--out", "taken", "--rollouts", rollouts, "--device", PORT];
        qube_hil(directory.path(), &[&["run", "--policy", "classical"], &out[..]].concat())
    };
    has_refused(&run("3"), 2, &["taken/rollout-2.mcap", "exists"]);
    has_refused(&run("2"), 2, &["no such port"]);
    let soak = ["soak", "--keep", "taken", "--device", PORT];
    refused(directory.path(), &soak, 2, &["taken/rollout-2.mcap", "exists"]);
    assert_eq!(std::fs::read(folder.join("rollout-2.mcap")).unwrap(), b"precious");
    assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 1, "a file was left");
}

#[test]
fn an_invalid_port_leaves_no_files() {
    let directory = tempfile::tempdir().unwrap();
    for port in [PORT, "/dev/null"] {
        for more in [&[][..], &["--out", "new/one"]] {
            for command in [&["session"][..], &["run", "--policy", "classical"]] {
                let arguments = [command, &["--device", port], more].concat();
                refused(directory.path(), &arguments, 2, &[port]);
            }
        }
    }
    assert_eq!(std::fs::read_dir(directory.path()).unwrap().count(), 0, "a file was left");
    // An existing folder stays.
    std::fs::create_dir(directory.path().join("mine")).unwrap();
    let session = ["session", "--device", PORT, "--out", "mine"];
    refused(directory.path(), &session, 2, &[PORT]);
    assert_eq!(std::fs::read_dir(directory.path().join("mine")).unwrap().count(), 0);
}

#[test]
fn a_result_that_cannot_be_printed_is_a_failure() {
    let directory = tempfile::tempdir().unwrap();
    let run = |arguments: &[&str]| {
        let full = std::fs::File::options().write(true).open("/dev/full").unwrap();
        command_in(directory.path()).args(arguments).stdout(full).output().unwrap()
    };
    for arguments in [&["toy"][..], &["toy", "--json"], &["--help"], &["train", "--help"]] {
        let output = run(arguments);
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{stderr}");
        assert!(stderr.contains("could not be printed"), "{stderr}");
    }
}

/// Waits until a process handles this signal, by the kernel's record of the process.
fn wait_until_handled(process: Pid, signal: Signal) {
    let status = format!("/proc/{}/status", process.as_raw_nonzero());
    let begun = Instant::now();
    let is_handled = || {
        let text = std::fs::read_to_string(&status).unwrap();
        let mask = text.lines().find_map(|line| line.strip_prefix("SigCgt:")).unwrap();
        let mask = u64::from_str_radix(mask.trim(), 16).unwrap();
        (mask >> (signal.as_raw() - 1)) & 1 == 1
    };
    while !is_handled() {
        assert!(begun.elapsed() < Duration::from_secs(60), "{signal:?} is not handled");
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn a_signal_ends_a_computation_with_a_result_for_scripts() {
    let directory = tempfile::tempdir().unwrap();
    // A minute of computing, or more.
    let benchmark = ["benchmark", "regret", "--json", "--out", "regret"];
    for (signal, exit_code) in [(Signal::INT, 130), (Signal::TERM, 143), (Signal::HUP, 129)] {
        let mut command = command_in(directory.path());
        command.args(benchmark).stdout(Stdio::piped()).stderr(Stdio::piped());
        let computing = command.spawn().unwrap();
        let process = Pid::from_child(&computing);
        wait_until_handled(process, signal);
        kill_process(process, signal).unwrap();
        let output = computing.wait_with_output().unwrap();
        assert_eq!(output.status.code(), Some(exit_code), "{output:?}");
        let result: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
        assert_eq!(result["ended_by"]["exit_code"], exit_code, "{result}");
    }
}

#[test]
fn messages_that_cannot_be_printed_change_no_exit_code() {
    let directory = tempfile::tempdir().unwrap();
    let run = |arguments: &[&str]| {
        let full = std::fs::File::options().write(true).open("/dev/full").unwrap();
        command_in(directory.path()).args(arguments).stderr(full).output().unwrap()
    };
    let rollout = ["run", "--policy", "classical", "--clock", "virtual"];
    let output = run(&[&rollout[..], &["--out", "unheard"]].concat());
    assert_eq!(output.status.code(), Some(0));
    assert!(String::from_utf8_lossy(&output.stdout).contains("return"));
    assert!(directory.path().join("unheard/rollout-0.mcap").exists());
    let output = run(&["run", "--policy", "none.safetensors", "--clock", "virtual"]);
    assert_eq!(output.status.code(), Some(2));
}

#[test]
fn a_moving_picture_replaces_no_file_unasked() {
    let directory = tempfile::tempdir().unwrap();
    let run =
        ["run", "--policy", "classical", "--clock", "virtual", "--rollouts", "2", "--out", "r"];
    assert!(qube_hil(directory.path(), &run).status.success());
    let other = directory.path().join("r/rollout-1.mcap");
    let before = std::fs::read(&other).unwrap();
    let animate = ["replay", "--animate", "r/rollout-1.mcap", "r/rollout-0.mcap"];
    refused(directory.path(), &animate, 2, &["--animate r/rollout-1.mcap", "--force"]);
    assert_eq!(std::fs::read(&other).unwrap(), before);
    refused(
        directory.path(),
        &["replay", "--animate", "r", "r/rollout-0.mcap"],
        2,
        &["not a file"],
    );
    let animate = ["replay", "--animate", "moving.svg", "r/rollout-0.mcap"];
    assert!(qube_hil(directory.path(), &animate).status.success());
    refused(directory.path(), &animate, 2, &["exists already"]);
    assert!(qube_hil(directory.path(), &[&animate[..], &["--force"]].concat()).status.success());
}

#[test]
fn a_replay_that_only_draws_names_its_picture() {
    let directory = tempfile::tempdir().unwrap();
    let table = "time_s,theta_rad,alpha_rad,theta_dot_rad_s,alpha_dot_rad_s,voltage_v\n\
                 0,0,0,0,0,0\n0.01,0,0,0,0,0\n0.02,0,0,0,0,0\n";
    std::fs::write(directory.path().join("mv.csv"), table).unwrap();
    let told = succeeds(directory.path(), &["replay", "--animate", "mv.svg", "mv.csv"]);
    assert_eq!(told.trim_end(), "mv.csv: its motion is drawn in mv.svg");
    assert!(directory.path().join("mv.svg").exists());
    for name in ["mv.gif", "mv"] {
        let animate = ["replay", "--animate", name, "mv.csv"];
        refused(directory.path(), &animate, 2, &[&format!("--animate {name}: "), ".svg"]);
        assert!(!directory.path().join(name).exists());
    }
}

#[test]
fn an_export_of_files_one_of_which_is_bad_writes_nothing() {
    let directory = tempfile::tempdir().unwrap();
    let at = |name: &str| directory.path().join(name);
    let run = ["run", "--excite", "chirp", "--clock", "virtual", "--out", "."];
    assert!(qube_hil(directory.path(), &run).status.success());
    let policy = Path::new(env!("CARGO_MANIFEST_DIR")).join("policies/nominal.safetensors");
    std::fs::copy(policy, at("good.safetensors")).unwrap();
    for bad in ["bad.mcap", "bad.safetensors"] {
        std::fs::write(at(bad), "neither").unwrap();
    }
    let tables = ["export", "rollout-0.mcap", "bad.mcap"];
    refused(directory.path(), &tables, 2, &["bad.mcap"]);
    assert!(!at("rollout-0.csv").exists());
    let models = ["export", "--onnx", "good.safetensors", "bad.safetensors", "--out", "models"];
    refused(directory.path(), &models, 2, &["bad.safetensors"]);
    assert!(!at("models").exists());
}

#[test]
fn a_page_that_is_not_a_report_is_not_replaced_by_one() {
    let directory = tempfile::tempdir().unwrap();
    let page = directory.path().join("rollout-0.html");
    let run = ["run", "--excite", "chirp", "--clock", "virtual", "--out", "."];
    assert!(qube_hil(directory.path(), &run).status.success());
    std::fs::write(&page, "my own page\n").unwrap();
    let report = ["report", "rollout-0.mcap"];
    let words = ["rollout-0.html", "is not a report", "--out"];
    refused(directory.path(), &report, 2, &words);
    assert_eq!(std::fs::read_to_string(&page).unwrap(), "my own page\n");
    std::fs::remove_file(&page).unwrap();
    // A report is replaced.
    for _ in 0..2 {
        assert!(qube_hil(directory.path(), &report).status.success());
    }
}
