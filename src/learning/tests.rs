use std::sync::atomic::{AtomicBool, Ordering};

use super::*;
use crate::qube::{PlantModel, QubeModel, RewardWeights};
use crate::simulation::{DomainDistribution, Family, SimulationSettingError, SimulationSettings};

/// Settings that are small enough for a test and large enough to exercise each part of a training.
pub(super) fn small() -> TrainSettings {
    TrainSettings {
        updates: 3,
        num_envs: 48,
        epochs: 1,
        evaluation_starts: 20,
        ..TrainSettings::quick()
    }
}

/// The small settings with the last two commands in the observation.
fn small_with_history() -> TrainSettings {
    let settings = small();
    let simulation = SimulationSettings { history: 2, ..settings.simulation };
    TrainSettings { simulation, ..settings }
}

fn train_small(
    settings: &TrainSettings,
    seed: u64,
    checkpointing: Option<&Checkpointing>,
    stop_after: u32,
) -> Result<Trained, TrainError> {
    let stop = AtomicBool::new(false);
    let distribution = DomainDistribution::handcrafted(Family::Normal);
    train(&distribution, settings, seed, checkpointing, &stop, |update| {
        stop.store(update.update + 1 == stop_after, Ordering::Relaxed);
    })
}

#[test]
fn the_same_seed_gives_the_same_policy_on_one_and_on_two_threads() {
    let one = train_small(&small(), 5, None, u32::MAX).unwrap();
    let two = train_small(&TrainSettings { threads: 2, ..small() }, 5, None, u32::MAX).unwrap();
    assert_eq!(one, two);
    assert_eq!(one.curve.len(), 3);
    let other = train_small(&small(), 6, None, u32::MAX).unwrap();
    assert_ne!(one.network, other.network);
}

#[test]
fn the_worst_trajectories_come_from_more_pendulums_and_choose_the_network() {
    let settings = TrainSettings { updates: 4, worst_share: 0.25, ..small() };
    assert_eq!([1, 2].map(|update| settings.num_envs_at(update)), [48, 192]);
    let trained = train_small(&settings, 5, None, u32::MAX).unwrap();
    let simulated: Vec<u64> = trained.curve.iter().map(|update| update.steps).collect();
    assert_eq!(simulated, [1, 2, 6, 10].map(|batches| batches * 48 * 600));
    // As many transitions are learnt from, up to those of falls.
    let learnt = |update: usize| {
        trained.curve[update].gradient_steps - trained.curve[update - 1].gradient_steps
    };
    assert!(learnt(3) <= learnt(1) && 2 * learnt(3) > learnt(1), "{:?}", trained.curve);
    // The network of the first half with the highest mean return is not kept for that mean.
    let later = trained.curve[1..].iter().map(|update| update.mean_return);
    assert!(later.into_iter().any(|it| it == trained.best_return), "{:?}", trained.curve);
}

#[test]
fn a_history_is_seen_by_the_network_and_changes_the_policy() {
    let without = train_small(&small(), 5, None, u32::MAX).unwrap();
    let with = train_small(&small_with_history(), 5, None, u32::MAX).unwrap();
    assert_eq!(without.network.sizes(), [6, 64, 64, 1]);
    assert_eq!(with.network.sizes(), [8, 64, 64, 1]);
    let mut network = with.network.clone();
    let mut voltage_after =
        |last: f32| network.voltage_of_observation_v(&[0.0, 1.0, 0.0, 1.0, 0.0, 0.0, last, 0.0]);
    assert_ne!(voltage_after(1.0), voltage_after(-1.0));
    assert!(with.curve.iter().all(|update| update.mean_return.is_finite()));
}

#[test]
fn a_training_that_was_interrupted_goes_on_to_the_same_policy() {
    let folder = tempfile::tempdir().unwrap();
    let checkpointing = Checkpointing { path: folder.path().join("checkpoint"), every: 1 };
    let settings = small_with_history();
    let whole = train_small(&settings, 8, None, u32::MAX).unwrap();
    for stop_after in [1, 2] {
        let stopped = train_small(&settings, 8, Some(&checkpointing), stop_after);
        assert!(matches!(stopped, Err(TrainError::Stopped)));
        assert!(checkpointing.path.exists());
    }
    let settings = TrainSettings { threads: 2, ..settings };
    // The checkpoint outlives the training, so a policy that could not be saved is trained again
    // from there.
    for _ in 0..2 {
        let resumed = train_small(&settings, 8, Some(&checkpointing), u32::MAX);
        assert_eq!(resumed.unwrap(), whole);
        assert!(checkpointing.path.exists());
    }
    checkpointing.remove().unwrap();
    assert!(!checkpointing.path.exists());
    checkpointing.remove().unwrap();
}

