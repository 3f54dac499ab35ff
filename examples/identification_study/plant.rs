//! A simulated Qube that may have effects which the library's equations leave out. Identification
//! can import neither this file nor the emulated Qube, so it cannot contain these effects.

use std::collections::VecDeque;

use qube_hil::device::emulator::{Effects, EmulatedPlant, EmulatorSettings};
use qube_hil::qube::{
    CONTROL_PERIOD_NS, CONTROL_PERIOD_S, NonidealDynamics, QubeModel, State, quantised,
};

use crate::mechanics::{Mechanics, SLIDING_RAD_S};

/// An effect outside the model class.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Beyond {
    /// No effect: the plant is of the model class.
    Nothing,
    /// Play between the motor with its encoder and the arm, rad.
    Play(f64),
    /// Friction that yields like a spring over this angle before it slides (Dahl's model), rad.
    Presliding(f64),
    /// Cable whose torque lags behind its angle: largest torque of the lagging part, N m, and the
    /// angle over which that torque builds up, rad.
    Hysteresis(f64, f64),
    /// Motor whose resistance grows by this share of its value in a recording of 10 s.
    Warming(f64),
    /// Arm encoder off its centre: amplitude of its error, rad.
    Eccentric(f64),
    /// An effect of the emulated Qube of a form for which the verdict does not look, with its name.
    OtherForm(&'static str, Effects),
}

/// The name of a plant without an effect.
pub const NOTHING: &str = "nothing";

impl Beyond {
    /// The same plant without its effect.
    pub fn without(self) -> Self {
        match self {
            Self::OtherForm(..) => Self::OtherForm(NOTHING, Effects::NONE),
            _ => Self::Nothing,
        }
    }

    /// The name in tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::Nothing => NOTHING,
            Self::Play(_) => "play",
            Self::Presliding(_) => "presliding",
            Self::Hysteresis(..) => "hysteresis",
            Self::Warming(_) => "warming",
            Self::Eccentric(_) => "eccentric",
            Self::OtherForm(name, _) => name,
        }
    }
}

/// Number of integration steps in a control period.
pub const STEPS: u32 = 400;

/// Length of an integration step, s.
fn step_s() -> f64 {
    CONTROL_PERIOD_S / f64::from(STEPS)
}

/// A Qube with its command delay and at most one effect outside the model class.
pub enum Plant {
    /// A Qube that this file simulates.
    Simulated(Box<SimulatedPlant>),
    /// The emulated Qube, with the time at which its next period begins, us.
    Emulated(Box<EmulatedPlant>, u64),
}

impl Plant {
    /// A Qube at rest with the arm at the angle `theta`, rad. An emulated Qube is released there
    /// 20 s earlier, because its effects may move it.
    pub fn at_rest(model: &QubeModel, beyond: Beyond, theta: f64) -> Self {
        let Beyond::OtherForm(_, effects) = beyond else {
            return Self::Simulated(Box::new(SimulatedPlant::at_rest(model, beyond, theta)));
        };
        let start = Some(State { theta, ..State::default() });
        let settings =
            EmulatorSettings { model: *model, effects, start, ..EmulatorSettings::default() };
        let mut plant = Box::new(EmulatedPlant::new(&settings));
        plant.advance_to(SETTLING_US);
        Self::Emulated(plant, SETTLING_US)
    }

    /// The angles that the encoders count, with the true velocities.
    pub fn measured(&self) -> State {
        match self {
            Self::Simulated(plant) => plant.measured(),
            Self::Emulated(plant, _) => {
                let State { theta, alpha, .. } = plant.state();
                State { theta: quantised(theta), alpha: quantised(alpha), ..plant.state() }
            }
        }
    }

    /// Advances by one control period with this command, V.
    pub fn advance(&mut self, command_v: f64) {
        match self {
            Self::Simulated(plant) => plant.advance(command_v),
            Self::Emulated(plant, time_us) => {
                plant.set_voltage(command_v);
                *time_us += CONTROL_PERIOD_NS / 1000;
                plant.advance_to(*time_us);
            }
        }
    }
}

