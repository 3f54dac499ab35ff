//! Tests the commands `replay` and `recover`: exit codes, JSON, and clear messages.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Output;

use qube_hil::device::emulator::EmulatorSettings;
use qube_hil::policy::{ClassicalController, ClassicalGains, Policy};
use qube_hil::qube::Profile;
use qube_hil::recording::RolloutWriter;
use qube_hil::replay::rerun;
use qube_hil::rig::{Rig, RigSettings, RolloutPlan};
use qube_hil::safety::{Guard, Limit};
use qube_hil::storage::MachineDisk;
use qube_hil::telemetry::{Ending, Fault, Phase};
use serde_json::Value;

use crate::folders::files_of;
use crate::program;

/// Runs the program in an empty folder.
fn qube_hil(arguments: &[&str]) -> Output {
    let directory = tempfile::tempdir().unwrap();
    program::qube_hil(directory.path(), arguments)
}

/// Records a whole rollout of the classical controller in virtual time under the guard `box`;
/// returns the path of the recording.
fn recorded(folder: &Path) -> PathBuf {
    recorded_under("box", folder)
}

fn recorded_under(guard: &str, folder: &Path) -> PathBuf {
    let folder = folder.to_str().unwrap();
    let run = ["run", "--policy", "classical", "--clock", "virtual", "--guard", guard, "--out"];
    let run = qube_hil(&[&run[..], &[folder]].concat());
    assert!(run.status.success(), "{run:?}");
    Path::new(folder).join("rollout-0.mcap")
}

fn stderr(output: &Output) -> String {
    String::from_utf8(output.stderr.clone()).unwrap()
}

fn json(output: &Output) -> Value {
    let stdout = String::from_utf8(output.stdout.clone()).unwrap();
    serde_json::from_str(stdout.lines().last().unwrap()).unwrap()
}

#[test]
fn a_rollout_comes_out_again_bit_for_bit() {
    let folder = tempfile::tempdir().unwrap();
    let path = recorded(folder.path());
    let path = path.to_str().unwrap();
    let output = qube_hil(&["replay", "--json", path]);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let recording = &json(&output)["recordings"][0];
    assert_eq!(recording["path"], path);
    assert_eq!(recording["return_recorded"], recording["return_recomputed"]);
    assert!(recording["return_recorded"].as_f64().unwrap() > 300.0, "{recording}");
    assert!(recording["actions_compared"].as_u64().unwrap() > 600);
    assert_eq!(recording["actions_different"], 0);

    assert!(recording.get("note").is_none(), "{recording}");

    // The same holds under foresight, whose settings are in the recording.
    let foreseen = recorded_under("foresight", &folder.path().join("foreseen"));
    let header = qube_hil::recording::read(&foreseen).unwrap().header;
    assert!(header.settings.foresight.is_some());
    let output = qube_hil(&["replay", "--json", foreseen.to_str().unwrap()]);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let recording = &json(&output)["recordings"][0];
    assert_eq!(recording["actions_different"], 0, "{recording}");

    let plots = folder.path().join("plots");
    let output =
        qube_hil(&["replay", "--simulate", "--plot", plots.to_str().unwrap(), "--json", path]);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    assert!(json(&output)["recordings"][0]["rmse"]["theta_rad"].is_number());
    assert!(fs::read_to_string(plots.join("rollout-0.svg")).unwrap().starts_with("<svg"));
    // The option --profile implies --simulate.
    let output = qube_hil(&["replay", "--profile", "lab", "--json", path]);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    assert!(json(&output)["recordings"][0]["rmse"]["theta_rad"].is_number());
}

#[test]
fn a_rollout_that_foresight_ended_says_for_which_qube() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().to_str().unwrap();
    // The guard of an unidentified Qube ends almost every swing-up.
    let run =
        ["run", "--policy", "classical", "--clock", "virtual", "--unidentified", "--out", out];
    let run = qube_hil(&run);
    assert!(run.status.success(), "{run:?}");
    let path = folder.path().join("rollout-0.mcap");
    let mut recording = qube_hil::recording::read(&path).unwrap();
    let outcome = recording.outcome.as_ref().unwrap();
    assert_eq!(outcome.ending, Ending::LeftBox(Limit::Foresight));
    let foreseen = outcome.foreseen.unwrap();
    assert!(!foreseen.identified);
    assert!(foreseen.particle < 64, "{foreseen:?}");
    assert!(foreseen.beyond_rad.unwrap() >= 0.0, "{foreseen:?}");
    let output = qube_hil(&["replay", "--json", path.to_str().unwrap()]);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    assert_eq!(json(&output)["recordings"][0]["foreseen"]["particle"], foreseen.particle);
    let output = qube_hil(&["replay", path.to_str().unwrap()]);
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(text.contains(&format!("the arm of particle {}", foreseen.particle)), "{text}");

    // With a wider margin the recomputed rollout does not end by the same prediction.
    let known = recording.header.settings.foresight.as_mut().unwrap();
    known.margin_rad = 0.2;
    let policy = Policy::from_bytes(&recording.policy).unwrap();
    assert_ne!(rerun(&recording, policy).foreseen, Some(foreseen));
}

