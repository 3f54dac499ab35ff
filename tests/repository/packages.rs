//! Tests the packages: the one for Debian holds the files that the installer installs and makes the
//! same groups and user; tools, compiler and the crates on which the program depends have the same
//! version wherever it is named.

use std::collections::BTreeSet;
use std::fs;

use toml::Value;

use crate::tree::{root, source_files};

fn manifest() -> Value {
    fs::read_to_string(root().join("Cargo.toml")).unwrap().parse::<toml::Table>().unwrap().into()
}

/// Sources and targets of the files in the package for Debian.
fn assets() -> Vec<(String, String)> {
    let manifest = manifest();
    let assets = manifest["package"]["metadata"]["deb"]["assets"].as_array().unwrap();
    let text = |value: &Value| value.as_str().unwrap().to_owned();
    assets.iter().map(|asset| (text(&asset[0]), text(&asset[1]))).collect()
}

/// The files that a source names: one file, or all files of a folder with an ending, such as
/// `docs/*.md`.
fn files_of(source: &str) -> Vec<String> {
    let Some((folder, ending)) = source.split_once("/*") else { return vec![source.to_owned()] };
    let Ok(entries) = fs::read_dir(root().join(folder)) else { return Vec::new() };
    let names = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap());
    names.filter(|name| name.ends_with(ending)).map(|name| format!("{folder}/{name}")).collect()
}

/// Returns whether a command of a script writes this file, or the files of this folder: the last
/// word of the command is its path.
fn is_written(script: &str, source: &str) -> bool {
    let path = source.split("/*").next().unwrap();
    let commands = script.lines().map(|line| line.trim_matches(['\'', '"', ' ']));
    let only_tidies = |line: &str| ["#", "rm ", "mkdir "].iter().any(|it| line.starts_with(it));
    let mut writers = commands.filter(|line| !only_tidies(line));
    writers.any(|line| line.strip_suffix(path).is_some_and(|rest| rest.ends_with([' ', '\'', '"'])))
}

#[test]
fn an_asset_that_no_command_of_the_script_writes_is_found() {
    let script = "# makes out/none\nrm -rf out/man out/only\nmkdir -p out/only\n\
                  program manual --out out/man\npackaged 'a' 'out/a@.service'\nb > out/b.txt\n";
    for source in ["out/man/*", "out/a@.service", "out/b.txt"] {
        assert!(is_written(script, source), "{source}");
    }
    for source in ["out/none", "out/only/*", "out/b", "b.txt", "out/man/x"] {
        assert!(!is_written(script, source), "{source}");
    }
}

#[test]
fn everything_in_the_debian_package_exists_or_is_built_by_its_script() {
    let script = fs::read_to_string(root().join("scripts/deb")).unwrap();
    for (source, _) in assets() {
        match source.strip_prefix("target/") {
            Some("dist/qube-hil") => {
                assert!(script.contains("cargo build --locked --profile dist"))
            }
            Some(_) => assert!(is_written(&script, &source), "scripts/deb does not write {source}"),
            None => {
                let exists = files_of(&source).iter().any(|file| root().join(file).is_file());
                assert!(exists, "{source} does not exist");
            }
        }
    }
    let scripts = manifest()["package"]["metadata"]["deb"]["maintainer-scripts"].clone();
    assert!(root().join(scripts.as_str().unwrap()).join("postinst").exists());
}

#[test]
fn the_debian_package_holds_the_pages_that_help_texts_name() {
    let packed: Vec<String> = assets().iter().flat_map(|(source, _)| files_of(source)).collect();
    let mut named = BTreeSet::new();
    for file in source_files(&root().join("src/commands")) {
        let text = fs::read_to_string(&file).unwrap();
        // clap makes the help from doc comments.
        for comment in text.lines().filter(|line| line.trim_start().starts_with("///")) {
            let words = comment
                .split(|letter: char| !letter.is_ascii_alphanumeric() && !"/_-.".contains(letter));
            let words = words.map(|word| word.trim_end_matches('.'));
            let pages = words.filter(|word| word.starts_with("docs/") && word.ends_with(".md"));
            named.extend(pages.map(str::to_owned));
        }
    }
    assert!(named.len() >= 4, "{named:?}");
    for page in named {
        assert!(packed.contains(&page), "the package lacks {page}");
    }
}

#[test]
fn the_debian_package_holds_the_files_of_the_installer() {
    let script = fs::read_to_string(root().join("scripts/install")).unwrap();
    let installed: Vec<&str> = script
        .lines()
        .filter_map(|line| line.strip_prefix("put \"$here/"))
        .map(|rest| rest.split('"').next().unwrap())
        .collect();
    assert_eq!(installed.len(), 4, "{installed:?}");
    let sources: Vec<String> = assets().into_iter().map(|(source, _)| source).collect();
    for file in installed {
        let is_packed = |source: &String| source.rsplit('/').next() == Some(file);
        assert!(sources.iter().any(is_packed), "the package lacks {file}");
    }
}

