//! Compares `docs/reference/json.md` with the program: every printed field is listed, and every
//! listed field is printed unless the page marks it with *Sometimes*.

use std::collections::BTreeSet;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::Stdio;
use std::sync::Arc;

use qube_hil::jobs::folder::{JobFolder, Terms};
use qube_hil::storage::MachineDisk;
use serde_json::Value;

use crate::shared::command_in;

const PAGE: &str = include_str!("../../docs/reference/json.md");

/// Runs the program with these arguments and `--json`; returns the last line of its standard
/// output, and its exit code.
fn told(directory: &Path, arguments: &[&str]) -> (Value, Option<i32>) {
    let output = command_in(directory).args(arguments).arg("--json").output().unwrap();
    let stdout = String::from_utf8(output.stdout).unwrap();
    let last = stdout.lines().last().unwrap_or_else(|| panic!("{arguments:?} printed nothing"));
    (serde_json::from_str(last).unwrap(), output.status.code())
}

/// The fields in a section of the page, each with whether the page marks it with *Sometimes*.
fn listed(section: &str) -> Vec<(&'static str, bool)> {
    let title = format!("\n## {section}\n");
    let after = PAGE.split(title.as_str()).nth(1).unwrap_or_else(|| panic!("no section {section}"));
    let section = after.split("\n## ").next().unwrap();
    let rows = section.lines().filter_map(|line| line.strip_prefix("| `"));
    rows.map(|row| {
        let (field, meaning) = row.split_once("` | ").unwrap();
        (field, meaning.starts_with("Sometimes"))
    })
    .collect()
}

/// Adds to `found` the path of each value in `value` that contains no others; `path` is the path of
/// `value` itself.
fn printed(value: &Value, path: &str, found: &mut BTreeSet<String>) {
    match value {
        Value::Object(fields) if !fields.is_empty() => {
            for (name, value) in fields {
                let path = if path.is_empty() { name.clone() } else { format!("{path}.{name}") };
                printed(value, &path, found);
            }
        }
        Value::Array(entries) if !entries.is_empty() => {
            entries.iter().for_each(|entry| printed(entry, &format!("{path}[]"), found));
        }
        _ => drop(found.insert(path.to_owned())),
    }
}

/// Returns whether a printed path belongs to a field of the page: it is the path of the field, or
/// the path of an empty or missing value that would contain the field. A field that ends with `.*`
/// stands for every path below it.
fn is_of(path: &str, field: &str) -> bool {
    let above = |rest: &str| rest.starts_with('.') || rest.starts_with("[]");
    match field.strip_suffix(".*") {
        Some(object) => {
            path == object
                || path.strip_prefix(object).is_some_and(above)
                || object.strip_prefix(path).is_some_and(above)
        }
        None => path == field || field.strip_prefix(path).is_some_and(above),
    }
}

#[track_caller]
fn agrees(section: &str, value: &Value) {
    let mut paths = BTreeSet::new();
    printed(value, "", &mut paths);
    let fields = listed(section);
    for path in &paths {
        let is_listed = fields.iter().any(|(field, _)| is_of(path, field));
        assert!(is_listed, "{section}: {path} is printed and not listed: {value}");
    }
    for (field, sometimes) in fields {
        let is_printed = paths.iter().any(|path| is_of(path, field));
        assert!(is_printed || sometimes, "{section}: {field} is listed and not printed: {value}");
    }
}

