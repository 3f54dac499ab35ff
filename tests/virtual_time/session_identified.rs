//! Tests sessions that first identify their Qube and then search around the identified profile.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};

use qube_hil::clock::{Clock, Nanoseconds, VirtualClock};
use qube_hil::device::emulator::{Effects, EmulatorSettings};
use qube_hil::device::{DeviceError, SerialLink};
use qube_hil::policy::{ExcitationShape, Policy};
use qube_hil::qube::{Profile, QubeModel};
use qube_hil::recording::{Recording, read};
use qube_hil::rig::{Connect, DeviceChoice, RigSettings, TimedDevice};
use qube_hil::safety::Limit;
use qube_hil::session::{
    IdentificationSettings, Session, SessionError, SessionEvent, SessionFolder, SessionPaths,
    SessionSettings, SessionView,
};
use qube_hil::storage::MachineDisk;
use qube_hil::telemetry::Ending;
use serde_json::Value;

use crate::given_networks::{Given, robust};
use crate::program::{program, qube_hil};

/// Settings of a session whose trainings are too short to learn a swing-up.
const SMALL: &str = "seed = 5\n\
    [extent]\ninitial_candidates = 2\niterations = 0\nrollouts = 1\nverification_rollouts = 2\nbaseline = true\n\
    [training]\nupdates = 2\nnum_envs = 16\nepochs = 1\n";

fn session(directory: &Path, settings: &str, arguments: &[&str]) -> Value {
    std::fs::write(directory.join("small.toml"), settings).unwrap();
    let mut command = program(directory);
    command.args(["session", "--clock", "virtual", "--json"]);
    let output = command.args(arguments).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

fn list<'a>(told: &'a Value, key: &str) -> &'a [Value] {
    told[key].as_array().unwrap_or_else(|| panic!("{key}: {told}"))
}

#[test]
fn a_qube_is_identified_and_the_search_varies_the_errors_of_its_profile() {
    let directory = tempfile::tempdir().unwrap();
    let settings = format!("{SMALL}[identification]\ncandidates = 2\n");
    let arguments = ["--config", "small.toml", "--profile", "lab", "--out", "s"];
    let told = session(directory.path(), &settings, &arguments);

    let excitations = list(&told, "excitations");
    assert_eq!(excitations.len(), 1);
    let known = &told["identification"];
    assert!(known["verdict"].as_str().unwrap().starts_with("fits"), "{known}");
    let text = std::fs::read_to_string(directory.path().join("s/profile-1.toml")).unwrap();
    let profile = Profile::parse(&text).unwrap();
    let delay_s = profile.nonidealities.command_delay_s;
    assert!((0.008..0.014).contains(&delay_s), "{delay_s}");
    assert!(
        !profile.may_be_of_board("0123456789abcdef"),
        "the profile of an emulated board may be of a real one"
    );

    // The first candidate is trained at psi = 0, the Qube as it was identified, the second at
    // another psi.
    let candidates = list(&told, "candidates");
    let psi = |candidate: &Value| candidate["psi"].as_object().unwrap().clone();
    assert_eq!(candidates.len(), 2);
    assert!(psi(&candidates[0]).contains_key("log_width"), "{told}");
    assert!(psi(&candidates[0]).values().all(|value| value == 0.0), "{told}");
    assert!(psi(&candidates[1]).values().any(|value| value != 0.0), "{told}");
    // The Qube is identified from the excitation, again with the first candidate's recording before
    // the second candidate is proposed, and at the end with the second candidate's recording and
    // the two of the verification.
    assert_eq!(known["recordings"], 5);
    let profile = |number: u32| directory.path().join(format!("s/profile-{number}.toml")).exists();
    assert_eq!([1, 2, 3, 4, 5].map(profile), [true, true, false, false, true]);

    let [verified] = list(&told, "verified") else { panic!("{told}") };
    assert_eq!((&verified["purpose"], list(verified, "returns").len()), (&"incumbent".into(), 2));
    assert_eq!(list(&told, "baseline").len(), 1);
    assert!(told["expected_gain"].as_f64().unwrap() >= 0.0, "{told}");
    assert_eq!(told["real_rollouts"], 3);
    // A finished session is only read.
    let again = session(directory.path(), &settings, &["--resume", "s"]);
    assert_eq!(again["best"], told["best"]);
    // The guard follows the profile, so without it, or with another, the session does not go on.
    let path = directory.path().join("s/profile-1.toml");
    for (profile, defect) in [(Some(text + "# mine\n"), "was changed"), (None, "is missing")] {
        match profile {
            Some(text) => std::fs::write(&path, text).unwrap(),
            None => std::fs::remove_file(&path).unwrap(),
        }
        let resume = ["session", "--clock", "virtual", "--resume", "s"];
        let output = qube_hil(directory.path(), &resume);
        let told = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(3), "{told}");
        assert!(told.contains("profile-1.toml") && told.contains(defect), "{told}");
        assert!(told.contains("Restore it from a backup"), "{told}");
    }
}

