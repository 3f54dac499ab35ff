use crate::control::{Motion, Tick, TickInput};
use crate::policy::{Controller, Policy, PolicyFault};
use crate::recording::Recording;
use crate::safety::{Foreseen, ForeseenAngle, Guard};
use crate::scoring::return_of;
use crate::telemetry::{Ending, Fault, Phase, TickRecord};

/// The result of a replay: the recorded decisions compared with the recomputed ones.
#[derive(Clone, Debug, PartialEq)]
pub struct Rerun {
    /// Return from the recorded states and voltages of all ticks of the file; at most 600 in a
    /// rollout of 600 steps.
    pub return_recorded: f64,
    /// Return from the recomputed states and voltages of the compared ticks.
    pub return_recomputed: f64,
    /// Number of ticks whose decision was compared.
    pub actions_compared: usize,
    /// Number of ticks that decided differently: the voltage wanted or sent, the phase or the state
    /// differs.
    pub actions_different: usize,
    /// First tick that decided differently.
    pub first_difference: Option<Difference>,
    /// Number of ticks that could not be compared because earlier ones are missing.
    pub not_compared: usize,
    /// Ending of the rollout: the recomputed one, or the recorded one where `ending_of_the_file` is
    /// set. `None` if the last compared tick ends nothing, as where ticks are missing at the end or
    /// before.
    pub ending: Option<Ending>,
    /// Recomputed prediction for which foresight ended the rollout; `None` if foresight did not end
    /// it.
    pub foreseen: Option<Foreseen>,
    /// Recomputed tick at which foresight was nearest to ending the policy; `None` if the guard was
    /// not foresight, or if no policy ran.
    pub guard_approach: Option<GuardApproach>,
    /// Whether the rollout braked under [`Guard::Envelope`], a guard of old recordings that this
    /// program cannot compute: ticks from the first braking tick on are not compared, and the
    /// ending is the file's.
    pub ending_of_the_file: bool,
}

/// The tick at which foresight was nearest to ending the policy, or ended it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GuardApproach {
    /// Number of the tick.
    pub tick: u32,
    /// Angle of the arm in that tick, rad.
    pub theta_rad: f64,
    /// Angle that foresight predicted for the voltage of that tick and the brake after it.
    pub foreseen: ForeseenAngle,
}

/// One tick that decided differently.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Difference {
    /// The tick as the file has it.
    pub recorded: TickRecord,
    /// The tick as it was recomputed.
    pub recomputed: TickRecord,
}

impl Rerun {
    /// Whether every tick was compared that this program can compute, and every decision and the
    /// return came out again, bit for bit.
    #[must_use]
    pub fn agrees(&self) -> bool {
        self.actions_different == 0
            && self.not_compared == 0
            && self.return_recorded.to_bits() == self.return_recomputed.to_bits()
    }
}

/// The controller that drove a recording: the policy attached to it, or for an external controller
/// one that repeats the recorded answers.
///
/// # Errors
/// The attachment is not a policy.
pub fn controller_of(recording: &Recording) -> Result<Policy, PolicyFault> {
    let Policy::External(external) = Policy::from_bytes(&recording.policy)? else {
        return Policy::from_bytes(&recording.policy);
    };
    let running = recording.ticks.iter().filter(|tick| tick.phase == Phase::Running);
    // An answer that the guard refused is in no running tick: the guard replaces it, and the tick's
    // phase is then braking. The outcome holds that last answer.
    let last_v = recording.outcome.as_ref().and_then(|outcome| outcome.last_answer_v);
    let answers_v = running.filter_map(|tick| tick.wanted_v).chain(last_v);
    Ok(Policy::External(external.answering(answers_v.collect())))
}

