//! Tests the methods of the command `experiment`, until a recommendation succeeds and at fixed
//! budgets: interrupted and resumed, a method gives the same table and the same files.

use std::collections::BTreeMap;
use std::path::Path;

use crate::experiments::{
    SEARCH, TINY, experiment, files, run_with_interruptions, same_but_for_a_stop, same_files, table,
};
use crate::program::succeeded;

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
            assert!(same_but_for_a_stop(&found[&name], &names[&name]), "{name} differs");
        }
    }
}