/// Time in which an emulated Qube comes to rest, us.
const SETTLING_US: u64 = 20_000_000;

/// A simulated Qube whose effects this file and its mechanics contain.
pub struct SimulatedPlant {
    model: QubeModel,
    beyond: Beyond,
    mechanics: Mechanics,
    /// Time since the start, s; the motor warms with it.
    time_s: f64,
    /// Last commands, V, newest first.
    commands_v: VecDeque<f64>,
}

impl SimulatedPlant {
    fn at_rest(model: &QubeModel, beyond: Beyond, theta: f64) -> Self {
        Self {
            model: *model,
            beyond,
            mechanics: Mechanics::at_rest(NonidealDynamics::new(model), theta),
            time_s: 0.0,
            commands_v: VecDeque::new(),
        }
    }

    fn measured(&self) -> State {
        let state = self.mechanics.state;
        // The semi-implicit Euler method moves the angles half a step early, which would be as much
        // as the standard error of a delay.
        let early_s = 0.5 * step_s();
        let arm_rad = state.theta - early_s * state.theta_dot;
        let theta = match self.beyond {
            // The contact takes the motor along, so that it mostly has the arm's velocity.
            Beyond::Play(_) => self.mechanics.motor_rad() - early_s * state.theta_dot,
            Beyond::Eccentric(amplitude_rad) => arm_rad + amplitude_rad * (arm_rad + 0.7).sin(),
            _ => arm_rad,
        };
        let alpha = state.alpha - early_s * state.alpha_dot;
        State { theta: quantised(theta), alpha: quantised(alpha), ..state }
    }

    fn advance(&mut self, command_v: f64) {
        self.commands_v.push_front(command_v);
        self.commands_v.truncate(8);
        let step_s = step_s();
        if let Beyond::Warming(share) = self.beyond {
            let mut warm = self.model;
            warm.parameters.motor_resistance_ohm *= 1.0 + share * self.time_s / 10.0;
            self.mechanics.dynamics = NonidealDynamics::new(&warm);
        }
        for step in 0..STEPS {
            let sent_s =
                (f64::from(step) + 0.5) * step_s - self.model.nonidealities.command_delay_s;
            let age = (-sent_s / CONTROL_PERIOD_S).ceil().max(0.0) as usize;
            let voltage_v = self.commands_v.get(age).copied().unwrap_or(0.0);
            self.step(voltage_v, step_s);
        }
        self.time_s += CONTROL_PERIOD_S;
    }

    fn step(&mut self, voltage_v: f64, step_s: f64) {
        let friction = self.friction();
        let mechanics = &mut self.mechanics;
        match self.beyond {
            Beyond::Play(play_rad) => mechanics.step_with_play(play_rad, voltage_v, step_s),
            Beyond::Presliding(distance_rad) => {
                mechanics.step_with_presliding(distance_rad, voltage_v, step_s);
            }
            Beyond::Hysteresis(torque_n_m, distance_rad) => {
                let lag = torque_n_m * mechanics.give_way(distance_rad, step_s) / distance_rad;
                let torque = mechanics.motor_torque(voltage_v) - mechanics.cable_torque();
                mechanics.turn(torque - lag - friction, step_s);
            }
            Beyond::Nothing | Beyond::Warming(_) | Beyond::Eccentric(_) | Beyond::OtherForm(..) => {
                let torque = mechanics.motor_torque(voltage_v) - mechanics.cable_torque();
                mechanics.turn(torque - friction, step_s);
            }
        }
    }

    /// The torque of friction against the arm's velocity, N m, by the library's law.
    fn friction(&self) -> f64 {
        let x = self.mechanics.state.theta_dot / SLIDING_RAD_S;
        self.mechanics.dynamics.coulomb_torque * x / (1.0 / 3.0 + x.abs())
    }
}
