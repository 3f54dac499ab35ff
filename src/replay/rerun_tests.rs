use std::path::Path;

use super::{controller_of, rerun};
use crate::control::{DeviceLoss, Motion, Tick, TickInput};
use crate::estimation::{EstimatorSettings, ObserverSettings};
use crate::policy::{
    ClassicalController, ClassicalGains, Controller, External, LayerWeights, Network,
    NetworkPolicy, Policy, SimulatedGuard, SimulatedSensors, TrainingRecord,
};
use crate::qube::{
    CONTROL_PERIOD_NS, DomainParameters, Dynamics, Measurement, Nonidealities, PlantModel,
    QubeModel, RAD_PER_COUNT, State, Status, control_step, counts, volts,
};
use crate::recording::samples::{POLICY, header, outcome};
use crate::recording::{Recording, RolloutWriter, parse};
use crate::safety::{Limit, MotorHeat, SafetyBox};
use crate::telemetry::{Ending, Fault, Phase, RolloutHeader, RolloutOutcome, TickRecord};

fn classical(gains: ClassicalGains) -> Policy {
    Policy::Classical(ClassicalController::new(gains))
}

fn training_record() -> TrainingRecord {
    TrainingRecord {
        model: "nominal".into(),
        psi: None,
        randomisation: None,
        seed: 0,
        preset: "quick".into(),
        steps: 0,
        gradient_steps: 0,
        sensors: SimulatedSensors::TrueState,
        guard: SimulatedGuard::Box,
        voltage_change_weight: 0.0,
        plant: PlantModel::QUBE,
        best_return: None,
        program_version: "0".into(),
    }
}

/// A rollout on an ideal plant, read back from its recording. Every 13th sample is lost.
fn recorded_rollout(policy: Policy, link_breaks_at: Option<u32>) -> Recording {
    recorded_with(EstimatorSettings::default(), policy, link_breaks_at)
}

fn recorded_with(
    estimator: EstimatorSettings,
    policy: Policy,
    link_breaks_at: Option<u32>,
) -> Recording {
    recorded_warm(MotorHeat::default(), 0.0, estimator, policy, link_breaks_at)
}

/// The rollout of [`recorded_rollout`] with this estimator, on a motor that begins with this heat
/// and whose samples show `current_factor` times the nominal current (in [`recorded_rollout`] 0).
fn recorded_warm(
    heat: MotorHeat,
    current_factor: f64,
    estimator: EstimatorSettings,
    policy: Policy,
    link_breaks_at: Option<u32>,
) -> Recording {
    let mut header: RolloutHeader = header();
    header.settings.estimator = estimator;
    recorded_under(header, heat, current_factor, policy, link_breaks_at)
}

/// The rollout of [`recorded_warm`] with this header, except for the motor's heat, 300 steps and
/// the arm's zero.
fn recorded_under(
    mut header: RolloutHeader,
    mut heat: MotorHeat,
    current_factor: f64,
    policy: Policy,
    link_breaks_at: Option<u32>,
) -> Recording {
    header.motor_heat = Some(heat);
    header.settings.max_steps = 300;
    header.settings.calibration.theta_zero_counts = 0;
    let mut writer =
        RolloutWriter::begin(Vec::new(), Path::new("memory"), header.clone(), POLICY).unwrap();
    let dynamics = Dynamics::<f64>::new(&DomainParameters::NOMINAL);
    let mut plant = State { theta: 0.3, alpha: 0.1, ..State::default() };
    let mut tick = Tick::new(&header.settings, policy);
    let mut voltage_mv = 0;
    for number in 0.. {
        let link_gone = link_breaks_at == Some(number);
        let status = Status { armed: true, ..Status::default() };
        let measurement = (number % 13 != 5 && !link_gone).then(|| Measurement {
            device_time_us: u64::from(number) * 10_000,
            theta_counts: counts(plant.theta),
            alpha_counts: counts(plant.alpha),
            tachometer_counts_s: (plant.theta_dot / RAD_PER_COUNT) as i32,
            applied_mv: header.settings.calibration.device_mv(voltage_mv),
            status,
            ..Measurement::default()
        });
        let measurement = measurement.map(|sample| {
            let motor_v = f64::from(voltage_mv) * 1e-3 - 0.042 * plant.theta_dot;
            let current_a = (current_factor * motor_v / 8.4) as f32;
            Measurement { current_a, ..sample }
        });
        let deadline_ns = u64::from(number) * CONTROL_PERIOD_NS;
        let motor_overheated = heat.is_overheated();
        let input = TickInput {
            deadline_ns,
            measurement,
            device_loss: link_gone.then_some(DeviceLoss::LinkGone),
            motor_overheated,
            ..TickInput::default()
        };
        let output = tick.decide(&input);
        heat.pass(0, measurement.as_ref(), voltage_mv, output.heating_theta_dot_rad_s);
        voltage_mv = output.voltage_mv;
        let record = TickRecord {
            tick: number,
            phase: output.phase,
            deadline_ns,
            measurement,
            state: output.state,
            wanted_v: output.wanted_v,
            voltage_mv: output.voltage_mv,
            ..TickRecord::default()
        };
        writer.write(&record).unwrap();
        if let Some(ending) = output.ending {
            let outcome = RolloutOutcome { ending, ..outcome() };
            return parse(&writer.finish(&outcome).unwrap()).unwrap();
        }
        plant = control_step(&dynamics, plant, volts(output.voltage_mv));
    }
    unreachable!()
}

