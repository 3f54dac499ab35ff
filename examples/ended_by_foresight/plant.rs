//! A Qube with effects that the library's equations leave out: play between motor and arm, and
//! friction that yields like a spring before it slides.

use std::collections::VecDeque;

use qube_hil::qube::{
    CONTROL_PERIOD_S, EquationsOfMotion, MAX_HISTORY, NonidealDynamics, QubeModel, State,
    runge_kutta_4,
};

/// A Qube to simulate: its model, and an effect that the library's equations leave out.
#[derive(Clone, Copy)]
pub struct Kind {
    pub model: QubeModel,
    pub beyond_the_model: Beyond,
}

/// An effect that the library's equations leave out.
#[derive(Clone, Copy, PartialEq)]
pub enum Beyond {
    Nothing,
    /// Play between motor and arm, rad; the encoder is on the motor's side.
    Play(f64),
    /// Distance over which the friction yields before it slides (Dahl's model), rad.
    Presliding(f64),
}

/// Number of integration steps in a control period.
const STEPS: u32 = 20;

/// Number of integration steps in a control period if contacts or friction are stiff.
const STIFF_STEPS: u32 = 500;

/// Inertia of the motor's rotor with its hub, kg m^2: data sheet of the Qube-Servo 2.
const ROTOR_INERTIA_KG_M2: f64 = 4.6e-6;

/// Stiffness of the contact between rotor and arm, N m/rad: the rotor vibrates at about 75 Hz.
const CONTACT_N_M_RAD: f64 = 1.0;

/// Damping of the contact between rotor and arm, N m s/rad: the rotor hardly bounces.
const CONTACT_N_M_S_RAD: f64 = 2e-3;

/// Velocity at which the friction of a motor with play has reached three quarters of its torque,
/// rad/s.
const SLIDING_RAD_S: f64 = 0.05;

/// A simulated Qube with its command delay and the effect of its kind.
pub struct Plant {
    kind: Kind,
    dynamics: NonidealDynamics,
    /// State of arm and pendulum.
    state: State,
    /// The motor's angle, rad, and velocity, rad/s; used only with play.
    rotor: [f64; 2],
    /// Angle by which the friction has yielded, rad.
    given_way_rad: f64,
    /// Last commands, V, newest first.
    commands_v: VecDeque<f64>,
}

impl Plant {
    /// A Qube at rest with the arm at the angle `theta`, rad.
    pub fn at_rest(kind: &Kind, theta: f64) -> Self {
        Self {
            kind: *kind,
            dynamics: NonidealDynamics::new(&kind.model),
            state: State { theta, ..State::default() },
            rotor: [theta, 0.0],
            given_way_rad: 0.0,
            commands_v: VecDeque::new(),
        }
    }

    /// The angles that the two encoders measure, rad.
    pub fn angles(&self) -> [f64; 2] {
        match self.kind.beyond_the_model {
            Beyond::Play(_) => [self.rotor[0], self.state.alpha],
            Beyond::Nothing | Beyond::Presliding(_) => [self.state.theta, self.state.alpha],
        }
    }

    /// Advances by one control period with this command, V.
    pub fn advance(&mut self, command_v: f64) {
        self.commands_v.push_front(command_v);
        self.commands_v.truncate(MAX_HISTORY + 2);
        let is_stiff = self.kind.beyond_the_model != Beyond::Nothing;
        let steps = if is_stiff { STIFF_STEPS } else { STEPS };
        let step_s = CONTROL_PERIOD_S / f64::from(steps);
        for step in 0..steps {
            // The voltage that acts at this instant was sent `sent_s` after the start of this
            // period, or before the start if `sent_s` is negative.
            let sent_s =
                (f64::from(step) + 0.5) * step_s - self.kind.model.nonidealities.command_delay_s;
            let age = (-sent_s / CONTROL_PERIOD_S).ceil().max(0.0) as usize;
            let voltage_v = self.commands_v.get(age).copied().unwrap_or(0.0);
            match self.kind.beyond_the_model {
                Beyond::Nothing => {
                    self.state = runge_kutta_4(&self.dynamics, self.state, voltage_v, step_s);
                }
                Beyond::Play(play_rad) => self.step_with_play(play_rad, voltage_v, step_s),
                Beyond::Presliding(distance_rad) => {
                    self.step_with_presliding(distance_rad, voltage_v, step_s);
                }
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
        self.step_arm(contact - self.cable_torque(), step_s);
        let friction = self.dynamics.coulomb_torque * (velocity / SLIDING_RAD_S).tanh();
        let torque = self.motor_torque(voltage_v) - friction - contact;
        let velocity = velocity + step_s * torque / ROTOR_INERTIA_KG_M2;
        self.rotor = [angle + step_s * velocity, velocity];
    }

    fn step_with_presliding(&mut self, distance_rad: f64, voltage_v: f64, step_s: f64) {
        let velocity = self.state.theta_dot;
        let slipping = velocity.abs() * self.given_way_rad / distance_rad;
        self.given_way_rad += step_s * (velocity - slipping);
        let friction = self.dynamics.coulomb_torque * self.given_way_rad / distance_rad;
        let torque = self.motor_torque(voltage_v) - self.cable_torque() - friction;
        self.step_arm(torque, step_s);
    }

    /// Integrates arm and pendulum by the semi-implicit Euler method, under which a stiff contact
    /// gains no energy.
    fn step_arm(&mut self, torque: f64, step_s: f64) {
        let ideal = &self.dynamics.ideal;
        let acceleration = ideal.acceleration(&self.state, torque / ideal.torque_per_volt);
        self.state.theta_dot += step_s * acceleration.theta;
        self.state.alpha_dot += step_s * acceleration.alpha;
        self.state.theta += step_s * self.state.theta_dot;
        self.state.alpha += step_s * self.state.alpha_dot;
    }

    /// The motor's torque without the back-EMF, which the arm's equation contains, N m.
    fn motor_torque(&self, voltage_v: f64) -> f64 {
        let nonidealities = &self.kind.model.nonidealities;
        let above = (voltage_v - nonidealities.positive_dead_zone_v).max(0.0);
        let below = (voltage_v + nonidealities.negative_dead_zone_v).min(0.0);
        self.dynamics.ideal.torque_per_volt * (above + below)
    }

    fn cable_torque(&self) -> f64 {
        self.dynamics.cable_stiffness * (self.state.theta - self.dynamics.cable_rest)
    }
}
