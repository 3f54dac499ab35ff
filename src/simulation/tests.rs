//! Compares lanes that have nonidealities with the emulator's plant, the equations in `f64` and
//! ideal lanes.

use super::{DomainDistribution, LaneStatus, Pendulums, SimulationSettings, Trajectory};
use crate::device::emulator::{EmulatedPlant, EmulatorSettings};
use crate::elementary::Level;
use crate::qube::{
    Distribution, NonidealDynamics, Nonidealities, Nonideality, QubeModel, RAD_PER_COUNT, State,
    control_step,
};

/// A Qube whose friction, dead zones and cable differ from lane to lane; delays from 0 to 40 ms.
fn real_model(lane: usize) -> QubeModel {
    let part = lane as f64 / 63.0;
    let nonidealities = Nonidealities {
        coulomb_torque_n_m: 7e-4 * part,
        positive_dead_zone_v: 0.3 * (1.0 - part),
        negative_dead_zone_v: 0.4 * part,
        cable_stiffness_n_m_rad: 1.2e-3 * part,
        cable_rest_rad: 2.0 * part - 1.0,
        command_delay_s: 0.04 * part,
        ..Nonidealities::default()
    };
    QubeModel { nonidealities, ..QubeModel::NOMINAL }
}

/// A square wave whose edges differ between lanes.
fn command_v(lane: usize, step: usize) -> f32 {
    if (step / (6 + lane % 5)).is_multiple_of(2) { 1.2 } else { -1.3 }
}

/// The states of all lanes after this number of steps from the starts of their trajectories.
fn run(level: Level, trajectories: &[Trajectory], steps: usize) -> Vec<State<f32>> {
    let settings = SimulationSettings::default();
    let mut pendulums = Pendulums::new(trajectories.len(), &settings).at_level(level);
    let lanes = pendulums.lanes();
    for (lane, trajectory) in trajectories.iter().enumerate() {
        pendulums.restart(lane, trajectory);
    }
    let mut rewards = vec![0.0; lanes];
    let mut statuses = vec![LaneStatus::Running; lanes];
    let mut observations = vec![0.0; settings.observation_size() * lanes];
    for step in 0..steps {
        let commands: Vec<f32> = (0..lanes).map(|lane| command_v(lane, step)).collect();
        pendulums.step(&commands, &mut rewards, &mut statuses, &mut observations);
    }
    (0..trajectories.len()).map(|lane| pendulums.state(lane)).collect()
}

/// The largest difference of an angle between lanes and the emulator's plants after 0.8 s, rad,
/// over the plants whose arm stays within 2.3 rad. `model_of` gives the Qube of each lane.
fn farthest_from_plants(model_of: impl Fn(usize) -> QubeModel) -> f64 {
    let steps = 80;
    let plant = |lane: usize| {
        let settings = EmulatorSettings { seed: lane as u64, ..EmulatorSettings::default() };
        EmulatedPlant::new(&EmulatorSettings { model: model_of(lane), ..settings })
    };
    let mut plants: Vec<EmulatedPlant> = (0..64).map(plant).collect();
    let trajectories: Vec<Trajectory> = plants
        .iter()
        .enumerate()
        .map(|(lane, plant)| Trajectory { model: model_of(lane), start: plant.state() })
        .collect();
    let lanes = run(Level::best(), &trajectories, steps);
    let (mut worst, mut compared) = (0.0_f64, 0);
    for (lane, plant) in plants.iter_mut().enumerate() {
        let mut farthest_rad: f64 = 0.0;
        for step in 0..steps {
            plant.set_voltage(f64::from(command_v(lane, step)));
            plant.advance_to((step as u64 + 1) * 10_000);
            farthest_rad = farthest_rad.max(plant.state().theta.abs());
        }
        // Only the plant has stops; the trajectory of a lane ends at the box before them.
        if farthest_rad > 2.3 {
            continue;
        }
        compared += 1;
        let (exact, single) = (plant.state(), lanes[lane]);
        worst = worst
            .max((f64::from(single.theta) - exact.theta).abs())
            .max((f64::from(single.alpha) - exact.alpha).abs());
    }
    println!("worst: {worst:e} rad in {compared} lanes");
    assert!(compared >= 32, "only {compared} lanes stay off the stops");
    worst
}

