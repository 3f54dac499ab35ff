//! Measures `identify` on emulated plants of known truth: how often its intervals contain the
//! truth, and its verdict on plants inside and outside the model class.
//!
//! ```text
//! cargo run --release --example identification_study [other-forms] [PLANTS [SEED [MOTION ...]]]
//! ```
//!
//! For each of PLANTS seeds from SEED on (by default 50 seeds from 2000 on) the program draws a
//! Qube, records motions of 10 s at 100 Hz, and fits a model to them. It does so twice: with the
//! Qube as drawn, and with one effect outside the model class added. The five effects take turns.
//! With the word `other-forms` the program adds one of four effects for which the verdict does not
//! look. A MOTION is the shape and the largest voltage of an excitation, or `policy:FILE` for a
//! rollout; the default is `chirp:1.5 chirp:1.5`. The program prints a line for each plant, then
//! tables of the counts: plants whose model the verdict doubts or whose fit is refused, plants
//! whose held-out recordings add a doubt, and refusals that name a reversed sign. The limits of the
//! verdict were chosen on seeds from 100 on; the default seeds had no part in that choice.

#[path = "../beyond_the_equations/mechanics.rs"]
mod mechanics;
mod motion;
mod plant;

use std::collections::BTreeMap;

use motion::Motion;
use plant::{Beyond, NOTHING};
use qube_hil::device::emulator::Effects;
use qube_hil::elementary::normal_pair;
use qube_hil::identification::{
    Cause, Estimate, Identified, IdentifyError, MissingEffect, ModelVerdict, PredictionBand,
    Unknown, check_recording, identify, prediction_errors,
};
use qube_hil::qube::{
    CONTROL_PERIOD_S, DomainParameter, Nonideality, PlantModel, Quantity, QubeModel,
};
use qube_hil::replay::MotionLog;
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

/// PLANTS and SEED if the command does not name them.
const DEFAULTS: [u64; 2] = [50, 2000];

/// Half the width of a 90 % interval, in standard errors.
const NINETY_PERCENT: f64 = 1.645;

/// Draws a Qube. Parameters and the cable's rest angle are drawn from the prior of the
/// identification, except that the motor's constants have a third of the prior's width, and the
/// dampings' logarithms are at most two of its standard deviations from its mean. Strengths of
/// nonidealities and the delay (2 to 14 ms) are uniform over fixed ranges.
fn drawn(rng: &mut ChaCha8Rng) -> QubeModel {
    let mut model = QubeModel::NOMINAL;
    for unknown in Unknown::all() {
        let prior = unknown.prior(&PlantModel::QUBE);
        let [normal, _] = normal_pair(rng.random());
        let moved = match unknown.0 {
            Quantity::Parameter(
                DomainParameter::MotorResistance | DomainParameter::MotorBackEmf,
            ) => prior.mean + normal * prior.std / 3.0,
            Quantity::Parameter(
                DomainParameter::RotaryDamping | DomainParameter::PendulumDamping,
            ) => prior.mean + normal.clamp(-2.0, 2.0) * prior.std,
            Quantity::Parameter(_) => prior.mean + normal * prior.std,
            Quantity::Nonideality(Nonideality::CommandDelay) => {
                // The plant applies commands at multiples of its integration step.
                let step_s = CONTROL_PERIOD_S / f64::from(plant::STEPS);
                step_s * ((0.002 + 0.012 * rng.random::<f64>()) / step_s).round()
            }
            Quantity::Nonideality(Nonideality::CableRest) => normal * prior.std,
            // Strengths are uniform: friction up to 0.6 mN m, the cable up to 1.2 mN m/rad, dead
            // zones up to 0.25 V.
            Quantity::Nonideality(Nonideality::CoulombTorque) => 6e-4 * rng.random::<f64>(),
            Quantity::Nonideality(Nonideality::CableStiffness) => 1.2e-3 * rng.random::<f64>(),
            Quantity::Nonideality(_) => 0.25 * rng.random::<f64>(),
        };
        unknown.set(&mut model, moved);
    }
    model
}

/// The effect outside the model class for this seed, with half to all of the size that a worn or
/// cheap rig has.
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

