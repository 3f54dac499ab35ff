//! A Qube with what the project's own equations leave out: play between motor and arm, and friction that gives way
//! like a spring before it slides.

use std::collections::VecDeque;

use qube_hil::qube::{
    CONTROL_PERIOD_S, EquationsOfMotion, MAX_HISTORY, NonidealDynamics, QubeModel, State,
    runge_kutta_4,
};

/// A Qube of a table's row.
#[derive(Clone, Copy)]
pub struct Kind {
    pub model: QubeModel,
    pub beyond_the_model: Beyond,
}

/// What of a real Qube the project's equations leave out.
#[derive(Clone, Copy, PartialEq)]
pub enum Beyond {
    Nothing,
    /// Between the motor with its encoder and the arm, rad.
    Play(f64),
    /// How far the friction gives way before it slides, rad: Dahl's model.
    Presliding(f64),
}

/// Integration steps in a control period, of the equations and of stiff contacts.
const STEPS: u32 = 20;
const STIFF_STEPS: u32 = 500;

/// Inertia of the motor's rotor with its hub, kg m^2: data sheet of the Qube-Servo 2.
const ROTOR_INERTIA_KG_M2: f64 = 4.6e-6;

/// Stiffness and damping where the rotor touches the arm: 70 Hz, and a contact that hardly bounces.
const CONTACT_N_M_RAD: f64 = 1.0;
const CONTACT_N_M_S_RAD: f64 = 2e-3;

/// Above this the friction of a motor with play has its whole torque, nearly, rad/s.
const SLIDING_RAD_S: f64 = 0.05;

/// A Qube whose commands arrive late.
pub struct Plant {
    kind: Kind,
    dynamics: NonidealDynamics,
    /// Arm and pendulum.
    state: State,
    /// The motor's angle, rad, and velocity, rad/s: those of the arm where there is no play.
    rotor: [f64; 2],
    /// By how much the friction has given way, rad.
    given_way_rad: f64,
    /// Newest first.
    commands_v: VecDeque<f64>,
}

impl Plant {
    /// At rest with the arm at this angle.
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

    /// The angles that the encoders see, of motor and pendulum, rad.
    pub fn angles(&self) -> [f64; 2] {
        match self.kind.beyond_the_model {
            Beyond::Play(_) => [self.rotor[0], self.state.alpha],
            Beyond::Nothing | Beyond::Presliding(_) => [self.state.theta, self.state.alpha],
        }
    }

    /// One control period after this command, V.
    pub fn advance(&mut self, command_v: f64) {
        self.commands_v.push_front(command_v);
        self.commands_v.truncate(MAX_HISTORY + 2);
        let is_stiff = self.kind.beyond_the_model != Beyond::Nothing;
        let steps = if is_stiff { STIFF_STEPS } else { STEPS };
        let step_s = CONTROL_PERIOD_S / f64::from(steps);
        for step in 0..steps {
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

    /// The motor drives the arm where they touch; friction is the motor's, the cable pulls the arm.
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

    /// Velocities first, then angles with the new ones: a stiff contact gains no energy so.
    fn step_arm(&mut self, torque: f64, step_s: f64) {
        let ideal = &self.dynamics.ideal;
        let acceleration = ideal.acceleration(&self.state, torque / ideal.torque_per_volt);
        self.state.theta_dot += step_s * acceleration.theta;
        self.state.alpha_dot += step_s * acceleration.alpha;
        self.state.theta += step_s * self.state.theta_dot;
        self.state.alpha += step_s * self.state.alpha_dot;
    }

    /// The motor's torque without its back-EMF, which the arm's equation has, N m.
    fn motor_torque(&self, voltage_v: f64) -> f64 {
        let gap = &self.kind.model.nonidealities;
        let above = (voltage_v - gap.positive_dead_zone_v).max(0.0);
        let below = (voltage_v + gap.negative_dead_zone_v).min(0.0);
        self.dynamics.ideal.torque_per_volt * (above + below)
    }

    fn cable_torque(&self) -> f64 {
        self.dynamics.cable_stiffness * (self.state.theta - self.dynamics.cable_rest)
    }
}