#[test]
fn a_qube_that_cannot_be_identified_is_searched_as_an_unknown_one() {
    let directory = tempfile::tempdir().unwrap();
    // No Qube has an arm three times as heavy as the name plate says.
    let settings = format!("{SMALL}[identification]\ncandidates = 2\n");
    let arguments = ["--config", "small.toml", "--scale", "M_r=3", "--out", "s"];
    let told = session(directory.path(), &settings, &arguments);
    let refused = told["identification"]["refused"].as_str().unwrap_or_else(|| panic!("{told}"));
    assert!(refused.contains("M_r"), "{refused}");
    let candidates = list(&told, "candidates");
    assert_eq!(candidates.len(), 2);
    assert!(candidates[0]["psi"].get("mean_M_p").is_some(), "{told}");
    assert_eq!(told["expected_gain"], Value::Null);
}

/// The point of a session's second searched candidate.
fn second_point(folder: &Path) -> Vec<f64> {
    let view = SessionView::read(&MachineDisk, SessionPaths::new(folder)).unwrap();
    view.state().searched().nth(1).unwrap().point.clone()
}

/// The first two initial points of the search around a session's first profile.
fn initial_points(folder: &Path) -> Vec<Vec<f64>> {
    let settings = SessionSettings::load(&folder.join("session.toml")).unwrap();
    let text = std::fs::read_to_string(folder.join("profile-1.toml")).unwrap();
    let profile = Profile::parse(&text).unwrap();
    let plan = settings.identification.unwrap();
    let search = settings.around(&plan, &profile, &profile).search().unwrap();
    search.propose(&[], &[], 2).unwrap()
}

#[test]
fn where_the_fit_is_doubted_a_policy_for_an_unknown_qube_competes() {
    let directory = tempfile::tempdir().unwrap();
    // Policies of so small a training differ by luck alone, so the one for an unknown Qube wins
    // with some seeds.
    let kept = |effect: &[&str], seed: u32| {
        let settings = format!("{SMALL}[identification]\ncandidates = 2\n")
            .replace("seed = 5", &format!("seed = {seed}"));
        let out = format!("s{seed}{}", effect.len());
        let arguments =
            [&["--config", "small.toml", "--profile", "lab", "--out", &out], effect].concat();
        let told = session(directory.path(), &settings, &arguments);
        let folder = directory.path().join(out);
        let policy = folder.join("candidates/001/policy.safetensors");
        let Policy::Network(policy) = Policy::load(&policy).unwrap() else { panic!("a network") };
        // The search learns only from a policy that was trained at its own psi.
        let learnt = usize::from(policy.training.model != "robust");
        assert_eq!(second_point(&folder), initial_points(&folder)[learnt]);
        (list(&told["identification"], "doubts").len(), policy.training.model.clone())
    };
    let eccentric = ["--effect", "eccentricity_rad=0.03"];
    let mut doubted = Vec::new();
    let is_kept =
        |doubted: &[(usize, String)], name: &str| doubted.iter().any(|(_, model)| model == name);
    for seed in 2..=9 {
        doubted.push(kept(&eccentric, seed));
        if is_kept(&doubted, "robust") && is_kept(&doubted, "opt-profile") {
            break;
        }
    }
    assert!(doubted.iter().all(|(doubts, _)| *doubts > 0), "{doubted:?}");
    assert!(is_kept(&doubted, "robust") && is_kept(&doubted, "opt-profile"), "{doubted:?}");
    let sure = kept(&[], 1);
    assert_eq!(sure, (0, "opt-profile".to_owned()));
}

