use std::collections::VecDeque;

use firmware_protocol::scaling::{
    CURRENT_COUNTS_PER_A, CURRENT_ZERO, TACHOMETER_COUNTS_S_TICKS, TACHOMETER_NEGATIVE,
    TACHOMETER_STILL,
};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::effects::{ActingEffects, EFFECTS_STEP_US};
use super::fault_progress::{FaultProgress, TrueReadings};
use super::play::Play;
use super::{EmulatorSettings, Finger};
use crate::qube::{Encoder, Encoders, NonidealDynamics, QubeModel, State, runge_kutta_4};

/// Longest integration step, us: the error is 6e-6 rad at the worst speeds of a swing-up, 1/500 of
/// an encoder count.
const MAX_STEP_US: u64 = 5_000;

/// Longest step while something stops arm or pendulum (a hard stop or a hand), us: each such step
/// ends in an impact, and finer steps keep the arm in place.
const CONTACT_STEP_US: u64 = 500;

/// Longest step of an arm with backlash, us: the instants at which motor and arm meet and part must
/// be resolved.
const PLAY_STEP_US: u64 = 250;

/// Largest distance of the arm from its middle at a start that the seed determines, rad.
const START_RANGE_RAD: f64 = 1.0;

/// Capacity of the queue of commands in transit: 0.64 s of acts at 100 Hz. A command that finds the
/// queue full displaces the oldest.
const COMMANDS_UNDER_WAY: usize = 64;

/// Random stream of the jitter, separate so that the jitter does not change the initial state.
const JITTER_STREAM: u64 = 2;

/// Largest absolute start value of the counters, counts.
const START_COUNTS: i32 = 10_000;

/// The mechanics and electronics of a Qube: a voltage goes in, counts and readings come out.
///
/// An amplifier that is off is modelled as 0 V at the motor, which brakes by its back EMF. The
/// behaviour of a real amplifier is not published.
#[derive(Clone, Debug)]
pub struct EmulatedPlant {
    model: QubeModel,
    command_jitter_s: f64,
    jitter: ChaCha8Rng,
    dynamics: NonidealDynamics,
    state: State,
    /// Largest speed at which the arm has touched a stop, rad/s.
    hardest_touch_rad_s: f64,
    play: Option<Play>,
    effects: Option<ActingEffects>,
    /// Longest step while the arm touches nothing, us.
    longest_step_us: u64,
    voltage_v: f64,
    /// Voltages in transit to the motor: arrival time, us, and voltage, V, in order.
    under_way: VecDeque<(u64, f64)>,
    time_us: u64,
    theta_offset_counts: i32,
    alpha_offset_counts: i32,
    finger: Option<Finger>,
    next_finger_us: u64,
    arm_blocked: bool,
    motor_is_open: bool,
    /// Resistance of the motor as a multiple of its cold one.
    resistance_factor: f64,
    stops_rad: [f64; 2],
    encoders: Encoders,
    fault_progress: FaultProgress,
}

impl EmulatedPlant {
    /// A Qube in the initial state of the settings. If they name none, the Qube is at rest with a
    /// hanging pendulum, and the seed determines the arm's angle. The seed also determines the
    /// counters' start values.
    #[must_use]
    pub fn new(settings: &EmulatorSettings) -> Self {
        let EmulatorSettings {
            model,
            command_jitter_s,
            seed,
            play_rad,
            effects,
            start,
            finger,
            ..
        } = *settings;
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut jitter = random.clone();
        jitter.set_stream(JITTER_STREAM);
        let [lowest_rad, highest_rad] = settings.stops_rad;
        let theta = random.random_range(-START_RANGE_RAD..=START_RANGE_RAD);
        let theta = theta.max(lowest_rad).min(highest_rad);
        let dynamics = NonidealDynamics::new(&model);
        let state = start.unwrap_or(State { theta, ..State::default() });
        let play = (play_rad > 0.0).then(|| Play::new(play_rad, &state));
        let effects = ActingEffects::new(effects, &model.parameters);
        let mut longest_step_us =
            if play.is_some() { PLAY_STEP_US } else { accurate_step_us(&dynamics) };
        if effects.is_some() {
            longest_step_us = longest_step_us.min(EFFECTS_STEP_US);
        }
        let mut plant = Self {
            model,
            command_jitter_s,
            jitter,
            longest_step_us,
            dynamics,
            play,
            effects,
            state,
            hardest_touch_rad_s: 0.0,
            voltage_v: 0.0,
            under_way: VecDeque::with_capacity(COMMANDS_UNDER_WAY),
            time_us: 0,
            theta_offset_counts: random.random_range(-START_COUNTS..=START_COUNTS),
            alpha_offset_counts: random.random_range(-START_COUNTS..=START_COUNTS),
            finger,
            next_finger_us: finger.map_or(u64::MAX, |finger| finger.from_us.max(1)),
            arm_blocked: false,
            motor_is_open: false,
            resistance_factor: 1.0,
            stops_rad: settings.stops_rad,
            encoders: settings.encoders,
            fault_progress: FaultProgress::new(settings.fault),
        };
        plant.advance_fault();
        plant
    }

