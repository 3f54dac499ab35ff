use super::State;
use crate::elementary::Scalar;

/// Number of entries in an [`observation`].
pub const OBSERVATION_SIZE: usize = 6;

/// Largest number of last commands that a policy may see in addition to the [`observation`]. Four
/// cover the 40 ms in which a command may still be on its way to the motor.
pub const MAX_HISTORY: usize = 4;

/// Factor on the arm's velocity in an [`observation`], s/rad.
pub const THETA_DOT_FACTOR: f64 = 0.1;

/// Factor on the pendulum's velocity in an [`observation`], s/rad.
pub const ALPHA_DOT_FACTOR: f64 = 0.05;

/// The observation of a state: [sin theta, cos theta, sin alpha, cos alpha, 0.1 theta_dot, 0.05
/// alpha_dot].
///
/// The thesis does not state its observation. Sine and cosine remove the jump of an angle at a full
/// turn; the factors scale velocities to about one.
#[inline(always)]
pub fn observation<T: Scalar>(state: &State<T>) -> [T; OBSERVATION_SIZE] {
    let (sin_theta, cos_theta) = state.theta.sin_cos();
    let (sin_alpha, cos_alpha) = state.alpha.sin_cos();
    [
        sin_theta,
        cos_theta,
        sin_alpha,
        cos_alpha,
        T::from_f64(THETA_DOT_FACTOR) * state.theta_dot,
        T::from_f64(ALPHA_DOT_FACTOR) * state.alpha_dot,
    ]
}