#[test]
fn a_checkpoint_of_another_training_or_a_damaged_one_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("checkpoint");
    let checkpointing = Checkpointing { path: path.clone(), every: 1 };
    assert!(train_small(&small(), 1, Some(&checkpointing), 1).is_err());
    let other_seed = train_small(&small(), 2, Some(&checkpointing), u32::MAX);
    assert!(matches!(other_seed, Err(TrainError::CheckpointOfAnother { property: "seed", .. })));
    let other_settings = TrainSettings { clip: 0.3, ..small() };
    let other_settings = train_small(&other_settings, 1, Some(&checkpointing), u32::MAX);
    let refused = other_settings.err().unwrap();
    assert!(matches!(refused, TrainError::CheckpointOfAnother { property: "settings", .. }));
    let words = "differs in its settings. Give the same settings again";
    assert!(refused.to_string().contains(words), "{refused}");

    let bytes = std::fs::read(&path).unwrap();
    for damaged in [&bytes[..bytes.len() - 1], &bytes[..100], &[], b"{}"] {
        std::fs::write(&path, damaged).unwrap();
        let refused = train_small(&small(), 1, Some(&checkpointing), u32::MAX);
        assert!(matches!(refused, Err(TrainError::CheckpointDamaged { .. })), "{}", damaged.len());
    }
}

#[test]
fn a_stop_that_is_set_ends_the_training_within_the_update() {
    let stop = AtomicBool::new(true);
    let distribution = DomainDistribution::nominal();
    let settings = TrainSettings::thesis();
    let stopped = train(&distribution, &settings, 0, None, &stop, |_| panic!("an update was done"));
    assert!(matches!(stopped, Err(TrainError::Stopped)));
}

#[test]
fn settings_out_of_range_are_named() {
    let refused = |settings: TrainSettings| match train_small(&settings, 0, None, u32::MAX) {
        Err(TrainError::Setting { name, .. }) => name,
        Err(TrainError::Simulation(SimulationSettingError::OutOfRange { name, .. })) => name,
        other => panic!("{other:?}"),
    };
    assert_eq!(refused(TrainSettings { updates: 0, ..small() }), "updates");
    assert_eq!(refused(TrainSettings { num_envs: 0, ..small() }), "num_envs");
    assert_eq!(refused(TrainSettings { num_envs: 40, ..small() }), "num_envs");
    assert_eq!(refused(TrainSettings { learning_rate: f32::NAN, ..small() }), "learning_rate");
    assert_eq!(refused(TrainSettings { clip: 0.0, ..small() }), "clip");
    assert_eq!(refused(TrainSettings { evaluation_starts: 0, ..small() }), "evaluation_starts");
    let voltage_change_weight = f32::NAN;
    let weight_not_a_number = TrainSettings { voltage_change_weight, ..small() };
    assert_eq!(refused(weight_not_a_number), "voltage_change_weight");
    assert_eq!(refused(TrainSettings { threads: 0, ..small() }), "threads");
    let simulation = SimulationSettings { history: 5, ..small().simulation };
    assert_eq!(refused(TrainSettings { simulation, ..small() }), "history");
    let reward = RewardWeights { alpha: -1.0, ..small().simulation.reward };
    let simulation = SimulationSettings { reward, ..small().simulation };
    assert_eq!(refused(TrainSettings { simulation, ..small() }), "reward.alpha");
    assert!(TrainSettings::thesis().check().is_ok() && TrainSettings::quick().check().is_ok());
}

#[test]
fn the_thesis_preset_has_the_published_budget() {
    let thesis = TrainSettings::thesis();
    let transitions = usize::from(thesis.num_envs) * crate::qube::MAX_STEPS;
    assert_eq!(transitions, 48_000);
    assert_eq!(thesis.updates, 100);
    assert_eq!(transitions / network::WIDTH * thesis.epochs as usize * 100, 750_000);
    assert_eq!((thesis.discount, thesis.gae_lambda, thesis.clip), (0.99, 0.95, 0.1));
    assert_eq!(thesis.learning_rate, 5e-4);
}

#[test]
fn the_weight_on_voltage_changes_grows_and_reported_returns_exclude_it() {
    let settings = TrainSettings { voltage_change_weight: 0.5, ..small_with_history() };
    assert_eq!(settings.voltage_change_weight_at(0), 0.0);
    assert_eq!(settings.voltage_change_weight_at(settings.updates - 1), 0.5);
    let weighted = train_small(&settings, 5, None, u32::MAX).unwrap();
    let plain = train_small(&small_with_history(), 5, None, u32::MAX).unwrap();
    assert_ne!(weighted.network, plain.network);
    // The weight is 0 in the first update, so both trainings learn the same in that update. They
    // report the same return, because it excludes the weight.
    assert_eq!(weighted.curve[0].mean_return, plain.curve[0].mean_return);
    let reports_best = |trained: &Trained| {
        trained.curve.iter().any(|update| update.mean_return == trained.best_return)
    };
    assert!(reports_best(&weighted) && reports_best(&plain));
    assert_eq!((weighted.voltage_change_weight, plain.voltage_change_weight), (0.5, 0.0));
}

