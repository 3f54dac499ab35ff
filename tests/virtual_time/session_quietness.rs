//! Tests that a session goes on searching after a policy that balances but buzzes: the mean change
//! of its voltage a tick, or the number of its sign changes a second, is above the limit of
//! `Quietness::is_loud`.

use std::sync::Arc;

use qube_hil::device::emulator::EmulatorSettings;
use qube_hil::policy::Network;
use qube_hil::qube::Profile;
use qube_hil::rig::RigSettings;
use qube_hil::session::{
    IdentificationSettings, Session, SessionEvent, SessionFolder, SessionReport, SessionSettings,
};

use crate::given_networks::{Given, robust};

/// The policy `robust` with its last layer multiplied by 2.5, so that it buzzes.
fn buzzing() -> Network {
    let robust = robust();
    let mut layers = robust.layers();
    let last = layers.last_mut().unwrap();
    last.weight.iter_mut().chain(&mut last.bias).for_each(|value| *value *= 2.5);
    Network::new(robust.sizes(), &layers, robust.action_scale_v()).unwrap()
}

#[test]
fn the_search_goes_on_after_a_verified_policy_that_buzzes_and_a_quiet_one_is_best() {
    let directory = tempfile::tempdir().unwrap();
    let mut settings = SessionSettings::quick();
    (settings.extent.rollouts, settings.extent.verification_rollouts) = (1, 2);
    settings.extent.baseline = false;
    (settings.training.updates, settings.training.num_envs, settings.training.epochs) = (1, 16, 1);
    settings.identification = Some(IdentificationSettings {
        candidates: 3,
        trainings: 1,
        ..IdentificationSettings::DEFAULT
    });
    let folder =
        SessionFolder::create(&directory.path().join("s"), &settings.to_toml().unwrap()).unwrap();
    let emulator =
        EmulatorSettings { model: Profile::lab().model(), ..EmulatorSettings::default() };
    let rig = RigSettings { homing: settings.homing, ..RigSettings::emulated(emulator) };
    let given = Given::new(vec![buzzing(), robust()]);
    let mut session =
        Session::open(folder, settings, rig, Arc::default()).unwrap().trained_by(Arc::new(given));
    let mut buzzed = 0;
    session
        .run(&mut |event| buzzed += u32::from(matches!(event, SessionEvent::TooLoud(_))))
        .unwrap();
    assert_eq!(buzzed, 1);
    let report = SessionReport::read(&mut session).unwrap();
    // The candidates in order: the excitation, the policy that buzzes, its verification, the quiet
    // policy, its verification.
    let [_, _, buzzing, _, quiet] = &report.candidates[..] else {
        panic!("{:?}", report.candidates)
    };
    for (scored, is_loud) in [(buzzing, true), (quiet, false)] {
        assert_eq!(scored.successes(), 2, "{scored:?}");
        assert_eq!(scored.quietness.is_loud(), is_loud, "{:?}", scored.quietness.figures());
    }
    assert_eq!(report.best.map(|best| best.candidate), Some(4));
}
