//! The discrete linear-quadratic regulator of the nominal Qube, for tests of the gains that were
//! computed with it.

use nalgebra::{Matrix4, RowVector4, Vector4};

use super::{DomainParameters, Dynamics, State, control_step};

/// The gains k of the state feedback V = -k (s - [0, `alpha_rad`, 0, 0]) that minimises the sum of
/// s' Q s + R V^2 at 100 Hz, on the nominal parameters linearised about rest at `alpha_rad`. `q` is
/// the diagonal of Q.
pub fn lqr_gains(alpha_rad: f64, q: [f64; 4], r: f64) -> [f64; 4] {
    let (a, b) = linearised(alpha_rad);
    let weights = Matrix4::from_diagonal(&Vector4::from(q));
    let mut cost = weights;
    let mut gains = RowVector4::zeros();
    // The Riccati equation, iterated to its fixed point.
    for _ in 0..5000 {
        gains = (b.transpose() * cost * a) / (r + (b.transpose() * cost * b)[0]);
        cost = weights + a.transpose() * cost * (a - b * gains);
    }
    std::array::from_fn(|entry| gains[entry])
}

/// The derivatives of a nominal Qube's state after one period, with respect to the state and the
/// voltage before it, around rest with the pendulum at `alpha_rad`.
fn linearised(alpha_rad: f64) -> (Matrix4<f64>, Vector4<f64>) {
    const STEP: f64 = 1e-4;
    let dynamics = Dynamics::<f64>::new(&DomainParameters::NOMINAL);
    let next = |change: [f64; 4], voltage_v: f64| {
        let [theta, alpha, theta_dot, alpha_dot] = change;
        let state = State { theta, alpha: alpha_rad + alpha, theta_dot, alpha_dot };
        let State { theta, alpha, theta_dot, alpha_dot } =
            control_step(&dynamics, state, voltage_v);
        Vector4::new(theta, alpha, theta_dot, alpha_dot)
    };
    let slope = |of: &dyn Fn(f64) -> Vector4<f64>| (of(STEP) - of(-STEP)) / (2.0 * STEP);
    let columns: [Vector4<f64>; 4] = std::array::from_fn(|entry| {
        slope(&|change| {
            let mut changes = [0.0; 4];
            changes[entry] = change;
            next(changes, 0.0)
        })
    });
    (Matrix4::from_columns(&columns), slope(&|volts| next([0.0; 4], volts)))
}
