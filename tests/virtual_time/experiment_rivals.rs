//! Tests the methods from the literature from end to end: recordings of an emulated Qube in virtual
//! time, the beliefs that are learnt from them, and a policy at each budget.

use std::path::Path;

use crate::shared::command_in;

/// A recipe for policies with two small updates of training; its psi is not searched here.
const TINY: &str = "name = \"tiny\"\nmodel = \"opt-robust\"\n\n\
                    [settings.training]\nupdates = 2\nnum_envs = 16\nepochs = 1\n";

/// Runs an experiment in a folder; returns the printed JSON object.
fn experiment(folder: &Path, arguments: &[&str]) -> serde_json::Value {
    let output =
        command_in(folder).arg("experiment").args(arguments).arg("--json").output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

/// Runs methods on the emulated `lab` at budgets, checks that a resumed run has the same results,
/// and returns the folder and the names of the rows.
fn rows_of(methods: &str, budgets: &str) -> (tempfile::TempDir, Vec<String>) {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("tiny.toml"), TINY).unwrap();
    let begin = ["--strategies", methods, "--budgets", budgets, "--recipe", "tiny.toml"];
    let rest = ["--preset", "robust", "--profile", "lab", "--repetitions", "1", "--rollouts", "1"];
    let place = ["--seed", "3", "--out", "one"];
    let result = experiment(folder.path(), &[&begin[..], &rest, &place].concat());
    let resumed = experiment(folder.path(), &["--resume", "one"]);
    assert_eq!(result["models"], resumed["models"], "the resumed experiment has other results");
    let models = result["models"].as_array().unwrap();
    (folder, models.iter().map(|row| row["model"].as_str().unwrap().to_owned()).collect())
}

/// The first policy that scores a method's recommendation at a budget.
fn policy_at_budget(run: &Path, budget: &str) -> Vec<u8> {
    std::fs::read(run.join("judged").join(budget).join("000/policy.safetensors")).unwrap()
}

/// The policy that made a recording of a method's run.
fn recorded(run: &Path, number: u32) -> Vec<u8> {
    let name = format!("recordings/rollout-{number}-attempt-0.mcap");
    qube_hil::recording::read(&run.join(name)).unwrap().policy
}

#[test]
fn a_rival_learns_from_a_rollout_of_its_first_policy_and_has_one_at_each_budget() {
    let (folder, rows) = rows_of("simopt", "0,1");
    assert_eq!(rows, ["simopt 0", "simopt 1"]);
    let run = folder.path().join("one/budgets/lab/simopt/000");
    let belief = std::fs::read_to_string(run.join("belief-1.json")).unwrap();
    assert!(belief.contains("gaussian"), "{belief}");
    // The two budgets have policies of their own, and the policy of budget 0 made the rollout.
    assert_ne!(policy_at_budget(&run, "000"), policy_at_budget(&run, "001"));
    assert!(recorded(&run, 0) == policy_at_budget(&run, "000"), "another policy made the rollout");
}

#[test]
fn strategy_optimisation_tries_two_inputs_and_recommends_one_of_them() {
    let (folder, rows) = rows_of("so-cma", "0,2");
    assert_eq!(rows, ["so-cma 0", "so-cma 2"]);
    let run = folder.path().join("one/budgets/lab/so-cma/000");
    let scored = |number| policy_at_budget(&run, number);
    let recorded = |number| recorded(&run, number);
    // The first candidate has the inputs of the prior's mean, which are also recommended without a
    // rollout. The recommendation after two rollouts is one of the two candidates.
    assert_eq!(recorded(0), scored("000"));
    assert_ne!(recorded(0), recorded(1));
    assert!([recorded(0), recorded(1)].contains(&scored("002")));
}

#[test]
fn a_method_whose_policies_share_a_training_is_refused_without_budgets() {
    let folder = tempfile::tempdir().unwrap();
    let output = command_in(folder.path())
        .args(["experiment", "--strategies", "so-cma", "--profile", "lab", "--out", "one"])
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(2));
    let message = String::from_utf8_lossy(&output.stderr);
    assert!(message.contains("so-cma makes all its policies from one training"), "{message}");
}

#[test]
#[ignore = "takes minutes: every method learns as much as in an experiment"]
fn every_rival_has_a_policy_at_each_budget() {
    let methods =
        ["simopt", "bayessim", "dropo", "epopt", "npdr", "lsdr", "fpo", "adr", "so-cma", "history"];
    let (folder, rows) = rows_of(&methods.join(","), "0,1,2");
    let expected: Vec<String> = methods
        .iter()
        .flat_map(|method| ["0", "1", "2"].map(|budget| format!("{method} {budget}")))
        .collect();
    assert_eq!(rows, expected);
    for method in ["simopt", "bayessim", "dropo", "epopt", "npdr"] {
        let run = folder.path().join("one/budgets/lab").join(method).join("000");
        assert!(run.join("belief-2.json").exists(), "{method}");
    }
}