/// Feeds the recorded measurements and times to the tick that ran on the machine, and compares its
/// decisions with the recorded ones. `policy` is the controller that drove the rollout;
/// [`controller_of`] gives it.
///
/// The comparison ends where ticks are missing, because the recorder had no room for them or a
/// block of the file is damaged: the state of the filters depends on every earlier tick. It also
/// ends where a rollout under [`Guard::Envelope`] brakes, because this program cannot compute that
/// guard and its brake.
#[must_use]
pub fn rerun(recording: &Recording, policy: impl Controller) -> Rerun {
    let mut tick = Tick::new(&recording.header.settings, policy);
    let outcome_ending = recording.outcome.as_ref().map(|outcome| outcome.ending);
    let ended_by = |fault| outcome_ending == Some(Ending::Fault(fault));
    let knows_guard = recording.header.settings.safety_box.guard != Guard::Envelope;
    let is_known = |tick: &&TickRecord| knows_guard || tick.phase != Phase::Braking;
    let known = recording.ticks.iter().take_while(is_known).count();
    let ticks = &recording.ticks[..known];
    let ending_of_the_file = known < recording.ticks.len();
    let whole = ticks.iter().zip(0..).take_while(|(tick, number)| tick.tick == *number);
    let compared: Vec<&TickRecord> = whole.map(|(tick, _)| tick).collect();

    let mut heat = recording.header.motor_heat;
    let mut voltage_mv = 0;
    let mut recomputed = Vec::with_capacity(compared.len());
    let mut ending = None;
    let mut guard_approach: Option<GuardApproach> = None;
    for (index, recorded) in compared.iter().enumerate() {
        let is_last = index + 1 == recording.ticks.len();
        let output = tick.decide(&TickInput {
            deadline_ns: recorded.deadline_ns,
            lateness_ns: recorded.lateness_ns,
            skipped_periods: recorded.skipped_periods,
            stop_requested: recorded.stop_requested,
            measurement: recorded.measurement,
            // A recording has no fields for these two events. They happen only in the last tick,
            // because they end the rollout, and the outcome names them.
            link_gone: is_last && ended_by(Fault::LinkGone),
            board_restarted: is_last && ended_by(Fault::BoardRestarted),
            motor_overheated: heat.is_some_and(|heat| heat.is_overheated()),
        });
        if let Some(heat) = &mut heat {
            let measurement = recorded.measurement.as_ref();
            heat.pass(recorded.skipped_periods, measurement, voltage_mv, output.state.theta_dot);
        }
        voltage_mv = output.voltage_mv;
        if let Some(foreseen) = tick.foreseen_angle()
            && guard_approach.is_none_or(|it| foreseen.largest_rad > it.foreseen.largest_rad)
        {
            let theta_rad = output.state.theta;
            guard_approach = Some(GuardApproach { tick: recorded.tick, theta_rad, foreseen });
        }
        recomputed.push(TickRecord {
            phase: output.phase,
            state: output.state,
            wanted_v: output.wanted_v,
            voltage_mv: output.voltage_mv,
            ..**recorded
        });
        ending = output.ending;
    }

    let differences: Vec<Difference> = compared
        .iter()
        .zip(&recomputed)
        .filter(|(recorded, recomputed)| !same_decision(recorded, recomputed))
        .map(|(recorded, recomputed)| Difference { recorded: **recorded, recomputed: *recomputed })
        .collect();
    Rerun {
        return_recorded: return_of(&recording.ticks, &recording.header.reward),
        return_recomputed: return_of(&recomputed, &recording.header.reward),
        actions_compared: compared.len(),
        actions_different: differences.len(),
        first_difference: differences.first().copied(),
        not_compared: known - compared.len(),
        foreseen: tick.foreseen(),
        guard_approach,
        ending: if ending_of_the_file { outcome_ending } else { ending },
        ending_of_the_file,
    }
}

fn same_decision(a: &TickRecord, b: &TickRecord) -> bool {
    let bits = |tick: &TickRecord| {
        let state = tick.state;
        let numbers = [state.theta, state.alpha, state.theta_dot, state.alpha_dot];
        (tick.phase, tick.voltage_mv, numbers.map(number_bits), tick.wanted_v.map(number_bits))
    };
    bits(a) == bits(b)
}