#[test]
fn every_decision_comes_out_again_bit_for_bit() {
    let recording = recorded_rollout(classical(ClassicalGains::default()), None);
    let rerun = rerun(&recording, classical(ClassicalGains::default()));
    assert!(rerun.agrees(), "{rerun:?}");
    assert!(rerun.actions_compared > 300);
    assert!(rerun.return_recorded > 1.0);
    assert_eq!(rerun.ending, Some(Ending::Completed));
}

#[test]
fn an_external_controller_is_replayed_by_its_recorded_answers() {
    let answers_v = (0..300).map(|tick| 0.5 * f64::sin(0.3 * f64::from(tick))).collect();
    let driven = Policy::External(External::new("mine").answering(answers_v));
    let mut recording = recorded_rollout(driven, None);
    recording.policy = Policy::External(External::new("mine")).to_bytes();
    assert_eq!(recording.outcome.as_ref().map(|it| it.ending), Some(Ending::Completed));
    let again = rerun(&recording, controller_of(&recording).unwrap());
    assert!(again.agrees() && again.actions_compared > 300, "{again:?}");
    // A replay recomputes everything but the answers.
    let running = recording.ticks.iter_mut().filter(|tick| tick.phase == Phase::Running);
    running.last().unwrap().voltage_mv += 1;
    let changed = rerun(&recording, controller_of(&recording).unwrap());
    assert_eq!(changed.actions_different, 1);
}

#[test]
fn an_answer_that_the_guard_refused_is_replayed_from_the_outcome() {
    let mut recording = recorded_rollout(classical(ClassicalGains::default()), None);
    recording.policy = Policy::External(External::new("mine")).to_bytes();
    let running = |tick: &TickRecord| tick.phase == Phase::Running;
    let requests = recording.ticks.iter().filter(|tick| running(tick) && tick.wanted_v.is_some());
    let requests = requests.count();
    for last_v in [None, Some(4.5)] {
        recording.outcome.as_mut().unwrap().last_answer_v = last_v;
        let mut controller = controller_of(&recording).unwrap();
        let state = State::default();
        let answers = (0..=requests).map(|_| Controller::voltage_v(&mut controller, &state));
        let last = answers.last().unwrap();
        assert!(last_v.map_or(last.is_nan(), |last_v| last == last_v), "{last}");
    }
}

#[test]
fn a_network_with_a_history_comes_out_again_bit_for_bit() {
    let weights = |inputs: usize, outputs: usize| LayerWeights {
        weight: (0..inputs * outputs).map(|i| (0.7 * i as f32).sin()).collect(),
        bias: vec![0.1; outputs],
    };
    let policy = |newest: f32| {
        let mut layers = [weights(9, 5), weights(5, 1)];
        // The change is in the second neuron, because the output ignores the first (its weight
        // is sin 0).
        layers[0].weight[9 + 6] = newest;
        let network = Network::new(&[9, 5, 1], &layers, 0.05).unwrap();
        Policy::Network(NetworkPolicy { network, training: training_record() })
    };
    let recording = recorded_rollout(policy(0.3), None);
    let mut used = policy(0.3);
    used.applied(4.0);
    let again = rerun(&recording, used);
    assert!(again.agrees(), "{again:?}");
    let other = rerun(&recording, policy(0.31));
    assert!(other.actions_different > 50, "the last command has no effect: {other:?}");
}

