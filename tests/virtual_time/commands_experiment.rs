//! Tests the command `experiment`: interrupted, killed and resumed, on one thread or several, it
//! gives the same table and the same files, byte for byte. Impossible and changed settings are
//! refused.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use rustix::process::{Pid, Signal, kill_process};

use crate::folders::files_of;
use crate::program::succeeded;
use crate::shared::command_in;

/// Policies with two small updates of training.
const TINY: &str = "[settings.training]\nupdates = 2\nnum_envs = 16\nepochs = 1\n";

/// A search of three candidates, whose recommendation is verified; one rollout each.
const SEARCH: &str = "[settings.extent]\ninitial_candidates = 2\niterations = 1\nrollouts = 1\n\
                      verification_rollouts = 1\n";

const PLANTS: &str = "[[plants]]\nname = \"lab\"\nprofile = \"lab\"\n\n\
                      [[plants]]\nname = \"worse\"\nprofile = \"lab\"\ngap = 1.5\nvary = 0.1\n";

/// Writes two recipes and the file of the plants into the folder.
fn prepare(directory: &Path) {
    let recipe = |model: &str, more: &str| {
        let text = format!("name = \"tiny-{model}\"\nmodel = \"{model}\"\n{TINY}{more}");
        std::fs::write(directory.join(format!("{model}.toml")), text).unwrap();
    };
    recipe("nominal", "");
    recipe("opt-nominal", SEARCH);
    std::fs::write(directory.join("plants.toml"), PLANTS).unwrap();
}

fn experiment(directory: &Path, arguments: &[&str]) -> Command {
    let mut command = command_in(directory);
    command.arg("experiment").args(arguments);
    command
}

const BEGIN: [&str; 14] = [
    "--recipe",
    "nominal.toml",
    "--recipe",
    "opt-nominal.toml",
    "--plants",
    "plants.toml",
    "--policies",
    "3",
    "--rollouts",
    "2",
    "--seed",
    "4",
    "--out",
    "one",
];

fn begin(directory: &Path, arguments: &[&str], threads: &str) -> Child {
    experiment(directory, &[arguments, &["--threads", threads]].concat())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .expect("the program starts")
}

/// Resumes the experiment and returns the printed table, then the table in CSV.
fn table(directory: &Path) -> String {
    let output = experiment(directory, &["--resume", "one", "--csv", "one.csv"]).output().unwrap();
    succeeded(&output) + &std::fs::read_to_string(directory.join("one.csv")).unwrap()
}

/// The bytes of every file by its path, without files that an interruption has left unfinished.
fn files(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let whole = files_of(folder).into_iter();
    whole.filter(|(name, _)| !name.contains("unfinished")).collect()
}

