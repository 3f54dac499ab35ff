//! Tests, in virtual time, the effect of a wrong profile: a Qube that moves otherwise than its
//! profile predicts is homed again, and guarded as an unknown one from the next rollout on.

use qube_hil::device::emulator::EmulatorSettings;
use qube_hil::policy::{ClassicalController, ClassicalGains, Policy};
use qube_hil::qube::{DomainParameter, Profile};
use qube_hil::recording::read;
use qube_hil::replay::{controller_of, rerun};
use qube_hil::rig::{Rig, RigError, RigSettings, RolloutPlan};
use qube_hil::safety::{Contradiction, Limit};
use qube_hil::storage::MachineDisk;
use qube_hil::telemetry::{Ending, Fault};

/// What one of several rollouts shows.
#[derive(Debug)]
struct Seen {
    /// Whether the rollout began only after another homing.
    homed_again: bool,
    /// Whether the guard still had the profile at its beginning.
    has_profile: bool,
    ending: Ending,
}

/// Three rollouts of a Qube that is `lab` with this factor on one parameter, under the profile
/// `lab`. Checks that a contradiction of the profile is recorded, and that a replay finds the same
/// one.
fn rollouts(parameter: DomainParameter, factor: f64) -> Vec<Seen> {
    let mut model = Profile::lab().model();
    model.parameters.set(parameter, factor * model.parameters.get(parameter));
    let emulator = EmulatorSettings { model, seed: 3, ..EmulatorSettings::default() };
    let settings = RigSettings { profile: Some(Profile::lab()), ..RigSettings::emulated(emulator) };
    let mut rig = Rig::open(&settings, &Default::default()).unwrap();
    let controller = ClassicalController::new(ClassicalGains::default());
    let policy = Policy::Classical(controller).to_bytes();
    let folder = tempfile::tempdir().unwrap();
    let rollout = |number: u32| {
        let path = folder.path().join(format!("{number}.mcap"));
        let header = RolloutPlan::single("test", "test").header();
        let run = |rig: &Rig| rig.rollout(&MachineDisk, &path, header.clone(), &policy);
        let mut ran = run(&rig);
        let homed_again = matches!(ran, Err(RigError::NotBegun { fault: Fault::CountsMoved, .. }));
        if homed_again {
            rig.start_again().unwrap();
            ran = run(&rig);
        }
        let outcome = ran.unwrap().outcome;
        let recording = read(&path).unwrap();
        let rerun = rerun(&recording, controller_of(&recording).unwrap());
        assert_eq!(rerun.contradiction, outcome.contradiction);
        let is_unpredicted = outcome.ending == Ending::LeftBox(Limit::Unpredicted);
        assert_eq!(outcome.contradiction.is_some(), is_unpredicted, "{outcome:?}");
        let is_far = |it: Contradiction| it.beyond_rad.is_some_and(|beyond| beyond >= 0.025);
        assert!(outcome.contradiction.is_none_or(is_far), "{outcome:?}");
        assert_eq!(recording.outcome.as_ref().unwrap().contradiction, outcome.contradiction);
        let foresight = recording.header.settings.foresight.unwrap();
        let has_profile = foresight.identified.is_some();
        Seen { homed_again, has_profile, ending: outcome.ending }
    };
    (0..3).map(rollout).collect()
}

#[test]
fn a_qube_that_moves_unlike_its_profile_is_homed_again_and_guarded_as_an_unknown_one() {
    let unpredicted = Ending::LeftBox(Limit::Unpredicted);
    for (parameter, factor, ends_the_trust) in [
        (DomainParameter::PendulumLength, 1.0, false),
        (DomainParameter::PendulumLength, 1.3, true),
        (DomainParameter::RotaryMass, 2.0, true),
    ] {
        let rollouts = rollouts(parameter, factor);
        let because = format!("{parameter:?} times {factor}: {rollouts:?}");
        let first = rollouts.iter().position(|it| it.ending == unpredicted);
        assert_eq!(first.is_some(), ends_the_trust, "{because}");
        for (number, seen) in rollouts.iter().enumerate() {
            assert_eq!(seen.has_profile, first.is_none_or(|first| number <= first), "{because}");
            assert_eq!(
                seen.homed_again,
                first.is_some_and(|first| number == first + 1),
                "{because}"
            );
        }
    }
}
