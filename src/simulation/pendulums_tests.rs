//! Compares the lanes with the equations in `f64`, with the bits of the scalar equations in `f32`,
//! and with the estimator of the computer that drives a real Qube ("the machine").

use super::{
    DomainDistribution, Family, LaneStatus, Pendulums, SensorModel, SimulationSettings, Trajectory,
};
use crate::elementary::Level;
use crate::estimation::{Calibration, Estimates, Estimator, EstimatorSettings, ObserverSettings};
use crate::qube::{
    Dynamics, MAX_HISTORY, MAX_STEPS, Measurement, OBSERVATION_SIZE, QubeModel, RewardWeights,
    State, control_step, counts, observation,
};
use crate::safety::SafetyBox;

/// Pendulums with their input and output arrays.
struct Bench {
    pendulums: Pendulums,
    voltages_v: Vec<f32>,
    rewards: Vec<f32>,
    statuses: Vec<LaneStatus>,
    observations: Vec<f32>,
}

impl Bench {
    fn new(lanes: usize, settings: &SimulationSettings) -> Self {
        let pendulums = Pendulums::new(lanes, settings);
        let lanes = pendulums.lanes();
        Self {
            pendulums,
            voltages_v: vec![0.0; lanes],
            rewards: vec![0.0; lanes],
            statuses: vec![LaneStatus::Running; lanes],
            observations: vec![0.0; settings.observation_size() * lanes],
        }
    }

    fn step(&mut self) {
        self.pendulums.step(
            &self.voltages_v,
            &mut self.rewards,
            &mut self.statuses,
            &mut self.observations,
        );
    }
}

/// A trajectory with a drawn Qube, whose start has angles and velocities up to the values of
/// `reach` on either side; the numbers of the start are exact in `f32`.
fn anywhere(number: u64, reach: &State) -> Trajectory {
    let distribution = DomainDistribution::handcrafted(Family::Normal);
    let trajectory = Trajectory::draw(&distribution, 11, number);
    let spread = |salt: f64| f64::from((12.9898 * salt * (number + 1) as f64).sin() as f32);
    let exact = |value: f64| f64::from(value as f32);
    Trajectory {
        start: State {
            theta: exact(reach.theta * spread(1.0)),
            alpha: exact(reach.alpha * spread(2.0)),
            theta_dot: exact(reach.theta_dot * spread(3.0)),
            alpha_dot: exact(reach.alpha_dot * spread(4.0)),
        },
        ..trajectory
    }
}

fn voltage_v(lane: usize) -> f32 {
    5.0 * (0.7 * lane as f32).sin()
}

#[test]
fn a_step_is_within_a_microradian_of_the_same_step_in_f64() {
    let lanes = 8192;
    // The test covers one turn to either side: for larger angles the last bit of an `f32` is as
    // large as the tolerance.
    let reach = State { theta: 2.3, alpha: 6.3, theta_dot: 20.0, alpha_dot: 21.0 };
    let mut bench = Bench::new(lanes, &SimulationSettings::default());
    let (mut worst_angle, mut worst_velocity) = (0.0_f64, 0.0_f64);
    for lane in 0..lanes {
        bench.pendulums.restart(lane, &anywhere(lane as u64, &reach));
        bench.voltages_v[lane] = voltage_v(lane);
    }
    bench.step();
    for lane in 0..lanes {
        let Trajectory { model, start } = anywhere(lane as u64, &reach);
        let exact = control_step(&Dynamics::new(&model.parameters), start, voltage_v(lane).into());
        let single = bench.pendulums.state(lane);
        worst_angle = worst_angle
            .max((f64::from(single.theta) - exact.theta).abs())
            .max((f64::from(single.alpha) - exact.alpha).abs());
        worst_velocity = worst_velocity
            .max((f64::from(single.theta_dot) - exact.theta_dot).abs())
            .max((f64::from(single.alpha_dot) - exact.alpha_dot).abs());
        let reward = RewardWeights::THESIS.reward(&start, voltage_v(lane).into());
        assert!((f64::from(bench.rewards[lane]) - reward).abs() < 1e-6);
        let observed = observation(&exact);
        for (feature, value) in observed.into_iter().enumerate() {
            let error = f64::from(bench.observations[feature * lanes + lane]) - value;
            assert!(error.abs() < 1e-5, "feature {feature} is off by {error:e}");
        }
    }
    println!("worst: {worst_angle:e} rad, {worst_velocity:e} rad/s");
    assert!(worst_angle <= 1e-6, "{worst_angle:e} rad");
    assert!(worst_velocity <= 1e-4, "{worst_velocity:e} rad/s");
}

