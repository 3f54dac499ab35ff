//! Tests that no file can widen a limit or switch off the guard of a real Qube. The program exits
//! with code 2 and one message, creates no folder and opens no port.

use std::path::Path;

use qube_hil::experiment::{ExperimentFolder, ExperimentSettings, Plant, Recipe};
use qube_hil::recording::read;
use qube_hil::safety::{Guard, SafetyBox};
use qube_hil::session::{EmulatedQubeSettings, SessionFolder, SessionSettings};
use qube_hil::simulation::Model;

use crate::program::qube_hil;

/// A port that does not exist. The message about it shows that all limits were accepted.
const PORT: [&str; 2] = ["--device", "/dev/ttyNOWHERE"];
const EMULATED: [&str; 2] = ["--clock", "virtual"];

#[track_caller]
fn refused(directory: &Path, arguments: &[&str], words: &[&str]) {
    let output = qube_hil(directory, arguments);
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{arguments:?}: {stderr}");
    assert!(output.stdout.is_empty(), "{arguments:?} printed a result");
    for word in words {
        assert!(stderr.contains(word), "{arguments:?}: {word:?} is missing in: {stderr}");
    }
    // There is one message.
    let messages = stderr.lines().filter(|line| line.starts_with("qube-hil:")).count();
    assert_eq!(messages, 1, "{stderr}");
}

const NO_LIMITS: [&str; 6] = ["9", "50", "nan", "inf", "-1", "0"];

#[test]
fn a_configuration_widens_nothing() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("my.toml");
    let session = |text: &str, device: [&str; 2], flags: &[&str], words: &[&str]| {
        std::fs::write(&path, text).unwrap();
        let begin = ["session", "--config", "my.toml", "--out", "session"];
        refused(directory.path(), &[&begin, &device[..], flags].concat(), words);
        assert!(!directory.path().join("session").exists(), "a session was begun");
    };
    for device in [EMULATED, PORT] {
        for value in NO_LIMITS {
            for (key, most) in [("theta", "at most 2.3"), ("alpha_dot", "at most 40")] {
                let value = if value == "9" && key == "alpha_dot" { "90" } else { value };
                let value = if value == "50" { "50.5" } else { value };
                let text = format!("[safety_box]\n{key} = {value}\n");
                session(&text, device, &[], &["my.toml", &format!("safety_box.{key}"), most]);
            }
        }
        let text = "[training.simulation.safety_box]\ntheta = 9.0\n";
        session(text, device, &[], &["my.toml", "training.simulation.safety_box.theta"]);
        let text = "[homing]\ntheta_offset_rad = 1.0\n";
        session(text, device, &[], &["my.toml", "homing.theta_offset_rad", "0.3"]);
    }
    let off = "[safety_box]\nguard = \"box\"\n";
    session(off, PORT, &[], &["my.toml", "guard", "--accept-hard-stop"]);
    for flags in [&["--guard", "box"][..], &["--accept-hard-stop"]] {
        session(off, PORT, flags, &["--accept-hard-stop", "--guard box"]);
    }
    let contradiction = ["--guard", "foresight", "--accept-hard-stop"];
    session("seed = 1\n", PORT, &contradiction, &["--accept-hard-stop"]);
}

#[test]
fn guard_box_with_accept_hard_stop_is_accepted() {
    let directory = tempfile::tempdir().unwrap();
    let both = ["--guard", "box", "--accept-hard-stop"];
    let port = ["no such port", "/dev/ttyNOWHERE"];
    let run = ["run", "--policy", "classical"];
    refused(directory.path(), &[&run, &PORT[..], &both].concat(), &port);
    refused(directory.path(), &[&run, &PORT[..], &both[..2]].concat(), &["--accept-hard-stop"]);
    refused(directory.path(), &[&run, &PORT[..]].concat(), &port);

    let begin = ["session", "--out", "session"];
    refused(directory.path(), &[&begin, &PORT[..], &both].concat(), &port);
    assert!(!directory.path().join("session").exists(), "a session without a Qube was begun");
    let settings = SessionSettings::quick().with_guard(Guard::Box).to_toml().unwrap();
    drop(SessionFolder::create(&directory.path().join("session"), &settings).unwrap());
    // The session's settings name the guard, and each process that drives needs consent again.
    let resume = ["session", "--resume", "session"];
    let named = ["session.toml", "guard", "--accept-hard-stop"];
    refused(directory.path(), &[&resume, &PORT[..]].concat(), &named);
    refused(directory.path(), &[&resume, &PORT[..], &both[..2]].concat(), &["--accept-hard-stop"]);
    refused(directory.path(), &[&resume, &PORT[..], &both].concat(), &port);
    let other = ["--guard", "foresight"];
    refused(directory.path(), &[&resume, &PORT[..], &other].concat(), &["that it began with"]);
}

