//! Tests a Qube with the USB panel: whole processes that load a library with the vendor's C
//! interface over the emulator's plant, in real time.

use serde_json::Value;

use crate::busy_computer::in_real_time;
use crate::panel::{Ended, Panel, library};

/// Checks that the program refused: it ended with exit code 2, printed one message, printed these
/// words, and armed nothing.
#[track_caller]
fn refused(panel: &Panel, ended: &Ended, words: &[&str]) {
    assert_eq!(ended.code, Some(2), "{ended:?}");
    for word in words {
        assert!(ended.told.contains(word), "{word}: {}", ended.told);
    }
    let said = ended.told.lines().filter(|line| line.starts_with("qube-hil: ")).count();
    assert_eq!(said, 1, "the program printed {said} sentences: {}", ended.told);
    if let Some(state) = panel.amplifier() {
        assert!(state.contains("\never enabled false\n"), "the card was armed: {state}");
    }
}

#[test]
fn without_the_library_check_run_and_session_say_what_to_install() {
    let folder = tempfile::tempdir().unwrap();
    let nowhere = folder.path().join("libhil.so");
    for arguments in [
        &["check", "--device", "hil"][..],
        &["run", "--policy", "classical", "--device", "hil", "--out", "runs"],
        &["session", "--preset", "quick", "--device", "hil", "--out", "session"],
    ] {
        let panel = Panel::new(&[]);
        let mut command = panel.command(arguments);
        command.env("QUBE_HIL_LIBHIL", &nowhere);
        let ended = Ended::of(command.output().unwrap());
        refused(&panel, &ended, &["was not found", nowhere.to_str().unwrap(), "quanser-sdk"]);
        assert!(!panel.path().join("session").exists(), "{arguments:?}");
    }
}

#[test]
fn a_library_that_cannot_be_loaded_is_refused_with_the_loaders_reason() {
    let panel = Panel::new(&[]);
    let broken = panel.path().join("libhil.so");
    std::fs::write(&broken, "no library").unwrap();
    for arguments in [&["check", "--device", "hil"][..], &["doctor", "--seconds", "1"]] {
        let mut command = panel.command(arguments);
        command.env("QUBE_HIL_LIBHIL", &broken);
        let ended = Ended::of(command.output().unwrap());
        let said = format!("{}{}", ended.out, ended.told);
        let said = said.split_whitespace().collect::<Vec<_>>().join(" ");
        assert!(said.contains("cannot be loaded") && said.contains("too short"), "{said}");
        assert!(!said.contains("not found"), "{said}");
    }
}

#[test]
fn a_library_of_another_version_is_refused_with_the_function_that_it_lacks() {
    let panel = Panel::new(&[]);
    let older = panel.path().join("libhil.so");
    let mut bytes = std::fs::read(library()).unwrap();
    // An exported function gets another name, so that the loader does not find it.
    let name = b"\0hil_watchdog_is_expired\0";
    let places: Vec<usize> =
        (0..bytes.len() - name.len()).filter(|&at| bytes[at..].starts_with(name)).collect();
    assert!(!places.is_empty());
    for at in places {
        bytes[at + 1] = b'H';
    }
    std::fs::write(&older, bytes).unwrap();
    let mut command = panel.command(&["check", "--device", "hil"]);
    // A name without a slash means a file of the working directory too.
    command.env("QUBE_HIL_LIBHIL", "libhil.so");
    let ended = Ended::of(command.output().unwrap());
    refused(&panel, &ended, &["hil_watchdog_is_expired", "another version", "quanser-sdk"]);
}

#[test]
fn a_card_that_cannot_be_opened_is_refused_with_the_librarys_words_and_a_remedy() {
    for (fault, words) in [
        ("hil_open:error=108", ["is not there", "USB cable"]),
        ("hil_open:error=1073", ["already opened by another process", "Stop that program"]),
        ("hil_open:error=195", ["license file is missing", "licence in place"]),
        ("hil_open:error=11", ["may not be opened by this user", "udev"]),
        ("hil_open:error=4", ["hil_open failed", "error 4"]),
        ("hil_read:error=1029", ["is not there", "not connected"]),
        ("hil_write_digital:error=1029", ["is not there", "not connected"]),
    ] {
        let panel = Panel::new(&[("QUBE_TEST_HIL_FAULT", fault)]);
        refused(&panel, &panel.run(&["check", "--device", "hil"]), &words);
    }
    let panel = Panel::new(&[("QUBE_TEST_HIL_CARD", "qube_servo3_usb")]);
    refused(&panel, &panel.run(&["check", "--device", "hil"]), &["qube_servo2_usb@0 is not there"]);
    refused(&panel, &panel.run(&["check", "--device", "hil:@"]), &["hil:qube_servo2_usb@0"]);
    refused(
        &panel,
        &panel.run(&["check", "--device", "hil", "--conformance"]),
        &["Leave --conformance out"],
    );
    refused(
        &panel,
        &panel.run(&["check", "--device", "hil", "--clock", "virtual"]),
        &["virtual time works with the emulated Qube only"],
    );
}

#[test]
fn guard_box_alone_does_not_switch_off_the_guard_of_a_card() {
    let panel = Panel::new(&[]);
    let arguments =
        ["run", "--policy", "classical", "--device", "hil", "--guard", "box", "--out", "runs"];
    refused(&panel, &panel.run(&arguments), &["--accept-hard-stop"]);
    assert!(panel.amplifier().is_none(), "the card was opened");
}