#[test]
fn every_instruction_set_computes_the_bits_of_the_scalar_equations() {
    let reach = State { theta: 2.3, alpha: 12.5, theta_dot: 30.0, alpha_dot: 40.0 };
    let weights = RewardWeights::THESIS.cast::<f32>();
    let safety_box = SafetyBox::THESIS.cast::<f32>();
    for level in Level::ALL {
        let lanes = 64;
        let mut bench = Bench::new(lanes, &SimulationSettings::default());
        bench.pendulums = bench.pendulums.clone().at_level(level);
        for lane in 0..lanes {
            bench.pendulums.restart(lane, &anywhere(lane as u64, &reach));
            bench.voltages_v[lane] = voltage_v(lane);
        }
        for _ in 0..20 {
            let before: Vec<_> = (0..lanes).map(|lane| bench.pendulums.state(lane)).collect();
            bench.step();
            for (lane, before) in before.into_iter().enumerate() {
                let parameters = anywhere(lane as u64, &reach).model.parameters;
                let voltage_v = voltage_v(lane);
                let after = control_step(&Dynamics::new(&parameters), before, voltage_v);
                assert_eq!(bench.pendulums.state(lane), after, "{level:?}, lane {lane}");
                assert_eq!(bench.rewards[lane], weights.reward(&before, voltage_v));
                let left = bench.statuses[lane] == LaneStatus::LeftBox;
                assert_eq!(left, !safety_box.contains(&after));
                for (feature, value) in observation(&after).into_iter().enumerate() {
                    assert_eq!(bench.observations[feature * lanes + lane], value);
                }
            }
        }
    }
}

#[test]
fn a_lane_does_not_depend_on_other_lanes() {
    let reach = State { theta: 1.0, alpha: 3.0, theta_dot: 5.0, alpha_dot: 5.0 };
    let mut few = Bench::new(16, &SimulationSettings::default());
    let mut many = Bench::new(96, &SimulationSettings::default());
    few.pendulums.restart(3, &anywhere(3, &reach));
    for lane in 0..96 {
        many.pendulums.restart(lane, &anywhere(100 + lane as u64, &reach));
        many.voltages_v[lane] = f32::NAN;
    }
    many.pendulums.restart(77, &anywhere(3, &reach));
    few.voltages_v[3] = 1.0;
    many.voltages_v[77] = 1.0;
    for _ in 0..50 {
        few.step();
        many.step();
        assert_eq!(few.pendulums.state(3), many.pendulums.state(77));
        assert_eq!(few.rewards[3], many.rewards[77]);
    }
}

#[test]
fn a_trajectory_ends_at_the_box_at_a_state_that_is_not_a_number_and_after_600_steps() {
    let mut bench = Bench::new(16, &SimulationSettings::default());
    let nominal = DomainDistribution::nominal();
    for lane in 0..16 {
        bench.pendulums.restart(lane, &Trajectory::draw(&nominal, 1, lane as u64));
    }
    bench.voltages_v[1] = 5.0;
    bench.voltages_v[2] = f32::NAN;
    bench.voltages_v[4] = -1e9;
    bench.voltages_v[5] = -5.0;
    bench.pendulums.restart(5, &Trajectory::draw(&nominal, 1, 4));
    for step in 1..=MAX_STEPS {
        bench.step();
        assert_eq!(bench.pendulums.state(4), bench.pendulums.state(5), "not limited to 5 V");
        assert_eq!(bench.statuses[2], LaneStatus::LeftBox);
        if step == 1 {
            assert_eq!(bench.statuses[1], LaneStatus::Running);
        }
        if step == 100 {
            assert_eq!(bench.statuses[1], LaneStatus::LeftBox);
            assert!(bench.pendulums.state(1).theta >= 2.3);
        }
        let last = step == MAX_STEPS;
        let expected = if last { LaneStatus::TimeUp } else { LaneStatus::Running };
        assert_eq!(bench.statuses[0], expected, "step {step}");
    }
    bench.pendulums.restart(0, &Trajectory::draw(&nominal, 1, 0));
    bench.step();
    assert_eq!(bench.statuses[0], LaneStatus::Running);
}