    fn advance_fault(&mut self) {
        while self.fault_progress.next_us().is_some_and(|next_us| next_us <= self.time_us) {
            let Some(share) = self.fault_progress.advance_stage(self.true_readings()) else {
                continue;
            };
            self.model.parameters.motor_resistance_ohm /= share;
            self.dynamics = NonidealDynamics::new(&self.model);
        }
    }

    /// Advances the time to `time_us` since the start, us; a time in the past changes nothing.
    pub fn advance_to(&mut self, time_us: u64) {
        while self.time_us < time_us {
            while let Some(&(arrives_us, voltage_v)) = self.under_way.front()
                && arrives_us <= self.time_us
            {
                self.voltage_v = voltage_v;
                self.under_way.pop_front();
            }
            self.push_by_finger();
            let until_us = self.under_way.front().map_or(time_us, |next| next.0.min(time_us));
            let until_us = until_us.min(self.next_finger_us);
            self.advance_fault();
            let until_us =
                self.fault_progress.next_us().map_or(until_us, |next_us| next_us.min(until_us));
            let longest_us = if self.touches() || self.fault_progress.holds_pendulum() {
                CONTACT_STEP_US.min(self.longest_step_us)
            } else {
                self.longest_step_us
            };
            let step_us = longest_us.min(until_us - self.time_us);
            self.dynamics.cable_rest =
                self.model.nonidealities.cable_rest_after(self.time_us as f64 * 1e-6);
            let before = self.state;
            let step_s = step_us as f64 * 1e-6;
            self.warm(step_s);
            self.push_by_effects(0.5 * step_s);
            let (equations, torque_factor) = match &self.effects {
                None => (self.dynamics, 1.0),
                Some(effects) => {
                    let torque_factor = effects.torque_factor(before.theta);
                    (effects.equations(&self.dynamics, torque_factor), torque_factor)
                }
            };
            let push_v = self.fault_progress.driven_v(self.voltage_v)
                + self.fault_progress.push_equivalent_v() / torque_factor;
            self.state = match &mut self.play {
                None => runge_kutta_4(&equations, self.state, push_v, step_s),
                Some(play) => play.step(&equations, self.state, push_v, step_s),
            };
            self.push_by_effects(0.5 * step_s);
            self.time_us += step_us;
            if self.fault_progress.holds_pendulum() {
                self.state = self.dynamics.ideal.with_pendulum_stopped(self.state, before.alpha);
                if let Some(play) = &mut self.play {
                    play.follow(&self.state);
                }
            }
            if self.arm_blocked {
                self.stop_arm_at(before.theta);
            } else if let Some(stop_rad) = self.stop_beyond(self.state.theta) {
                self.hardest_touch_rad_s = self.hardest_touch_rad_s.max(self.state.theta_dot.abs());
                self.stop_arm_at(stop_rad);
            }
        }
        self.advance_fault();
    }

    /// Lets the torques of the effects act for `step_s`, s. Half of each step before the motion and
    /// half after it leave no shift in time.
    fn push_by_effects(&mut self, step_s: f64) {
        let Some(effects) = &mut self.effects else { return };
        self.state = effects.push(&self.dynamics, self.state, step_s);
        if let Some(play) = &mut self.play {
            play.follow(&self.state);
        }
    }

