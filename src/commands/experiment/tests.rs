use std::path::Path;

use clap::Parser as _;

use super::*;

#[derive(clap::Parser)]
struct Alone {
    #[command(flatten)]
    arguments: Arguments,
}

/// Begins an experiment in `folder/out` on a port that does not exist; returns the failure.
fn refused(folder: &Path, recipes: &[(&str, &str)]) -> Failure {
    let mut words = vec!["experiment".to_owned()];
    for (name, settings) in recipes {
        let path = folder.join(format!("{name}.toml"));
        std::fs::write(&path, format!("name = \"{name}\"\nmodel = \"nominal\"\n{settings}"))
            .unwrap();
        words.extend(["--recipe".into(), path.display().to_string()]);
    }
    let out = folder.join("out").display().to_string();
    words.extend(["--device", "/dev/no-such-qube", "--out", &out].map(String::from));
    let Alone { arguments } = Alone::parse_from(words);
    run(arguments, &Output::new(false)).unwrap_err()
}

#[test]
fn recipes_with_different_homing_are_refused_on_a_real_qube_before_anything_moves() {
    let folder = tempfile::tempdir().unwrap();
    let shifted = "[settings.homing]\ntheta_offset_rad = 0.1\n";
    let failure = refused(folder.path(), &[("plain", ""), ("shifted", shifted)]);
    let cause = failure.cause();
    assert!(failure.is_usage() && cause.contains("recipe shifted: its settings.homing"), "{cause}");
    assert!(!folder.path().join("out").exists());
    // Recipes that agree reach the check of the port.
    let failure = refused(folder.path(), &[("one", shifted), ("two", shifted)]);
    assert!(failure.cause().contains("no-such-qube"), "{}", failure.cause());
}

#[test]
fn an_emulated_qube_with_the_name_of_the_real_one_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let plants = folder.path().join("plants.toml");
    std::fs::write(&plants, "[[plants]]\nname = \"device\"\n").unwrap();
    let (plants, out) = (plants.display().to_string(), folder.path().join("out"));
    let out_text = out.display().to_string();
    let words = ["experiment", "--plants", &plants, "--out", &out_text];
    let Alone { arguments } = Alone::parse_from(words);
    let failure = run(arguments, &Output::new(false)).unwrap_err();
    assert!(failure.is_usage() && failure.cause().contains("device stands for the real Qube"));
    assert!(!out.exists());
}

#[test]
fn a_table_of_no_experiment_is_refused_and_makes_no_folder() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("new");
    let out_text = out.display().to_string();
    let Alone { arguments } = Alone::parse_from(["experiment", "--table", "--out", &out_text]);
    let failure = run(arguments, &Output::new(false)).unwrap_err();
    assert!(failure.is_usage() && failure.cause().contains("--resume"), "{}", failure.cause());
    assert!(!out.exists());
}

#[test]
fn each_file_that_cannot_be_written_is_named() {
    assert!(all_written([("--csv", None), ("--figures", Some(Ok(())))]).is_ok());
    let full = || Some(Err(Failure::failed("the disk is full")));
    let misplaced = || Some(Err(Failure::usage("it is a folder")));
    let both = all_written([("--csv", full()), ("--figures", misplaced())]).unwrap_err();
    assert_eq!(both.cause(), "--csv: the disk is full\n--figures: it is a folder");
    assert!(both.is_usage());
    let one = all_written([("--csv", full()), ("--figures", None)]).unwrap_err();
    assert_eq!((one.cause(), one.is_usage()), ("--csv: the disk is full", false));
}