#[test]
fn a_void_rollout_is_said_to_have_no_result() {
    let folder = tempfile::tempdir().unwrap();
    let fault = Some("unplug@18".parse().unwrap());
    let emulator = EmulatorSettings { fault, seed: 11, ..EmulatorSettings::default() };
    let rig = Rig::open(&RigSettings::emulated(emulator), &Default::default()).unwrap();
    let controller = Policy::Classical(ClassicalController::new(ClassicalGains::default()));
    let path = folder.path().join("rollout.mcap");
    let header = RolloutPlan::single("test", "test").header();
    let made = rig.rollout(&MachineDisk, &path, header, &controller.to_bytes()).unwrap();
    assert_eq!(made.outcome.ending, Ending::Fault(Fault::LinkGone));

    let path = path.to_str().unwrap();
    let output = qube_hil(&["replay", "--json", path]);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let reason = json(&output)["recordings"][0]["void"].as_str().unwrap().to_owned();
    let text = String::from_utf8(qube_hil(&["replay", path]).stdout).unwrap();
    let sentence = format!("the rollout is void, its return does not count: {reason}");
    assert!(text.contains(&sentence), "{text}");
}

#[test]
fn a_rollout_that_contradicted_its_profile_says_how() {
    let folder = tempfile::tempdir().unwrap();
    let lab = Profile::lab();
    // The emulated Qube has a longer pendulum than the profile that it is said to have.
    let mut model = lab.model();
    model.parameters.pendulum_length_m *= 1.3;
    let emulator = EmulatorSettings { model, seed: 3, ..EmulatorSettings::default() };
    let settings = RigSettings { profile: Some(lab), ..RigSettings::emulated(emulator) };
    let rig = Rig::open(&settings, &Default::default()).unwrap();
    let controller = Policy::Classical(ClassicalController::new(ClassicalGains::default()));
    let path = folder.path().join("rollout.mcap");
    let header = RolloutPlan::single("test", "test").header();
    let made = rig.rollout(&MachineDisk, &path, header, &controller.to_bytes()).unwrap();
    let contradiction = made.outcome.contradiction.expect("the pendulum is longer");

    let output = qube_hil(&["replay", "--json", path.to_str().unwrap()]);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let told = &json(&output)["recordings"][0]["contradiction"];
    assert_eq!(told["periods"], contradiction.periods);
    assert!(["theta", "alpha"].contains(&told["angle"].as_str().unwrap()), "{told}");
    assert!(told["beyond_rad"].as_f64().unwrap() > 0.025, "{told}");
    let output = qube_hil(&["replay", path.to_str().unwrap()]);
    let text = String::from_utf8(output.stdout).unwrap();
    let sentence = format!("the guard ended the policy: {contradiction}");
    assert!(text.contains(&sentence), "{text}");

    // The outcome of this file names another contradiction than its ticks show.
    let whole = qube_hil::recording::read(&path).unwrap();
    let altered = folder.path().join("altered.mcap");
    let mut writer =
        RolloutWriter::create(&MachineDisk, &altered, whole.header, &whole.policy).unwrap();
    for tick in &whole.ticks {
        writer.write(tick).unwrap();
    }
    let mut outcome = whole.outcome.unwrap();
    outcome.contradiction.as_mut().unwrap().periods += 1;
    writer.finish(&outcome).unwrap();
    let output = qube_hil(&["replay", altered.to_str().unwrap()]);
    assert_eq!(output.status.code(), Some(3), "{}", stderr(&output));
    assert!(stderr(&output).contains("recorded contradiction"), "{}", stderr(&output));
}

