//! Counts the Qubes within 30 % of the nominal one that a brake brings to rest, for two brakes: one
//! that loses gain when it rings, and one that keeps its gain.
//!
//! `cargo run --release --example braked_qubes -- 5000` draws 5000 Qubes. Every second one has a
//! strong motor, a short light arm, a light pendulum and little friction.

use std::collections::VecDeque;

use qube_hil::estimation::{FilterGains, GUARD_CORNER_RAD_S, through_filters};
use qube_hil::qube::{
    CONTROL_PERIOD_S, DomainParameter as P, HARD_STOP_RAD, NonidealDynamics, Nonideality,
    PlantModel, Quantity, QubeModel, State, quantised, runge_kutta_4,
};
use qube_hil::safety::{Belief, Brake, ForesightSettings};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

/// Control periods for which a brake is observed: 10 s.
const PERIODS: usize = 1000;

/// Largest range of the arm's angle over the last `REST_PERIODS` at which the arm counts as at
/// rest, rad.
const REST_RANGE_RAD: f64 = 0.05;

/// Control periods over which this range is taken: 0.6 s.
const REST_PERIODS: usize = 60;

/// A Qube, and the state in which its brake begins.
struct Case {
    model: QubeModel,
    start: State,
    /// Error of the arm's zero, rad.
    zero_rad: f64,
    /// Delay from a sample until its voltage is sent, ms; the Qube's own delay comes on top.
    computing_ms: usize,
}

/// The result of braking.
enum Braked {
    /// Arm at rest after this many control periods.
    AtRest(usize),
    StillMoving,
    HitStop,
}

impl Case {
    fn drawn(seed: u64) -> Self {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let belief = Belief::of_any_qube(0.3);
        let (at_corners, is_strong) = (random.random_bool(0.5), seed.is_multiple_of(2));
        let mut model = QubeModel::NOMINAL;
        for quantity in Quantity::all() {
            let [low, high] = [belief.low, belief.high].map(|end| end.get(quantity));
            let drawn: f64 = random.random();
            let part = if at_corners && random.random_bool(0.7) { drawn.round() } else { drawn };
            let part = match quantity {
                Quantity::Parameter(
                    P::MotorResistance | P::RotaryMass | P::PendulumMass | P::RotaryLength,
                )
                | Quantity::Nonideality(Nonideality::CoulombTorque)
                    if is_strong =>
                {
                    0.3 * part
                }
                Quantity::Parameter(P::MotorBackEmf) if is_strong => 1.0 - 0.3 * part,
                _ => part,
            };
            model.set(quantity, low + part * (high - low));
        }
        let mut within = |most: f64| random.random_range(-most..most);
        let start = State {
            theta: within(1.6),
            alpha: within(std::f64::consts::PI),
            theta_dot: within(15.0),
            alpha_dot: within(20.0),
        };
        let (zero_rad, computing_ms) = (within(0.02), within(4.0).abs() as usize + 1);
        Self { model, start, zero_rad, computing_ms }
    }

    /// Simulates the brake until the arm is at rest or hits a stop, for at most `periods` control
    /// periods.
    fn braked(&self, mut brake: Brake, periods: usize) -> Braked {
        let dynamics = NonidealDynamics::new(&self.model);
        let gains = FilterGains::new(GUARD_CORNER_RAD_S, CONTROL_PERIOD_S);
        let late_ms =
            self.computing_ms + (1e3 * self.model.nonidealities.command_delay_s).round() as usize;
        let mut under_way: VecDeque<f64> = std::iter::repeat_n(0.0, late_ms).collect();
        let mut state = self.start;
        let mut seen = State { theta: state.theta + self.zero_rad, ..state };
        let mut angles = Vec::with_capacity(periods);
        for period in 0..periods {
            let theta = quantised(state.theta + self.zero_rad);
            seen = through_filters(&seen, theta, quantised(state.alpha), &gains);
            angles.push(seen.theta);
            let last = &angles[angles.len().saturating_sub(REST_PERIODS)..];
            let highest = last.iter().fold(f64::NEG_INFINITY, |most, angle| most.max(*angle));
            let lowest = last.iter().fold(f64::INFINITY, |least, angle| least.min(*angle));
            if last.len() == REST_PERIODS && highest - lowest <= REST_RANGE_RAD {
                return Braked::AtRest(period);
            }
            let voltage_v = brake.voltage_v(&seen);
            for _ in 0..10 {
                under_way.push_back(voltage_v);
                let arriving_v = under_way.pop_front().unwrap_or(0.0);
                state = runge_kutta_4(&dynamics, state, arriving_v, 1e-3);
                if state.theta.abs() > HARD_STOP_RAD {
                    return Braked::HitStop;
                }
            }
        }
        Braked::StillMoving
    }
}

fn main() {
    let qubes = std::env::args().nth(1).and_then(|count| count.parse().ok()).unwrap_or(5000);
    let foreseen = ForesightSettings::HORIZON_PERIODS as usize;
    // If the simulated brake lets the arm reach its stop, foresight brakes earlier, so such cases
    // never occur.
    let cases: Vec<Case> = (0..qubes)
        .map(Case::drawn)
        .filter(|case| {
            !matches!(case.braked(Brake::centring(&PlantModel::QUBE), foreseen), Braked::HitStop)
        })
        .collect();
    println!("{} of {qubes} Qubes: the arm stays off its stops for 0.75 s", cases.len());
    for (name, brake) in [
        ("loses gain where it rings", Brake::centring(&PlantModel::QUBE)),
        ("keeps its gain", Brake::centring(&PlantModel::QUBE).by_earlier_rules()),
    ] {
        let (mut rest_periods, mut moving, mut hits) = (Vec::new(), 0, 0);
        for case in &cases {
            match case.braked(brake, PERIODS) {
                Braked::AtRest(periods) => rest_periods.push(periods),
                Braked::StillMoving => moving += 1,
                Braked::HitStop => hits += 1,
            }
        }
        rest_periods.sort_unstable();
        // The time within which all Qubes that came to rest did so, except one in `one_in`, s.
        let all_but = |one_in: usize| {
            let (count, last) = (rest_periods.len(), rest_periods.len() / one_in + 1);
            let periods = count.checked_sub(last).map(|index| rest_periods[index]);
            periods.map_or(f64::NAN, |periods| CONTROL_PERIOD_S * periods as f64)
        };
        println!(
            "a brake that {name}: at rest {} (half within {:.2} s, 99 % within {:.2} s), moving after \
             10 s {moving}, at a stop {hits}",
            rest_periods.len(),
            all_but(2),
            all_but(100),
        );
    }
}