#[test]
fn the_doctor_says_whether_the_library_is_here_and_the_card_answers() {
    let panel = Panel::new(&[]);
    let ended = panel.run(&["doctor", "--seconds", "1", "--device", "hil", "--json"]);
    assert!(ended.out.contains("panel library") && ended.out.contains("card hil"), "{ended:?}");
    assert!(ended.out.contains("answers; a sample takes"), "{ended:?}");
    panel.must_be_off();
    assert_eq!(panel.calls("hil_watchdog_start"), 0, "the card was armed");
    let away = Panel::new(&[("QUBE_TEST_HIL_FAULT", "hil_open:error=108")]);
    let ended = away.run(&["doctor", "--seconds", "1", "--device", "hil", "--json"]);
    assert_eq!(ended.code, Some(1), "{ended:?}");
    assert!(ended.out.contains("is not there"), "{ended:?}");
}

#[test]
#[ignore = "takes half a minute by the wall clock"]
fn a_check_learns_the_signs_and_writes_the_card_into_the_file() {
    in_real_time(|| {
        let panel = Panel::new(&[("QUBE_TEST_HIL_SIGNS", "alpha")]);
        let ended = panel.run(&["check", "--device", "hil", "--write"]);
        assert_eq!(ended.code, Some(0), "{ended:?}");
        panel.must_be_off();
        let file = std::fs::read_to_string(panel.path().join("qube.toml")).unwrap();
        for line in [
            "port = \"hil:qube_servo2_usb@0\"",
            "board = \"QS2-0042\"",
            "theta_inverted = false",
            "alpha_inverted = true",
            "[watchdog]",
            "expired_ms = ",
        ] {
            assert!(file.contains(line), "{line}: {file}");
        }
    });
}

#[test]
fn a_rollout_is_recorded_and_comes_out_again_bit_for_bit() {
    in_real_time(|| {
        let panel = Panel::new(&[("QUBE_TEST_HIL_CARD", "qube_servo3_usb")]);
        let arguments = ["run", "--policy", "classical", "--home", "hand", "--skip-check"];
        let device = ["--device", "hil:qube_servo3_usb@0", "--out", "runs"];
        let ended = panel.run(&[&arguments[..], &device].concat());
        assert_eq!(ended.code, Some(0), "{ended:?}");
        panel.must_be_off();
        let ended = panel.run(&["replay", "runs/rollout-0.mcap"]);
        assert_eq!(ended.code, Some(0), "{ended:?}");
        assert!(ended.out.contains("the same bit for bit"), "{ended:?}");
    });
}

#[test]
#[ignore = "takes two minutes by the wall clock"]
fn a_session_identifies_a_card_and_its_recordings_come_out_again() {
    const SMALL: &str = "seed = 5\n\
        [extent]\ninitial_candidates = 1\niterations = 0\nrollouts = 1\nverification_rollouts = 1\n\
        [training]\nupdates = 2\nnum_envs = 16\nepochs = 1\n\
        [identification]\ncandidates = 1\n";
    in_real_time(|| {
        let panel = Panel::new(&[]);
        std::fs::write(panel.path().join("small.toml"), SMALL).unwrap();
        let checked = panel.run(&["check", "--device", "hil", "--write"]);
        assert_eq!(checked.code, Some(0), "{checked:?}");
        let arguments = ["session", "--config", "small.toml", "--qube", "qube.toml", "--out", "s"];
        let ended = panel.run(&[&arguments[..], &["--device", "hil", "--json"]].concat());
        assert_eq!(ended.code, Some(0), "{ended:?}");
        panel.must_be_off();
        let told: Value = serde_json::from_str(&ended.out).unwrap();
        let verdict = told["identification"]["verdict"].as_str().unwrap();
        assert!(verdict.starts_with("fits"), "{told}");
        for candidate in ["000", "001"] {
            let recording = format!("s/candidates/{candidate}/rollout-0-attempt-0.mcap");
            let replayed = panel.run(&["replay", &recording]);
            assert_eq!(replayed.code, Some(0), "{replayed:?}");
            assert!(replayed.out.contains("the same bit for bit"), "{replayed:?}");
        }
    });
}

#[test]
fn a_card_without_a_watchdog_is_not_switched_on() {
    let panel = Panel::new(&[("QUBE_TEST_HIL_WATCHDOG", "none")]);
    refused(&panel, &panel.run(&["check", "--device", "hil"]), &["has no watchdog"]);
    assert!(panel.amplifier().is_some(), "the card was not opened");
}

#[test]
#[ignore = "takes a minute by the wall clock"]
fn a_watchdog_that_leaves_the_motor_on_fails_the_check_and_writes_no_file() {
    in_real_time(|| {
        for (watchdog, words, code) in [
            ("keeps", "the motor stays on", 1),
            ("never", "motor still on", 1),
            ("none", "has no watchdog", 2),
        ] {
            let panel = Panel::new(&[("QUBE_TEST_HIL_WATCHDOG", watchdog)]);
            let ended = panel.run(&["check", "--device", "hil", "--write"]);
            assert_eq!(ended.code, Some(code), "{watchdog}: {ended:?}");
            let told = format!("{}{}", ended.out, ended.told);
            let told = told.split_whitespace().collect::<Vec<_>>().join(" ");
            assert!(told.contains(words), "{watchdog}: {told}");
            let is_driven_further = told.contains("-sign pass") || told.contains("homing pass");
            assert!(!is_driven_further, "{watchdog}: {told}");
            assert!(!panel.path().join("qube.toml").exists(), "{watchdog}");
            panel.must_be_off();
        }
    });
}