/// A computer that, in its first `stalling` connections, stalls for 25 ms every 0.2 s from 20 s on.
/// That is too often for a fit, and too brief for the watchdog.
#[derive(Debug)]
struct StallingComputer {
    connections: AtomicU32,
    stalling: u32,
}

#[derive(Debug)]
struct StallingClock {
    time: VirtualClock,
    stalls_next_ns: AtomicU64,
}

impl Clock for StallingClock {
    fn now_ns(&self) -> Nanoseconds {
        self.time.now_ns()
    }

    fn sleep_until(&self, deadline_ns: Nanoseconds) {
        self.time.sleep_until(deadline_ns);
        if self.now_ns() >= self.stalls_next_ns.load(Ordering::Relaxed) {
            self.time.advance(25_000_000);
            self.stalls_next_ns.store(self.now_ns() + 200_000_000, Ordering::Relaxed);
        }
    }

    fn passes_by_itself(&self) -> bool {
        self.time.passes_by_itself()
    }
}

impl Connect for StallingComputer {
    fn connect(&self, emulator: &EmulatorSettings) -> Result<TimedDevice, DeviceError> {
        let time = VirtualClock::default();
        let link = SerialLink::in_process(*emulator, time.clone());
        let stalls = self.connections.fetch_add(1, Ordering::Relaxed) < self.stalling;
        let first_ns = if stalls { 20_000_000_000 } else { u64::MAX };
        Ok((Box::new(link), Arc::new(StallingClock { time, stalls_next_ns: first_ns.into() })))
    }

    fn is_hardware(&self) -> bool {
        false
    }
}

#[test]
fn a_second_excitation_is_weaker_and_begins_in_the_other_direction() {
    let directory = tempfile::tempdir().unwrap();
    let settings = format!("{SMALL}[identification]\nexcitations = 2\ncandidates = 1\n");
    let arguments = ["--config", "small.toml", "--profile", "lab", "--out", "s"];
    let told = session(directory.path(), &settings, &arguments);
    assert_eq!(list(&told, "excitations").len(), 2);
    let excitation = |candidate: &str| {
        let path = format!("s/candidates/{candidate}/policy.safetensors");
        match Policy::load(&directory.path().join(path)).unwrap() {
            Policy::Excitation(excitation) => (excitation.shape(), excitation.limit_v()),
            other => panic!("{candidate}: {other:?}"),
        }
    };
    assert_eq!(excitation("000"), (ExcitationShape::Chirp, 1.5));
    // Slow motions, at small voltages, tell the dead zones.
    let (_, limit_v) = excitation("001");
    assert!((-1.2..-0.5).contains(&limit_v), "{limit_v}");
}

/// Runs a session whose computer stalls in its first `stalling` connections. Returns the numbers of
/// repeated excitations, first identifications and refused identifications, the number of
/// recordings that the first profile was fitted to, and the number of these first connections whose
/// recording was reported as left out.
fn excited_again(stalling: u32) -> [u32; 5] {
    let directory = tempfile::tempdir().unwrap();
    let mut settings = SessionSettings::quick();
    (settings.extent.initial_candidates, settings.extent.iterations) = (1, 0);
    (settings.extent.rollouts, settings.extent.verification_rollouts) = (1, 1);
    (settings.training.updates, settings.training.num_envs, settings.training.epochs) = (1, 16, 1);
    settings.identification =
        Some(IdentificationSettings { candidates: 1, ..IdentificationSettings::DEFAULT });
    let folder =
        SessionFolder::create(&directory.path().join("s"), &settings.to_toml().unwrap()).unwrap();
    let computer = StallingComputer { connections: AtomicU32::new(0), stalling };
    let lab = Profile::lab().model();
    let rig = RigSettings {
        emulator: EmulatorSettings { model: lab, ..EmulatorSettings::default() },
        homing: settings.homing,
        ..RigSettings::in_virtual_time(DeviceChoice::Other(Arc::new(computer)))
    };
    let mut told = [0; 5];
    let mut session =
        Session::open(folder, settings, rig, Arc::new(AtomicBool::new(false))).unwrap();
    let ran = session.run(&mut |event| match event {
        SessionEvent::ExcitationRepeated(_) => told[0] += 1,
        // A later identification includes the recordings of the verification.
        SessionEvent::Identified { recordings, .. } if told[1] == 0 => {
            (told[1], told[3]) = (1, recordings);
        }
        SessionEvent::NotIdentified(_) => told[2] += 1,
        SessionEvent::RecordingLeftOut { candidate, reason, .. } if candidate < stalling => {
            assert!(reason.contains("without a sample"), "{reason}");
            told[4] += 1;
        }
        _ => (),
    });
    ran.unwrap();
    told
}

