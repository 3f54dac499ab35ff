//! Tests the command `experiment`: interrupted, killed and resumed, on one thread or several, it
//! gives the same table and the same files, byte for byte but for a stop that a recording holds.
//! Impossible and changed settings are refused.

use std::path::Path;
use std::process::Stdio;
use std::time::Duration;

use crate::experiments::{
    SEARCH, TINY, experiment, files, run_with_interruptions, same_files, table,
};
use crate::program::succeeded;

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
        (vec!["--strategies", "epopt", "--rival-settings", "epopt_worst_share=9"], "_share = 9"),
        (vec!["--strategies", "cem", "--rival-settings", "fpo_beta=1"], "add fpo to --strategies"),
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