#[test]
fn an_experiment_killed_and_stopped_again_and_again_comes_to_the_same_table() {
    let whole = tempfile::tempdir().unwrap();
    prepare(whole.path());
    let tables = ["--csv", "one/first.csv", "--figures", "one/figures"];
    let output = experiment(whole.path(), &[&BEGIN[..], &tables].concat()).output().unwrap();
    let text = succeeded(&output);
    // Table and figures were made. The experiments that are compared below are begun without them.
    for made in tables.map(|it| whole.path().join(it)).iter().skip(1).step_by(2) {
        assert!(made.exists(), "{}", made.display());
        if made.is_dir() { std::fs::remove_dir_all(made) } else { std::fs::remove_file(made) }
            .unwrap();
    }
    assert!(text.contains("on lab") && text.contains("on worse"), "{text}");
    assert!(text.contains("/3 ") && text.contains("tiny-opt-nominal"), "{text}");
    let expected = table(whole.path());
    assert!(expected.starts_with(&text), "a resumed finished experiment printed another table");
    let expected_files = files(&whole.path().join("one"));
    // 2 recipes of 3 policies with 2 rollouts on 2 plants, and a search with 4 rollouts.
    let recordings = expected_files.keys().filter(|name| name.ends_with(".mcap")).count();
    assert_eq!(recordings, 2 * 3 * 2 * 2 + 4);

    // A file that the experiment did not write is replaced only with --force.
    let foreign = whole.path().join("foreign.csv");
    std::fs::write(&foreign, "mine").unwrap();
    let arguments = ["--resume", "one", "--table", "--csv", "foreign.csv"];
    let output = experiment(whole.path(), &arguments).output().unwrap();
    assert_eq!(output.status.code(), Some(2));
    let told = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(told.contains("--csv foreign.csv exists already"), "{told}");
    // The rollouts of an experiment are compared, so all of them have the same guard and homing.
    for (option, words) in [
        (&["--unidentified"][..], "leave --unidentified out"),
        (&["--home", "hand"], "give --home stops"),
    ] {
        let resume = [&["--resume", "one", "--table"], option].concat();
        let output = experiment(whole.path(), &resume).output().unwrap();
        let told = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{told}");
        assert!(told.contains(words), "{told}");
    }
    assert_eq!(std::fs::read_to_string(&foreign).unwrap(), "mine");
    assert!(!whole.path().join("two").exists());
    let refused = ["--out", "two", "--models", "nominal", "--csv", "foreign.csv"];
    assert_eq!(experiment(whole.path(), &refused).output().unwrap().status.code(), Some(2));
    assert!(!whole.path().join("two").exists(), "an experiment was begun");
    // A real Qube would not follow options that describe an emulated one.
    for (option, value) in
        [("--profile", "lab"), ("--gap", "1.5"), ("--vary", "0.1"), ("--plants", "plants.toml")]
    {
        let refused =
            ["--device", "/dev/none", "--out", "two", "--models", "nominal", option, value];
        let output = experiment(whole.path(), &refused).output().unwrap();
        let told = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{told}");
        assert!(told.contains(&format!("leave {option} out")), "{told}");
    }
    assert!(!whole.path().join("two").exists(), "an experiment was begun");
    // A command whose executor is refused leaves no folder that stops the corrected command.
    let refused = ["--out", "two", "--models", "nominal", "--executor", "no-such-executor"];
    for _ in 0..2 {
        let output = experiment(whole.path(), &refused).output().unwrap();
        let told = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{told}");
        assert!(told.contains("no-such-executor") && !told.contains("exists already"), "{told}");
        assert!(!whole.path().join("two/experiment.toml").exists(), "{told}");
    }
    let arguments = [&arguments[..], &["--force"]].concat();
    succeeded(&experiment(whole.path(), &arguments).output().unwrap());
    assert!(expected.ends_with(&std::fs::read_to_string(&foreign).unwrap()));

    // A recording that is put in the place of another, and a policy that did not make the
    // recordings beside it, are refused.
    let policies = whole.path().join("one/policies/tiny-nominal");
    for (from, to) in [
        ("000/lab/rollout-0-attempt-0.mcap", "000/lab/rollout-1-attempt-0.mcap"),
        ("000/lab/rollout-0-attempt-0.mcap", "001/lab/rollout-0-attempt-0.mcap"),
        ("000/policy.safetensors", "001/policy.safetensors"),
    ] {
        let kept = std::fs::read(policies.join(to)).unwrap();
        std::fs::copy(policies.join(from), policies.join(to)).unwrap();
        for table in [&["--table"][..], &[]] {
            let resume = [&["--resume", "one"], table].concat();
            let output = experiment(whole.path(), &resume).output().unwrap();
            let told = String::from_utf8_lossy(&output.stderr).into_owned();
            assert_eq!(output.status.code(), Some(3), "{to}: {told}");
            assert!(told.contains("policies/tiny-nominal/00"), "{told}");
        }
        std::fs::write(policies.join(to), kept).unwrap();
    }
    // The whole folder of a policy in the place of another is refused, too.
    let recording = "lab/rollout-0-attempt-0.mcap";
    let copied = ["policy.safetensors", recording, "lab/rollout-1-attempt-0.mcap"];
    let kept = copied.map(|file| std::fs::read(policies.join("001").join(file)).unwrap());
    for file in copied {
        std::fs::copy(policies.join("000").join(file), policies.join("001").join(file)).unwrap();
    }
    for table in [&["--table"][..], &[]] {
        let resume = [&["--resume", "one"], table].concat();
        let output = experiment(whole.path(), &resume).output().unwrap();
        let told = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(3), "{told}");
        assert!(told.contains(&format!("policies/tiny-nominal/001/{recording}")), "{told}");
    }
    for (file, kept) in copied.iter().zip(kept) {
        std::fs::write(policies.join("001").join(file), kept).unwrap();
    }
    // A policy that is damaged is trained again, to the same bytes.
    std::fs::write(policies.join("001/policy.safetensors"), "cut off").unwrap();
    assert_eq!(table(whole.path()), expected);
    assert!(files(&whole.path().join("one")) == expected_files, "the policy differs");

    // --table shows finished work without running anything; a resumed experiment makes missing
    // files again.
    let lost = "one/policies/tiny-nominal/002/lab/rollout-1-attempt-0.mcap";
    std::fs::remove_file(whole.path().join(lost)).unwrap();
    let output = experiment(whole.path(), &["--resume", "one", "--table"]).output().unwrap();
    let text = succeeded(&output);
    assert!(text.contains("/2 ") && text.contains("/3 "), "{text}");
    assert!(!whole.path().join(lost).exists());
    assert_eq!(table(whole.path()), expected);
    assert!(files(&whole.path().join("one")) == expected_files);

    // A damaged recording does not count, as --table says; the rollout is recorded again.
    std::fs::write(whole.path().join(lost), "damaged").unwrap();
    let output = experiment(whole.path(), &["--resume", "one", "--table"]).output().unwrap();
    let told = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(told.contains(&format!("{lost}: this is not an MCAP file")), "{told}");
    assert_eq!(succeeded(&output), text);
    assert_eq!(table(whole.path()), expected);
    let aside = lost.replace(".mcap", ".unfinished-1.mcap");
    std::fs::remove_file(whole.path().join(aside)).unwrap();
    assert!(files(&whole.path().join("one")) == expected_files);

    // With changed settings only --table works: the program makes nothing more.
    let settings = whole.path().join("one/experiment.toml");
    let begun_with = std::fs::read_to_string(&settings).unwrap();
    std::fs::write(&settings, begun_with.replacen("seed = 4", "seed = 5", 1)).unwrap();
    let output = experiment(whole.path(), &["--resume", "one"]).output().unwrap();
    assert_eq!(output.status.code(), Some(2));
    let told = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(told.contains("experiment.toml: it was changed since"), "{told}");
    succeeded(&experiment(whole.path(), &["--resume", "one", "--table"]).output().unwrap());

    let torn = tempfile::tempdir().unwrap();
    prepare(torn.path());
    run_with_interruptions(torn.path(), &BEGIN);
    assert_eq!(table(torn.path()), expected);
    same_files(torn.path(), &expected_files);
}

