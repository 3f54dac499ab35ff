//! A simulated Qube that may have effects which the library's equations leave out. The library
//! cannot import this file, so identification knows nothing of these effects.

use std::collections::VecDeque;

use qube_hil::qube::{
    CONTROL_PERIOD_S, EquationsOfMotion, NonidealDynamics, QubeModel, State, quantised,
};

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
}

impl Beyond {
    /// The name in tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::Nothing => "nothing",
            Self::Play(_) => "play",
            Self::Presliding(_) => "presliding",
            Self::Hysteresis(..) => "hysteresis",
            Self::Warming(_) => "warming",
            Self::Eccentric(_) => "eccentric",
        }
    }
}

/// Number of integration steps in a control period.
const STEPS: u32 = 400;

/// Inertia of the motor's rotor with its hub, kg m^2: data sheet of the QUBE-Servo 2.
const ROTOR_INERTIA_KG_M2: f64 = 4.6e-6;

/// Stiffness of the contact between rotor and arm, N m/rad: the rotor vibrates at about 75 Hz.
const CONTACT_N_M_RAD: f64 = 1.0;

/// Damping of the contact between rotor and arm, N m s/rad: the rotor hardly bounces.
const CONTACT_N_M_S_RAD: f64 = 2e-3;

/// Velocity at which friction has reached three quarters of its torque, rad/s.
const SLIDING_RAD_S: f64 = 0.05;

/// A simulated Qube with its command delay and at most one effect outside the model class.
pub struct Plant {
    model: QubeModel,
    beyond: Beyond,
    dynamics: NonidealDynamics,
    /// State of arm and pendulum.
    state: State,
    /// The motor's angle, rad, and velocity, rad/s; used only with play.
    rotor: [f64; 2],
    /// Angle by which the friction or the cable has yielded, rad.
    given_way_rad: f64,
    /// Time since the start, s; the motor warms with it.
    time_s: f64,
    /// Last commands, V, newest first.
    commands_v: VecDeque<f64>,
}

impl Plant {
    /// A Qube at rest with the arm at the angle `theta`, rad.
    pub fn at_rest(model: &QubeModel, beyond: Beyond, theta: f64) -> Self {
        Self {
            model: *model,
            beyond,
            dynamics: NonidealDynamics::new(model),
            state: State { theta, ..State::default() },
            rotor: [theta, 0.0],
            given_way_rad: 0.0,
            time_s: 0.0,
            commands_v: VecDeque::new(),
        }
    }

    /// The angles that the encoders count, with the true velocities.
    pub fn measured(&self) -> State {
        let theta = match self.beyond {
            Beyond::Play(_) => self.rotor[0],
            Beyond::Eccentric(amplitude_rad) => {
                self.state.theta + amplitude_rad * (self.state.theta + 0.7).sin()
            }
            _ => self.state.theta,
        };
        State { theta: quantised(theta), alpha: quantised(self.state.alpha), ..self.state }
    }

    /// Advances by one control period with this command, V.
    pub fn advance(&mut self, command_v: f64) {
        self.commands_v.push_front(command_v);
        self.commands_v.truncate(8);
        let step_s = CONTROL_PERIOD_S / f64::from(STEPS);
        if let Beyond::Warming(share) = self.beyond {
            let mut warm = self.model;
            warm.parameters.motor_resistance_ohm *= 1.0 + share * self.time_s / 10.0;
            self.dynamics = NonidealDynamics::new(&warm);
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
        let velocity = self.state.theta_dot;
        match self.beyond {
            Beyond::Play(play_rad) => self.step_with_play(play_rad, voltage_v, step_s),
            Beyond::Presliding(distance_rad) => {
                self.give_way(distance_rad, step_s);
                let friction = self.dynamics.coulomb_torque * self.given_way_rad / distance_rad;
                self.turn(self.motor_torque(voltage_v) - self.cable_torque() - friction, step_s);
            }
            Beyond::Hysteresis(torque_n_m, distance_rad) => {
                self.give_way(distance_rad, step_s);
                let lag = torque_n_m * self.given_way_rad / distance_rad;
                let friction = self.friction(velocity);
                let torque = self.motor_torque(voltage_v) - self.cable_torque() - lag - friction;
                self.turn(torque, step_s);
            }
            Beyond::Nothing | Beyond::Warming(_) | Beyond::Eccentric(_) => {
                let friction = self.friction(velocity);
                self.turn(self.motor_torque(voltage_v) - self.cable_torque() - friction, step_s);
            }
        }
    }

    /// Integrates one step with play: the motor drives the arm through the contact, friction acts
    /// on the motor, and the cable pulls the arm.
    fn step_with_play(&mut self, play_rad: f64, voltage_v: f64, step_s: f64) {
        let [angle, velocity] = self.rotor;
        let apart = angle - self.state.theta;
        let pressed = apart - apart.clamp(-0.5 * play_rad, 0.5 * play_rad);
        let closing = velocity - self.state.theta_dot;
        let damping = if pressed == 0.0 { 0.0 } else { CONTACT_N_M_S_RAD * closing };
        let contact = CONTACT_N_M_RAD * pressed + damping;
        self.turn(contact - self.cable_torque(), step_s);
        let friction = self.dynamics.coulomb_torque * (velocity / SLIDING_RAD_S).tanh();
        let torque = self.motor_torque(voltage_v) - friction - contact;
        let velocity = velocity + step_s * torque / ROTOR_INERTIA_KG_M2;
        self.rotor = [angle + step_s * velocity, velocity];
    }

    /// Integrates the angle by which an elastoplastic element is extended: it follows the arm, and
    /// slips at its full extension, `distance_rad`.
    fn give_way(&mut self, distance_rad: f64, step_s: f64) {
        let velocity = self.state.theta_dot;
        let slipping = velocity.abs() * self.given_way_rad / distance_rad;
        self.given_way_rad += step_s * (velocity - slipping);
    }

    /// Integrates arm and pendulum by the semi-implicit Euler method, under which a stiff contact
    /// gains no energy.
    fn turn(&mut self, torque_n_m: f64, step_s: f64) {
        let ideal = &self.dynamics.ideal;
        let acceleration = ideal.acceleration(&self.state, torque_n_m / ideal.torque_per_volt);
        self.state.theta_dot += step_s * acceleration.theta;
        self.state.alpha_dot += step_s * acceleration.alpha;
        self.state.theta += step_s * self.state.theta_dot;
        self.state.alpha += step_s * self.state.alpha_dot;
    }

    /// The torque of friction against this velocity, N m, by the library's law.
    fn friction(&self, velocity: f64) -> f64 {
        let x = velocity / SLIDING_RAD_S;
        self.dynamics.coulomb_torque * x / (1.0 / 3.0 + x.abs())
    }

    /// The motor's torque without the back-EMF, which the arm's equation contains, N m.
    fn motor_torque(&self, voltage_v: f64) -> f64 {
        let dead = &self.dynamics;
        let above = (voltage_v - dead.positive_dead_zone).max(0.0);
        let below = (voltage_v + dead.negative_dead_zone).min(0.0);
        dead.ideal.torque_per_volt * (above + below)
    }

    fn cable_torque(&self) -> f64 {
        self.dynamics.cable_stiffness * (self.state.theta - self.dynamics.cable_rest)
    }
}
