//! Tests `config`, `completions` and `manual` as a user runs them.

use std::fs;
use std::process::{Command, Stdio};

use crate::program::{qube_hil, succeeds};
use crate::shared::say_skipped;

#[test]
fn the_printed_settings_are_a_good_file_and_a_changed_one_is_listed() {
    let directory = tempfile::tempdir().unwrap();
    let directory = directory.path();
    for preset in ["quick", "thesis"] {
        let printed = succeeds(directory, &["config", "print", "--preset", preset]);
        fs::write(directory.join("printed.toml"), &printed).unwrap();
        let told = succeeds(directory, &["config", "check", "printed.toml", "--preset", preset]);
        assert_eq!(told, "printed.toml: valid; it changes nothing\n");
        let changed = printed.replace("\nrollouts = ", "\nrollouts = 1");
        fs::write(directory.join("changed.toml"), changed).unwrap();
        let told = succeeds(directory, &["config", "check", "changed.toml", "--preset", preset]);
        assert!(told.contains("extent.rollouts = 1"), "{told}");
    }
    fs::write(directory.join("seed.toml"), "seed = 5\n").unwrap();
    let told = succeeds(directory, &["config", "check", "seed.toml"]);
    assert!(told.contains("it changes one setting") && told.contains("method is bayrn"), "{told}");
    let told = succeeds(directory, &["config", "check", "seed.toml", "--preset", "thesis"]);
    assert!(told.contains("it changes one setting") && !told.contains("bayrn"), "{told}");
}

#[test]
fn an_error_names_line_and_key() {
    let directory = tempfile::tempdir().unwrap();
    for (text, line, key) in [
        ("seed = 1\n[extent]\nrollouts = 0\n", "line 3", "extent.rollouts"),
        ("[training]\n\nlearning_rat = 1.0\n", "line 3", "learning_rat"),
        ("[training]\nupdates = \"many\"\n", "line 2", "updates"),
        ("[training.simulation.sensors]\ntype = \"encoder\"\n", "line 2", "encoder"),
        ("[[psi]]\nname = \"mean_M_x\"\n", "line 1", "mean_M_x"),
        ("[homing]\n\n[homing.signs]\ntheta_invertd = true\n", "line 4", "theta_invertd"),
        // A profile is absent by default and has to be whole.
        ("[homing]\n\n[profile]\nspread = 0.1\n", "line 3", "`model`"),
        ("[extent\n", "line 1", "extent"),
    ] {
        fs::write(directory.path().join("bad.toml"), text).unwrap();
        let output = qube_hil(directory.path(), &["config", "check", "bad.toml"]);
        let told = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(2), "{text}: {told}");
        let names_both = told.contains("bad.toml") && told.contains(line) && told.contains(key);
        assert!(names_both, "{text}{line}, {key}: {told}");
    }
}

#[test]
fn every_number_in_the_settings_is_checked() {
    let directory = tempfile::tempdir().unwrap();
    let printed = succeeds(directory.path(), &["config", "print"]);
    // The comments with settings that are absent by default count as settings, too.
    let lines: Vec<&str> = printed
        .lines()
        .map(|line| line.strip_prefix('#').filter(|it| !it.starts_with(' ')).unwrap_or(line))
        .collect();
    fs::write(directory.path().join("good.toml"), lines.join("\n")).unwrap();
    succeeds(directory.path(), &["config", "check", "good.toml"]);
    let mut replaced = 0;
    // True if the line is in an array of tables: the message then names the line of a header.
    let mut in_array = false;
    for (index, line) in lines.iter().enumerate() {
        if line.starts_with('[') {
            in_array = line.starts_with("[[");
        }
        let Some((key, number)) = line.split_once(" = ") else { continue };
        let is_whole = number.parse::<i64>().is_ok();
        if number.parse::<f64>().is_err() {
            continue;
        }
        let wrong = if key == "seed" {
            &["nan", "inf", "-1"][..]
        } else if is_whole {
            &["nan", "inf", "4294967296"][..]
        } else if key == "largest_gradient_norm" {
            // Infinity means no limit.
            &["nan", "-inf", "-1e300"][..]
        } else {
            &["nan", "inf", "-inf", "1e300", "-1e300"][..]
        };
        for value in wrong {
            let mut lines = lines.clone();
            let changed = format!("{key} = {value}");
            lines[index] = &changed;
            fs::write(directory.path().join("bad.toml"), lines.join("\n")).unwrap();
            let output = qube_hil(directory.path(), &["config", "check", "bad.toml"]);
            let told = String::from_utf8(output.stderr).unwrap();
            let place = format!("line {}: {changed}", index + 1);
            assert_eq!(output.status.code(), Some(2), "{place} is accepted");
            // For the end of a range of psi the message names the header of its table.
            let is_named = told.contains(key) || told.contains("[[psi]]");
            assert!(told.contains("bad.toml") && is_named, "{place}: {told}");
            let number = index + 1;
            let has_line = [format!("line {number}:"), format!("line {number},")]
                .iter()
                .any(|line| told.contains(line));
            let has_any_line = in_array && told.contains("line ");
            assert!(has_line || has_any_line, "{place}: {told}");
            if !is_whole {
                let has_remedy = ["give ", "it must "].iter().any(|words| told.contains(words));
                assert!(has_remedy, "{place}: {told}");
            }
            replaced += 1;
        }
    }
    assert!(replaced > 500, "only {replaced} numbers were replaced");
}

#[test]
fn a_shell_reads_its_completions() {
    let directory = tempfile::tempdir().unwrap();
    for shell in ["bash", "zsh", "fish"] {
        let script = succeeds(directory.path(), &["completions", shell]);
        for word in ["session", "export", "config", "rollouts"] {
            assert!(script.contains(word), "{shell}: {word} is missing");
        }
        let path = directory.path().join(shell);
        fs::write(&path, script).unwrap();
        let read = Command::new(shell).arg("-n").arg(&path).stderr(Stdio::piped()).output();
        match read {
            Ok(read) => {
                assert!(read.status.success(), "{shell}: {}", String::from_utf8_lossy(&read.stderr))
            }
            Err(error) => say_skipped("completions of one shell", format!("{shell}: {error}"), &[]),
        }
    }
}

#[test]
fn every_command_has_a_manual_page_with_its_examples() {
    let directory = tempfile::tempdir().unwrap();
    let directory = directory.path();
    succeeds(directory, &["manual", "--out", "man"]);
    let page = |name: &str| {
        let path = directory.join("man").join(name);
        fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
    };
    let whole = page("qube-hil.1");
    assert!(whole.contains(".TH") && whole.contains("Exit codes"), "{whole}");
    let help = succeeds(directory, &["--help"]);
    let commands = help.split("Commands:").nth(1).unwrap().split("Options:").next().unwrap();
    let names: Vec<&str> = commands
        .lines()
        .filter(|line| line.starts_with("  ") && !line.starts_with("   "))
        .filter_map(|line| line.split_whitespace().next())
        .filter(|name| *name != "help")
        .collect();
    assert!(names.len() >= 19, "{names:?}");
    for name in names {
        let page = page(&format!("qube-hil-{name}.1"));
        assert!(page.contains("SYNOPSIS") && page.contains("qube"), "{name}: {page}");
        let examples = page.split("Examples:\n").nth(1).unwrap_or_default();
        let command = format!("qube\\-hil {}", name.replace('-', "\\-"));
        assert!(examples.contains(&command), "{name}: {page}");
    }
    assert!(page("qube-hil-session.1").contains("\\-\\-resume"));
    assert!(page("qube-hil-config-print.1").contains("\\-\\-preset"));
}
