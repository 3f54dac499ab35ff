use std::collections::VecDeque;

use qube_hil::qube::{HARD_STOP_RAD, NonidealDynamics, State, runge_kutta_4};

use super::beliefs::DrawnQube;

/// Longest integration step, ns: friction at rest is stable with it for every Qube of the beliefs.
const STEP_NS: u64 = 1_000_000;

/// The true Qube: its commands arrive late, its amplifier may be weak, and its arm has stops.
#[derive(Clone)]
pub struct Plant {
    pub state: State,
    pub now_ns: u64,
    /// The largest |theta| so far, rad.
    pub farthest_rad: f64,
    /// Largest |theta| so far that the arm would have reached `ahead_s` later at its velocity, rad.
    pub headed_rad: f64,
    /// Largest speed at which the arm reached a stop, rad/s; `None` if it did not.
    pub hit_rad_s: Option<f64>,
    qube: DrawnQube,
    dynamics: NonidealDynamics,
    delay_ns: u64,
    ahead_s: f64,
    /// Voltage at the motor, V.
    motor_v: f64,
    /// Voltages in transit, V, with their times of arrival, ns.
    under_way: VecDeque<(u64, f64)>,
}

impl Plant {
    /// A Qube in a state; [`Self::headed_rad`] extrapolates over the time `ahead_s`.
    pub fn new(qube: DrawnQube, state: State, ahead_s: f64) -> Self {
        Self {
            state,
            now_ns: 0,
            farthest_rad: state.theta.abs(),
            headed_rad: 0.0,
            hit_rad_s: None,
            dynamics: NonidealDynamics::new(&qube.model),
            delay_ns: (qube.model.nonidealities.command_delay_s * 1e9).round() as u64,
            qube,
            ahead_s,
            motor_v: 0.0,
            under_way: VecDeque::new(),
        }
    }

    /// This Qube without the cable on its arm.
    pub fn without_cable(&self) -> Self {
        let mut free = self.clone();
        free.dynamics.cable_stiffness = 0.0;
        free
    }

    /// Sends the amplifier a voltage at this instant.
    pub fn command(&mut self, voltage_v: f64) {
        let positive = voltage_v > 0.0;
        let share = if positive { self.qube.positive_share } else { self.qube.negative_share };
        self.under_way.push_back((self.now_ns + self.delay_ns, share * voltage_v));
    }

    /// The motor's current, A: its voltage less its back-EMF, divided by its resistance.
    pub fn current_a(&self) -> f64 {
        let motor = &self.qube.model.parameters;
        (self.motor_v - motor.motor_back_emf_v_s * self.state.theta_dot)
            / motor.motor_resistance_ohm
    }

    /// Advances the simulation to this time, ns.
    pub fn go_on_until(&mut self, until_ns: u64) {
        while self.now_ns < until_ns {
            while let Some(&(at_ns, voltage_v)) = self.under_way.front()
                && at_ns <= self.now_ns
            {
                self.motor_v = voltage_v;
                self.under_way.pop_front();
            }
            let next_ns = self.under_way.front().map_or(until_ns, |&(at_ns, _)| at_ns);
            let step_ns = (next_ns.min(until_ns) - self.now_ns).min(STEP_NS);
            let step_s = step_ns as f64 * 1e-9;
            self.state = runge_kutta_4(&self.dynamics, self.state, self.motor_v, step_s);
            self.now_ns += step_ns;
            self.look();
        }
    }

    /// Returns whether the arm is at rest and the pendulum hangs at rest.
    pub fn is_at_rest(&self) -> bool {
        let State { alpha, theta_dot, alpha_dot, .. } = self.state;
        theta_dot.abs() < 0.02
            && alpha_dot.abs() < 0.5
            && alpha.sin().abs() < 0.05
            && alpha.cos() > 0.0
    }

    fn look(&mut self) {
        let State { theta, theta_dot, .. } = self.state;
        self.farthest_rad = self.farthest_rad.max(theta.abs());
        self.headed_rad = self.headed_rad.max((theta + self.ahead_s * theta_dot).abs());
        if theta.abs() >= HARD_STOP_RAD {
            self.hit_rad_s = Some(self.hit_rad_s.unwrap_or(0.0).max(theta_dot.abs()));
            let stop_rad = HARD_STOP_RAD.copysign(theta);
            self.state = self.dynamics.ideal.with_arm_stopped(self.state, stop_rad);
        }
    }
}