#[test]
fn a_session_that_is_resumed_widens_nothing() {
    let directory = tempfile::tempdir().unwrap();
    let root = directory.path().join("session");
    let whole = SessionSettings::quick().to_toml().unwrap();
    drop(SessionFolder::create(&root, &whole).unwrap());
    let resume = |text: &str, words: &[&str]| {
        std::fs::write(root.join("session.toml"), text).unwrap();
        for device in [EMULATED, PORT] {
            let arguments = [&["session", "--resume", "session"], &device[..]].concat();
            refused(directory.path(), &arguments, words);
        }
    };
    for value in ["9.0", "50.0", "nan", "-1.0", "0.0"] {
        let wide = whole.replacen("theta_rad = 2.3", &format!("theta_rad = {value}"), 1);
        assert_ne!(wide, whole);
        resume(&wide, &["session.toml", "safety_box.theta", "at most 2.3"]);
    }
    let off = whole.replace("guard = \"foresight\"", "guard = \"box\"");
    // A file that names no guard means the box.
    let silent = whole.replace("guard = \"foresight\"\n", "");
    for text in [off, silent] {
        assert_ne!(text, whole);
        std::fs::write(root.join("session.toml"), text).unwrap();
        let arguments = [&["session", "--resume", "session"], &PORT[..]].concat();
        refused(directory.path(), &arguments, &["session.toml", "guard", "--accept-hard-stop"]);
        let settings = SessionSettings::load(&root.join("session.toml")).unwrap();
        assert_eq!(settings.safety_box, SafetyBox::THESIS);
        assert_eq!(settings.training.simulation.safety_box.guard, Guard::Box);
    }
}

