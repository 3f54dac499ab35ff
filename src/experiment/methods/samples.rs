//! An experiment on a nominal emulated Qube that is called `lab`, with recordings of known motions,
//! for tests of methods.

use std::path::Path;
use std::sync::Arc;

use super::run::{Access, MethodRun};
use super::{Method, MethodSettings, RepetitionId, RepetitionSeeds, RivalSettings};
use crate::experiment::{Experiment, ExperimentFolder, ExperimentSettings, Plant, Recipe};
use crate::qube::{Measurement, PlantModel, State};
use crate::recording::{RolloutWriter, samples};
use crate::rig::{DeviceChoice, RigSettings};
use crate::session::{RolloutAttempt, SeedFor, SessionSettings, derived_seed, recording_in};
use crate::simulation::Model;
use crate::storage::MachineDisk;
use crate::telemetry::{Ending, Phase, RolloutHeader, RolloutOutcome, TickRecord};

/// A comparison of these methods at fixed budgets on the nominal Qube, in a new folder.
pub fn experiment(root: &Path, methods: Vec<Method>) -> Experiment {
    let plant = Plant { name: "lab".into(), emulated: Default::default(), vary: 0.0 };
    experiment_on(root, methods, vec![plant])
}

/// A comparison of these methods at fixed budgets on these plants, in a new folder.
pub fn experiment_on(root: &Path, methods: Vec<Method>, plants: Vec<Plant>) -> Experiment {
    let methods = MethodSettings {
        methods,
        repetitions: 1,
        recordings: 6,
        spread: 0.1,
        budgets: vec![0, 2, 5],
        trainings: 1,
        seeds: RepetitionSeeds::OfEachPlant,
        rivals: RivalSettings::default(),
    };
    let settings = ExperimentSettings {
        name: "table".into(),
        seed: 7,
        policies: 1,
        rollouts: 1,
        simulated_starts: 1,
        guard_profile: None,
        plants,
        recipes: vec![Recipe::of(Model::OptRobust, &SessionSettings::thesis())],
        methods: Some(methods),
    };
    let folder = ExperimentFolder::create(root, &settings.to_toml().unwrap()).unwrap();
    let rig = RigSettings::in_virtual_time(DeviceChoice::Emulated);
    Experiment::new(folder, settings, rig, 1, Arc::default())
}

/// The first repetition of a method on the first plant.
pub fn run<'a>(experiment: &'a Experiment, method: Method, access: Access<'a>) -> MethodRun<'a> {
    let plant = &experiment.settings().plants[0];
    let folder = experiment.folder().repetition_on(&plant.name, method.name(), 0);
    experiment.method_run(RepetitionId { method, number: 0 }, plant, folder, access)
}

/// A motion of arm and pendulum that can be fitted, at a time in s.
pub fn swings(time_s: f64) -> State {
    let (theta, alpha) = (3.0 * time_s, 5.0 * time_s);
    State {
        theta: 0.5 * theta.sin(),
        alpha: 0.4 * alpha.sin(),
        theta_dot: 1.5 * theta.cos(),
        alpha_dot: 2.0 * alpha.cos(),
    }
}

/// Writes the recording of an attempt with this number of steps of a motion under 2 V of changing
/// sign.
pub fn record(
    run: &MethodRun,
    attempt: RolloutAttempt,
    ending: Ending,
    steps: u32,
    motion: impl Fn(f64) -> State,
) {
    let folder = run.recordings();
    std::fs::create_dir_all(&folder).unwrap();
    let path = recording_in(&folder, attempt);
    let RolloutAttempt { rollout, attempt } = attempt;
    let seed = derived_seed(run.seed, SeedFor::ExperimentPart);
    let header = RolloutHeader { candidate: None, rollout, attempt, seed, ..samples::header() };
    record_with(&path, header, ending, steps, motion);
}

/// Writes a recording with this header.
pub fn record_with(
    path: &Path,
    mut header: RolloutHeader,
    ending: Ending,
    steps: u32,
    motion: impl Fn(f64) -> State,
) {
    header.settings.calibration.theta_zero_counts = 0;
    let mut writer = RolloutWriter::create(&MachineDisk, path, header, samples::POLICY).unwrap();
    let encoders = PlantModel::QUBE.encoders;
    for tick in 0..steps {
        let state = motion(f64::from(tick) * 0.01);
        let sample = samples::tick(0);
        let measurement = sample.measurement.map(|measured| Measurement {
            device_time_us: u64::from(tick) * 10_000,
            theta_counts: (state.theta / encoders.theta.rad_per_count()).round() as i32,
            alpha_counts: (state.alpha / encoders.alpha.rad_per_count()).round() as i32,
            ..measured
        });
        let record = TickRecord {
            tick,
            phase: Phase::Running,
            deadline_ns: u64::from(tick) * 10_000_000,
            measurement,
            state,
            voltage_mv: if tick % 20 < 10 { 2000 } else { -2000 },
            ..sample
        };
        writer.write(&record).unwrap();
    }
    let phase = Phase::Running;
    writer.finish(&RolloutOutcome { ending, phase, steps, ..samples::outcome() }).unwrap();
}