/// Simulates one lane for 3 s, and gives the machine's estimator the same encoder counts. Checks
/// the lane's observations, and that its status follows from the machine's guarded state. Returns
/// the largest differences between the states that both show to a policy, rad and rad/s, and the
/// number of steps that end outside of the box.
fn beside_the_machine(estimator: EstimatorSettings, safety_box: SafetyBox) -> (f64, f64, u32) {
    let settings = SimulationSettings {
        sensors: SensorModel::Encoders { estimator },
        safety_box,
        ..SimulationSettings::default()
    };
    let mut bench = Bench::new(16, &settings);
    let trajectory = anywhere(3, &State { theta: 0.5, alpha: 3.0, ..State::default() });
    bench.pendulums.restart(3, &trajectory);
    bench.pendulums.observe_lane(3, &mut bench.observations);
    let mut estimator = Estimator::new(estimator, Calibration::IDENTITY);
    let (mut angle, mut velocity, mut outside) = (0.0_f64, 0.0_f64, 0);
    for step in 0..300_u64 {
        let state = bench.pendulums.state(3);
        let Estimates { seen: expected, guarded } = estimator.update(&Measurement {
            device_time_us: 10_000 * step,
            theta_counts: counts(state.theta.into()),
            alpha_counts: counts(state.alpha.into()),
            ..Measurement::default()
        });
        let seen = bench.pendulums.seen(3);
        angle = angle
            .max((f64::from(seen.theta) - expected.theta).abs())
            .max((f64::from(seen.alpha) - expected.alpha).abs());
        velocity = velocity
            .max((f64::from(seen.theta_dot) - expected.theta_dot).abs())
            .max((f64::from(seen.alpha_dot) - expected.alpha_dot).abs());
        for (feature, value) in observation(&seen).into_iter().enumerate() {
            assert_eq!(bench.observations[feature * 16 + 3], value);
        }
        let inside = safety_box.contains(&guarded);
        outside += u32::from(!inside);
        assert!(step == 0 || (bench.statuses[3] == LaneStatus::Running) == inside, "step {step}");
        bench.voltages_v[3] = voltage_v(step as usize / 30);
        estimator.send(f64::from(bench.voltages_v[3]));
        bench.step();
    }
    (angle, velocity, outside)
}

#[test]
fn simulated_encoders_show_the_estimates_of_the_machines_estimator() {
    for corner_rad_s in [50.0, 200.0, 300.0] {
        let estimator = EstimatorSettings::filter(corner_rad_s);
        let (angle, velocity, _) = beside_the_machine(estimator, SafetyBox::THESIS);
        assert!(angle < 1e-5 && velocity < 1e-3, "{corner_rad_s}: {angle} {velocity}");
    }
    for delay_s in [0.0, 0.0037, 0.01, 0.0234, 0.1] {
        let observer = ObserverSettings::default().with_delay(delay_s);
        let estimator = EstimatorSettings::observer(observer);
        let (angle, velocity, _) = beside_the_machine(estimator, SafetyBox::THESIS);
        println!("{delay_s}: {angle:e} {velocity:e}");
        assert!(angle < 1e-4 && velocity < 1e-2, "{delay_s}: {angle} {velocity}");
    }
}

#[test]
fn simulated_lanes_guard_by_the_guards_own_filter_like_a_real_tick() {
    // The box is so narrow that the velocities cross its limits many times.
    let safety_box =
        SafetyBox { theta_dot: 5.0, alpha_dot: 5.0, theta: 100.0, ..SafetyBox::THESIS };
    let observer = ObserverSettings::default().with_delay(0.02);
    for estimator in [
        EstimatorSettings::filter(200.0),
        EstimatorSettings::filter(20.0),
        EstimatorSettings::observer(observer),
    ] {
        let (_, _, outside) = beside_the_machine(estimator, safety_box);
        assert!((30..270).contains(&outside), "{outside} of 300 steps end outside of the box");
    }
}

