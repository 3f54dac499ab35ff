//! Tests that a pendulum that swings widely but never comes upright is identified, although no
//! model predicts such a motion from one start state.

use super::*;
use crate::qube::{
    NonidealDynamics, Nonidealities, PlantModel, QubeModel, State, control_step, quantised,
};
use crate::replay::{MotionLog, MotionSample};

/// A Qube with friction and a cable, without delay.
fn truth() -> QubeModel {
    let nonidealities = Nonidealities {
        coulomb_torque_n_m: 3e-4,
        cable_stiffness_n_m_rad: 1e-3,
        ..Nonidealities::default()
    };
    QubeModel { nonidealities, ..QubeModel::NOMINAL }
}

/// Eight seconds in which a controller swings the pendulum by this voltage while it is below 1.4
/// rad, and keeps the arm near the middle.
fn swing(pump_v: f64) -> MotionLog {
    let dynamics = NonidealDynamics::new(&truth());
    let mut state = State::<f64> { alpha: 0.2, ..State::default() };
    let samples = (0..800).map(|index| {
        let pump_v = if state.alpha.abs() < 1.4 { pump_v } else { 0.0 };
        let towards = (state.alpha_dot * state.alpha.cos()).signum();
        let centring_v = 6.0 * state.theta + 0.3 * state.theta_dot;
        let voltage_v = (pump_v * towards - centring_v).clamp(-5.0, 5.0);
        let seen = State { theta: quantised(state.theta), alpha: quantised(state.alpha), ..state };
        let sample = MotionSample { time_s: f64::from(index) * 0.01, state: seen, voltage_v };
        state = control_step(&dynamics, state, voltage_v);
        sample
    });
    MotionLog { samples: samples.collect(), plant: PlantModel::QUBE }
}

/// The largest absolute angle in a motion, rad.
fn largest_rad(log: &MotionLog, angle: fn(&State) -> f64) -> f64 {
    log.samples.iter().map(|sample| angle(&sample.state).abs()).fold(0.0, f64::max)
}

#[test]
fn a_wide_swing_below_upright_is_described_by_the_model() {
    let unknowns: Vec<Unknown> = Unknown::all().collect();
    let mut swings = 0;
    for pump_v in (14..30).map(|step| 0.2 * f64::from(step)) {
        let log = swing(pump_v);
        let highest_rad = largest_rad(&log, |state| state.alpha);
        let stays_below = (1.6..2.09).contains(&highest_rad);
        if !stays_below || largest_rad(&log, |state| state.theta) > 2.0 {
            continue;
        }
        swings += 1;
        let found = identify(&[log], &unknowns, &QubeModel::NOMINAL).unwrap();
        println!("{pump_v} V: highest {highest_rad:.2} rad, {:?}", found.scale);
        assert_eq!(found.assessment.verdict, ModelVerdict::Fits, "{pump_v} V");
        if swings == 4 {
            return;
        }
    }
    panic!("only {swings} motions swing widely and stay below upright");
}