/// The effect of another form that this seed gets, with half to all of a size that moves a Qube
/// about as much as the effects of [`outside`].
fn of_another_form(seed: u64, rng: &mut ChaCha8Rng) -> Beyond {
    let size = 0.5 + 0.5 * rng.random::<f64>();
    let none = Effects::NONE;
    match seed % 4 {
        0 => Beyond::OtherForm("tilt", Effects { tilt_rad: 0.02 * size, ..none }),
        1 => Beyond::OtherForm("ripple", Effects { ripple: 0.2 * size, ..none }),
        2 => Beyond::OtherForm("bearing", Effects { pendulum_friction_n_m: 1e-4 * size, ..none }),
        _ => Beyond::OtherForm("stiffening", Effects { cubic_n_m_rad3: 1e-4 * size, ..none }),
    }
}

fn identified(
    model: &QubeModel,
    beyond: Beyond,
    motions: &[Motion],
) -> Result<Identified, IdentifyError> {
    let logs: Vec<MotionLog> = motions
        .iter()
        .zip(0..)
        .map(|(motion, number)| motion.record(model, beyond, number, false))
        // A rollout may end too early for a fit; the program leaves it out.
        .filter(|log| check_recording(log).is_ok())
        .collect();
    let unknowns: Vec<Unknown> = Unknown::all().collect();
    identify(&logs, &unknowns, &QubeModel::NOMINAL)
}