#[test]
fn rollouts_with_an_observer_or_a_slow_filter_replay_bit_for_bit() {
    let model = QubeModel {
        nonidealities: Nonidealities { command_delay_s: 0.0037, ..Nonidealities::default() },
        ..QubeModel::NOMINAL
    };
    let fast = recorded_rollout(classical(ClassicalGains::default()), None);
    for estimator in
        [EstimatorSettings::observer(ObserverSettings::of(model)), EstimatorSettings::filter(120.0)]
    {
        let recording = recorded_with(estimator, classical(ClassicalGains::default()), None);
        assert_eq!(recording.header.settings.estimator, estimator);
        let rerun = rerun(&recording, classical(ClassicalGains::default()));
        assert!(rerun.agrees(), "{rerun:?}");
        assert!(rerun.actions_compared > 300);
        // The policy saw other states than under the usual filter.
        let differs = |pair: (&TickRecord, &TickRecord)| pair.0.state != pair.1.state;
        assert!(recording.ticks.iter().zip(&fast.ticks).any(differs));
    }
}

/// A policy that requests the same voltage at all times, 20 times `scale_v`.
fn pushing(scale_v: f32) -> Policy {
    let layer = |inputs: usize, outputs: usize, bias: f32| LayerWeights {
        weight: vec![0.0; inputs * outputs],
        bias: vec![bias; outputs],
    };
    // The output layer is linear with a bias of 20; the tick limits the voltage.
    let network =
        Network::new(&[9, 5, 1], &[layer(9, 5, 0.0), layer(5, 1, 20.0)], scale_v).unwrap();
    Policy::Network(NetworkPolicy { network, training: training_record() })
}

#[test]
fn the_replay_finds_where_foresight_was_nearest_to_ending_the_policy() {
    let guarded = |policy| {
        let mut header: RolloutHeader = header();
        header.settings.safety_box = SafetyBox::GUARDED;
        recorded_under(header, MotorHeat::default(), 0.0, policy, None)
    };
    let first_running = |recording: &Recording| {
        recording.ticks.iter().find(|tick| tick.phase == Phase::Running).unwrap().tick
    };
    // A policy that requests about 0 V stays away from the end.
    let calm = guarded(pushing(1e-6));
    let calm_again = rerun(&calm, pushing(1e-6));
    assert!(calm_again.agrees(), "{calm_again:?}");
    let approach = calm_again.guard_approach.unwrap();
    assert!(approach.foreseen.largest_rad < approach.foreseen.end_rad, "{approach:?}");
    assert!(f64::from(approach.foreseen.largest_rad) >= approach.theta_rad.abs() - 0.01);
    assert!(approach.tick >= first_running(&calm));

    // Foresight ends a policy that pushes to one side, and the nearest tick is the tick that ended
    // it.
    let pushed = guarded(pushing(2.0));
    let again = rerun(&pushed, pushing(2.0));
    assert!(again.agrees(), "{again:?}");
    assert_eq!(again.ending, Some(Ending::LeftBox(Limit::Foresight)));
    let last = pushed
        .ticks
        .iter()
        .find(|tick| tick.tick > first_running(&pushed) && tick.phase == Phase::Braking);
    let approach = again.guard_approach.unwrap();
    assert_eq!(approach.tick, last.unwrap().tick);
    let beyond_rad = approach.foreseen.largest_rad - approach.foreseen.end_rad;
    let told_rad = again.foreseen.unwrap().beyond_rad.unwrap();
    assert!(beyond_rad >= 0.0 && (beyond_rad - told_rad).abs() < 1e-5, "{approach:?}");
    assert_eq!(approach.theta_rad, last.unwrap().state.theta);

    // The box predicts nothing.
    let boxed = recorded_rollout(pushing(1e-6), None);
    assert_eq!(rerun(&boxed, pushing(1e-6)).guard_approach, None);
}

