//! The adversary's Qube: the shared equations of motion, with friction and a cable of the arm.

use qube_hil::qube::{DomainParameter, DomainParameters, Dynamics, State, counts, runge_kutta_4};

/// Longest integration step, s.
const STEP_S: f64 = 0.005;

/// Friction and cable of the arm, as the voltages that they take from the motor.
#[derive(Clone, Copy, Debug, Default)]
pub struct Roughness {
    /// Coulomb friction of the arm, V.
    pub coulomb_v: f64,
    /// Stiffness of the encoder's cable, V/rad, on one side of `cable_theta`; its sign gives the
    /// side.
    pub cable_v_rad: f64,
    /// Angle at which the cable begins to pull, rad.
    pub cable_theta: f64,
}

/// A Qube without stops, because the angle that the arm reaches is the result.
pub struct Plant {
    pub state: State,
    /// The largest |theta| so far, rad.
    pub farthest_rad: f64,
    /// Time of the largest |theta|, s.
    pub farthest_at_s: f64,
    dynamics: Dynamics,
    parameters: DomainParameters,
    roughness: Roughness,
    voltage_v: f64,
    time_s: f64,
}

impl Plant {
    /// A Qube at rest at the arm's angle `theta`, rad, each parameter scaled by its entry of
    /// `factors`.
    pub fn new(factors: &[f64; 9], roughness: Roughness, theta: f64) -> Self {
        let mut parameters = DomainParameters::NOMINAL;
        for (parameter, factor) in DomainParameter::ALL.into_iter().zip(factors) {
            parameters.set(parameter, parameters.get(parameter) * factor);
        }
        Self {
            state: State { theta, ..State::default() },
            farthest_rad: 0.0,
            farthest_at_s: 0.0,
            dynamics: Dynamics::new(&parameters),
            parameters,
            roughness,
            voltage_v: 0.0,
            time_s: 0.0,
        }
    }

    /// Advances to `time_s`.
    pub fn advance_to(&mut self, time_s: f64) {
        while self.time_s < time_s - 1e-9 {
            let step_s = STEP_S.min(time_s - self.time_s);
            let voltage_v = self.voltage_v - self.lost_v();
            self.state = runge_kutta_4(&self.dynamics, self.state, voltage_v, step_s);
            self.time_s += step_s;
            if self.state.theta.abs() > self.farthest_rad {
                (self.farthest_rad, self.farthest_at_s) = (self.state.theta.abs(), self.time_s);
            }
        }
    }

    /// Voltage that friction and cable take from the motor, V.
    fn lost_v(&self) -> f64 {
        let Roughness { coulomb_v, cable_v_rad, cable_theta } = self.roughness;
        let past = self.state.theta - cable_theta;
        let pulled = if past * cable_v_rad > 0.0 { cable_v_rad.abs() * past } else { 0.0 };
        // Friction grows over the first 0.1 rad/s, so that it does not shake an arm at rest.
        coulomb_v * (10.0 * self.state.theta_dot).clamp(-1.0, 1.0) + pulled
    }

    pub fn set_voltage(&mut self, voltage_v: f64) {
        self.voltage_v = voltage_v;
    }

    /// The motor's current, A.
    pub fn current_a(&self) -> f32 {
        let back_emf_v = self.parameters.motor_back_emf_v_s * self.state.theta_dot;
        ((self.voltage_v - back_emf_v) / self.parameters.motor_resistance_ohm) as f32
    }

    /// Counts of the two encoders.
    pub fn counts(&self) -> (i32, i32) {
        (counts(self.state.theta), counts(self.state.alpha))
    }
}