#[test]
fn commands_print_the_fields_of_the_page() {
    let directory = tempfile::tempdir().unwrap();
    let succeeds = |section: &str, arguments: &[&str]| {
        let (value, code) = told(directory.path(), arguments);
        assert_eq!(code, Some(0), "{arguments:?}: {value}");
        agrees(section, &value);
    };
    let small = "[extent]\ninitial_candidates = 1\niterations = 0\nrollouts = 1\n\
                 verification_rollouts = 1\n[training]\nupdates = 1\nnum_envs = 16\nepochs = 1\n";
    std::fs::write(directory.path().join("small.toml"), small).unwrap();
    let recipe = "name = \"tiny\"\nmodel = \"nominal\"\n[settings.training]\nupdates = 1\n\
                  num_envs = 16\nepochs = 1\n";
    std::fs::write(directory.path().join("tiny.toml"), recipe).unwrap();

    succeeds("`run`", &["run", "--policy", "classical", "--clock", "virtual", "--out", "run"]);
    let chirp = ["run", "--excite", "chirp", "--clock", "virtual", "--out", "chirp"];
    succeeds("`run`", &chirp);
    succeeds("`replay`", &["replay", "run/rollout-0.mcap"]);
    succeeds("`replay`", &["replay", "run/rollout-0.mcap", "--simulate"]);
    succeeds("`report`", &["report", "run/rollout-0.mcap"]);
    let model = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/fixtures/onnx/silu-wrapped.onnx");
    succeeds(
        "`import`",
        &["import", model, "--action-scale", "5", "--out", "imported.safetensors"],
    );
    succeeds("`export`", &["export", "run/rollout-0.mcap"]);
    let shipped = concat!(env!("CARGO_MANIFEST_DIR"), "/policies/nominal.safetensors");
    succeeds("`export`", &["export", "--onnx", shipped, "--out", "models"]);
    succeeds("`config`", &["config", "print"]);
    succeeds("`config`", &["config", "check", "small.toml"]);
    succeeds("`completions`", &["completions", "bash"]);
    succeeds("`manual`", &["manual"]);
    succeeds("`recover`", &["recover", "run/rollout-0.mcap"]);
    let whole = std::fs::read(directory.path().join("run/rollout-0.mcap")).unwrap();
    std::fs::write(directory.path().join("cut.mcap"), &whole[..whole.len() / 2]).unwrap();
    let (recovered, code) = told(directory.path(), &["recover", "cut.mcap"]);
    assert_eq!(code, Some(3), "{recovered}");
    agrees("`recover`", &recovered);

    // All quantities but the pendulum's damping stay fixed: one unknown shows all fields.
    let fixed = [
        "R_m",
        "k_m",
        "D_r",
        "M_r",
        "M_p",
        "L_r",
        "L_p",
        "coulomb_torque_n_m",
        "positive_dead_zone_v",
        "negative_dead_zone_v",
        "cable_stiffness_n_m_rad",
        "cable_rest_rad",
        "command_delay_s",
    ];
    let fixed: Vec<&str> = fixed.into_iter().flat_map(|name| ["--fix", name]).collect();
    succeeds("`identify`", &[&["identify", "chirp/rollout-0.mcap"], &fixed[..]].concat());

    let session = ["session", "--clock", "virtual", "--config", "small.toml", "--out", "session"];
    succeeds("`session`", &session);
    let identified = format!("{small}[identification]\ncandidates = 1\n");
    let identified = identified.replace("[extent]\n", "[extent]\nbaseline = true\n");
    std::fs::write(directory.path().join("identified.toml"), identified).unwrap();
    let session =
        ["session", "--clock", "virtual", "--config", "identified.toml", "--out", "around"];
    succeeds("`session`", &session);
    let pair = ["session", "--clock", "virtual", "--device", "emulated", "--device", "emulated"];
    let own = ["--config", "small.toml", "--rig-policy", "own", "--out", "own"];
    succeeds("`session --rig-policy own`", &[&pair[..], &own].concat());
    let both = small.replace("rollouts = 1", "rollouts = 2");
    std::fs::write(directory.path().join("both.toml"), both).unwrap();
    let shared = ["--config", "both.toml", "--rig-policy", "shared", "--out", "shared"];
    succeeds("`session`", &[&pair[..], &shared].concat());
    let experiment = ["experiment", "--recipe", "tiny.toml", "--policies", "1", "--rollouts", "1"];
    succeeds("`experiment`", &[&experiment[..], &["--out", "experiment"]].concat());
    let searched = format!(
        "{recipe}[settings.extent]\ninitial_candidates = 1\niterations = 1\nrollouts = 1\n"
    );
    let searched = searched.replace("\"nominal\"", "\"opt-nominal\"");
    std::fs::write(directory.path().join("searched.toml"), searched).unwrap();
    let strategies = ["experiment", "--recipe", "searched.toml", "--strategies", "random"];
    let one = ["--repetitions", "1", "--policies", "1", "--rollouts", "1", "--out", "strategies"];
    succeeds("`experiment --strategies`", &[&strategies[..], &one].concat());
    let jobs =
        JobFolder::create(Arc::new(MachineDisk), &directory.path().join("jobs"), Terms::default());
    drop(jobs.unwrap());
    succeeds("`work`", &["work", "jobs", "--linger", "0"]);
    succeeds("`soak`", &["soak", "--clock", "virtual", "--hours", "0.001"]);
    succeeds("`check`", &["check", "--clock", "virtual"]);
    succeeds("`toy`", &["toy"]);
}