#[test]
fn an_excitation_that_cannot_be_fitted_is_repeated() {
    assert_eq!(excited_again(0), [0, 1, 0, 1, 0]);
    // Two recordings cannot be fitted and do not count; each is reported once.
    assert_eq!(excited_again(2), [2, 1, 0, 1, 2]);
}

/// Runs a session on a Qube with large effects that the equations omit, so that its motion
/// contradicts its profile, up to the end of candidate 2; with `interrupted` the session is stopped
/// after the first rollout of a policy and resumed. Returns its ledger, and the recordings of
/// candidates 1 and 2.
fn contradicted(directory: &Path, interrupted: bool) -> (Vec<u8>, [Recording; 2]) {
    let mut settings = SessionSettings::quick();
    settings.extent.rollouts = 1;
    (settings.training.updates, settings.training.num_envs, settings.training.epochs) = (1, 16, 1);
    let plan = IdentificationSettings { trainings: 1, ..IdentificationSettings::DEFAULT };
    settings.identification = Some(plan);
    let effects = Effects {
        hysteresis_n_m: 0.002,
        presliding_rad: 0.1,
        eccentricity_rad: 0.03,
        ..Effects::NONE
    };
    let model = Profile::lab().model();
    let emulator =
        EmulatorSettings { model, play_rad: 0.07, effects, ..EmulatorSettings::default() };
    let root = directory.join(format!("{interrupted}"));
    drop(SessionFolder::create(&root, &settings.to_toml().unwrap()).unwrap());
    let stops_after = if interrupted { &[1, 2][..] } else { &[2] };
    for last in stops_after {
        let stop = Arc::new(AtomicBool::new(false));
        let rig = RigSettings { homing: settings.homing, ..RigSettings::emulated(emulator) };
        let folder = SessionFolder::open(&root).unwrap();
        let ran = Session::open(folder, settings.clone(), rig, Arc::clone(&stop))
            .unwrap()
            .trained_by(Arc::new(Given::new(vec![robust()])))
            .run(&mut |event| {
                if let SessionEvent::Rollout { candidate, .. } = event {
                    stop.store(candidate == *last, Ordering::Relaxed);
                }
            });
        assert!(matches!(ran, Err(SessionError::Stopped)), "{ran:?}");
    }
    let recording = |candidate| {
        read(&root.join(format!("candidates/00{candidate}/rollout-0-attempt-0.mcap"))).unwrap()
    };
    (std::fs::read(root.join("ledger.jsonl")).unwrap(), [1, 2].map(recording))
}

#[test]
fn a_qube_that_contradicts_its_profile_is_excited_again_and_guarded_as_unknown_until_then() {
    let directory = tempfile::tempdir().unwrap();
    let (ledger, [first, second]) = contradicted(directory.path(), false);
    let outcome = first.outcome.as_ref().unwrap();
    assert_eq!(outcome.ending, Ending::LeftBox(Limit::Unpredicted));
    // The rollout was too short for another fit.
    assert!(outcome.steps < 200, "{outcome:?}");
    assert!(matches!(Policy::from_bytes(&second.policy), Ok(Policy::Excitation(_))));
    let is_known =
        |recording: &Recording| recording.header.settings.foresight.unwrap().identified.is_some();
    assert_eq!([&first, &second].map(is_known), [true, false]);

    let (resumed, [_, second]) = contradicted(directory.path(), true);
    assert!(ledger == resumed);
    assert!(!is_known(&second), "the resumed session trusts the profile again");
}