fn describe(found: &Result<Identified, IdentifyError>) -> String {
    match found {
        Ok(found) => {
            let tests = &found.assessment;
            let doubts: Vec<_> = tests.missing_effects.iter().map(|doubt| doubt.name()).collect();
            format!(
                "{} noise {:.2} whiteness {:.3} growth {:.2} inflation {:.2} {}",
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

/// The counts of the plants with one effect outside the model class, or of those with none.
#[derive(Default)]
struct Row {
    /// Number of predictions of the recordings that were not fitted: all, and those within the
    /// band.
    predicted: [u32; 2],
    plants: u32,
    /// Number of fits that the verdict doubts, or that are refused.
    doubted: u32,
    /// Number of fits to which the held-out recordings add a doubt.
    doubted_by_held_out: u32,
    /// Number of refusals that name a reversed sign; each is wrong, because no sign is reversed.
    naming_a_sign: u32,
    /// Number of times that each effect was named.
    named: BTreeMap<&'static str, u32>,
}

impl Row {
    fn add(&mut self, found: &Result<Identified, IdentifyError>) {
        self.plants += 1;
        let verdict = found.as_ref().map(|found| found.assessment.verdict);
        self.doubted += u32::from(verdict != Ok(ModelVerdict::Fits));
        let cause = found.as_ref().err().and_then(IdentifyError::cause);
        self.naming_a_sign += u32::from(matches!(cause, Some(Cause::Reversed(_))));
        let doubts = found.iter().flat_map(|found| &found.assessment.missing_effects);
        for doubt in doubts.filter(|doubt| **doubt != MissingEffect::Unexplained) {
            *self.named.entry(doubt.name()).or_default() += 1;
        }
    }

    /// Predicts the held-out recording of each motion, and tests whether these recordings
    /// contradict the fit. Returns the factor by which they widen its standard errors.
    fn predict(
        &mut self,
        found: &Identified,
        truth: &QubeModel,
        beyond: Beyond,
        motions: &[Motion],
    ) -> f64 {
        let logs = |held_out: bool| {
            let numbered = motions.iter().zip(0..);
            numbered.map(move |(motion, number)| motion.record(truth, beyond, number, held_out))
        };
        let errors = |held_out: bool| {
            logs(held_out).flat_map(|log| prediction_errors(&log, &found.model)).collect::<Vec<_>>()
        };
        let usable = logs(true).filter(|log| check_recording(log).is_ok());
        let mut compared = found.clone();
        compared.hold_out(&usable.collect::<Vec<_>>());
        let new_doubts =
            compared.assessment.missing_effects.len() > found.assessment.missing_effects.len();
        self.doubted_by_held_out += u32::from(new_doubts);
        let widening = compared.inflation / found.inflation;
        let Some(band) = PredictionBand::of(&errors(false)) else { return widening };
        let held_out = errors(true);
        for share in band.shares_within(&held_out) {
            self.predicted[0] += held_out.len() as u32;
            self.predicted[1] += (share * held_out.len() as f64).round() as u32;
        }
        widening
    }

    fn line(&self, name: &str) {
        let named: Vec<String> =
            self.named.iter().map(|(name, count)| format!("{name} {count}")).collect();
        let named = named.join(", ");
        let within = percent(self.predicted);
        let Self { plants, doubted, doubted_by_held_out, naming_a_sign, .. } = self;
        println!(
            "{name:12} {plants:>7} {doubted:>8} {doubted_by_held_out:>8} {naming_a_sign:>8} {within:>12}   {named}"
        );
    }
}

/// The share of predictions within their band, in percent; a dash if no prediction was counted,
/// because no fit has a band ([`PredictionBand::of`]).
fn percent([all, within]: [u32; 2]) -> String {
    if all == 0 {
        return "-".to_string();
    }
    format!("{:.1} %", 100.0 * f64::from(within) / f64::from(all))
}

/// The error of an estimate of a plant's quantity.
struct Miss {
    /// Whether the plant follows the equations.
    inside: bool,
    unknown: Unknown,
    /// The error in standard errors.
    standardised: f64,
}

/// The errors of a fit's estimates.
fn misses(found: &Identified, truth: &QubeModel, inside: bool) -> Vec<Miss> {
    let one = |&Estimate { unknown, value, standard_error, .. }: &Estimate| {
        let standardised = (value - truth.get(unknown.0)) / standard_error;
        Miss { inside, unknown, standardised }
    };
    found.estimates.iter().map(one).collect()
}

/// Prints the number of 90 % intervals that contain the truth, of all intervals, and the root mean
/// square of the errors in standard errors, for plants inside and outside the model class.
fn print_coverage(name: &str, misses: &[&Miss]) {
    let part = |inside: bool| {
        let squares: Vec<f64> = misses
            .iter()
            .filter(|miss| miss.inside == inside)
            .map(|miss| miss.standardised.powi(2))
            .collect();
        let covered = squares.iter().filter(|square| square.sqrt() <= NINETY_PERCENT).count();
        let count = squares.len();
        let root_mean_square = (squares.iter().sum::<f64>() / count as f64).sqrt();
        format!("{covered:>4} of {count:<4} {root_mean_square:>6.2}")
    };
    println!("{name:24} {}    {}", part(true), part(false));
}

fn main() {
    let mut words = std::env::args().skip(1).peekable();
    let added = match words.next_if(|word| word == "other-forms") {
        Some(_) => of_another_form,
        None => outside,
    };
    let [plants, first_seed] = DEFAULTS.map(|default| {
        words.next().map_or(default, |text| text.parse().expect("a number is given"))
    });
    let mut motions: Vec<Motion> = words.map(|text| Motion::named(&text)).collect();
    if motions.is_empty() {
        motions = vec![Motion::named("chirp:1.5"); 2];
    }
    let mut rows: BTreeMap<&str, Row> = BTreeMap::new();
    let mut all: Vec<Miss> = Vec::new();
    for seed in first_seed..first_seed + plants {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let truth = drawn(&mut rng);
        let beyond = added(seed, &mut rng);
        for beyond in [beyond.without(), beyond] {
            let found = identified(&truth, beyond, &motions);
            let row = rows.entry(beyond.name()).or_default();
            row.add(&found);
            let widening = match &found {
                Ok(found) => row.predict(found, &truth, beyond, &motions),
                Err(_) => f64::NAN,
            };
            let words = describe(&found);
            println!("{seed} {:12} held-out {widening:.2} {words}", beyond.name());
            if let Ok(found) = &found {
                all.extend(misses(found, &truth, beyond.name() == NOTHING));
            }
        }
    }
    println!(
        "\n{:12} {:>7} {:>8} {:>8} {:>8} {:>12}   named",
        "effect", "plants", "doubted", "held out", "sign", "within band"
    );
    rows.iter().for_each(|(name, row)| row.line(name));
    let with_effect = || rows.iter().filter(|(name, _)| **name != NOTHING);
    let sum = |count: fn(&Row) -> u32| with_effect().map(|(_, row)| count(row)).sum::<u32>();
    let within =
        percent([0, 1].map(|index| with_effect().map(|(_, row)| row.predicted[index]).sum()));
    let [plants, doubted] = [sum(|row| row.plants), sum(|row| row.doubted)];
    let [held_out, sign] = [sum(|row| row.doubted_by_held_out), sum(|row| row.naming_a_sign)];
    println!("{:12} {plants:>7} {doubted:>8} {held_out:>8} {sign:>8} {within:>12}", "outside");
    println!("\n90 % intervals that contain the truth, and the errors in standard errors (RMS),");
    println!("{:24} inside the equations  outside", "quantity");
    for unknown in Unknown::all() {
        let own: Vec<&Miss> = all.iter().filter(|miss| miss.unknown == unknown).collect();
        print_coverage(unknown.name(), &own);
    }
    print_coverage("all", &all.iter().collect::<Vec<_>>());
}
