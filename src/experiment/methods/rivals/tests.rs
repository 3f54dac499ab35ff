//! Tests of rivals on a known simulated Qube: motions of Qubes from a rival's belief must resemble
//! the known Qube's motion more than motions of Qubes from the prior do.

use std::sync::atomic::AtomicBool;

use nalgebra::DVector;
use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;

use super::belief::RivalBelief;
use super::discrepancy::discrepancy;
use super::dropo::Dropo;
use super::rival::{Data, Rival, RivalInput};
use super::simulator::{Demonstration, SampledMotion, simulate};
use super::space::Space;
use super::{RivalKind, RivalSettings};
use crate::learning::TrainSettings;
use crate::policy::{EXCITATION_STEPS, Excitation, ExcitationShape, Network, Policy};
use crate::qube::{CONTROL_PERIOD_S, PlantModel, QubeModel, State};
use crate::replay::{MotionLog, MotionSample};
use crate::simulation::{LaneStatus, Pendulums, SimulationSettings, Trajectory};

/// A Qube that differs from the mean of the prior by 0.8 or 0.9 standard deviations in each
/// coordinate.
fn known_point(space: &Space) -> DVector<f64> {
    DVector::from_fn(space.dimensions(), |index, _| if index % 2 == 0 { 0.9 } else { -0.8 })
}

fn log_of(states: impl Iterator<Item = (State, f64)>) -> MotionLog {
    let samples = states.enumerate().map(|(step, (state, voltage_v))| MotionSample {
        time_s: step as f64 * CONTROL_PERIOD_S,
        state,
        voltage_v,
    });
    MotionLog { samples: samples.collect(), plant: PlantModel::QUBE }
}

/// The motion of a Qube under an excitation of `run --excite`, with true states.
fn excitation_of(model: QubeModel, shape: ExcitationShape, number: u32) -> Demonstration {
    let mut excitation = Excitation::of_rollout(shape, 1.5, number);
    let mut pendulums = Pendulums::new(1, &SimulationSettings::default());
    pendulums.restart(0, &Trajectory { model, start: State::default() });
    let lanes = pendulums.lanes();
    let mut observations = vec![0.0; pendulums.observation_size() * lanes];
    let (mut voltages_v, mut rewards) = (vec![0.0; lanes], vec![0.0; lanes]);
    let mut statuses = vec![LaneStatus::Running; lanes];
    let states = (0..EXCITATION_STEPS).map(|_| {
        let state: State = pendulums.state(0).into();
        let voltage_v = excitation.voltage_v(&state);
        voltages_v.fill(voltage_v as f32);
        pendulums.step(&voltages_v, &mut rewards, &mut statuses, &mut observations);
        (state, voltage_v)
    });
    Demonstration { log: log_of(states), policy: None }
}

fn shipped_policy() -> Network {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("policies/robust.safetensors");
    match Policy::load(&path).unwrap() {
        Policy::Network(policy) => policy.network,
        _ => panic!("the shipped policy is a network"),
    }
}

/// A swing-up of a Qube by the shipped policy.
fn rollout_of(model: QubeModel, simulation: &SimulationSettings, theta: f64) -> Demonstration {
    let template = Demonstration::of_policy(&shipped_policy(), &PlantModel::QUBE, theta);
    let motion = simulate(&template, simulation, &[model]).remove(0);
    let log = log_of(motion.states.into_iter().zip(motion.voltages_v));
    Demonstration { log, ..template }
}

/// Number of Qubes drawn to compare a belief with another.
const DRAWS: usize = 64;

/// The mean discrepancy between another motion of a known Qube and the motions of drawn Qubes:
/// first of Qubes from the prior, then of Qubes from a rival's belief after two motions.
fn learnt_by(rival: &dyn Rival) -> [f64; 2] {
    let space = Space::of_unknown(&PlantModel::QUBE);
    let simulation = SimulationSettings::robust();
    let known = space.model(&known_point(&space));
    let rollout = |theta| rollout_of(known, &simulation, theta);
    let excitation = |shape, number| excitation_of(known, shape, number);
    let (recorded, other) = match rival.data() {
        Data::Rollouts => (vec![rollout(0.05), rollout(-0.03)], rollout(-0.08)),
        _ => (
            [0, 1].map(|number| excitation(ExcitationShape::Chirp, number)).into(),
            excitation(ExcitationShape::Steps, 0),
        ),
    };
    let before = RivalBelief::Unknown;
    let given = RivalInput {
        space: &space,
        before: &before,
        recorded: &recorded,
        first_latest: 0,
        simulation: &simulation,
        training: &TrainSettings::robust(),
        stop: &AtomicBool::new(false),
        seed: 11,
    };
    let belief = rival.update(&given).unwrap();
    [before, belief].map(|belief| {
        let draws = belief.draws(&space, DRAWS, &mut ChaCha8Rng::seed_from_u64(7));
        let models: Vec<QubeModel> = draws.iter().map(|point| space.model(point)).collect();
        let motions = simulate(&other, &simulation, &models);
        let real = SampledMotion::recorded(&other.log);
        motions.iter().map(|motion| discrepancy(&real, motion)).sum::<f64>() / DRAWS as f64
    })
}

#[test]
fn every_rival_with_data_simulates_a_known_qube_better_than_before() {
    let learning = RivalKind::ALL.into_iter().filter(|kind| !kind.needs_no_rollouts());
    let settings = RivalSettings::default();
    let rival = |kind: RivalKind| match kind {
        // A fifth of its evaluations, which take most of the time of this test. So few do not find
        // the Qube with twice the noise.
        RivalKind::Dropo => Box::new(Dropo { evaluations: 600, noise: 1.0 }),
        _ => kind.rival(&settings),
    };
    let results: Vec<(&str, [f64; 2])> =
        learning.map(|kind| (kind.name(), learnt_by(&*rival(kind)))).collect();
    println!("{results:.4?}");
    for (name, [before, after]) in results {
        assert!(after < 0.8 * before, "{name}: {before} to {after}");
    }
}
