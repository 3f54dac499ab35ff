//! Tests that the installer can be repeated, that it installs its files, that it refuses impossible
//! requests, and that its rules give only known and named boards the name of a Qube.

use std::fs;
use std::process::{Command, Output};

use crate::shared::isolate;
use crate::tree::root;

fn install(arguments: &[&str]) -> Output {
    let home = tempfile::tempdir().unwrap();
    let mut command = Command::new(root().join("scripts/install"));
    command.args(["--binary", env!("CARGO_BIN_EXE_qube-hil")]).args(arguments);
    isolate(&mut command, home.path());
    command.output().unwrap()
}

fn stdout(output: &Output) -> String {
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8_lossy(&output.stdout).into_owned()
}

const FILES: [&str; 5] = [
    "usr/local/bin/qube-hil",
    "etc/udev/rules.d/60-qube-hil.rules",
    "etc/udev/rules.d/61-qube-hil-realtime.rules",
    "etc/security/limits.d/qube-hil.conf",
    "etc/systemd/system/qube-hil@.service",
];

#[test]
fn a_second_installation_changes_nothing() {
    let directory = tempfile::tempdir().unwrap();
    let prefix = directory.path().to_str().unwrap();

    let dry = stdout(&install(&["--dry-run", "--prefix", prefix]));
    assert_eq!(dry.matches("would run: install").count(), FILES.len(), "{dry}");
    assert_eq!(fs::read_dir(directory.path()).unwrap().count(), 0, "a dry run installed something");

    let first = stdout(&install(&["--prefix", prefix]));
    assert!(first.contains(": 5 (groups"), "{first}");
    let modified =
        || FILES.map(|file| fs::metadata(directory.path().join(file)).unwrap().modified().unwrap());
    let before = modified();
    let second = stdout(&install(&["--prefix", prefix]));
    assert!(second.contains(": 0 (groups"), "{second}");
    assert_eq!(second.matches("unchanged:").count(), FILES.len(), "{second}");
    assert_eq!(modified(), before);

    // The installer restores a changed file and leaves the others.
    let source = root().join("scripts/60-qube-hil.rules");
    let is_whole = || {
        let installed = fs::read(directory.path().join(FILES[1])).unwrap();
        installed == fs::read(&source).unwrap()
    };
    assert!(is_whole());
    fs::write(directory.path().join(FILES[1]), "mine").unwrap();
    let third = stdout(&install(&["--prefix", prefix]));
    assert!(third.contains(": 1 (groups"), "{third}");
    assert!(is_whole());
    let after = modified();
    for other in [0, 2, 3, 4] {
        assert_eq!(after[other], before[other], "{}", FILES[other]);
    }

    let unit = fs::read_to_string(directory.path().join(FILES[4])).unwrap();
    for word in ["LimitRTPRIO=50", "LimitMEMLOCK=infinity", "WatchdogSec=", "Type=notify"] {
        assert!(unit.contains(word), "{word} is missing in the unit");
    }
    let rules = fs::read_to_string(directory.path().join(FILES[2])).unwrap();
    let rule = rules.lines().find(|line| line.starts_with("KERNEL==\"cpu_dma_latency\"")).unwrap();
    assert!(rule.contains("GROUP=\"realtime\"") && rule.contains("MODE=\"0660\""), "{rule}");
    assert!(unit.contains("ExecStart=/usr/local/bin/qube-hil session --resume"), "{unit}");
}

#[test]
fn impossible_requests_are_refused() {
    for arguments in [
        &["--prefix"][..],
        &["--nonsense"],
        &["--binary", "/no/such/file"],
        &["--board"],
        // In a rule, none of these would be the serial number of one board.
        &["--board", "*"],
        &["--board", "A\", RUN+=\"/bin/sh"],
        &["--board", "A|B"],
        &["--board", ""],
    ] {
        let output = install(arguments);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}");
        assert!(!output.stderr.is_empty());
    }
}

/// A port, with the properties of its board that udev sees.
struct Port<'a> {
    vendor: &'a str,
    product: &'a str,
    serial: Option<&'a str>,
}

