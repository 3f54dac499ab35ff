//! Tests an experiment that makes all its rollouts on one Qube, as an experiment on a real Qube
//! does.

use std::path::Path;
use std::sync::{Arc, Mutex};

use qube_hil::clock::{Nanoseconds, VirtualClock};
use qube_hil::control::HomingMethod;
use qube_hil::experiment::{
    Experiment, ExperimentError, ExperimentEvent, ExperimentFolder, ExperimentSettings, Plant,
    Recipe,
};
use qube_hil::rig::{ClockChoice, DeviceChoice, RigSettings};
use qube_hil::session::{EmulatedQubeSettings, SessionError, SessionSettings};
use qube_hil::simulation::Model;
use qube_hil::telemetry::Fault;

use crate::watched_disarm::Timed;

/// Runs an experiment with a recipe for each model, on a Qube that confirms no disarm from
/// `off_unconfirmed_from_ns` on. Returns the recipe of each policy that ran, in order, and the
/// result of the experiment.
fn ran(
    root: &Path,
    models: &[Model],
    policies: u32,
    off_unconfirmed_from_ns: Nanoseconds,
) -> (Vec<String>, Result<(), ExperimentError>) {
    let mut session = SessionSettings::thesis();
    (session.training.updates, session.training.num_envs, session.training.epochs) = (1, 16, 1);
    session.extent.steps = 500;
    session.homing.method = HomingMethod::Hand;
    let settings = ExperimentSettings {
        name: "turns".into(),
        seed: 1,
        policies,
        rollouts: 1,
        simulated_starts: 1,
        guard_profile: None,
        plants: vec![Plant {
            name: "ideal".into(),
            emulated: EmulatedQubeSettings::default(),
            vary: 0.0,
        }],
        recipes: models.iter().map(|&it| Recipe::of(it, &session)).collect(),
        methods: None,
    };
    let clock = VirtualClock::default();
    let device = Timed { clock, off_unconfirmed_from_ns, awaited: None, stalls: Arc::default() };
    let rig = RigSettings {
        clock: ClockChoice::Wall,
        ..RigSettings::in_virtual_time(DeviceChoice::Other(Arc::new(device)))
    };
    let folder = ExperimentFolder::create(root, &settings.to_toml().unwrap()).unwrap();
    let experiment = Experiment::new(folder, settings, rig, 1, Arc::default());
    let recipes = Mutex::new(Vec::new());
    let ended = experiment.run(&|event| {
        if let ExperimentEvent::Ran { recipe, .. } = event {
            recipes.lock().unwrap().push(recipe.to_owned());
        }
    });
    (recipes.into_inner().unwrap(), ended)
}

#[test]
fn the_recipes_take_turns_and_each_round_begins_with_another() {
    let directory = tempfile::tempdir().unwrap();
    let (recipes, ended) = ran(
        &directory.path().join("e"),
        &[Model::Nominal, Model::Handcrafted],
        3,
        Nanoseconds::MAX,
    );
    ended.unwrap();
    let (one, other) = ("nominal", "handcrafted");
    assert_eq!(recipes, [one, other, other, one, one, other]);
}

#[test]
fn a_motor_that_nobody_confirmed_to_be_off_after_the_only_rollout_is_told() {
    let directory = tempfile::tempdir().unwrap();
    let (_, ended) = ran(&directory.path().join("e"), &[Model::Nominal], 1, 4_000_000_000);
    let Err(ExperimentError::Session(SessionError::Rig(error))) = ended else {
        panic!("{ended:?}");
    };
    assert_eq!(error.fault(), Some(Fault::OffUnconfirmed), "{error}");
}