/// The bits of a number, with one value for all NaN: the processor chooses which NaN an operation
/// gives, and no NaN is ever sent to the motor.
fn number_bits(number: f64) -> u64 {
    if number.is_nan() { f64::NAN.to_bits() } else { number.to_bits() }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::estimation::{EstimatorSettings, ObserverSettings};
    use crate::policy::{
        ClassicalController, ClassicalGains, Controller, External, LayerWeights, Network,
        NetworkPolicy, Policy, SimulatedGuard, SimulatedSensors, TrainingRecord,
    };
    use crate::qube::{
        CONTROL_PERIOD_NS, DomainParameters, Dynamics, Measurement, Nonidealities, PlantModel,
        QubeModel, RAD_PER_COUNT, State, Status, control_step, counts,
    };
    use crate::recording::samples::{POLICY, header, outcome};
    use crate::recording::{RolloutWriter, parse};
    use crate::safety::{Limit, MotorHeat, SafetyBox};
    use crate::telemetry::{RolloutHeader, RolloutOutcome};

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

    /// A rollout on an ideal plant, as the reader gives it. Every 13th sample is lost.
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

    /// The rollout of [`recorded_rollout`] on a warm motor that draws `current_factor` times the
    /// nominal current.
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

    /// The rollout of [`recorded_warm`] with the settings of this header.
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
                link_gone,
                motor_overheated,
                ..TickInput::default()
            };
            let output = tick.decide(&input);
            heat.pass(0, measurement.as_ref(), voltage_mv, output.state.theta_dot);
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
            plant = control_step(&dynamics, plant, f64::from(output.voltage_mv) / 1000.0);
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
        let asked = recording.ticks.iter().filter(|tick| running(tick) && tick.wanted_v.is_some());
        let asked = asked.count();
        for last_v in [None, Some(4.5)] {
            recording.outcome.as_mut().unwrap().last_answer_v = last_v;
            let mut controller = controller_of(&recording).unwrap();
            let state = State::default();
            let answers = (0..=asked).map(|_| Controller::voltage_v(&mut controller, &state));
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
        assert!(other.actions_different > 50, "the last command plays no part: {other:?}");
    }

    #[test]
    fn rollouts_with_an_observer_or_a_slow_filter_replay_bit_for_bit() {
        let model = QubeModel {
            nonidealities: Nonidealities { command_delay_s: 0.0037, ..Nonidealities::default() },
            ..QubeModel::NOMINAL
        };
        let fast = recorded_rollout(classical(ClassicalGains::default()), None);
        for estimator in [
            EstimatorSettings::observer(ObserverSettings::of(model)),
            EstimatorSettings::filter(120.0),
        ] {
            let recording = recorded_with(estimator, classical(ClassicalGains::default()), None);
            assert_eq!(recording.header.settings.estimator, estimator);
            let rerun = rerun(&recording, classical(ClassicalGains::default()));
            assert!(rerun.agrees(), "{rerun:?}");
            assert!(rerun.actions_compared > 300);
            // The policy saw states other than under the usual filter.
            let differs = |pair: (&TickRecord, &TickRecord)| pair.0.state != pair.1.state;
            assert!(recording.ticks.iter().zip(&fast.ticks).any(differs));
        }
    }

    /// A policy that asks for the same voltage at all times.
    fn pushing(voltage_v: f32) -> Policy {
        let layer = |inputs: usize, outputs: usize, bias: f32| LayerWeights {
            weight: vec![0.0; inputs * outputs],
            bias: vec![bias; outputs],
        };
        // The output layer is linear with a bias of 20, so the policy asks for 20 times
        // `voltage_v`; the tick limits the voltage.
        let network =
            Network::new(&[9, 5, 1], &[layer(9, 5, 0.0), layer(5, 1, 20.0)], voltage_v).unwrap();
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
        // A policy that asks for about 0 V stays away from the end.
        let calm = guarded(pushing(1e-6));
        let calm_again = rerun(&calm, pushing(1e-6));
        assert!(calm_again.agrees(), "{calm_again:?}");
        let approach = calm_again.guard_approach.unwrap();
        assert!(approach.foreseen.largest_rad < approach.foreseen.end_rad, "{approach:?}");
        assert!(f64::from(approach.foreseen.largest_rad) >= approach.theta_rad.abs() - 0.01);
        assert!(approach.tick >= first_running(&calm));

        // Foresight ends a policy that pushes to one side, and the nearest tick is the one that
        // ended it.
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

    /// A policy that asks for full voltage of alternating sign, because its first neuron sees the
    /// last command.
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
        let by_heat = Some(Ending::Fault(Fault::MotorOverheated));
        assert_eq!(recording.outcome.as_ref().map(|outcome| outcome.ending), by_heat);
        assert_eq!(recording.header.motor_heat, Some(warm));
        let again = rerun(&recording, trembling());
        assert!(again.agrees(), "{again:?}");
        assert_eq!(again.ending, by_heat);
        // A header without heat is that of a recording older than the estimate; the replay then
        // ignores the heat.
        let mut older = recording;
        older.header.motor_heat = None;
        let other = rerun(&older, trembling());
        assert!(other.actions_different > 0, "{other:?}");
    }

    #[test]
    fn another_policy_and_another_voltage_are_found() {
        let recording = recorded_rollout(classical(ClassicalGains::default()), None);
        let gains = ClassicalGains::default();
        let other =
            ClassicalGains { centring_v_per_rad: gains.centring_v_per_rad * 1.001, ..gains };
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
    fn behind_missing_ticks_nothing_is_compared() {
        let mut recording = recorded_rollout(classical(ClassicalGains::default()), None);
        let ticks = recording.ticks.len();
        recording.ticks.remove(100);
        let rerun = rerun(&recording, classical(ClassicalGains::default()));
        assert_eq!((rerun.actions_compared, rerun.not_compared), (100, ticks - 101));
        assert_eq!(rerun.actions_different, 0);
        assert!(!rerun.agrees());
    }
}