/// Runs an experiment, killing and stopping it in turn, until it is complete.
fn run_with_interruptions(directory: &Path, arguments: &[&str]) {
    let mut child = begin(directory, arguments, "1");
    let mut interruptions = 0;
    loop {
        // The pauses differ, so that the interruptions come in different phases. The first pause is
        // zero, so that at least one interruption comes on any computer.
        std::thread::sleep(Duration::from_millis(53 * (interruptions % 7)));
        if let Some(status) = child.try_wait().unwrap() {
            assert!(status.success(), "after {interruptions} interruptions: {status}");
            break;
        }
        // After 20 interruptions the program runs to its end, even on a computer that is too slow
        // to finish anything between two of them.
        if interruptions < 20 {
            let signal = if interruptions % 2 == 0 { Signal::KILL } else { Signal::INT };
            let _ = kill_process(Pid::from_child(&child), signal);
            interruptions += 1;
            let code = child.wait().unwrap().code();
            assert!(matches!(code, None | Some(0 | 130)), "{code:?}");
            child = if directory.join("one/experiment.toml").exists() {
                let arguments = ["--resume", "one", "--threads", "2"];
                let mut command = experiment(directory, &arguments);
                command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap()
            } else {
                let _ = std::fs::remove_dir_all(directory.join("one"));
                begin(directory, arguments, "1")
            };
        }
    }
    assert!(interruptions > 0, "the experiment was over before it could be interrupted");
}

/// Panics unless the folder of the experiment has exactly these files, apart from unfinished ones.
fn same_files(directory: &Path, expected: &BTreeMap<String, Vec<u8>>) {
    let found = files(&directory.join("one"));
    assert_eq!(found.keys().collect::<Vec<_>>(), expected.keys().collect::<Vec<_>>());
    for (name, bytes) in expected {
        assert!(*bytes == found[name], "{name} differs");
    }
}