/// The names that udev rules give a port. The function implements the subset of udev's language
/// that the rules use: an unknown property equals no value, and an unknown assignment is an error.
fn names(rules: &str, port: &Port) -> Vec<String> {
    let mut names = Vec::new();
    let mut wanted: Option<String> = None;
    for line in rules.lines().filter(|line| !line.is_empty() && !line.starts_with('#')) {
        let terms: Vec<&str> = line.split(", ").collect();
        let unquoted = |text: &str| text.trim_matches('"').to_owned();
        if let Some(label) = terms[0].strip_prefix("LABEL=") {
            wanted.take_if(|wanted| *wanted == unquoted(label));
            continue;
        }
        if wanted.is_some() {
            continue;
        }
        let mut holds = true;
        for term in terms {
            let (key, operator, value) = ["==", "!=", "+=", "="]
                .into_iter()
                .find_map(|operator| {
                    let (key, value) = term.split_once(operator)?;
                    Some((key, operator, unquoted(value)))
                })
                .unwrap_or_else(|| panic!("{term} is no term"));
            let seen = match key {
                "ACTION" => Some("add"),
                "SUBSYSTEM" => Some("tty"),
                "DRIVER" => Some("ftdi_sio"),
                "ATTRS{idVendor}" => Some(port.vendor),
                "ATTRS{idProduct}" => Some(port.product),
                "ATTRS{serial}" => port.serial,
                _ => None,
            };
            let matches = || seen.is_some_and(|seen| value.split('|').any(|one| one == seen));
            match operator {
                "==" => holds &= matches(),
                "!=" => holds &= !matches(),
                _ if !holds => break,
                _ if key == "GOTO" => wanted = Some(value),
                _ if key == "SYMLINK" => names.push(value),
                _ => {
                    let known = [
                        "ATTR{latency_timer}",
                        "GROUP",
                        "MODE",
                        "ENV{ID_MM_DEVICE_IGNORE}",
                        "OPTIONS",
                    ];
                    assert!(known.contains(&key), "{key} is not known here");
                }
            }
        }
    }
    assert_eq!(wanted, None, "a label is missing");
    names
}

#[test]
fn only_known_or_named_boards_get_the_name_dev_qube() {
    let directory = tempfile::tempdir().unwrap();
    let prefix = directory.path().to_str().unwrap();
    let installed = || {
        let folder = directory.path().join("etc/udev/rules.d");
        let mut files: Vec<_> =
            fs::read_dir(folder).unwrap().map(|it| it.unwrap().path()).collect();
        files.sort();
        files.iter().map(|file| fs::read_to_string(file).unwrap()).collect::<String>()
    };
    let uno = Port { vendor: "2341", product: "0043", serial: Some("7583733") };
    let ftdi = Port { vendor: "0403", product: "6001", serial: Some("A50285BI") };
    let other_ftdi = Port { serial: Some("A50285BJ"), ..ftdi };
    let ch340 = Port { vendor: "1a86", product: "7523", serial: None };

    stdout(&install(&["--prefix", prefix]));
    assert_eq!(names(&installed(), &uno), ["qube"]);
    for port in [&ftdi, &other_ftdi, &ch340] {
        assert!(names(&installed(), port).is_empty(), "{} is taken for a Qube", port.vendor);
    }
    assert!(
        installed().contains("ATTR{latency_timer}=\"1\""),
        "the latency timer is left at 16 ms"
    );

    let told = stdout(&install(&["--prefix", prefix, "--board", "A50285BI"]));
    assert!(told.contains(": 1 (groups"), "{told}");
    assert_eq!(names(&installed(), &ftdi), ["qube"]);
    assert!(names(&installed(), &other_ftdi).is_empty());
    let again = stdout(&install(&["--prefix", prefix, "--board", "A50285BI"]));
    assert!(again.contains(": 0 (groups"), "{again}");
    stdout(&install(&["--prefix", prefix, "--board", "A50285BJ"]));
    stdout(&install(&["--prefix", prefix]));
    assert_eq!(names(&installed(), &ftdi), ["qube"]);
    assert_eq!(names(&installed(), &other_ftdi), ["qube"]);
    assert!(names(&installed(), &ch340).is_empty());
}