#[test]
fn the_quick_preset_learns_to_swing_up_and_balance() {
    let stop = AtomicBool::new(false);
    let distribution = DomainDistribution::nominal();
    let settings = TrainSettings { target_return: Some(540.0), ..TrainSettings::quick() };
    let trained = train(&distribution, &settings, 0, None, &stop, |_| {}).unwrap();
    assert!(trained.best_return >= 540.0, "best return {}", trained.best_return);
    assert!(trained.curve.len() <= 40, "{} updates", trained.curve.len());
    assert!(trained.curve[0].mean_return < 100.0, "the first update already swings up");
}

#[test]
fn a_training_from_a_policy_begins_with_it_and_never_ends_below_it() {
    let never = AtomicBool::new(false);
    let distribution = DomainDistribution::nominal();
    let settings = TrainSettings { updates: 25, ..TrainSettings::quick() };
    let first = train(&distribution, &settings, 3, None, &never, |_| {}).unwrap();
    // An update with a learning rate of 0 leaves the weights as they are, so it evaluates the given
    // policy.
    let still = TrainSettings {
        updates: 1,
        learning_rate: 0.0,
        last_learning_rate: 0.0,
        ..TrainSettings::quick()
    };
    let same = train_from(&first.network, &distribution, &still, 4, &never, |_| {}).unwrap();
    assert_eq!((&same.network, same.best_return), (&first.network, first.best_return));
    assert_eq!(same.final_network, first.network);
    let more = TrainSettings { updates: 10, ..TrainSettings::quick() };
    let further =
        |seed| train_from(&first.network, &distribution, &more, seed, &never, |_| {}).unwrap();
    let (one, again) = (further(5), further(5));
    assert_eq!(one, again);
    assert!(one.best_return >= first.best_return, "{} {}", one.best_return, first.best_return);
    let longer = SimulationSettings { history: 2, ..settings.simulation };
    let other = TrainSettings { simulation: longer, ..more };
    let refused = train_from(&first.network, &distribution, &other, 5, &never, |_| {});
    assert!(matches!(refused, Err(TrainError::Start { .. })));
}

#[test]
fn stages_of_one_distribution_are_one_training() {
    let never = AtomicBool::new(false);
    let distribution = DomainDistribution::nominal();
    let settings = TrainSettings { updates: 7, ..small() };
    let whole = train(&distribution, &settings, 3, None, &never, |_| {}).unwrap();
    let mut stages = StagedTraining::new(&settings, 3, 3).unwrap();
    let mut stage = || stages.train_stage(distribution.clone(), &never).unwrap();
    let (first, second, last) = (stage(), stage(), stage());
    assert_eq!([&first, &second, &last].map(|it| it.curve.len()), [2, 4, 7]);
    assert_eq!((&last.final_network, &last.curve), (&whole.final_network, &whole.curve));
    // After the last stage nothing is left to train.
    assert_eq!(stage().final_network, whole.final_network);
}

#[test]
fn a_training_that_diverges_keeps_the_policy_of_the_previous_update() {
    let (distribution, settings) = (DomainDistribution::nominal(), small());
    let stop = AtomicBool::new(false);
    let mut training = state::TrainingState::new(&distribution, &settings, None, 3);
    training.update(&stop).unwrap().unwrap();
    let (policy, best_return) = (training.policy.network.clone(), training.best_return);
    training.value.network.last[0] = f32::NAN;
    assert!(training.update(&stop).unwrap().is_none());
    assert_eq!(training.policy.network, policy);
    let trained = training.trained().unwrap();
    assert_eq!((trained.best_return, trained.curve.len()), (best_return, 1));

    let mut training = state::TrainingState::new(&distribution, &settings, None, 3);
    training.value.network.last[0] = f32::NAN;
    assert!(matches!(training.update(&stop), Err(TrainError::Diverged)));
}

#[test]
fn an_update_that_diverges_leaves_the_whole_learner_as_it_was() {
    let distribution = DomainDistribution::nominal();
    let settings = TrainSettings { last_learning_rate: 1e30, ..small() };
    let stop = AtomicBool::new(false);
    let mut training = state::TrainingState::new(&distribution, &settings, None, 3);
    training.update(&stop).unwrap().unwrap();
    let learners = |training: &state::TrainingState<'_>| {
        [&training.policy, &training.value].map(|it| (it.network.clone(), it.moments.clone()))
    };
    let before = learners(&training);
    assert!(training.update(&stop).unwrap().is_none());
    assert_eq!(learners(&training), before);
}

#[test]
fn plants_and_distributions_that_cannot_be_simulated_are_refused() {
    let mut plant = PlantModel::QUBE;
    plant.parameters.rotary_mass_kg = f64::NAN;
    let simulation = SimulationSettings { plant, ..small().simulation };
    let refused = train_small(&TrainSettings { simulation, ..small() }, 0, None, u32::MAX);
    assert!(
        matches!(refused, Err(TrainError::Simulation(SimulationSettingError::Plant(_)))),
        "{refused:?}"
    );

    let mut late = QubeModel::NOMINAL;
    late.nonidealities.command_delay_s = 10.0;
    let stop = AtomicBool::new(false);
    let refused = train(&DomainDistribution::constant(&late), &small(), 0, None, &stop, |_| ());
    assert!(matches!(refused, Err(TrainError::Distribution(_))), "{refused:?}");
}