#[test]
fn files_that_cannot_be_written_in_the_end_do_not_hide_the_table() {
    // The trainings last longer each time, until the test writes its files before they end.
    let shown = [20, 160, 1280].into_iter().any(shows_its_table_despite_files_in_its_way);
    assert!(shown, "every experiment ended before its files were in the way");
}

/// Writes files at the paths of an experiment's results while its policies train with this number
/// of updates; returns whether they were written before the last training had ended.
fn shows_its_table_despite_files_in_its_way(updates: u32) -> bool {
    let directory = tempfile::tempdir().unwrap();
    let recipe = format!(
        "name = \"longer\"\nmodel = \"nominal\"\n\
         [settings.training]\nupdates = {updates}\nnum_envs = 16\nepochs = 1\n"
    );
    std::fs::write(directory.path().join("longer.toml"), recipe).unwrap();
    let arguments = ["--recipe", "longer.toml", "--profile", "lab", "--policies", "3"];
    let files = ["--out", "one", "--csv", "one.csv", "--figures", "figures", "--json"];
    let mut child = experiment(directory.path(), &[&arguments[..], &files].concat())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("the program starts");
    // The program checks the paths of both options before it writes the settings. The test writes
    // files at these paths afterwards, as another program might.
    loop {
        // The program may end between the two checks, so the test looks for the file last.
        let has_ended = child.try_wait().unwrap().is_some();
        if directory.path().join("one/experiment.toml").exists() {
            break;
        }
        assert!(!has_ended, "the experiment ended before it wrote its settings");
        std::thread::sleep(Duration::from_millis(2));
    }
    let written =
        ["one.csv", "figures"].map(|name| std::fs::write(directory.path().join(name), "mine"));
    let last_policy = directory.path().join("one/policies/longer/002/policy.safetensors");
    let is_in_time = !last_policy.exists();
    let output = child.wait_with_output().unwrap();
    if !is_in_time {
        return false;
    }
    written.into_iter().for_each(Result::unwrap);
    let told = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{told}");
    assert!(told.contains("--csv: one.csv") && told.contains("--figures: figures"), "{told}");
    let result: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(result["models"][0]["policies"], 3);
    assert_eq!(result["ended_by"]["exit_code"], 2);
    assert_eq!(std::fs::read_to_string(directory.path().join("one.csv")).unwrap(), "mine");
    true
}

/// A box that the excitation leaves at once.
const NARROW: &str = "[settings.safety_box]\nalpha_dot = 0.5\n";

#[test]
fn interrupted_and_resumed_methods_give_the_same_table() {
    let arguments = [
        "--strategies",
        "bayrn,random,identify",
        "--recipe",
        "search.toml",
        "--profile",
        "lab",
        "--repetitions",
        "2",
        "--recordings",
        "2",
        "--policies",
        "3",
        "--rollouts",
        "2",
        "--seed",
        "4",
        "--out",
        "one",
    ];
    let prepare = |directory: &Path| {
        let text = format!("name = \"tiny\"\nmodel = \"opt-nominal\"\n{TINY}{SEARCH}{NARROW}");
        std::fs::write(directory.join("search.toml"), text).unwrap();
    };
    let whole = tempfile::tempdir().unwrap();
    prepare(whole.path());
    let output = experiment(whole.path(), &arguments).output().unwrap();
    let text = succeeded(&output);
    assert!(text.contains("tiny on lab"), "{text}");
    // Untrained policies never succeed, and a recording that is cut short cannot identify a Qube.
    let lines = [
        "bayrn              0/2",
        "random             0/2",
        "identify           0/2",
        "identify: ",
    ];
    for line in lines {
        assert!(text.lines().any(|it| it.starts_with(line)), "{line} in {text}");
    }
    assert!(text.contains("> 3") && text.contains("> 2"), "{text}");
    let expected = table(whole.path());
    assert!(expected.starts_with(&text), "a resumed finished experiment printed another table");
    assert!(expected.contains("bayrn,1,3,1,0,2,false,"), "{expected}");
    let expected_files = files(&whole.path().join("one"));
    let count = |end: &str| expected_files.keys().filter(|name| name.ends_with(end)).count();
    assert_eq!(count("refused-2.txt"), 2);
    // Every recommendation fails here, so that the first of the three policies that would score it
    // decides. The four refused recommendations of `identify` have no policy.
    let scored = expected.lines().filter(|line| line.contains(",false,")).count() - 4;
    let search_policies = 2 * 2 * 3;
    assert_eq!(count("policy.safetensors"), search_policies + scored);

    let drawn = experiment(whole.path(), &["--resume", "one", "--table", "--figures", "figures"]);
    succeeded(&{ drawn }.output().unwrap());
    let svg = std::fs::read_to_string(whole.path().join("figures/strategies.svg")).unwrap();
    assert!(svg.contains("bayrn") && svg.contains("identify"));

    let torn = tempfile::tempdir().unwrap();
    prepare(torn.path());
    run_with_interruptions(torn.path(), &arguments);
    assert_eq!(table(torn.path()), expected);
    same_files(torn.path(), &expected_files);
}

