use crate::elementary::Scalar;
use crate::qube::State;

/// How long the arm goes on before a brake can act, s: 20 ms of delay and 10 ms of filter lag.
const BLIND_S: f64 = 0.03;

/// How a Qube brakes, and how far its arm may be going to reach.
struct Kind {
    /// What 5 V take off the arm's momentum, rad/s^2.
    braking_rad_s2: f64,
    /// Where the arm must come to rest before, rad.
    farthest_rad: f64,
}

/// A Qube whose motor is 30 % weaker and whose masses and lengths are 30 % larger: it needs the room
/// that its own equations ask for.
const WEAK: Kind = Kind { braking_rad_s2: 26.0, farthest_rad: 2.1 };

/// A nominal Qube (108 rad/s^2) and all stronger ones: they leave more room, because their pendulum
/// may throw the arm farther than a nominal one (r up to 1.2), and the brake may overshoot.
const STRONG: Kind = Kind { braking_rad_s2: 100.0, farthest_rad: 1.7 };

/// r = c / A of a nominal Qube: how far the arm recoils, in rad, when the pendulum swings from
/// hanging to horizontal.
const RECOIL_RAD: f64 = 0.57;

/// q / A: how much heavier the arm turns when the pendulum is level.
const LEVEL_INERTIA: f64 = 0.43;

/// Between these r lies for the masses and lengths that a momentum must be judged for.
const LEAST_RECOIL_RAD: f64 = 0.4;
const LARGEST_RECOIL_RAD: f64 = 0.7;

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
/// reach = th + r (1 + sin a) + tau u + u^2 / 2 b,      u = p / A = (1 + q/A sin^2 a) th' + r cos a a',  r = c / A
/// ```
///
/// and for the other side the same of the mirrored state. It is monotone: farther out, faster
/// outward or a pendulum that will push outward never make it smaller.
///
/// It is asked for two kinds of Qubes, and both must be inside.
pub struct SpeedEnvelope;

impl SpeedEnvelope {
    /// Towards which stop the state has left the envelope, with so much room, rad, left to it: 1 for
    /// the positive one, -1 for the negative one, 0 for neither or both.
    #[must_use]
    pub fn outward(state: &State, room_rad: f64) -> f64 {
        let (sin, cos) = Scalar::sin_cos(state.alpha);
        let swing = cos * state.alpha_dot;
        let positive = one_sided(state.theta + room_rad, sin, state.theta_dot, swing);
        let negative = one_sided(room_rad - state.theta, -sin, -state.theta_dot, -swing);
        f64::from(u8::from(negative)) - f64::from(u8::from(positive))
    }

    /// Whether braking need not begin, on either side; not for what is not a number.
    #[must_use]
    #[inline(always)]
    pub fn contains<T: Scalar>(state: &State<T>) -> bool {
        Self::contains_with_room(state, T::from_f64(0.0))
    }

    /// The same with so much room, rad, left to where braking would begin: how policies learn not to
    /// count on its last centimetre.
    #[must_use]
    #[inline(always)]
    pub fn contains_with_room<T: Scalar>(state: &State<T>, room_rad: T) -> bool {
        let (sin, cos) = state.alpha.sin_cos();
        let swing = cos * state.alpha_dot;
        one_sided(state.theta + room_rad, sin, state.theta_dot, swing)
            & one_sided(room_rad - state.theta, -sin, -state.theta_dot, -swing)
    }
}

/// Whether an arm stays short of its positive stop.
#[inline(always)]
fn one_sided<T: Scalar>(theta: T, sin: T, theta_dot: T, swing: T) -> bool {
    let most = T::from_f64(LARGEST_RECOIL_RAD) * swing;
    let least = T::from_f64(LEAST_RECOIL_RAD) * swing;
    let handed_over = if most > least { most } else { least };
    let heavier = T::from_f64(LEVEL_INERTIA).mul_add(sin * sin, T::from_f64(1.0));
    let momentum = heavier.mul_add(theta_dot, handed_over);
    // Not a number goes on as one: the comparison is false for it.
    let outward = if momentum < T::from_f64(0.0) { T::from_f64(0.0) } else { momentum };
    let thrown = T::from_f64(RECOIL_RAD).mul_add(T::from_f64(1.0) + sin, theta);
    let when_braked = T::from_f64(BLIND_S).mul_add(outward, thrown);
    let square = outward * outward;
    let stays_short = |kind: Kind| {
        let reach = T::from_f64(0.5 / kind.braking_rad_s2).mul_add(square, when_braked);
        reach < T::from_f64(kind.farthest_rad)
    };
    stays_short(WEAK) & stays_short(STRONG)
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use proptest::prelude::*;

    use super::*;
    use crate::qube::{
        DomainParameters, Dynamics, HARD_STOP_RAD, MAX_VOLTAGE_V, RAD_PER_COUNT, runge_kutta_4,
    };
    use crate::safety::Retreat;

    fn states() -> impl Strategy<Value = State> {
        (-3.0..3.0, -13.0..13.0, -40.0..40.0, -60.0..60.0).prop_map(
            |(theta, alpha, theta_dot, alpha_dot)| State { theta, alpha, theta_dot, alpha_dot },
        )
    }

    fn positive_side(state: &State) -> bool {
        let (sin, cos) = state.alpha.sin_cos();
        one_sided(state.theta, sin, state.theta_dot, cos * state.alpha_dot)
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
        fn farther_out_and_faster_outward_never_comes_back_inside(
            state in states(),
            more in 0.0..5.0_f64,
        ) {
            let outside = |state: &State| !positive_side(state);
            let farther = State { theta: state.theta + more, ..state };
            let faster = State { theta_dot: state.theta_dot + more, ..state };
            let outward = more * state.alpha.cos().signum();
            let pushed = State { alpha_dot: state.alpha_dot + outward, ..state };
            for further in [farther, faster, pushed] {
                prop_assert!(!outside(&state) || outside(&further), "{:?}", further);
            }
            prop_assert!(state.theta < STRONG.farthest_rad || outside(&state));
        }

        #[test]
        fn both_sides_are_judged_alike_and_in_both_number_types(state in states()) {
            let inside = SpeedEnvelope::contains(&state);
            prop_assert_eq!(SpeedEnvelope::contains(&mirrored(&state)), inside);
            prop_assert_eq!(inside, positive_side(&state) && positive_side(&mirrored(&state)));
            let shifted = |by: f64| State { theta: state.theta + by, ..state };
            let with_room = SpeedEnvelope::contains_with_room(&state, 0.2);
            prop_assert_eq!(
                with_room,
                positive_side(&shifted(0.2)) && positive_side(&mirrored(&shifted(-0.2)))
            );
            let single: State<f32> = State {
                theta: state.theta as f32,
                alpha: state.alpha as f32,
                theta_dot: state.theta_dot as f32,
                alpha_dot: state.alpha_dot as f32,
            };
            // Off the edge, where the last bit decides.
            let off = |by: f64| State { theta: state.theta + by, ..state };
            let (inward, outward) = (off(-1e-3), off(1e-3));
            if SpeedEnvelope::contains(&inward) == inside && SpeedEnvelope::contains(&outward) == inside
            {
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
        for theta in grid(steps[0], STRONG.farthest_rad) {
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
        let mut wanted_v = 0.0;
        let mut farthest = 0.0_f64;
        let mut retreat = Retreat::default();
        for step in 0..300 {
            // The brake decides each control period.
            if step % 5 == 0 {
                wanted_v = retreat.voltage_v(&state);
            }
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
