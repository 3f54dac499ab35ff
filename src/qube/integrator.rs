use super::{CONTROL_PERIOD_S, EquationsOfMotion, State};
use crate::elementary::Scalar;

/// Runge-Kutta steps in one control period.
///
/// With three, a control period ends within 1e-6 rad of a reference with steps 200 times finer,
/// over the whole range of a swing-up: a pendulum that falls from upright passes the bottom at 21
/// rad/s (tested below). With two steps this holds only up to 13 rad/s.
pub const SUBSTEPS: usize = 3;

/// Returns the state after one control period of 10 ms at constant voltage, V, by [`SUBSTEPS`]
/// Runge-Kutta steps.
#[inline(always)]
pub fn control_step<T: Scalar>(
    dynamics: &impl EquationsOfMotion<T>,
    state: State<T>,
    voltage_v: T,
) -> State<T> {
    let step_s = T::from_f64(CONTROL_PERIOD_S / SUBSTEPS as f64);
    let mut state = state;
    for _ in 0..SUBSTEPS {
        state = runge_kutta_4(dynamics, state, voltage_v, step_s);
    }
    state
}

/// Returns the state after one classical fourth-order Runge-Kutta step of `step_s` seconds at
/// constant voltage, V.
#[inline(always)]
pub fn runge_kutta_4<T: Scalar>(
    dynamics: &impl EquationsOfMotion<T>,
    state: State<T>,
    voltage_v: T,
    step_s: T,
) -> State<T> {
    let half = T::from_f64(0.5) * step_s;
    let rate = |at: &State<T>| {
        let acceleration = dynamics.acceleration(at, voltage_v);
        State {
            theta: at.theta_dot,
            alpha: at.alpha_dot,
            theta_dot: acceleration.theta,
            alpha_dot: acceleration.alpha,
        }
    };
    let k1 = rate(&state);
    let k2 = rate(&moved(&state, &k1, half));
    let k3 = rate(&moved(&state, &k2, half));
    let k4 = rate(&moved(&state, &k3, step_s));
    let sixth = step_s * T::from_f64(1.0 / 6.0);
    let two = T::from_f64(2.0);
    let mean = |a: T, b: T, c: T, d: T| two.mul_add(b + c, a + d);
    let weighted = State {
        theta: mean(k1.theta, k2.theta, k3.theta, k4.theta),
        alpha: mean(k1.alpha, k2.alpha, k3.alpha, k4.alpha),
        theta_dot: mean(k1.theta_dot, k2.theta_dot, k3.theta_dot, k4.theta_dot),
        alpha_dot: mean(k1.alpha_dot, k2.alpha_dot, k3.alpha_dot, k4.alpha_dot),
    };
    moved(&state, &weighted, sixth)
}

#[inline(always)]
fn moved<T: Scalar>(state: &State<T>, rate: &State<T>, duration_s: T) -> State<T> {
    State {
        theta: duration_s.mul_add(rate.theta, state.theta),
        alpha: duration_s.mul_add(rate.alpha, state.alpha),
        theta_dot: duration_s.mul_add(rate.theta_dot, state.theta_dot),
        alpha_dot: duration_s.mul_add(rate.alpha_dot, state.alpha_dot),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::{DomainParameters, Dynamics};

    #[test]
    fn energy_is_constant_without_damping_and_motor() {
        let free = DomainParameters {
            motor_back_emf_v_s: 0.0,
            rotary_damping_n_m_s: 0.0,
            pendulum_damping_n_m_s: 0.0,
            ..DomainParameters::NOMINAL
        };
        let dynamics = Dynamics::<f64>::new(&free);
        let mut state = State { theta: 0.3, alpha: 2.5, theta_dot: 4.0, alpha_dot: -6.0 };
        let before = dynamics.energy(&state);
        let (steps, step_s) = (60_000, 1e-4);
        for _ in 0..steps {
            state = runge_kutta_4(&dynamics, state, 0.0, step_s);
            let relative = (dynamics.energy(&state) - before).abs() / before.abs();
            assert!(relative < 1e-9, "energy drifted by {relative:e}");
        }
    }

    #[test]
    fn a_control_step_is_within_a_microradian_of_a_finer_reference() {
        let dynamics = Dynamics::<f64>::new(&DomainParameters::NOMINAL);
        let finer = 200 * SUBSTEPS;
        let mut worst: f64 = 0.0;
        for (theta_dot, alpha_dot) in [(0.0, 0.0), (5.0, 10.0), (20.0, 21.0), (20.0, -21.0)] {
            for degrees in 0..360 {
                for voltage_v in [-5.0, 0.0, 5.0] {
                    let alpha = f64::from(degrees).to_radians();
                    let start = State { theta: 0.3, alpha, theta_dot, alpha_dot };
                    let coarse = control_step(&dynamics, start, voltage_v);
                    let fine = (0..finer).fold(start, |state, _| {
                        runge_kutta_4(&dynamics, state, voltage_v, CONTROL_PERIOD_S / finer as f64)
                    });
                    worst = worst
                        .max((coarse.theta - fine.theta).abs())
                        .max((coarse.alpha - fine.alpha).abs());
                }
            }
        }
        assert!(worst < 1e-6, "{worst:e} rad");
    }
}