/// A computer whose first connection drives one Qube, and whose others drive another.
#[derive(Debug)]
struct ExchangedQube {
    connections: AtomicU32,
    other: QubeModel,
}

impl Connect for ExchangedQube {
    fn connect(&self, emulator: &EmulatorSettings) -> Result<TimedDevice, DeviceError> {
        let time = VirtualClock::default();
        let mut emulator = *emulator;
        if self.connections.fetch_add(1, Ordering::Relaxed) > 0 {
            emulator.model = self.other;
        }
        Ok((Box::new(SerialLink::in_process(emulator, time.clone())), Arc::new(time)))
    }

    fn is_hardware(&self) -> bool {
        false
    }
}

#[test]
fn a_later_fit_that_fails_is_told_and_a_policy_for_an_unknown_qube_competes_from_then_on() {
    let directory = tempfile::tempdir().unwrap();
    let root = directory.path().join("s");
    let mut settings = SessionSettings::quick();
    // A rollout that contradicts the profile too early to be fitted is followed by one excitation.
    (settings.extent.rollouts, settings.extent.repetitions) = (1, 1);
    (settings.training.updates, settings.training.num_envs, settings.training.epochs) = (1, 16, 1);
    settings.identification =
        Some(IdentificationSettings { trainings: 1, ..IdentificationSettings::DEFAULT });
    drop(SessionFolder::create(&root, &settings.to_toml().unwrap()).unwrap());
    let model = Profile::lab().model();
    let mut other = model;
    other.parameters.rotary_mass_kg *= 3.0;
    // Resumed at the moment of the failed fit, the session neither repeats the fit nor enters it
    // into the ledger again.
    let (mut failed, mut trainings) = (Vec::new(), [0, 0]);
    for connections in [0, 1] {
        let stop = Arc::new(AtomicBool::new(false));
        let computer = ExchangedQube { connections: AtomicU32::new(connections), other };
        let rig = RigSettings {
            emulator: EmulatorSettings { model, ..EmulatorSettings::default() },
            homing: settings.homing,
            ..RigSettings::in_virtual_time(DeviceChoice::Other(Arc::new(computer)))
        };
        let folder = SessionFolder::open(&root).unwrap();
        let session = Session::open(folder, settings.clone(), rig, Arc::clone(&stop)).unwrap();
        let ran =
            session.trained_by(Arc::new(Given::new(vec![robust()]))).run(
                &mut |event| match event {
                    SessionEvent::RefitFailed { recordings, reason } => {
                        assert!(!reason.is_empty());
                        failed.push(recordings);
                        stop.store(true, Ordering::Relaxed);
                    }
                    SessionEvent::Training { training, .. } => {
                        let since_failed = usize::from(!failed.is_empty());
                        trainings[since_failed] = trainings[since_failed].max(training + 1);
                    }
                    SessionEvent::Trained { .. } => {
                        stop.store(!failed.is_empty(), Ordering::Relaxed);
                    }
                    _ => {}
                },
            );
        assert!(matches!(ran, Err(SessionError::Stopped)), "{ran:?}");
    }
    assert_eq!(failed.len(), 1, "{failed:?}");
    assert_eq!(trainings[0], 1, "the first fit is doubted");
    // A round has a training for psi and one for an unknown Qube.
    assert!(trainings[1] >= 2, "{trainings:?}");
    let view = SessionView::read(&MachineDisk, SessionPaths::new(&root)).unwrap();
    assert!(view.state().identification().is_questionable());
}

#[test]
fn a_method_that_does_not_fit_its_arguments_is_refused() {
    let directory = tempfile::tempdir().unwrap();
    for (arguments, words) in [
        (&["--method", "bayrn", "--candidates", "3"][..], "--candidates"),
        (&["--method", "posterior", "--candidates", "3"], "one candidate"),
        (&["--method", "identified", "--candidates", "0"], "--candidates"),
    ] {
        let session = [&["session", "--clock", "virtual", "--out", "s"], arguments].concat();
        let output = qube_hil(directory.path(), &session);
        let told = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(2), "{told}");
        assert!(told.contains(words), "{told}");
        assert!(!directory.path().join("s").exists());
    }
}