#[test]
fn a_rollout_that_lost_its_link_comes_out_again() {
    let recording = recorded_rollout(classical(ClassicalGains::default()), Some(200));
    let outcome = recording.outcome.clone().unwrap();
    assert_eq!(outcome.ending, Ending::Fault(Fault::LinkGone));
    let rerun = rerun(&recording, classical(ClassicalGains::default()));
    assert!(rerun.agrees(), "{rerun:?}");
    assert_eq!(rerun.ending, Some(outcome.ending));
}

#[test]
fn a_rollout_that_lost_its_link_and_whose_last_ticks_are_missing_differs_in_no_tick() {
    let mut recording = recorded_rollout(classical(ClassicalGains::default()), Some(200));
    recording.ticks.truncate(190);
    assert!(recording.ticks[189].measurement.is_some());
    let rerun = rerun(&recording, classical(ClassicalGains::default()));
    assert_eq!((rerun.actions_compared, rerun.actions_different), (190, 0), "{rerun:?}");
    assert_eq!(rerun.ending, None);
}

/// A policy that requests full voltage of alternating sign, because its first neuron sees the last
/// command.
fn trembling() -> Policy {
    let mut layers = [
        LayerWeights { weight: vec![0.0; 45], bias: vec![0.0; 5] },
        LayerWeights { weight: vec![0.0; 5], bias: vec![0.0] },
    ];
    layers[0].weight[6] = 20.0;
    layers[0].bias[0] = 1.0;
    layers[1].weight[0] = -20.0;
    let network = Network::new(&[9, 5, 1], &layers, 5.0).unwrap();
    Policy::Network(NetworkPolicy { network, training: training_record() })
}

#[test]
fn a_rollout_on_an_overheated_motor_comes_out_again_and_only_from_the_same_heat() {
    let warm = MotorHeat { load: 0.85, ..MotorHeat::default() };
    let recording = recorded_warm(warm, 2.2, EstimatorSettings::default(), trembling(), None);
    let by_heat = Some(Ending::LeftBox(Limit::MotorLoad));
    assert_eq!(recording.outcome.as_ref().map(|outcome| outcome.ending), by_heat);
    assert_eq!(recording.header.motor_heat, Some(warm));
    let again = rerun(&recording, trembling());
    assert!(again.agrees(), "{again:?}");
    assert_eq!(again.ending, by_heat);
    // A header without heat belongs to a recording from before the estimate existed; the replay
    // then ignores the heat.
    let cooler = MotorHeat { load: 0.5, ..warm };
    for heat in [None, Some(cooler)] {
        let mut other = recording.clone();
        other.header.motor_heat = heat;
        let differs = rerun(&other, trembling());
        assert!(differs.actions_different > 0, "{heat:?}: {differs:?}");
    }
}

#[test]
fn another_policy_another_voltage_and_another_sample_are_found() {
    let recording = recorded_rollout(classical(ClassicalGains::default()), None);
    let gains = ClassicalGains::default();
    let other = ClassicalGains { centring_v_per_rad: gains.centring_v_per_rad * 1.001, ..gains };
    let differs = rerun(&recording, classical(other));
    assert!(differs.actions_different > 50 && !differs.agrees(), "{differs:?}");

    let mut changed = recording.clone();
    let place = changed.ticks.iter().rposition(|tick| tick.phase == Phase::Running).unwrap();
    changed.ticks[place].voltage_mv += 1;
    let differs = rerun(&changed, classical(gains));
    assert_eq!(differs.actions_different, 1);
    let first = differs.first_difference.unwrap();
    assert_eq!(first.recorded.tick as usize, place);
    assert_eq!(first.recorded.voltage_mv, first.recomputed.voltage_mv + 1);

    let mut changed = recording;
    changed.ticks[40].measurement =
        Some(Measurement { theta_counts: 500, ..changed.ticks[40].measurement.unwrap() });
    let differs = rerun(&changed, classical(gains));
    assert_eq!(differs.first_difference.unwrap().recorded.tick, 40);
}

#[test]
fn after_missing_ticks_nothing_is_compared() {
    let mut recording = recorded_rollout(classical(ClassicalGains::default()), None);
    let ticks = recording.ticks.len();
    recording.ticks.remove(100);
    let rerun = rerun(&recording, classical(ClassicalGains::default()));
    assert_eq!((rerun.actions_compared, rerun.not_compared), (100, ticks - 101));
    assert_eq!(rerun.actions_different, 0);
    assert!(!rerun.agrees());
}
