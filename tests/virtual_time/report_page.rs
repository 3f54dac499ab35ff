//! Tests the pages that `session`, `experiment` and `report` write, in a browser if there is one.

use std::fs;
use std::path::Path;
use std::process::Command;

use serde_json::Value;

use crate::program::qube_hil;
use crate::shared::{isolate, say_skipped};

/// Settings of a session whose trainings are too short to learn a swing-up.
const SMALL: &str = "seed = 5\n\
    [extent]\ninitial_candidates = 3\niterations = 1\nrollouts = 2\nverification_rollouts = 2\n\
    [training]\nupdates = 2\nnum_envs = 16\nepochs = 1\n";

/// A folder's name that is also markup and shell code.
const HOSTILE: &str = "<img src=x onerror=alert(1)> $(id) 'x'";

#[track_caller]
fn succeeds(directory: &Path, arguments: &[&str]) -> Value {
    let output = qube_hil(directory, &[arguments, &["--json"]].concat());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

/// The commands of a page, as its reader sees them.
fn commands(page: &str) -> Vec<String> {
    let blocks = page.split("<pre>").skip(1).map(|rest| rest.split("</pre>").next().unwrap());
    let letters = [("&lt;", "<"), ("&gt;", ">"), ("&quot;", "\""), ("&#39;", "'"), ("&amp;", "&")];
    let read = |block: &str| {
        letters.iter().fold(block.to_owned(), |it, (name, sign)| it.replace(name, sign))
    };
    blocks.map(read).collect()
}

/// Checks pages in Chromium. Without Chromium the check says that it is skipped, or fails if
/// `QUBE_HIL_REQUIRE_BROWSER` is set.
fn look_at(pages: &[&Path]) {
    let skipped = |reason: &str| {
        say_skipped("the check of pages in a browser", reason, &["QUBE_HIL_REQUIRE_BROWSER"]);
    };
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("scripts/report-check");
    let output = match Command::new(script).args(pages).output() {
        Ok(output) => output,
        Err(error) => return skipped(&format!("scripts/report-check: {error}")),
    };
    let told = String::from_utf8_lossy(&output.stdout).into_owned()
        + &String::from_utf8_lossy(&output.stderr);
    match output.status.code() {
        Some(0) => {}
        Some(77) => skipped(told.trim()),
        _ => panic!("{told}"),
    }
}

#[test]
fn a_search_becomes_a_page_that_a_browser_shows_and_a_shell_repeats() {
    let directory = tempfile::tempdir().unwrap();
    let directory = directory.path();
    fs::write(directory.join("small.toml"), SMALL).unwrap();
    let arguments = ["session", "--clock", "virtual", "--config", "small.toml", "--out", HOSTILE];
    let told = succeeds(directory, &arguments);
    let path = directory.join(told["report"].as_str().unwrap());
    let page = fs::read_to_string(&path).unwrap();
    assert!(page.len() < 5_000_000, "{}", page.len());
    assert!(page.contains("verifying rollouts on the Qube"), "the outcome is missing");
    assert!(!page.contains("<img"), "a name became markup");
    let best = format!("{:.1}", told["best"]["mean_return"].as_f64().unwrap());
    assert!(page.contains(&format!("a mean return of {best} of at most 600")), "{best}");
    for section in ["Search", "Rollouts", "Surrogate of the return", "Timing", "Provenance"] {
        assert!(page.contains(&format!("<h2>{section}</h2>")), "{section}");
    }
    // The page is the same when it is written again.
    let again = succeeds(directory, &["report", HOSTILE]);
    assert_eq!(again["bytes"], page.len());
    assert_eq!(fs::read_to_string(&path).unwrap(), page);

    // The page's commands work; the test adds only the virtual clock and --json.
    let bin = Path::new(env!("CARGO_BIN_EXE_qube-hil")).parent().unwrap();
    let search_path = format!("{}:{}", bin.display(), std::env::var("PATH").unwrap());
    let commands = commands(&page);
    assert_eq!(commands.len(), 3, "{commands:?}");
    for command in &commands {
        let clock = if command.contains(" run ") { " --clock virtual" } else { "" };
        let line = format!("{command}{clock} --json");
        let mut shell = Command::new("sh");
        shell.current_dir(directory).env("PATH", &search_path).args(["-c", &line]);
        isolate(&mut shell, directory);
        let output = shell.output().unwrap();
        assert!(output.status.success(), "{line}: {}", String::from_utf8_lossy(&output.stderr));
        if command.contains(" session ") {
            let repeated: Value = serde_json::from_slice(&output.stdout).unwrap();
            assert_eq!(repeated["candidates"], told["candidates"], "{line}");
            assert_eq!(repeated["verified"], told["verified"], "{line}");
        }
    }

    // The page names each file that cannot be read, and shows the others.
    let folder = directory.join(HOSTILE);
    fs::remove_file(folder.join("candidates/001/rollout-0-attempt-0.mcap")).unwrap();
    fs::write(folder.join("candidates/002/curve.csv"), "update,steps\n<b>\n").unwrap();
    let output = qube_hil(directory, &["report", HOSTILE, "--out", "poorer.html"]);
    let told = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.code() == Some(3) && told.contains("(and 1 more"), "{told}");
    let poorer = fs::read_to_string(directory.join("poorer.html")).unwrap();
    assert_eq!(poorer.matches("Left out of this page: ").count(), 2);

    // Changed settings are a problem, too, which a script finds in the fields of the output.
    fs::write(folder.join("session.toml"), SMALL.replace("seed = 5", "seed = 6")).unwrap();
    let output = qube_hil(directory, &["report", HOSTILE, "--out", "changed.html", "--json"]);
    let told: Value = serde_json::from_slice(&output.stdout).unwrap();
    let problems: Vec<&str> =
        told["problems"].as_array().unwrap().iter().map(|it| it.as_str().unwrap()).collect();
    assert!(output.status.code() == Some(3) && problems.len() == 3, "{told}");
    assert!(problems[2].contains("session.toml was changed after the session began"), "{told}");

    // A folder that has lost its ledger keeps its page.
    fs::rename(folder.join("ledger.jsonl"), folder.join("ledger.lost")).unwrap();
    let output = qube_hil(directory, &["report", HOSTILE]);
    let told = String::from_utf8(output.stderr).unwrap();
    let words = "ledger.jsonl has no candidates";
    assert!(output.status.code() == Some(3) && told.contains(words), "{told}");
    assert_eq!(fs::read_to_string(&path).unwrap(), page);
    look_at(&[&path, &directory.join("poorer.html")]);
}

