//! Motor, arm and pendulum with effects that the library's equations leave out: play between motor
//! and arm, and friction or a cable that yields before it slides. Two studies share this file.

use qube_hil::qube::{EquationsOfMotion, NonidealDynamics, State};

/// Inertia of the motor's rotor with its hub, kg m^2: data sheet of the QUBE-Servo 2.
const ROTOR_INERTIA_KG_M2: f64 = 4.6e-6;

/// Stiffness of the contact between rotor and arm, N m/rad: the rotor vibrates at about 75 Hz.
const CONTACT_N_M_RAD: f64 = 1.0;

/// Damping of the contact between rotor and arm, N m s/rad: the rotor hardly bounces.
const CONTACT_N_M_S_RAD: f64 = 2e-3;

/// Velocity at which friction has reached three quarters of its torque, rad/s.
pub const SLIDING_RAD_S: f64 = 0.05;

/// The mechanics of a Qube, integrated step by step under a voltage.
pub struct Mechanics {
    pub dynamics: NonidealDynamics,
    /// State of arm and pendulum.
    pub state: State,
    /// The motor's angle, rad, and velocity, rad/s; used only with play.
    rotor: [f64; 2],
    /// Angle by which the friction or the cable has yielded, rad.
    given_way_rad: f64,
}

impl Mechanics {
    /// A Qube at rest with the arm at the angle `theta`, rad.
    pub fn at_rest(dynamics: NonidealDynamics, theta: f64) -> Self {
        let state = State { theta, ..State::default() };
        Self { dynamics, state, rotor: [theta, 0.0], given_way_rad: 0.0 }
    }

    /// Angle of the motor, rad, in a Qube with play.
    pub fn motor_rad(&self) -> f64 {
        self.rotor[0]
    }

    /// Integrates one step with play: the motor drives the arm through the contact, friction acts
    /// on the motor, and the cable pulls the arm.
    pub fn step_with_play(&mut self, play_rad: f64, voltage_v: f64, step_s: f64) {
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

    /// Integrates one step with friction that yields like a spring over `distance_rad` before it
    /// slides (Dahl's model).
    pub fn step_with_presliding(&mut self, distance_rad: f64, voltage_v: f64, step_s: f64) {
        let yielded = self.give_way(distance_rad, step_s);
        let friction = self.dynamics.coulomb_torque * yielded / distance_rad;
        self.turn(self.motor_torque(voltage_v) - self.cable_torque() - friction, step_s);
    }

    /// Integrates the angle by which an elastoplastic element is extended, rad, and returns it: it
    /// follows the arm, and slips at its full extension, `distance_rad`.
    pub fn give_way(&mut self, distance_rad: f64, step_s: f64) -> f64 {
        let velocity = self.state.theta_dot;
        let slipping = velocity.abs() * self.given_way_rad / distance_rad;
        self.given_way_rad += step_s * (velocity - slipping);
        self.given_way_rad
    }

    /// Integrates arm and pendulum by the semi-implicit Euler method, under which a stiff contact
    /// gains no energy.
    pub fn turn(&mut self, torque_n_m: f64, step_s: f64) {
        let ideal = &self.dynamics.ideal;
        let acceleration = ideal.acceleration(&self.state, torque_n_m / ideal.torque_per_volt);
        self.state.theta_dot += step_s * acceleration.theta;
        self.state.alpha_dot += step_s * acceleration.alpha;
        self.state.theta += step_s * self.state.theta_dot;
        self.state.alpha += step_s * self.state.alpha_dot;
    }

    /// The motor's torque without the back-EMF, which the arm's equation contains, N m.
    pub fn motor_torque(&self, voltage_v: f64) -> f64 {
        let above = (voltage_v - self.dynamics.positive_dead_zone).max(0.0);
        let below = (voltage_v + self.dynamics.negative_dead_zone).min(0.0);
        self.dynamics.ideal.torque_per_volt * (above + below)
    }

    /// The torque with which the cable pulls the arm back, N m.
    pub fn cable_torque(&self) -> f64 {
        self.dynamics.cable_stiffness * (self.state.theta - self.dynamics.cable_rest)
    }
}