/// Replays a recording of an older program, whose guard was the speed envelope and whose policy
/// left it. To keep the file small, its blocks are merged into one and its index is left out; every
/// message is as that program wrote it.
#[test]
fn a_rollout_under_a_retired_guard_is_compared_until_it_brakes() {
    let fixture =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/left_the_speed_envelope.mcap");
    let recording = qube_hil::recording::read(&fixture).unwrap();
    let left = Ending::LeftBox(Limit::Envelope);
    assert_eq!(recording.header.settings.safety_box.guard, Guard::Envelope);
    assert_eq!(recording.outcome.as_ref().map(|outcome| outcome.ending), Some(left));
    let braking = recording.ticks.iter().position(|tick| tick.phase == Phase::Braking).unwrap();

    let policy = || Policy::from_bytes(&recording.policy).unwrap();
    let again = rerun(&recording, policy());
    assert!(again.agrees() && again.ending_of_the_file, "{again:?}");
    assert_eq!((again.actions_compared, again.ending), (braking, Some(left)));
    // A changed action before the braking is found.
    let mut changed = recording.clone();
    changed.ticks[braking - 1].voltage_mv += 1;
    assert_eq!(rerun(&changed, policy()).actions_different, 1);

    let path = fixture.to_str().unwrap();
    let output = qube_hil(&["replay", path]);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let told = String::from_utf8(output.stdout).unwrap();
    let sentence = "compared up to its first braking tick, and its end is taken from the file";
    assert_eq!(told.matches(sentence).count(), 1, "{told}");
    assert!(told.contains(&format!("{braking} of {braking} actions")), "{told}");
    let output = qube_hil(&["replay", "--json", path]);
    let recording = &json(&output)["recordings"][0];
    assert!(recording["note"].as_str().unwrap().contains(sentence), "{recording}");
    assert_eq!((&recording["problem"], &recording["actions_different"]), (&Value::Null, &0.into()));
}

#[test]
fn a_changed_byte_is_bad_input_and_a_cut_off_file_is_lost_data() {
    let folder = tempfile::tempdir().unwrap();
    let path = recorded(folder.path());
    let whole = fs::read(&path).unwrap();
    let file = |name: &str, bytes: &[u8]| {
        let path = folder.path().join(name);
        fs::write(&path, bytes).unwrap();
        path.to_str().unwrap().to_owned()
    };
    let mut bytes = whole.clone();
    bytes[whole.len() / 3] ^= 4;
    let changed = file("changed.mcap", &bytes);
    let output = qube_hil(&["replay", &changed]);
    assert_eq!(output.status.code(), Some(2));
    assert!(stderr(&output).contains("changed or damaged"), "{}", stderr(&output));

    let cut = file("cut.mcap", &whole[..whole.len() / 2]);
    let output = qube_hil(&["replay", "--json", &cut]);
    assert_eq!(output.status.code(), Some(3));
    assert!(stderr(&output).contains("qube-hil recover"), "{}", stderr(&output));
    assert_eq!(json(&output)["recordings"][0]["actions_different"], 0);

    let output = qube_hil(&["recover", "--json", &cut]);
    assert_eq!(output.status.code(), Some(3));
    let saved = json(&output);
    assert!(saved["ticks"].as_u64().unwrap() > 100, "{saved}");
    let output = qube_hil(&["replay", "--json", saved["recovered"].as_str().unwrap()]);
    assert_eq!(json(&output)["recordings"][0]["actions_compared"], saved["ticks"]);
    // The commands `report` and `export` say that a part of the recording is missing.
    let saved = saved["recovered"].as_str().unwrap();
    for file in [&cut[..], saved] {
        let exports = folder.path().join("exports");
        let exports = exports.to_str().unwrap();
        for command in [
            &["report", "--force", "--out", "page.html"][..],
            &["export", "--force", "--out", exports],
        ] {
            let mut command = command.to_vec();
            let page = folder.path().join("page.html");
            command
                .iter_mut()
                .filter(|it| **it == "page.html")
                .for_each(|it| *it = page.to_str().unwrap());
            command.push(file);
            let output = qube_hil(&command);
            assert_eq!(output.status.code(), Some(3), "{command:?}: {}", stderr(&output));
            assert!(stderr(&output).contains("the recording "), "{}", stderr(&output));
        }
    }
    let output = qube_hil(&["recover", saved]);
    assert_eq!(output.status.code(), Some(3), "{}", stderr(&output));

    // A recording whose policy is damaged keeps its ticks, which can still be simulated.
    let policy = qube_hil::recording::read(&path).unwrap().policy;
    let place = whole.windows(policy.len()).position(|bytes| bytes == policy).unwrap();
    let mut bytes = whole.clone();
    bytes[place + 8] ^= 4;
    let output = qube_hil(&["recover", "--json", &file("policy.mcap", &bytes)]);
    assert_eq!(output.status.code(), Some(3));
    assert!(stderr(&output).contains("its policy is lost"), "{}", stderr(&output));
    let told = json(&output);
    assert_eq!(told["has_policy"], false);
    let saved = told["recovered"].as_str().unwrap();
    for (more, simulates) in [(&[][..], false), (&["--simulate"], true)] {
        let output = qube_hil(&[&["replay", "--json", saved], more].concat());
        assert_eq!(output.status.code(), Some(3));
        assert!(stderr(&output).contains("its policy was lost"), "{}", stderr(&output));
        assert_eq!(!json(&output)["rmse"].is_null(), simulates, "{}", json(&output));
    }

    let before = files_of(folder.path());
    let output = qube_hil(&["recover", path.to_str().unwrap()]);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let again = qube_hil(&["recover", &cut]);
    assert_eq!(again.status.code(), Some(2));
    let told = stderr(&again);
    assert!(told.contains("exists already") && told.contains("--out"), "{told}");
    assert!(files_of(folder.path()) == before, "a whole or a saved file was changed");
}