#[test]
fn installer_and_package_make_the_groups_and_the_user_that_rules_and_unit_name() {
    let read = |file: &str| fs::read_to_string(root().join(file)).unwrap();
    let rules = read("scripts/60-qube-hil.rules") + &read("scripts/61-qube-hil-realtime.rules");
    let unit = read("scripts/qube-hil@.service");
    let setting = |key: &str| unit.lines().find_map(|line| line.strip_prefix(key)).unwrap();
    let of_ports = rules.split("GROUP=\"").skip(1).map(|rest| rest.split('"').next().unwrap());
    let groups: BTreeSet<&str> =
        of_ports.chain(setting("SupplementaryGroups=").split_whitespace()).collect();
    assert!(groups.len() >= 2, "{groups:?}");
    for script in ["scripts/install", "scripts/debian/postinst"] {
        let text = read(script).replace("\\\n", " ");
        // Without `--system`, these scripts only make a user a member of a group.
        let makes = |commands: [&str; 2], name: &str| {
            text.lines().find_map(|line| {
                let words = line.split_whitespace();
                let made: Vec<&str> =
                    words.skip_while(|word| !commands.contains(word)).skip(1).collect();
                (made.contains(&"--system") && made.contains(&name)).then_some(made)
            })
        };
        for group in &groups {
            let made = makes(["groupadd", "addgroup"], group);
            assert!(made.is_some(), "{script} does not make {group}");
        }
        let user = setting("User=");
        let made = makes(["useradd", "adduser"], user);
        let made = made.unwrap_or_else(|| panic!("{script} does not make {user}"));
        // The program remembers a doubt about a Qube below the user's home.
        let home = ["--home", setting("WorkingDirectory=")];
        assert!(made.windows(2).any(|words| words == home), "{script}: {made:?}");
    }
}

/// The versions that a text gives to a package, after `@` or `==`.
fn versions_of<'a>(package: &str, text: &'a str) -> Vec<&'a str> {
    let after = text.split(package).skip(1);
    let given = after.filter_map(|rest| rest.strip_prefix('@').or_else(|| rest.strip_prefix("==")));
    given.map(|rest| rest.split([' ', '`', '\n', '"', ')']).next().unwrap()).collect()
}

#[test]
fn every_tool_has_one_version_wherever_it_is_installed() {
    let files = [
        ".ci/run",
        ".ci/tools.txt",
        ".github/workflows/checks.yml",
        "scripts/deb",
        "scripts/advisories",
    ];
    let texts = files.map(|file| fs::read_to_string(root().join(file)).unwrap());
    for (tool, places) in [("cargo-deny", 4), ("cargo-deb", 3), ("mdbook", 2)] {
        let versions: Vec<&str> = texts.iter().flat_map(|text| versions_of(tool, text)).collect();
        assert!(versions.len() >= places, "{tool}: {versions:?}");
        assert!(versions.iter().all(|it| *it == versions[0]), "{tool}: {versions:?}");
        let installs = texts.iter().flat_map(|text| text.lines());
        let mut installs =
            installs.filter(|line| line.contains("cargo install") && line.contains(tool));
        assert!(
            installs.all(|line| !versions_of(tool, line).is_empty()),
            "{tool} without a version"
        );
    }
}

#[test]
fn the_oldest_compiler_is_checked_by_the_workflow_and_named_by_the_pages() {
    let manifest = manifest();
    let oldest = manifest["workspace"]["package"]["rust-version"].as_str().unwrap();
    let read = |file: &str| fs::read_to_string(root().join(file)).unwrap();
    let workflow = read(".github/workflows/checks.yml");
    assert!(workflow.contains(&format!(
        "cargo +{oldest} check --locked --workspace --all-targets --features live"
    )));
    assert!(workflow.contains(&format!("rustup toolchain install {oldest} ")));
    for page in ["README.md", "CONTRIBUTING.md"] {
        assert!(read(page).contains(&format!("Rust {oldest}")), "{page}");
    }
}

#[test]
fn the_crates_of_the_workspace_and_their_dependencies_on_each_other_have_one_version() {
    let workspace = manifest();
    let version = &workspace["workspace"]["package"]["version"];
    assert_eq!(version.as_str(), Some(env!("CARGO_PKG_VERSION")));
    for file in ["Cargo.toml", "firmware-protocol/Cargo.toml", "python/Cargo.toml"] {
        let text = fs::read_to_string(root().join(file)).unwrap();
        let manifest: toml::Table = toml::from_str(&text).unwrap();
        let is_shared = manifest["package"]["version"].get("workspace");
        assert_eq!(is_shared.and_then(toml::Value::as_bool), Some(true), "{file}");
        for name in ["firmware-protocol", "qube-hil"] {
            let dependencies = manifest.get("dependencies");
            if let Some(dependency) = dependencies.and_then(|all| all.get(name)) {
                assert_eq!(&dependency["version"], version, "{name} in {file}");
            }
        }
    }
}
