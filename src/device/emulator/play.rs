//! Backlash between the motor and the arm.

use crate::qube::{EquationsOfMotion, NonidealDynamics, State, runge_kutta_4};

/// Inertia of the motor's rotor and hub, kg m^2 (data sheet of the QUBE-Servo 2: 4.0e-6 and
/// 0.6e-6): the part of the arm's inertia that is on the motor's side of the backlash.
const ROTOR_INERTIA_KG_M2: f64 = 4.6e-6;

/// Largest share of a light arm's inertia that is assigned to the rotor.
const LARGEST_ROTOR_SHARE: f64 = 0.2;

/// Backlash through which the motor turns the arm.
///
/// The motor's side has the rotor's inertia, the damping and the friction; the arm's side has the
/// remaining inertia, the cable, and the encoder with its tachometer. While the motor touches
/// either end of the play, both sides move together, exactly like a Qube without backlash. Contact
/// begins with an inelastic impact. The encoder is assumed to be on the arm's side: while the motor
/// crosses the play, the control loop sees an arm that rests or moves freely.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Play {
    half_play_rad: f64,
    motor_rad: f64,
    motor_rad_s: f64,
    /// End of the play at which the motor touches the arm: 1 where it pushes towards positive
    /// theta, -1 at the other end; `None` inside the play.
    contact: Option<f64>,
}

impl Play {
    /// Backlash of width `play_rad`, rad, with the motor in the middle of the play, at the arm's
    /// velocity.
    pub(super) fn new(play_rad: f64, arm: &State) -> Self {
        let (motor_rad, motor_rad_s) = (arm.theta, arm.theta_dot);
        Self { half_play_rad: 0.5 * play_rad, motor_rad, motor_rad_s, contact: None }
    }

    /// Velocity of the motor, rad/s, which determines its back EMF.
    pub(super) fn motor_rad_s(&self) -> f64 {
        self.motor_rad_s
    }

    /// Integrates both sides for `step_s`, s; returns the state of arm and pendulum.
    pub(super) fn step(
        &mut self,
        whole: &NonidealDynamics,
        before: State,
        voltage_v: f64,
        step_s: f64,
    ) -> State {
        let rotor_inertia = ROTOR_INERTIA_KG_M2.min(LARGEST_ROTOR_SHARE * whole.ideal.arm_inertia);
        let arm = arm_alone(whole, rotor_inertia);
        if let Some(side) = self.contact {
            // The contact pushes and cannot pull: both move together only while the arm alone would
            // fall behind.
            let together = whole.acceleration(&before, voltage_v).theta;
            if side * (together - arm.acceleration(&before, 0.0).theta) >= 0.0 {
                let after = runge_kutta_4(whole, before, voltage_v, step_s);
                self.follow(&after);
                return after;
            }
            self.contact = None;
        }
        let after = runge_kutta_4(&arm, before, 0.0, step_s);
        self.turn_motor(whole, rotor_inertia, voltage_v, step_s);
        self.apply_impact(&arm, rotor_inertia, after)
    }

    /// Places a motor in contact at its end of the play, with the arm's velocity, for a new state
    /// of the arm; a motor inside the play stays where it is.
    pub(super) fn follow(&mut self, state: &State) {
        if let Some(side) = self.contact {
            self.motor_rad = state.theta + side * self.half_play_rad;
            self.motor_rad_s = state.theta_dot;
        }
    }

    /// Moves the motor inside the play. Friction is applied last and never reverses the velocity;
    /// in an explicit step it would, because the rotor's inertia is so small.
    fn turn_motor(
        &mut self,
        whole: &NonidealDynamics,
        rotor_inertia: f64,
        voltage_v: f64,
        step_s: f64,
    ) {
        let push_v = (voltage_v - whole.positive_dead_zone).max(0.0)
            + (voltage_v + whole.negative_dead_zone).min(0.0);
        let torque =
            whole.ideal.torque_per_volt * push_v - whole.ideal.arm_damping * self.motor_rad_s;
        let driven_rad_s = self.motor_rad_s + step_s / rotor_inertia * torque;
        let lost_rad_s = step_s / rotor_inertia * whole.coulomb_torque;
        self.motor_rad_s = driven_rad_s.signum() * (driven_rad_s.abs() - lost_rad_s).max(0.0);
        self.motor_rad += step_s * self.motor_rad_s;
    }