#[test]
fn an_identified_session_and_single_recordings_become_pages() {
    let directory = tempfile::tempdir().unwrap();
    let directory = directory.path();
    let settings = format!("{SMALL}[identification]\ncandidates = 1\n");
    fs::write(directory.join("small.toml"), settings).unwrap();
    let session = [
        "session",
        "--clock",
        "virtual",
        "--profile",
        "lab",
        "--config",
        "small.toml",
        "--out",
        "s",
    ];
    let told = succeeds(directory, &session);
    let page = fs::read_to_string(directory.join("s/report.html")).unwrap();
    assert_eq!(told["report"], "s/report.html");
    assert!(page.contains("The Qube was identified from "), "no identification");
    assert!(page.contains("Correlations of the errors") && page.contains("class=\"matrix\""));
    // The last profile is fitted to the verification too, so the verification tests the one before.
    assert!(page.contains("profile-1.toml, so that the verification tests it"));
    assert!(page.contains("held out"), "no prediction of a rollout");

    succeeds(
        directory,
        &["report", "s/candidates/001/rollout-0-attempt-0.mcap", "--profile", "s/profile-1.toml"],
    );
    let single = directory.join("s/candidates/001/rollout-0-attempt-0.html");
    let page = fs::read_to_string(&single).unwrap();
    assert!(page.contains("How near the rollout came to its limits"));
    look_at(&[&directory.join("s/report.html"), &single]);
}

#[test]
fn an_experiment_becomes_a_page_and_a_rollout_a_moving_picture() {
    let directory = tempfile::tempdir().unwrap();
    let directory = directory.path();
    let recipe = "name = \"tiny\"\nmodel = \"handcrafted\"\n[settings.training]\nupdates = 1\nnum_envs = 16\nepochs = 1\n";
    fs::write(directory.join("tiny.toml"), recipe).unwrap();
    fs::write(directory.join("other.toml"), recipe.replace("tiny", "other")).unwrap();
    let arguments =
        ["experiment", "--recipe", "tiny.toml", "--recipe", "other.toml", "--policies", "2"];
    let told = succeeds(directory, &[&arguments[..], &["--rollouts", "1", "--out", "e"]].concat());
    assert_eq!(told["report"], "e/report.html");
    let path = directory.join("e/report.html");
    let page = fs::read_to_string(&path).unwrap();
    for words in
        ["Recipes in pairs", "How the rollouts ended", "Distributions of simulations", "policy 0"]
    {
        assert!(page.contains(words), "{words}");
    }
    assert_eq!(succeeds(directory, &["report", "e"])["bytes"], page.len());
    look_at(&[&path]);

    let run = ["run", "--policy", "classical", "--clock", "virtual", "--out", "run"];
    succeeds(directory, &run);
    succeeds(directory, &["replay", "run/rollout-0.mcap", "--animate", "moving.svg"]);
    let svg = fs::read_to_string(directory.join("moving.svg")).unwrap();
    assert!(svg.len() < 100_000 && svg.matches("<animate").count() == 10, "{}", svg.len());

    // A recording does not hold the guard's predictions, so the report replays the rollout.
    succeeds(directory, &["report", "run/rollout-0.mcap"]);
    let single = directory.join("run/rollout-0.html");
    let page = fs::read_to_string(&single).unwrap();
    for words in ["The guard was nearest at", "guard: predicted", "angle that the guard predicted"]
    {
        assert!(page.contains(words), "{words}");
    }
    let boxed = ["run", "--policy", "classical", "--clock", "virtual", "--guard", "box", "--out"];
    succeeds(directory, &[&boxed[..], &["boxed"]].concat());
    succeeds(directory, &["report", "boxed/rollout-0.mcap"]);
    let page = fs::read_to_string(directory.join("boxed/rollout-0.html")).unwrap();
    assert!(!page.contains("guard predicted") && !page.contains("guard: predicted"));
    look_at(&[&single]);
}

#[test]
fn a_source_without_a_session_and_an_existing_page_are_refused() {
    let directory = tempfile::tempdir().unwrap();
    let directory = directory.path();
    fs::write(directory.join("mine.html"), "mine").unwrap();
    fs::create_dir(directory.join("folder")).unwrap();
    fs::write(directory.join("no.mcap"), "<script>").unwrap();
    for (arguments, words) in [
        (vec!["report", "folder"], "it has no session.toml"),
        (vec!["report", "no.mcap"], "no.mcap"),
        (vec!["report", "nowhere"], "nowhere"),
        (vec!["report", "folder", "no.mcap"], "either one folder, or recordings"),
        (vec!["report", "no.mcap", "--out", "mine.html"], "--force"),
    ] {
        let output = qube_hil(directory, &arguments);
        let told = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {told}");
        assert!(told.contains(words), "{arguments:?}: {told}");
    }
    assert_eq!(fs::read_to_string(directory.join("mine.html")).unwrap(), "mine");
}