#[test]
fn the_replay_of_a_recovered_recording_reports_missing_last_ticks_and_no_other_ending() {
    let folder = tempfile::tempdir().unwrap();
    let whole = fs::read(recorded(folder.path())).unwrap();
    let mut are_missing = 0;
    // Some of these bytes lie in the last block of ticks, before the end of the recording.
    let last_tenth = whole.len() / 10 * 9..whole.len();
    for (number, place) in last_tenth.step_by(whole.len() / 500).enumerate() {
        let mut bytes = whole.clone();
        bytes[place] ^= 4;
        let name = |state: &str| folder.path().join(format!("{state}-{number}.mcap"));
        let (damaged, saved) = (name("damaged"), name("saved"));
        fs::write(&damaged, &bytes).unwrap();
        let [damaged, saved] = [&damaged, &saved].map(|path| path.to_str().unwrap());
        qube_hil(&["recover", damaged, "--out", saved]);
        let told = stderr(&qube_hil(&["replay", saved]));
        assert!(!told.contains("recomputed"), "byte {place}: {told}");
        are_missing += usize::from(told.contains("its last ticks are missing"));
    }
    assert!(are_missing > 0);
}

#[test]
fn a_recording_with_a_long_gap_is_not_simulated_and_its_missing_ticks_are_told_too() {
    let folder = tempfile::tempdir().unwrap();
    let whole = qube_hil::recording::read(&recorded(folder.path())).unwrap();
    let path = folder.path().join("gap.mcap");
    let mut writer =
        RolloutWriter::create(&MachineDisk, &path, whole.header, &whole.policy).unwrap();
    for tick in whole.ticks.iter().filter(|tick| !(400..550).contains(&tick.tick)) {
        writer.write(tick).unwrap();
    }
    writer.finish(&whole.outcome.unwrap()).unwrap();
    let output = qube_hil(&["replay", "--simulate", path.to_str().unwrap()]);
    assert_eq!(output.status.code(), Some(3), "{}", stderr(&output));
    for words in ["ticks are missing", "no sample for 1.5 s", "cannot be simulated"] {
        assert!(stderr(&output).contains(words), "{words:?} is missing in: {}", stderr(&output));
    }
}

#[test]
fn bad_input_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let table = folder.path().join("table.csv");
    fs::write(&table, "time_s,theta_rad\n0,0\n").unwrap();
    let table = table.to_str().unwrap();
    let misspelt = folder.path().join("profile.toml");
    fs::write(&misspelt, "name = \"x\"\n[parameters]\nM_q = 0.03\n").unwrap();
    let misspelt = misspelt.to_str().unwrap();
    for (arguments, expected) in [
        (vec!["replay", table], "add --simulate"),
        (vec!["replay", "--simulate", table], "the column `alpha_rad` is missing"),
        (vec!["replay", misspelt], "not an MCAP file"),
        (vec!["replay", "nowhere.mcap"], "nowhere.mcap"),
        (vec!["replay", "--simulate", "--profile", misspelt, table], "there is no parameter M_q"),
        (vec!["recover", "nowhere.mcap"], "nowhere.mcap"),
    ] {
        let output = qube_hil(&arguments);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}");
        assert!(stderr(&output).contains(expected), "{arguments:?}: {}", stderr(&output));
    }
}