    /// The current through the motor, (V - k_m theta') / R_m, A. The push of a hand counts as a
    /// torque and not as a voltage here, and with backlash the motor has a velocity of its own.
    fn current_a(&self) -> f64 {
        if self.motor_is_open {
            return 0.0;
        }
        let motor_rad_s = self.play.map_or(self.state.theta_dot, |play| play.motor_rad_s());
        let back_emf_v = self.model.parameters.motor_back_emf_v_s * motor_rad_s;
        let driven_v = self.fault_progress.driven_v(self.voltage_v);
        (driven_v - back_emf_v) / self.motor_resistance_ohm()
    }

    fn motor_resistance_ohm(&self) -> f64 {
        self.resistance_factor * self.model.parameters.motor_resistance_ohm
    }

    /// Adjusts the motor's resistance to the temperature of its winding after `step_s`, s.
    fn warm(&mut self, step_s: f64) {
        let loss_w = self.current_a().powi(2) * self.motor_resistance_ohm();
        let Some(effects) = self.effects.as_mut().filter(|_| !self.motor_is_open) else { return };
        let factor = effects.resistance_factor(loss_w, step_s);
        if factor != 1.0 {
            let mut warm = self.model;
            warm.parameters.motor_resistance_ohm *= factor;
            self.resistance_factor = factor;
            let cable_rest = self.dynamics.cable_rest;
            self.dynamics = NonidealDynamics::new(&warm);
            self.dynamics.cable_rest = cable_rest;
        }
    }

    /// The angle of the stop that an arm at this angle would have passed, rad; `None` between the
    /// stops.
    fn stop_beyond(&self, theta: f64) -> Option<f64> {
        let [lowest_rad, highest_rad] = self.stops_rad;
        if theta < lowest_rad {
            Some(lowest_rad)
        } else {
            (theta > highest_rad).then_some(highest_rad)
        }
    }

    /// Moves the arm as hand and finger do: carries it to its positive stop at the first time, and
    /// later pushes it off a stop from which it is at most ten counts away.
    fn push_by_finger(&mut self) {
        let Some(finger) = self.finger.filter(|_| self.time_us >= self.next_finger_us) else {
            return;
        };
        let is_carried = self.next_finger_us == finger.from_us.max(1);
        self.next_finger_us += finger.every_us.max(1);
        let state = self.state;
        let [lowest_rad, highest_rad] = self.stops_rad;
        let rad_per_count = self.encoders.theta.rad_per_count();
        let near_rad = 10.0 * rad_per_count;
        let is_at_stop =
            state.theta <= lowest_rad + near_rad || state.theta >= highest_rad - near_rad;
        if is_carried {
            self.state = State { theta: highest_rad, theta_dot: 0.0, ..state };
        } else if is_at_stop {
            let off_rad = f64::from(finger.counts) * rad_per_count;
            self.state.theta = state.theta - off_rad.copysign(state.theta);
            self.state.theta_dot = 0.0;
        }
    }

    fn touches(&self) -> bool {
        let [lowest_rad, highest_rad] = self.stops_rad;
        self.arm_blocked || self.state.theta <= lowest_rad || self.state.theta >= highest_rad
    }

    fn stop_arm_at(&mut self, theta: f64) {
        self.state = self.dynamics.ideal.with_arm_stopped(self.state, theta);
        if let Some(play) = &mut self.play {
            play.follow(&self.state);
        }
    }

    /// Sets the motor's voltage, V, which takes effect after the delay and its jitter.
    pub fn set_voltage(&mut self, voltage_v: f64) {
        let jitter_s = self.command_jitter_s;
        let late_s =
            if jitter_s > 0.0 { self.jitter.random_range(-jitter_s..=jitter_s) } else { 0.0 };
        let delay_us =
            ((self.model.nonidealities.command_delay_s + late_s).max(0.0) * 1e6).round() as u64;
        if delay_us == 0 && self.under_way.is_empty() {
            self.voltage_v = voltage_v;
            return;
        }
        // Commands share one wire: none overtakes another.
        let last_us = self.under_way.back().map_or(0, |last| last.0);
        if self.under_way.len() == COMMANDS_UNDER_WAY {
            self.under_way.pop_front();
        }
        self.under_way.push_back(((self.time_us + delay_us).max(last_us), voltage_v));
    }

