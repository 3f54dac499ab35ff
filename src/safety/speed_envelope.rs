use crate::elementary::Scalar;
use crate::qube::State;

/// How far the arm may be going to reach, rad: 0.89 rad inside of the hard stop. What is left takes
/// the error of the two bounds below; SAFETY.md has the derivation, `examples/adversary.rs` the
/// search for a policy that uses it up.
const FARTHEST_REACH_RAD: f64 = 1.5;

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

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use proptest::prelude::*;

    use super::*;
    use crate::qube::{
        DomainParameters, Dynamics, HARD_STOP_RAD, MAX_VOLTAGE_V, RAD_PER_COUNT, runge_kutta_4,
    };
    use crate::safety::retreat_voltage;

    fn states() -> impl Strategy<Value = State> {
        (-3.0..3.0, -13.0..13.0, -40.0..40.0, -60.0..60.0).prop_map(
            |(theta, alpha, theta_dot, alpha_dot)| State { theta, alpha, theta_dot, alpha_dot },
        )
    }

    fn mirrored(state: &State) -> State {
        State {
            theta: -state.theta,
            alpha: -state.alpha,
            theta_dot: -state.theta_dot,
            alpha_dot: -state.alpha_dot,
        }
    }

    proptest! {
        #[test]
        fn farther_out_and_faster_outward_never_reach_less(
            state in states(),
            more in 0.0..5.0_f64,
        ) {
            let reach = SpeedEnvelope::reach(&state);
            prop_assert!(reach >= state.theta);
            let farther = State { theta: state.theta + more, ..state };
            prop_assert!(SpeedEnvelope::reach(&farther) >= reach);
            let faster = State { theta_dot: state.theta_dot + more, ..state };
            prop_assert!(SpeedEnvelope::reach(&faster) >= reach);
            let pushed = State { alpha_dot: state.alpha_dot + more * state.alpha.cos().signum(), ..state };
            prop_assert!(SpeedEnvelope::reach(&pushed) >= reach);
        }

        #[test]
        fn both_sides_are_judged_alike_and_in_both_number_types(state in states()) {
            let inside = SpeedEnvelope::contains(&state);
            prop_assert_eq!(SpeedEnvelope::contains(&mirrored(&state)), inside);
            let reach = SpeedEnvelope::reach(&state).max(SpeedEnvelope::reach(&mirrored(&state)));
            prop_assert_eq!(inside, reach < FARTHEST_REACH_RAD);
            let single: State<f32> = State {
                theta: state.theta as f32,
                alpha: state.alpha as f32,
                theta_dot: state.theta_dot as f32,
                alpha_dot: state.alpha_dot as f32,
            };
            if (reach - FARTHEST_REACH_RAD).abs() > 1e-3 {
                prop_assert_eq!(SpeedEnvelope::contains(&single), inside);
            }
        }
    }

    #[test]
    fn what_is_not_a_number_is_outside() {
        for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            for entry in 0..4 {
                let mut numbers = [0.0; 4];
                numbers[entry] = bad;
                let [theta, alpha, theta_dot, alpha_dot] = numbers;
                let state = State { theta, alpha, theta_dot, alpha_dot };
                // A pendulum at infinite speed towards either side throws the arm to one.
                assert!(!SpeedEnvelope::contains(&state), "{state:?}");
            }
        }
    }

    /// Every state of a grid that the envelope lets pass: the policy pushes outward at 5 V for 20 ms
    /// more, then the brake works, 20 ms late too. Gives the farthest that any of them gets.
    fn farthest_from_inside(dynamics: &Dynamics, steps: [usize; 4]) -> (f64, usize) {
        let grid = |count: usize, largest: f64| {
            (0..count).map(move |i| largest * (2.0 * i as f64 / (count - 1) as f64 - 1.0))
        };
        let (mut farthest, mut states) = (0.0_f64, 0);
        for theta in grid(steps[0], FARTHEST_REACH_RAD) {
            let theta = (theta / RAD_PER_COUNT).round() * RAD_PER_COUNT;
            for alpha in grid(steps[1], PI) {
                for theta_dot in grid(steps[2], 30.0) {
                    for alpha_dot in grid(steps[3], 40.0) {
                        let start = State { theta, alpha, theta_dot, alpha_dot };
                        if SpeedEnvelope::contains(&start) {
                            states += 1;
                            for outward in [1.0, -1.0] {
                                farthest = farthest.max(braked_from(dynamics, start, outward));
                            }
                        }
                    }
                }
            }
        }
        (farthest, states)
    }

    /// 2 ms at a time for 0.6 s, after which the arm is on its way back.
    fn braked_from(dynamics: &Dynamics, start: State, outward: f64) -> f64 {
        const STEP_S: f64 = 0.002;
        const DELAY: usize = 10;
        let mut state = start;
        let mut late = [outward * MAX_VOLTAGE_V; DELAY];
        let mut farthest = 0.0_f64;
        for step in 0..300 {
            let wanted_v = retreat_voltage(&state);
            let voltage_v = std::mem::replace(&mut late[step % DELAY], wanted_v);
            state = runge_kutta_4(dynamics, state, voltage_v, STEP_S);
            farthest = farthest.max(state.theta.abs());
        }
        farthest
    }

    #[test]
    fn from_every_state_of_a_grid_the_brake_stops_a_nominal_qube_in_time() {
        let dynamics = Dynamics::new(&DomainParameters::NOMINAL);
        let (farthest, states) = farthest_from_inside(&dynamics, [13, 17, 13, 17]);
        println!("{states} states, farthest {farthest:.3} rad");
        assert!(states > 3000);
        assert!(farthest < HARD_STOP_RAD, "{farthest} rad");
    }

    /// The whole grid, with the parameters 10 % off in every combination that matters: minutes.
    #[test]
    #[ignore = "minutes: scripts/adversary runs it"]
    fn from_every_state_of_a_fine_grid_too() {
        for corner in 0..16_u32 {
            let factor = |bit: u32, share: f64| {
                if corner >> bit & 1 == 1 { 1.0 + share } else { 1.0 - share }
            };
            let nominal = DomainParameters::NOMINAL;
            let dynamics = Dynamics::new(&DomainParameters {
                motor_back_emf_v_s: nominal.motor_back_emf_v_s * factor(0, 0.1),
                rotary_mass_kg: nominal.rotary_mass_kg * factor(1, 0.1),
                pendulum_mass_kg: nominal.pendulum_mass_kg * factor(2, 0.1),
                pendulum_length_m: nominal.pendulum_length_m * factor(3, 0.1),
                ..nominal
            });
            let (farthest, states) = farthest_from_inside(&dynamics, [25, 33, 25, 33]);
            println!("corner {corner:04b}: {states} states, farthest {farthest:.3} rad");
            assert!(farthest < HARD_STOP_RAD, "{farthest} rad");
        }
    }
}
