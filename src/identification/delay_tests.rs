//! Tests that the standard error of the delay is its scatter over recordings, or up to 1.9 times as
//! large.

use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::qube::{DomainParameter, Nonidealities, Nonideality, PlantModel, QubeModel, State};
use crate::replay::{MotionLog, MotionSample, simulate_stretch};

/// A chirp of 4 s from 5 Hz down to 1.8 Hz, sampled at 100 Hz on a clock that jitters by up to 20
/// us, with angle noise of 1.6 mrad (standard deviation).
fn chirp(truth: &QubeModel, seed: u64) -> MotionLog {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut uniform = |reach: f64| reach * (2.0 * rng.random::<f64>() - 1.0);
    let phase = uniform(std::f64::consts::PI);
    let mut samples: Vec<MotionSample> = (0..=400)
        .map(|index| {
            let time_s = f64::from(index) * 0.01;
            let turned = 2.0 * std::f64::consts::PI * (5.0 * time_s - 0.4 * time_s * time_s);
            let voltage_v = 1.5 * (turned + phase).cos();
            MotionSample { time_s: time_s + uniform(2e-5), state: State::default(), voltage_v }
        })
        .collect();
    let mut states = Vec::new();
    let start = State { theta: -0.02, ..State::default() };
    simulate_stretch(&samples, 0..samples.len(), truth, start, |state| states.push(state));
    for (sample, state) in samples.iter_mut().zip(states) {
        let mut seen = |angle: f64| angle + uniform(2e-3) + uniform(2e-3);
        sample.state = State { theta: seen(state.theta), alpha: seen(state.alpha), ..state };
    }
    MotionLog { samples, plant: PlantModel::QUBE }
}

#[test]
fn the_standard_error_of_the_delay_is_at_least_its_scatter_and_less_than_twice_as_large() {
    let unknowns: Vec<Unknown> = vec![
        DomainParameter::MotorResistance.into(),
        Nonideality::CoulombTorque.into(),
        Nonideality::CableStiffness.into(),
        Nonideality::CommandDelay.into(),
    ];
    // The arrival of commands coincides with integration steps of a nominal period and lies within
    // the jitter of the neighbouring samples, so the number of steps between arrivals and samples
    // differs from sample to sample and from delay to delay.
    for delay_s in [0.0033, 0.0067, 0.01] {
        let nonidealities = Nonidealities {
            coulomb_torque_n_m: 5e-4,
            cable_stiffness_n_m_rad: 1e-3,
            command_delay_s: delay_s,
            ..Nonidealities::default()
        };
        let mut truth = QubeModel { nonidealities, ..QubeModel::NOMINAL };
        truth.parameters.motor_resistance_ohm *= 1.1;
        let (mut scatter_s, mut error_s) = (0.0, 0.0);
        let seeds = 1000..1024;
        let share = 1.0 / seeds.clone().count() as f64;
        for seed in seeds {
            let found = identify(&[chirp(&truth, seed)], &unknowns, &QubeModel::NOMINAL).unwrap();
            let estimate = found.estimates[3];
            let off_s = estimate.value - delay_s;
            let off = off_s.abs() / estimate.standard_error;
            assert!(off < 3.0, "{delay_s} s, seed {seed}: off by {off:.1} of {estimate:?}");
            scatter_s += share * off_s * off_s;
            error_s += share * estimate.standard_error * estimate.standard_error;
        }
        let (scatter_s, error_s) = (scatter_s.sqrt(), error_s.sqrt());
        println!("{delay_s} s: scatter {scatter_s:.1e} s, standard error {error_s:.1e} s");
        // The factor for windows that contradict each other is never below 1, so the standard error
        // of a recording without contradictions is too large rather than too small: here by half.
        // An error by the square root of two in either direction is outside these limits.
        let ratio = error_s / scatter_s;
        assert!((1.15..1.9).contains(&ratio), "{delay_s} s: {error_s:e} s beside {scatter_s:e} s");
    }
}