/// Nothing starts or resumes under the guard of old recordings, even if an option or a file names
/// it.
#[test]
fn a_retired_guard_is_refused_with_its_replacement() {
    let directory = tempfile::tempdir().unwrap();
    let told = |arguments: &[&str], words: &[&str]| {
        let output = qube_hil(directory.path(), arguments);
        let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {stderr}");
        for word in words {
            assert!(stderr.contains(word), "{arguments:?}: {word:?} is missing in: {stderr}");
        }
    };
    for command in [&["run", "--policy", "classical"][..], &["session"], &["experiment"]] {
        let arguments = [command, &["--guard", "envelope"]].concat();
        told(&arguments, &["--guard", "it is only for replays of old recordings; use foresight"]);
    }
    for command in ["train", "experiment"] {
        told(&[command, "--preset", "machine"], &["--preset", "use robust instead"]);
    }

    let write = |name: &str, text: &str| std::fs::write(directory.path().join(name), text).unwrap();
    let begin = ["session", "--config", "my.toml", "--out", "begun"];
    let envelope = "guard = \"envelope\"";
    for (text, words) in [
        (format!("[safety_box]\n{envelope}\n"), ["safety_box.guard", "give guard = \"foresight\""]),
        (
            format!("[training.simulation.safety_box]\n{envelope}\n"),
            ["training.simulation.safety_box.guard", "leave it out"],
        ),
        ("[training]\nwidening = 0.4\n".into(), ["training.widening", "leave it out"]),
        (
            "[training.simulation]\nenvelope_room_rad = 0.0\n".into(),
            ["training.simulation.envelope_room_rad", "leave it out"],
        ),
    ] {
        write("my.toml", &text);
        refused(directory.path(), &begin, &["my.toml", words[0], words[1]]);
        let (head, tail) =
            ("name = \"mine\"\nmodel = \"nominal\"\n", text.replace('[', "[settings."));
        write("mine.toml", &format!("{head}{tail}"));
        let begin = ["experiment", "--recipe", "mine.toml", "--out", "begun"];
        refused(directory.path(), &begin, &["mine.toml", words[0], words[1]]);
    }
    assert!(!directory.path().join("begun").exists());

    // The files of a session and of an experiment with these keys.
    let root = directory.path().join("session");
    let whole = SessionSettings::quick().to_toml().unwrap();
    drop(SessionFolder::create(&root, &whole).unwrap());
    let of_the_past = |whole: &str, guard: &str, widening: f64| {
        let text = whole.replace("guard = \"foresight\"", &format!("guard = \"{guard}\""));
        let text = text
            .replace("evaluation_starts", &format!("widening = {widening:?}\nevaluation_starts"));
        text.replace("history =", "envelope_room_rad = 0.0\nhistory =")
    };
    let resume = ["session", "--resume", "session"];
    for (guard, widening, words) in [
        ("envelope", 0.0, ["safety_box.guard", "begin a new one"]),
        ("box", 0.6, ["training.widening = 0.6", "begin a new one"]),
    ] {
        write("session/session.toml", &of_the_past(&whole, guard, widening));
        refused(directory.path(), &resume, &["session.toml", words[0], words[1]]);
        // A report only shows the session.
        let report = qube_hil(directory.path(), &["report", "session"]);
        assert!(report.status.success(), "{}", String::from_utf8_lossy(&report.stderr));
    }
    let settings = of_the_past(&whole, "box", 0.0);
    write("session/session.toml", &settings);
    let settings = SessionSettings::load_to_resume(&root.join("session.toml")).unwrap();
    assert_eq!(settings, SessionSettings::quick().with_guard(Guard::Box));

    let recipe = Recipe::of(Model::Nominal, &SessionSettings::quick());
    let lab = Plant { name: "lab".into(), emulated: EmulatedQubeSettings::default(), vary: 0.0 };
    let ended = ExperimentSettings {
        name: "ended".into(),
        seed: 0,
        policies: 1,
        rollouts: 1,
        simulated_starts: 1000,
        guard_profile: None,
        plants: vec![lab],
        recipes: vec![recipe],
        methods: None,
    };
    let whole = ended.to_toml().unwrap();
    drop(ExperimentFolder::create(&directory.path().join("ended"), &whole).unwrap());
    let resume = ["experiment", "--resume", "ended"];
    for (guard, widening, word) in
        [("envelope", 0.0, "safety_box.guard"), ("box", 0.6, "training.widening = 0.6")]
    {
        write("ended/experiment.toml", &of_the_past(&whole, guard, widening));
        refused(directory.path(), &resume, &["experiment.toml", word, "--table"]);
        let table = qube_hil(directory.path(), &[&resume[..], &["--table"]].concat());
        assert!(table.status.success(), "{}", String::from_utf8_lossy(&table.stderr));
    }
}