/// The arguments of a comparison at fixed budgets, with the settings of [`prepare_budgets`].
fn at_budgets(methods: &'static str) -> Vec<&'static str> {
    let ending = ["--budgets", "0,1,2", "--recipe", "search.toml", "--plants", "plants.toml"];
    let sizes = ["--repetitions", "1", "--rollouts", "1", "--trainings", "2"];
    [&["--strategies", methods][..], &ending, &sizes, &["--seed", "4", "--out", "one"]].concat()
}

fn prepare_budgets(directory: &Path, plants: &[&str]) {
    let text = format!("name = \"tiny\"\nmodel = \"opt-nominal\"\n{TINY}{SEARCH}");
    std::fs::write(directory.join("search.toml"), text).unwrap();
    std::fs::write(directory.join("plants.toml"), plants.concat()).unwrap();
}

/// The methods of a comparison with their budgets, as the table names them on this plant.
fn rows_on(result: &serde_json::Value, plant: &str) -> Vec<String> {
    let rows = result["models"].as_array().unwrap().iter();
    rows.filter(|row| row["plant"] == plant)
        .map(|row| row["model"].as_str().unwrap().to_owned())
        .collect()
}

const LAB: &str = "[[plants]]\nname = \"lab\"\nprofile = \"lab\"\n\n";

#[test]
fn methods_that_fit_a_qube_have_no_recommendation_without_a_recording() {
    let directory = tempfile::tempdir().unwrap();
    prepare_budgets(directory.path(), &[LAB]);
    let methods = at_budgets("identify-mean,sequential");
    let output = experiment(directory.path(), &methods).args(["--json"]).output().unwrap();
    let result: serde_json::Value = serde_json::from_str(&succeeded(&output)).unwrap();
    let expected = ["identify-mean 1", "identify-mean 2", "sequential 1", "sequential 2"];
    assert_eq!(rows_on(&result, "lab"), expected);
    let recorded = files(&directory.path().join("one"));
    let of_sequential = "budgets/lab/sequential/000/recordings";
    let is_of_sequential =
        |name: &&String| name.starts_with(of_sequential) && name.ends_with(".mcap");
    assert_eq!(recorded.keys().filter(is_of_sequential).count(), 2);
}

#[test]
fn methods_at_fixed_budgets_are_scored_on_every_plant_and_can_be_interrupted() {
    const CABLE: &str = "[[plants]]\nname = \"cable\"\nprofile = \"lab\"\nplay_deg = 0.5\n\
                         effects = { hysteresis_n_m = 0.0002, slack = 1.0 }\n";
    let whole = tempfile::tempdir().unwrap();
    prepare_budgets(whole.path(), &[LAB, CABLE]);
    let methods = at_budgets("robust,posterior,random");
    let output = experiment(whole.path(), &methods).args(["--json"]).output().unwrap();
    let result: serde_json::Value = serde_json::from_str(&succeeded(&output)).unwrap();
    for plant in ["lab", "cable", "all plants"] {
        // Only `robust` needs no rollout, so only it has a recommendation at budget 0.
        let expected = [
            "robust 0",
            "robust 1",
            "robust 2",
            "posterior 1",
            "posterior 2",
            "random 1",
            "random 2",
        ];
        assert_eq!(rows_on(&result, plant), expected, "{plant}");
    }
    // One policy of `robust` serves all budgets.
    let names = files(&whole.path().join("one"));
    let count = |start: &str, end: &str| {
        names.keys().filter(|name| name.starts_with(start) && name.ends_with(end)).count()
    };
    assert_eq!(count("budgets/lab/robust", "policy.safetensors"), 1);
    assert_eq!(count("budgets/cable/posterior", "identified-2.toml"), 1);
    let drawn = experiment(whole.path(), &["--resume", "one", "--table", "--figures", "figures"]);
    succeeded(&{ drawn }.output().unwrap());
    let svg = std::fs::read_to_string(whole.path().join("figures/budgets.svg")).unwrap();
    for words in ["over real rollouts", "all plants", "posterior", "cable"] {
        assert!(svg.contains(words), "{words}");
    }
    let fit = whole.path().join("one/budgets/cable/posterior/000/identified-2.toml");
    let found = std::fs::read(&fit).unwrap();
    std::fs::write(&fit, "name = ").unwrap();
    let output = experiment(whole.path(), &["--resume", "one"]).output().unwrap();
    let told = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{told}");
    assert!(
        told.contains("identified-2.toml: damaged") && told.contains("Remove the file"),
        "{told}"
    );
    std::fs::remove_file(&fit).unwrap();
    succeeded(&experiment(whole.path(), &["--resume", "one"]).output().unwrap());
    assert_eq!(std::fs::read(&fit).unwrap(), found);

    // A method depends neither on other methods nor on other plants, so an interrupted experiment
    // with fewer of them has the same files for each.
    let torn = tempfile::tempdir().unwrap();
    prepare_budgets(torn.path(), &[LAB]);
    run_with_interruptions(torn.path(), &at_budgets("robust,posterior"));
    let found = files(&torn.path().join("one"));
    let of = |files: &BTreeMap<String, Vec<u8>>, method: &str| {
        let folder = format!("budgets/lab/{method}/");
        let names = files.keys().filter(|name| name.starts_with(&folder));
        names.cloned().collect::<Vec<_>>()
    };
    for method in ["robust", "posterior"] {
        let of_method = of(&found, method);
        assert!(!of_method.is_empty() && of_method == of(&names, method), "{method}");
        for name in of_method {
            assert!(found[&name] == names[&name], "{name} differs");
        }
    }
}

#[test]
fn impossible_settings_are_refused_before_anything_is_made() {
    let directory = tempfile::tempdir().unwrap();
    prepare(directory.path());
    std::fs::write(directory.path().join("bad.toml"), "name = \"x\"\nmodel = \"nominl\"\n")
        .unwrap();
    std::fs::write(directory.path().join("around.toml"), "name = \"x\"\nmodel = \"profile\"\n")
        .unwrap();
    std::fs::write(directory.path().join("far.toml"), "[[plants]]\nname = \"x\"\ngap = 9.0\n")
        .unwrap();
    for (arguments, words) in [
        (vec!["--recipe", "bad.toml"], "nominl"),
        (vec!["--recipe", "nominal.toml", "--recipe", "nominal.toml"], "two are called"),
        (vec!["--recipe", "nominal.toml", "--policies", "0"], "policies"),
        (vec!["--recipe", "nominal.toml", "--plants", "far.toml"], "gap"),
        (vec!["--recipe", "around.toml"], "give this Qube in [profile]"),
        (vec!["--recipe", "nominal.toml", "--executor", "slurmm"], "give local, slurm or folder"),
        (vec!["--resume", "nowhere"], "no experiment"),
        (
            vec!["--strategies", "baysian"],
            "bayrn, cem, cmaes, random, sobol, robust, identify-mean",
        ),
        (vec!["--strategies", "robust"], "give budgets"),
        (vec!["--strategies", "cem", "--budgets", "5,2"], "larger than the one before"),
        (vec!["--strategies", "posterior", "--budgets", "0"], "at least 1 real rollout for"),
        (vec!["--strategies", "robust,cem", "--budgets", "0,1"], "cem needs at least 5 real"),
        (vec!["--recipe", "nominal.toml", "--effect", "slack=2"], "from 0 to 1"),
        (vec!["--recipe", "nominal.toml", "--effect", "hunger=2"], "no effect hunger"),
        (vec!["--strategies", "cem,cem"], "cem is there twice"),
        (vec!["--strategies", "cem", "--models", "nominal"], "give one of opt-handcrafted"),
        (vec!["--strategies", "cem", "--models", "opt-nominal,opt-robust"], "one model"),
        (vec!["--strategies", "cem", "--plants", "plants.toml"], "one plant"),
        (vec!["--strategies", "cem", "--device", "/dev/ttyACM0"], "emulated Qube only"),
        (vec!["--strategies", "cem", "--rival-settings", "fpo=1"], "unknown field `fpo`"),
        (vec!["--strategies", "cem", "--rival-settings", "fpo_beta=99"], "rivals.fpo_beta = 99"),
        (vec!["--repetitions", "3"], "--strategies"),
        (vec!["--models", "nominl"], "nominal-handcrafted"),
        (vec!["--recipe", "nominal.toml", "--device", "/dev/ttyNOWHERE"], "no such port"),
        (vec!["--recipe", "nominal.toml", "--device", "nominal.toml"], "not a serial port"),
    ] {
        let output = experiment(directory.path(), &arguments).args(["--json"]).output().unwrap();
        let message = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{message}");
        assert!(message.contains(words), "{message}");
        assert!(!message.contains("experiment in"), "{message}");
    }
    assert!(!directory.path().join("logs").exists());
}

#[test]
fn scripts_get_the_models_with_their_intervals() {
    let directory = tempfile::tempdir().unwrap();
    prepare(directory.path());
    let arguments = ["--recipe", "nominal.toml", "--policies", "2", "--rollouts", "1", "--json"];
    let output = experiment(directory.path(), &arguments).output().unwrap();
    let text = succeeded(&output);
    let value: serde_json::Value = serde_json::from_str(text.lines().last().unwrap()).unwrap();
    let model = &value["models"][0];
    assert_eq!(model["model"], "tiny-nominal");
    assert_eq!(model["plant"], "ideal");
    assert_eq!(model["policies"], 2);
    for number in ["sim_mean", "sim_std", "mean_return", "std_return", "success_rate"] {
        assert!(model[number].is_f64(), "{number} in {model}");
    }
    assert!(model["success_interval"]["upper"].as_f64().unwrap() < 1.0);
    let shares = model["rollouts"].as_object().unwrap().values();
    let sum: f64 = shares.map(|share| share.as_f64().unwrap()).sum();
    assert!((sum - 1.0).abs() < 1e-12);
}

#[test]
fn an_experiment_goes_on_with_the_settings_that_it_began_with_and_no_others() {
    let directory = tempfile::tempdir().unwrap();
    for (arguments, words) in [
        (&["--profile", "lab"][..], "leave --profile"),
        (&["--delay-ms", "16"], "leave --profile"),
        (&["--gap", "2"], "leave --profile"),
        (&["--filter", "20"], "leave --estimator"),
        (&["--vary", "0.1"], "--vary"),
        (&["--plants", "none.toml"], "--plants"),
        (&["--repetitions", "3"], "--repetitions"),
        (&["--budgets", "2"], "--budgets"),
        (&["--trainings", "2"], "--trainings"),
        (&["--recordings", "2"], "--recordings"),
        (&["--rival-settings", "fpo_beta=1"], "--rival-settings"),
    ] {
        let resume = [&["--resume", "one"], arguments].concat();
        let output = experiment(directory.path(), &resume).output().unwrap();
        let told = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {told}");
        assert!(told.contains(words), "{arguments:?}: {told}");
    }
}

#[test]
fn an_experiment_goes_on_with_the_profile_by_which_the_guard_knew_its_qube() {
    let directory = tempfile::tempdir().unwrap();
    prepare(directory.path());
    let lab = Path::new(env!("CARGO_MANIFEST_DIR")).join("profiles/lab.toml");
    std::fs::copy(lab, directory.path().join("lab.toml")).unwrap();
    std::fs::write(directory.path().join("qube.toml"), "profile = \"lab.toml\"\n").unwrap();
    let qube = ["--device", "emulated", "--qube", "qube.toml"];
    let begin = ["--recipe", "nominal.toml", "--profile", "lab", "--policies", "1", "--out", "one"];
    succeeded(&experiment(directory.path(), &[&begin[..], &qube].concat()).output().unwrap());
    let resume = ["--resume", "one"];
    let output = experiment(directory.path(), &resume).output().unwrap();
    let told = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{told}");
    assert!(told.contains("another profile of the Qube"), "{told}");
    succeeded(&experiment(directory.path(), &[&resume[..], &qube].concat()).output().unwrap());
    succeeded(&experiment(directory.path(), &["--resume", "one", "--table"]).output().unwrap());
}