#[test]
fn a_training_prints_the_fields_of_the_page() {
    let directory = tempfile::tempdir().unwrap();
    let (value, code) = told(directory.path(), &["train", "--preset", "quick"]);
    assert_eq!(code, Some(0), "{value}");
    agrees("`train`", &value);
}

#[test]
fn benchmarks_print_the_fields_of_the_page() {
    let directory = tempfile::tempdir().unwrap();
    for suite in ["regret", "noise"] {
        let few = ["--repetitions", "2", "--evaluations", "2"];
        let (value, code) = told(directory.path(), &[&["benchmark", suite], &few[..]].concat());
        assert_eq!(code, Some(0), "{value}");
        assert!(value[suite].as_array().is_some_and(|results| !results.is_empty()), "{value}");
        agrees("`benchmark`", &value);
    }
}

#[test]
fn emulate_prints_the_fields_of_the_page() {
    let directory = tempfile::tempdir().unwrap();
    let mut serving = command_in(directory.path())
        .args(["emulate", "--link", "qube", "--json"])
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut line = String::new();
    BufReader::new(serving.stdout.take().unwrap()).read_line(&mut line).unwrap();
    serving.kill().unwrap();
    serving.wait().unwrap();
    let value: Value = serde_json::from_str(&line).unwrap();
    assert_eq!(value["link"], "qube", "{value}");
    agrees("`emulate`", &value);
}

#[test]
fn doctor_prints_the_fields_of_the_page() {
    // Whether this computer is fit does not matter here.
    let directory = tempfile::tempdir().unwrap();
    agrees("`doctor`", &told(directory.path(), &["doctor"]).0);
}

#[test]
fn a_failure_prints_the_fields_of_the_page() {
    let directory = tempfile::tempdir().unwrap();
    for arguments in [&["run", "--nonsense"][..], &["session", "--device", "/dev/ttyNOWHERE"]] {
        let (value, code) = told(directory.path(), arguments);
        assert_eq!(code, Some(2), "{value}");
        agrees("Failures", &value);
    }
}

#[test]
fn every_command_has_its_section() {
    let directory = tempfile::tempdir().unwrap();
    let help = command_in(directory.path()).arg("--help").output().unwrap();
    let help = String::from_utf8(help.stdout).unwrap();
    let commands = help.split("Commands:\n").nth(1).unwrap().split("\n\n").next().unwrap();
    let names = commands.lines().filter_map(|line| line.strip_prefix("  ")?.split(' ').next());
    let names: Vec<&str> = names.filter(|name| !name.is_empty() && *name != "help").collect();
    assert!(names.len() >= 13, "{names:?}");
    for name in names {
        let heading = format!("\n## `{name}`\n");
        assert!(PAGE.contains(&heading), "the page has no section for {name}");
    }
}
