use crate::elementary::Scalar;
use crate::qube::State;

/// How far the arm may be going to reach, rad: 0.8 rad inside of the hard stop. What is left takes
/// the error of the two bounds below; SAFETY.md has the derivation, `examples/adversary.rs` the
/// search for a policy that uses it up.
const FARTHEST_REACH_RAD: f64 = 1.6;

/// How long the arm goes on before a brake can act, s: 20 ms of delay and 10 ms of filter lag.
const BLIND_S: f64 = 0.03;

/// What the brake is trusted to take off the arm's momentum, rad/s^2: a little over half of what
/// 5 V do to a nominal Qube (108 rad/s^2), as a Qube with 30 % less motor and more mass has it.
const BRAKING_RAD_S2: f64 = 60.0;

/// r = c / A of a nominal Qube: how far the arm recoils, in rad, when the pendulum swings from
/// hanging to horizontal.
const RECOIL_RAD: f64 = 0.57;

/// Between these r lies for the masses and lengths that a momentum must be judged for.
const LEAST_RECOIL_RAD: f64 = 0.3;
const LARGEST_RECOIL_RAD: f64 = 0.8;

/// The speed envelope: says brake as long as braking can still keep the arm off its hard stop.
///
/// An arm at 4 rad/s can be past saving while one at 15 rad/s is not, because the pendulum holds
/// momentum too and hands it to the arm as it swings. No torque but the motor's changes the sum of
/// both,
///
/// ```text
/// p = (A + q sin^2 a) th' + c cos a a',      dp/dt = k V - d th'
/// ```
///
/// (theta is a cyclic coordinate of the equations of motion). So the envelope looks at p / A, the
/// velocity that the arm would have if the pendulum gave it everything, and at where the arm is
/// when the pendulum has given everything:
///
/// ```text
/// reach = th + r (1 + sin a) + tau u + u^2 / 2 b,      u = max(0, th' + r cos a a'),  r = c / A
/// ```
///
/// and for the other side the same of the mirrored state. It is monotone: farther out, faster
/// outward or a pendulum that will push outward never make it smaller.
pub struct SpeedEnvelope;

impl SpeedEnvelope {
    /// How far the arm may get towards positive theta before it can be stopped, rad.
    #[must_use]
    #[inline(always)]
    pub fn reach<T: Scalar>(state: &State<T>) -> T {
        let (sin, cos) = state.alpha.sin_cos();
        one_sided(state.theta, sin, state.theta_dot, cos * state.alpha_dot)
    }

    /// Whether braking need not begin, on either side; not for what is not a number.
    #[must_use]
    #[inline(always)]
    pub fn contains<T: Scalar>(state: &State<T>) -> bool {
        let (sin, cos) = state.alpha.sin_cos();
        let swing = cos * state.alpha_dot;
        let farthest = T::from_f64(FARTHEST_REACH_RAD);
        (one_sided(state.theta, sin, state.theta_dot, swing) < farthest)
            & (one_sided(-state.theta, -sin, -state.theta_dot, -swing) < farthest)
    }
}

#[inline(always)]
fn one_sided<T: Scalar>(theta: T, sin: T, theta_dot: T, swing: T) -> T {
    let one = T::from_f64(1.0);
    let most = T::from_f64(LARGEST_RECOIL_RAD) * swing;
    let least = T::from_f64(LEAST_RECOIL_RAD) * swing;
    let handed_over = if most > least { most } else { least };
    let momentum = theta_dot + handed_over;
    // Not a number goes on as one: the comparison is false for it.
    let outward = if momentum < T::from_f64(0.0) { T::from_f64(0.0) } else { momentum };
    let stopping = T::from_f64(0.5 / BRAKING_RAD_S2).mul_add(outward, T::from_f64(BLIND_S));
    let recoil = T::from_f64(RECOIL_RAD).mul_add(one + sin, theta);
    stopping.mul_add(outward, recoil)
}