#[test]
fn delay_dead_zone_and_cable_move_a_lane_as_they_move_the_plant() {
    let worst = farthest_from_plants(|lane| {
        let mut model = real_model(lane);
        model.nonidealities.coulomb_torque_n_m = 0.0;
        model
    });
    assert!(worst < 3e-5, "{worst:e} rad");
}

/// Lanes do not resolve the steep part of friction where the arm reverses: compared with steps of
/// 0.1 ms, their error is up to 7e-4 rad. The emulated plant takes shorter steps with friction.
#[test]
fn friction_moves_a_lane_as_the_plant_within_two_counts() {
    let worst = farthest_from_plants(real_model);
    assert!(worst < 2.0 * RAD_PER_COUNT, "{worst:e} rad");
}

#[test]
fn every_instruction_set_computes_the_same_bits() {
    let trajectories: Vec<Trajectory> = (0..64)
        .map(|lane| Trajectory { model: real_model(lane), start: State::default() })
        .collect();
    let expected = run(Level::Plain, &trajectories, 60);
    assert!(expected.iter().any(|state| state.theta.abs() > 0.05));
    for level in Level::ALL {
        assert_eq!(run(level, &trajectories, 60), expected, "{level:?}");
    }
}

#[test]
fn an_ideal_lane_computes_the_same_bits_beside_real_ones() {
    let ideal = |lane: usize| {
        let start = State { theta: 0.1, alpha: 0.02 * lane as f64, ..State::default() };
        Trajectory { model: QubeModel::NOMINAL, start }
    };
    let alone: Vec<Trajectory> = (0..16).map(ideal).collect();
    let mixed: Vec<Trajectory> = (0..16)
        .map(|lane| match lane % 3 {
            0 => Trajectory { model: real_model(10 + lane), ..ideal(lane) },
            _ => ideal(lane),
        })
        .collect();
    let (alone, mixed) = (run(Level::best(), &alone, 100), run(Level::best(), &mixed, 100));
    for lane in 0..16 {
        assert_eq!(alone[lane] == mixed[lane], lane % 3 != 0, "lane {lane}");
    }
}

#[test]
fn a_delay_of_whole_periods_is_the_same_motion_later() {
    let start = State { theta: 0.2, ..State::default() };
    let dynamics = NonidealDynamics::<f64>::new(&QubeModel::NOMINAL);
    for periods in 0..=4_usize {
        let mut model = QubeModel::NOMINAL;
        model.nonidealities.command_delay_s = 0.01 * periods as f64;
        let delayed = run(Level::best(), &[Trajectory { model, start }], 50)[0];
        let mut state = start;
        for step in 0..50 - periods {
            state = control_step(&dynamics, state, command_v(0, step).into());
        }
        assert!((f64::from(delayed.theta) - state.theta).abs() < 1e-5, "{periods} periods");
        assert!((f64::from(delayed.theta_dot) - state.theta_dot).abs() < 1e-4);
    }
}

#[test]
fn a_distribution_draws_the_nonideality_that_it_names_and_leaves_the_others_zero() {
    let uniform = Distribution::Uniform { mean: 0.008, standard_deviation: 0.0046 };
    let distribution =
        DomainDistribution::nominal().with(Nonideality::CommandDelay, uniform).unwrap();
    let delays: Vec<f64> = (0..1000)
        .map(|number| {
            let QubeModel { parameters, nonidealities } =
                Trajectory::draw(&distribution, 3, number).model;
            assert_eq!(parameters, QubeModel::NOMINAL.parameters);
            let command_delay_s = nonidealities.command_delay_s;
            assert_eq!(
                nonidealities,
                Nonidealities { command_delay_s, ..Nonidealities::default() }
            );
            command_delay_s
        })
        .collect();
    let mean = delays.iter().sum::<f64>() / 1000.0;
    assert!((mean - 0.008).abs() < 5e-4, "{mean}");
    assert!(delays.iter().all(|delay_s| (0.0..=0.016).contains(delay_s)));
}
