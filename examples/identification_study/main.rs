//! Measures `identify` on emulated plants of known truth: coverage of its intervals, and its verdict on plants inside and
//! outside the model class.
//!
//! ```text
//! cargo run --release --example identification_study [PLANTS]
//! ```
//!
//! For each of PLANTS seeds from 1000 (10 unless named), a Qube is drawn, two chirps of 10 s are recorded at 100 Hz
//! and fitted; once as it is, and once with one effect outside the class, which alternates.

mod plant;

use plant::{Beyond, Plant};
use qube_hil::identification::{Identified, IdentifyError, Unknown, Verdict, identify};
use qube_hil::policy::{EXCITATION_STEPS, Excitation, ExcitationShape};
use qube_hil::qube::{CONTROL_PERIOD_S, DomainParameter, Nonideality, Quantity, QubeModel};
use qube_hil::replay::{MotionLog, MotionSample};
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

/// First seed.
const FIRST_SEED: u64 = 1000;

/// Half the width of a 90 % interval, in standard errors.
const NINETY_PERCENT: f64 = 1.645;

/// A Qube drawn from the prior of the identification, the motor's constants within a third of the prior's width.
fn drawn(rng: &mut ChaCha8Rng) -> QubeModel {
    let mut model = QubeModel::NOMINAL;
    for unknown in Unknown::all() {
        let prior = unknown.prior();
        let normal = normal(rng);
        let moved = match unknown.0 {
            Quantity::Parameter(
                DomainParameter::MotorResistance | DomainParameter::MotorBackEmf,
            ) => prior.mean + normal * prior.std / 3.0,
            Quantity::Parameter(
                DomainParameter::RotaryDamping | DomainParameter::PendulumDamping,
            ) => prior.mean + (0.5 * normal).clamp(-1.0, 1.0) * prior.std,
            Quantity::Parameter(_) => prior.mean + normal * prior.std,
            Quantity::Nonideality(Nonideality::CommandDelay) => 0.002 + 0.012 * rng.random::<f64>(),
            Quantity::Nonideality(Nonideality::CableRest) => normal * prior.std,
            // Strengths up to 0.6 mN m, 0.25 V, 1.2 mN m/rad.
            Quantity::Nonideality(Nonideality::CoulombTorque) => 6e-4 * rng.random::<f64>(),
            Quantity::Nonideality(Nonideality::CableStiffness) => 1.2e-3 * rng.random::<f64>(),
            Quantity::Nonideality(_) => 0.25 * rng.random::<f64>(),
        };
        unknown.set(&mut model, moved);
    }
    model
}

/// A standard normal number: Box and Muller's.
fn normal(rng: &mut ChaCha8Rng) -> f64 {
    let radius = (-2.0 * (1.0 - rng.random::<f64>()).ln()).sqrt();
    radius * (2.0 * std::f64::consts::PI * rng.random::<f64>()).cos()
}

/// An effect outside the class, of a size that a worn or cheap rig has.
fn outside(seed: u64, rng: &mut ChaCha8Rng) -> Beyond {
    let size = 0.5 + 0.5 * rng.random::<f64>();
    match seed % 5 {
        0 => Beyond::Play(0.0175 * size),
        1 => Beyond::Presliding(0.05 * size),
        2 => Beyond::Hysteresis(8e-4 * size, 0.2),
        3 => Beyond::Warming(0.25 * size),
        _ => Beyond::Eccentric(0.02 * size),
    }
}

fn record(model: &QubeModel, beyond: Beyond, number: u32) -> MotionLog {
    let mut plant = Plant::at_rest(model, beyond, 0.0);
    let mut excitation = Excitation::of_rollout(ExcitationShape::Chirp, 1.5, number);
    let samples = (0..EXCITATION_STEPS).map(|tick| {
        let state = plant.measured();
        let voltage_v = (1000.0 * excitation.voltage_v(&state)).round() / 1000.0;
        plant.advance(voltage_v);
        MotionSample { time_s: f64::from(tick) * CONTROL_PERIOD_S, state, voltage_v }
    });
    MotionLog { samples: samples.collect(), plant: qube_hil::qube::PlantModel::QUBE }
}

fn identified(model: &QubeModel, beyond: Beyond) -> Result<Identified, IdentifyError> {
    let logs = [record(model, beyond, 0), record(model, beyond, 1)];
    let unknowns: Vec<Unknown> = Unknown::all().collect();
    identify(&logs, &unknowns, &QubeModel::NOMINAL)
}

fn describe(found: &Result<Identified, IdentifyError>) -> String {
    match found {
        Ok(found) => {
            let tests = &found.assessment;
            let doubts: Vec<_> = tests.doubts.iter().map(|doubt| doubt.name()).collect();
            format!(
                "{} noise {:.2} whiteness {:.2} growth {:.2} inflation {:.2} {}",
                tests.verdict.name(),
                tests.noise_ratio,
                tests.whiteness,
                tests.growth,
                found.inflation,
                doubts.join(" ")
            )
        }
        Err(why) => format!("refused: {why}"),
    }
}

fn main() {
    let plants: u64 = std::env::args().nth(1).map_or(10, |text| text.parse().expect("a number"));
    let (mut covered, mut intervals, mut false_doubts, mut inside) = (0, 0, 0, 0);
    let (mut right, mut strangers) = (0, 0);
    for seed in FIRST_SEED..FIRST_SEED + plants {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let truth = drawn(&mut rng);
        let found = identified(&truth, Beyond::Nothing);
        let mut missed = Vec::new();
        inside += 1;
        if let Ok(found) = &found {
            for estimate in &found.estimates {
                let expected = truth.get(estimate.unknown.0);
                let off = if estimate.unknown.is_parameter() {
                    (estimate.value / expected).ln() * estimate.value / estimate.standard_error
                } else {
                    (estimate.value - expected) / estimate.standard_error
                };
                intervals += 1;
                if off.abs() <= NINETY_PERCENT {
                    covered += 1;
                } else {
                    missed.push(format!("{} {off:+.1}", estimate.unknown.name()));
                }
            }
        }
        let fits = found.as_ref().is_ok_and(|found| found.assessment.verdict == Verdict::Fits);
        false_doubts += u32::from(!fits);
        println!("{seed} nothing      {}  missed: {}", describe(&found), missed.join(", "));
        let beyond = outside(seed, &mut rng);
        let found = identified(&truth, beyond);
        strangers += 1;
        let doubted = !found.as_ref().is_ok_and(|found| found.assessment.verdict == Verdict::Fits);
        right += u32::from(doubted);
        println!("{seed} {:12} {}", beyond.name(), describe(&found));
    }
    println!("90 % intervals cover {covered} of {intervals}");
    println!("inside the class: doubted {false_doubts} of {inside}");
    println!("outside the class: doubted {right} of {strangers}");
}