    /// Applies the impact when the motor has reached an end of the play; returns the state after
    /// it.
    fn apply_impact(&mut self, arm: &NonidealDynamics, rotor_inertia: f64, state: State) -> State {
        let ahead_rad = self.motor_rad - state.theta;
        if ahead_rad.abs() < self.half_play_rad {
            return state;
        }
        let side = ahead_rad.signum();
        self.contact = Some(side);
        let closing_rad_s = self.motor_rad_s - state.theta_dot;
        let mut after = state;
        if side * closing_rad_s > 0.0 {
            // The impact conserves m12 theta' + m22 alpha' (m is the mass matrix), because the
            // pendulum swings freely about its bearing.
            let (sin, cos) = libm::sincos(state.alpha);
            let coupling = arm.ideal.coupling * cos;
            let arm_inertia = arm.ideal.arm_inertia + arm.ideal.quarter_inertia * sin * sin
                - coupling * coupling / arm.ideal.pendulum_inertia;
            let gained_rad_s = closing_rad_s * rotor_inertia / (rotor_inertia + arm_inertia);
            after.theta_dot += gained_rad_s;
            after.alpha_dot -= coupling / arm.ideal.pendulum_inertia * gained_rad_s;
        }
        self.follow(&after);
        after
    }
}

/// Arm, pendulum and cable without the motor.
fn arm_alone(whole: &NonidealDynamics, rotor_inertia: f64) -> NonidealDynamics {
    let mut arm = *whole;
    arm.ideal.arm_inertia -= rotor_inertia;
    arm.ideal.arm_damping = 0.0;
    arm.ideal.torque_per_volt = 0.0;
    arm.coulomb_torque = 0.0;
    arm
}

#[cfg(test)]
mod tests {
    use crate::device::emulator::{EmulatedPlant, EmulatorSettings};
    use crate::qube::{HARD_STOP_RAD, Nonidealities, QubeModel, RAD_PER_COUNT};

    fn plant(play_rad: f64, nonidealities: Nonidealities) -> EmulatedPlant {
        let model = QubeModel { nonidealities, ..QubeModel::NOMINAL };
        EmulatedPlant::new(&EmulatorSettings { model, play_rad, ..EmulatorSettings::default() })
    }

    fn friction() -> Nonidealities {
        Nonidealities { coulomb_torque_n_m: 5e-4, ..Nonidealities::default() }
    }

    #[test]
    fn the_arm_waits_until_the_motor_has_crossed_the_play_and_then_follows() {
        let (mut with, mut without) = (plant(0.0175, friction()), plant(0.0, friction()));
        let start = with.state().theta;
        for plant in [&mut with, &mut without] {
            plant.set_voltage(0.5);
        }
        with.advance_to(3_000);
        assert_eq!(with.state().theta, start);
        for plant in [&mut with, &mut without] {
            plant.advance_to(200_000);
        }
        let behind = without.state().theta - with.state().theta;
        assert!((0.0..0.06).contains(&behind), "{behind} rad behind");
        assert!((with.state().theta_dot - without.state().theta_dot).abs() < 0.5);
    }

    #[test]
    fn a_motor_that_turns_back_crosses_the_play_before_it_moves_the_arm() {
        let mut plant = plant(0.0175, friction());
        plant.set_voltage(0.4);
        plant.advance_to(300_000);
        plant.set_voltage(0.0);
        plant.advance_to(8_000_000);
        let rests = plant.state().theta;
        // The push is so slow that nothing coasts: the motor crosses the play and then takes the
        // arm along.
        plant.set_voltage(-0.104);
        let mut first_us = None;
        for time_us in (8_000_000..9_000_000).step_by(1_000) {
            plant.advance_to(time_us);
            if first_us.is_none() && (plant.state().theta - rests).abs() > RAD_PER_COUNT {
                first_us = Some(time_us);
            }
        }
        let first_us = first_us.expect("the motor moves the arm");
        assert!((8_010_000..8_400_000).contains(&first_us), "at {first_us} us");
        assert!(plant.state().theta < rests);
    }

    #[test]
    fn play_gives_no_energy_and_the_stops_hold() {
        for play_rad in [0.004, 0.0175] {
            let mut plant = plant(play_rad, friction());
            for (from_s, voltage_v) in [(0, 5.0), (1, -5.0), (2, 0.0)] {
                plant.set_voltage(voltage_v);
                for time_us in (from_s * 1_000_000..(from_s + 1) * 1_000_000).step_by(1_000) {
                    plant.advance_to(time_us);
                    assert!(plant.state().theta.abs() <= HARD_STOP_RAD);
                }
            }
            plant.advance_to(40_000_000);
            let state = plant.state();
            assert!(state.theta_dot.abs() < 0.2 && state.alpha_dot.abs() < 0.5, "{state:?}");
        }
    }
}