    /// Holds the arm at its current angle permanently.
    pub fn block_arm(&mut self) {
        self.arm_blocked = true;
        self.stop_arm_at(self.state.theta);
    }

    /// Opens the motor's circuit permanently: no current flows, so there is neither torque nor
    /// braking by the back EMF.
    pub fn disconnect_motor(&mut self) {
        self.motor_is_open = true;
        self.dynamics.ideal.torque_per_volt = 0.0;
        self.dynamics.ideal.arm_damping = self.model.parameters.rotary_damping_n_m_s;
    }

    /// The true state, which the wire does not show.
    #[must_use]
    pub fn state(&self) -> State {
        self.state
    }

    /// The largest speed at which the arm has touched one of its stops so far, rad/s.
    #[must_use]
    pub fn hardest_touch_rad_s(&self) -> f64 {
        self.hardest_touch_rad_s
    }

    /// Count of the arm's encoder.
    #[must_use]
    pub fn theta_counts(&self) -> i32 {
        self.fault_progress.readings(self.true_readings()).theta_counts
    }

    /// Count of the pendulum's encoder.
    #[must_use]
    pub fn alpha_counts(&self) -> i32 {
        self.fault_progress.readings(self.true_readings()).alpha_counts
    }

    /// The 24-bit register of the tachometer: the time in which the arm's encoder counts four, in
    /// units of 25 ns, and the direction.
    #[must_use]
    pub fn tachometer_raw(&self) -> u32 {
        self.fault_progress.readings(self.true_readings()).tachometer_raw
    }

    /// The readings of intact encoders.
    fn true_readings(&self) -> TrueReadings {
        let Encoders { theta, alpha } = self.encoders;
        let counted_rad = match &self.effects {
            None => self.state.theta,
            Some(effects) => effects.counted_theta(self.state.theta),
        };
        TrueReadings {
            theta_counts: theta.counts(counted_rad).wrapping_add(self.theta_offset_counts),
            alpha_counts: alpha.counts(self.state.alpha).wrapping_add(self.alpha_offset_counts),
            tachometer_raw: tachometer_register(theta, self.state.theta_dot),
            pendulum_tachometer_raw: tachometer_register(alpha, self.state.alpha_dot),
        }
    }

    /// The motor current as the Qube's converter reads it, in the converter's counts.
    #[must_use]
    pub fn current_raw(&self) -> u16 {
        let raw = f64::from(CURRENT_ZERO) + self.current_a() * f64::from(CURRENT_COUNTS_PER_A);
        raw.round().clamp(0.0, f64::from(u16::MAX)) as u16
    }
}

/// The tachometer's register at a velocity of this encoder's axis, rad/s.
fn tachometer_register(encoder: Encoder, rad_s: f64) -> u32 {
    let counts_s = rad_s / encoder.rad_per_count();
    let interval = f64::from(TACHOMETER_COUNTS_S_TICKS) / counts_s.abs();
    if interval >= f64::from(TACHOMETER_STILL) {
        return TACHOMETER_STILL;
    }
    let direction = if counts_s < 0.0 { TACHOMETER_NEGATIVE } else { 0 };
    direction | interval.round().max(1.0) as u32
}