#[test]
fn an_experiment_widens_nothing() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("mine.toml");
    let begin = ["experiment", "--recipe", "mine.toml", "--out", "experiment"];
    let recipe = |text: &str, device: &[&str], words: &[&str]| {
        let head = "name = \"mine\"\nmodel = \"nominal\"\n[settings.safety_box]\n";
        std::fs::write(&path, format!("{head}{text}\n")).unwrap();
        refused(directory.path(), &[&begin, device].concat(), words);
        assert!(!directory.path().join("experiment").exists(), "an experiment was begun");
    };
    for device in [&[][..], &PORT] {
        for value in ["9.0", "nan", "-1.0"] {
            recipe(&format!("theta = {value}"), device, &["mine.toml", "safety_box.theta"]);
        }
    }
    recipe("guard = \"box\"", &PORT, &["mine", "guard", "--accept-hard-stop"]);

    // The file with which an experiment is resumed widens nothing either.
    let small =
        ["--models", "nominal", "--policies", "1", "--rollouts", "1", "--out", "experiment"];
    let guarded = ["experiment", "--guard", "foresight"];
    let begun = qube_hil(directory.path(), &[&guarded[..], &small].concat());
    let toml = directory.path().join("experiment/experiment.toml");
    assert!(toml.exists(), "{}", String::from_utf8_lossy(&begun.stderr));
    let sealed = std::fs::read_to_string(&toml).unwrap();
    // A file without a checksum is accepted, so the test can change it.
    let (whole, _) = sealed.split_once("# checksum").unwrap();
    let resume = ["experiment", "--resume", "experiment"];
    let other = [&resume, &PORT[..]].concat();
    refused(directory.path(), &other, &["began on emulated Qubes"]);
    let emulated = "[[plants]]\nname = \"ideal\"";
    assert!(whole.contains(emulated), "{whole}");
    let whole = whole.replace(emulated, "[[plants]]\nname = \"device\"");
    std::fs::write(&toml, &whole).unwrap();
    refused(directory.path(), &resume, &["began on a real Qube", "--device"]);
    let wide = whole.replacen("theta_rad = 2.3", "theta_rad = 9.0", 1);
    assert_ne!(wide, whole);
    std::fs::write(&toml, wide).unwrap();
    refused(directory.path(), &[&resume, &PORT[..]].concat(), &["nominal", "safety_box.theta"]);
    std::fs::write(&toml, whole.replace("guard = \"foresight\"", "guard = \"box\"")).unwrap();
    let named = ["nominal", "guard", "--accept-hard-stop"];
    refused(directory.path(), &[&resume, &PORT[..]].concat(), &named);
}

#[test]
fn a_rigs_own_file_widens_nothing() {
    let directory = tempfile::tempdir().unwrap();
    for (key, widest) in [
        ("theta_rad", SafetyBox::THESIS.theta),
        ("alpha_rad", SafetyBox::THESIS.alpha),
        ("theta_dot_rad_s", SafetyBox::THESIS.theta_dot),
        ("alpha_dot_rad_s", SafetyBox::THESIS.alpha_dot),
    ] {
        let wider = [format!("{}", 1.001 * widest), "500".to_owned()];
        let no_limits = NO_LIMITS.map(str::to_owned).into_iter().filter(|value| {
            // Some of these numbers are within some of the limits.
            !value.parse::<f64>().is_ok_and(|value| value > 0.0 && value <= widest)
        });
        for value in no_limits.chain(wider) {
            let text = format!("port = \"/dev/ttyNOWHERE\"\n[limits]\n{key} = {value}\n");
            std::fs::write(directory.path().join("qube.toml"), text).unwrap();
            let run = ["run", "--policy", "classical", "--qube", "qube.toml"];
            refused(directory.path(), &run, &["qube.toml", "line 3", &format!("at most {widest}")]);
        }
    }
    // A rig's own file has no key for a guard.
    std::fs::write(directory.path().join("qube.toml"), "[limits]\nguard = \"box\"\n").unwrap();
    let run = ["run", "--policy", "classical", "--qube", "qube.toml"];
    refused(directory.path(), &run, &["qube.toml", "guard"]);
}

#[test]
fn a_soak_runs_under_foresight() {
    let directory = tempfile::tempdir().unwrap();
    let soak = ["soak", "--clock", "virtual", "--hours", "0.001", "--keep", "kept"];
    let output = qube_hil(directory.path(), &soak);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let recording = read(&directory.path().join("kept/rollout-0.mcap")).unwrap();
    // The measured stops may lie one count inside a Qube's nominal ones.
    let SafetyBox { theta, .. } = recording.header.settings.safety_box;
    assert!(
        theta <= SafetyBox::GUARDED.theta && theta > SafetyBox::GUARDED.theta - 0.01,
        "{theta}"
    );
    let guarded = SafetyBox { theta, ..SafetyBox::GUARDED };
    assert_eq!(recording.header.settings.safety_box, guarded);
    assert!(!recording.header.hard_stop_accepted);
}