#[test]
fn a_restarted_lane_does_not_depend_on_its_earlier_steps() {
    let estimator = EstimatorSettings::observer(ObserverSettings::default().with_delay(0.025));
    let settings = SimulationSettings {
        sensors: SensorModel::Encoders { estimator },
        ..SimulationSettings::default()
    };
    let (mut used, mut fresh) = (Bench::new(16, &settings), Bench::new(16, &settings));
    used.voltages_v = vec![4.0; 16];
    for _ in 0..50 {
        used.step();
    }
    let trajectory = anywhere(1, &State { theta: 0.5, alpha: 3.0, ..State::default() });
    used.pendulums.restart(5, &trajectory);
    fresh.pendulums.restart(5, &trajectory);
    for step in 0..50 {
        used.voltages_v[5] = voltage_v(step);
        fresh.voltages_v[5] = voltage_v(step);
        used.step();
        fresh.step();
        assert_eq!(used.pendulums.seen(5), fresh.pendulums.seen(5));
    }
}

#[test]
fn observing_writes_the_same_observations_as_the_step() {
    let mut bench = Bench::new(32, &SimulationSettings::default());
    for lane in 0..32 {
        let reach = State { theta: 1.0, alpha: 3.0, theta_dot: 5.0, alpha_dot: 5.0 };
        bench.pendulums.restart(lane, &anywhere(lane as u64, &reach));
    }
    bench.step();
    let mut again = vec![0.0; bench.observations.len()];
    bench.pendulums.observe(&mut again);
    assert_eq!(again, bench.observations);
    let mut lane_by_lane = vec![0.0; bench.observations.len()];
    for lane in 0..32 {
        bench.pendulums.observe_lane(lane, &mut lane_by_lane);
    }
    assert_eq!(lane_by_lane, bench.observations);
}

#[test]
fn last_commands_are_observed_newest_first_and_forgotten_at_a_restart() {
    for history in 1..=MAX_HISTORY {
        let settings = SimulationSettings { history, ..SimulationSettings::default() };
        let mut bench = Bench::new(32, &settings);
        let commands = |bench: &Bench, lane: usize| -> Vec<f32> {
            (0..history)
                .map(|age| bench.observations[(OBSERVATION_SIZE + age) * 32 + lane])
                .collect()
        };
        let mut expected = vec![0.0; history];
        for step in 0..10 {
            // The commands exceed 5 V from step 6 on.
            let command_v = 0.9 * step as f32;
            bench.voltages_v = vec![command_v; 32];
            bench.step();
            expected.insert(0, command_v.min(5.0) / 5.0);
            expected.pop();
            for (seen, expected) in commands(&bench, 17).into_iter().zip(&expected) {
                assert!((seen - expected).abs() < 1e-6);
            }
            let written = bench.observations.clone();
            bench.pendulums.observe(&mut bench.observations);
            assert_eq!(bench.observations, written);
        }
        bench.pendulums.restart(17, &anywhere(3, &State::default()));
        bench.pendulums.observe_lane(17, &mut bench.observations);
        assert_eq!(commands(&bench, 17), vec![0.0; history]);
        assert_eq!(commands(&bench, 16)[0], 1.0);
    }
}

#[test]
fn lanes_come_in_whole_blocks_and_start_as_nominal_qubes_at_rest() {
    let bench = Bench::new(17, &SimulationSettings::default());
    assert_eq!(bench.pendulums.lanes(), 32);
    let mut same = Bench::new(17, &SimulationSettings::default());
    same.pendulums.restart(20, &Trajectory { model: QubeModel::NOMINAL, start: State::default() });
    same.voltages_v = vec![2.0; 32];
    for _ in 0..10 {
        same.step();
    }
    assert_eq!(same.pendulums.state(20), same.pendulums.state(21));
}