/// The longest step, us, with which friction near rest is integrated accurately.
fn accurate_step_us(dynamics: &NonidealDynamics) -> u64 {
    MAX_STEP_US.min((dynamics.accurate_step_s() * 1e6) as u64).max(1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::emulator::Effects;
    use crate::qube::{HARD_STOP_RAD, Nonidealities, Profile, RAD_PER_COUNT, control_step};
    use firmware_protocol::scaling::{current_ma, tachometer_counts_s};

    fn nominal(seed: u64) -> EmulatedPlant {
        EmulatedPlant::new(&EmulatorSettings { seed, ..EmulatorSettings::default() })
    }

    #[test]
    fn a_motor_that_warms_lets_the_cable_drift_and_draws_less_current() {
        let mut model = QubeModel::NOMINAL;
        model.nonidealities.cable_stiffness_n_m_rad = 1e-3;
        model.nonidealities.cable_drift_rad_per_min = 0.6;
        let effects = Effects { warming_per_w: 0.05, ..Effects::NONE };
        let settings = EmulatorSettings { model, effects, ..EmulatorSettings::default() };
        let mut plant = EmulatedPlant::new(&settings);
        plant.block_arm();
        plant.set_voltage(5.0);
        plant.advance_to(30_000_000);
        let drift_rad = plant.dynamics.cable_rest - model.nonidealities.cable_rest_rad;
        assert!((drift_rad - 0.3).abs() < 1e-3, "{drift_rad} rad");
        let cold_a = 5.0 / model.parameters.motor_resistance_ohm;
        assert!((0.5..0.99).contains(&(plant.current_a() / cold_a)), "{} A", plant.current_a());
    }

    #[test]
    fn an_arm_that_creeps_and_sticks_moves_by_its_equations() {
        let model = Profile::lab().model().scaled(1.5);
        let model = QubeModel {
            nonidealities: Nonidealities { command_delay_s: 0.0, ..model.nonidealities },
            ..model
        };
        let start = Some(State { theta: -0.8, ..State::default() });
        let settings = EmulatorSettings { model, start, ..EmulatorSettings::default() };
        let mut plant = EmulatedPlant::new(&settings);
        let equations = NonidealDynamics::new(&model);
        let mut state = plant.state();
        let mut farthest_rad = 0.0_f64;
        for tick in 0..300_u64 {
            let voltage_v = 0.9 * (tick as f64 / 12.0).sin();
            plant.set_voltage(voltage_v);
            plant.advance_to((tick + 1) * 10_000);
            for _ in 0..200 {
                state = runge_kutta_4(&equations, state, voltage_v, 5e-5);
            }
            farthest_rad = farthest_rad.max((plant.state().theta - state.theta).abs());
        }
        assert!(farthest_rad < 0.2 * RAD_PER_COUNT, "{farthest_rad} rad");
    }

    #[test]
    fn the_seed_determines_the_position_at_rest() {
        let mut starts = Vec::new();
        for seed in 0..50 {
            let mut plant = nominal(seed);
            let start = plant.state();
            assert!(start.theta.abs() <= START_RANGE_RAD);
            plant.advance_to(1_000_000);
            assert_eq!(plant.state(), start);
            starts.push((start.theta.to_bits(), plant.theta_counts(), plant.alpha_counts()));
        }
        assert_eq!(
            starts,
            (0..50)
                .map(nominal)
                .map(|plant| {
                    (plant.state().theta.to_bits(), plant.theta_counts(), plant.alpha_counts())
                })
                .collect::<Vec<_>>()
        );
        starts.dedup();
        assert_eq!(starts.len(), 50);
    }

    #[test]
    fn the_plant_moves_by_the_shared_physics_with_any_time_steps() {
        let (mut whole, mut cut) = (nominal(3), nominal(3));
        let mut reference = whole.state();
        for tick in 1..=50_u64 {
            let voltage_v = if tick % 10 < 5 { 4.0 } else { -4.0 };
            whole.set_voltage(voltage_v);
            cut.set_voltage(voltage_v);
            whole.advance_to(tick * 10_000);
            cut.advance_to(tick * 10_000 - 9_137);
            cut.advance_to(tick * 10_000 - 20);
            cut.advance_to(tick * 10_000);
            reference = control_step(&whole.dynamics.ideal, reference, voltage_v);
        }
        for state in [whole.state(), cut.state()] {
            assert!((state.theta - reference.theta).abs() < 1e-5);
            assert!((state.alpha - reference.alpha).abs() < 1e-5);
        }
    }

    #[test]
    fn the_arm_never_passes_its_stops_and_rests_against_them() {
        for voltage_v in [5.0, -5.0] {
            let mut plant = nominal(1);
            plant.set_voltage(voltage_v);
            for step in 1..=20_000_u64 {
                plant.advance_to(step * 1_000);
                assert!(plant.state().theta.abs() <= HARD_STOP_RAD);
            }
            let state = plant.state();
            assert!((state.theta - HARD_STOP_RAD.copysign(voltage_v)).abs() < 1e-3, "{state:?}");
            assert!(state.theta_dot.abs() < 0.1, "{state:?}");
        }
    }

    #[test]
    fn a_blocked_arm_draws_the_current_of_a_stalled_motor() {
        let mut plant = nominal(1);
        plant.block_arm();
        plant.set_voltage(4.2);
        let theta = plant.state().theta;
        plant.advance_to(500_000);
        assert_eq!(plant.state().theta, theta);
        assert_eq!(current_ma(plant.current_raw()), 500);
        assert_eq!(tachometer_counts_s(plant.tachometer_raw()), 0);
    }

    #[test]
    fn a_motor_without_a_circuit_draws_nothing_and_moves_nothing() {
        let mut plant = nominal(1);
        plant.disconnect_motor();
        plant.set_voltage(5.0);
        let start = plant.state();
        plant.advance_to(500_000);
        assert_eq!((plant.state(), current_ma(plant.current_raw())), (start, 0));
    }

    #[test]
    fn the_tachometer_agrees_with_the_counter() {
        for voltage_v in [3.0, -3.0] {
            let mut plant = nominal(2);
            plant.set_voltage(voltage_v);
            plant.advance_to(60_000);
            let tachometer = f64::from(tachometer_counts_s(plant.tachometer_raw()));
            let exact = plant.state().theta_dot / RAD_PER_COUNT;
            assert!(exact.abs() > 100.0);
            assert!((tachometer - exact).abs() <= 1.0 + 1e-3 * exact.abs());
        }
    }

    #[test]
    fn a_drifting_cable_moves_the_arm_at_its_drift_rate() {
        let rests_after = |seed: u64, cable_drift_rad_per_min: f64| {
            let nonidealities = Nonidealities {
                cable_stiffness_n_m_rad: 1e-3,
                cable_rest_rad: -0.4,
                cable_drift_rad_per_min,
                ..Nonidealities::default()
            };
            let model = QubeModel { nonidealities, ..QubeModel::NOMINAL };
            let mut plant =
                EmulatedPlant::new(&EmulatorSettings { model, seed, ..Default::default() });
            [2, 7].map(|minutes| {
                plant.advance_to(minutes * 60_000_000);
                plant.state().theta
            })
        };
        for seed in 0..3 {
            for (drift, expected) in
                [(0.0, [-0.4, -0.4]), (0.03, [-0.34, -0.19]), (-0.1, [-0.6, -1.1])]
            {
                let rests = rests_after(seed, drift);
                assert_eq!(rests, rests_after(seed, drift));
                for (rest, expected) in rests.iter().zip(expected) {
                    assert!((rest - expected).abs() < 2e-3, "{drift} rad/min: {rests:?}");
                }
            }
        }
    }

    #[test]
    fn a_command_arrives_after_its_delay_and_none_overtakes_another() {
        let with = |command_delay_s, command_jitter_s| {
            let nonidealities = Nonidealities { command_delay_s, ..Nonidealities::default() };
            let model = QubeModel { nonidealities, ..QubeModel::NOMINAL };
            EmulatedPlant::new(&EmulatorSettings {
                model,
                command_jitter_s,
                ..EmulatorSettings::default()
            })
        };
        let mut plant = with(0.0123, 0.0);
        let start = plant.state();
        plant.set_voltage(3.0);
        plant.advance_to(12_300);
        assert_eq!(plant.state(), start);
        plant.advance_to(13_000);
        assert!(plant.state().theta > start.theta);

        let mut plant = with(0.005, 0.005);
        for command in 1..=100_u64 {
            plant.set_voltage(command as f64 * 0.01);
            let before_v = plant.voltage_v;
            plant.advance_to(command * 1_000);
            assert!(plant.voltage_v >= before_v && plant.under_way.len() <= 11);
        }
        plant.advance_to(200_000);
        assert_eq!(plant.voltage_v, 1.0);
    }
}
