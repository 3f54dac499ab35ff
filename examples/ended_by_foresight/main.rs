//! Counts the successful swing-ups that foresight would end: for Qubes that are not identified,
//! whose parameters may be off by 10 to 30 %, and for an identified Qube.
//!
//! `cargo run --release --example ended_by_foresight [-- POLICY ...]`. The shipped policies, the
//! named ones and the classical controller run on each Qube, and on Qubes with one parameter 10 %
//! off, guarded by the thesis's box alone. Foresight then examines every tick of the rollouts that
//! succeed.
//!
//! `--held N` and `--margin RAD` change the guard of the identified Qube: it holds a voltage for N
//! periods, or keeps the arm RAD from its stops. The identified Qube's profile is centred on the
//! Qube of the row and has the standard errors and correlations of `lab`. Some Qubes have effects
//! that no profile contains: play, and friction that yields before it slides.

#[path = "../beyond_the_equations/mechanics.rs"]
mod mechanics;
mod plant;

use std::path::Path;

use clap::Parser;
use qube_hil::estimation::{Calibration, Estimator, EstimatorSettings};
use qube_hil::policy::{ClassicalController, ClassicalGains, Controller, Policy};
use qube_hil::qube::{
    DomainParameter, MAX_HISTORY, Measurement, Nonidealities, PlantModel, Profile, QubeModel,
    State, counts, wrap_angle,
};
use qube_hil::safety::{Belief, ForesightSettings, IdentifiedQube, SafetyBox};

use plant::{Beyond, Kind, Plant};

/// Command-line arguments.
#[derive(Parser)]
struct Arguments {
    /// Policies beside those that are shipped.
    policies: Vec<String>,
    /// Control periods for which the guard of the identified Qube holds a voltage.
    #[arg(long)]
    held: Option<u32>,
    /// Distance that the guard of the identified Qube keeps from the arm's stops, rad.
    #[arg(long)]
    margin: Option<f64>,
}

/// Number of steps of a rollout.
const STEPS: u64 = 600;

/// Number of final steps in which the pendulum must balance.
const BALANCED_STEPS: u64 = 200;

/// The guard's input in a tick.
struct Tick {
    state: State,
    sent_v: [f32; MAX_HISTORY],
    voltage_v: f32,
}

/// Runs a rollout guarded by the box alone and returns its ticks; `None` if the rollout does not
/// succeed. Success here: the arm stays in the box, and the pendulum within 0.2 rad of upright
/// over the last 2 s.
fn rollout(kind: &Kind, policy: &mut dyn Controller, theta: f64) -> Option<Vec<Tick>> {
    let mut plant = Plant::at_rest(kind, theta);
    let mut estimator = Estimator::new(EstimatorSettings::default(), Calibration::IDENTITY);
    let (mut sent_v, mut ticks) = ([0.0; MAX_HISTORY], Vec::new());
    policy.start();
    for step in 0..STEPS {
        let [theta, alpha] = plant.angles();
        let estimates = estimator.update(&Measurement {
            device_time_us: (step + 1) * 10_000,
            theta_counts: counts(theta),
            alpha_counts: counts(alpha),
            ..Measurement::default()
        });
        let upright = wrap_angle(alpha - std::f64::consts::PI).abs() < 0.2;
        if SafetyBox::THESIS.violation(&estimates.guarded).is_some()
            || (step + BALANCED_STEPS >= STEPS && !upright)
        {
            return None;
        }
        let voltage_v = policy.voltage_v(&estimates.seen).clamp(-5.0, 5.0);
        policy.applied(voltage_v);
        let state = estimates.guarded;
        ticks.push(Tick { state, sent_v, voltage_v: voltage_v as f32 });
        sent_v.rotate_right(1);
        sent_v[0] = voltage_v as f32;
        plant.advance(voltage_v);
    }
    Some(ticks)
}

/// The Qube itself, and Qubes with one parameter (gravity excepted) 10 % larger or smaller.
fn around(kind: &Kind) -> Vec<Kind> {
    let mut kinds = vec![*kind];
    for parameter in DomainParameter::ALL {
        if parameter != DomainParameter::Gravity {
            for factor in [0.9, 1.1] {
                let mut other = *kind;
                let nominal = kind.model.parameters.get(parameter);
                other.model.parameters.set(parameter, factor * nominal);
                kinds.push(other);
            }
        }
    }
    kinds
}

/// The Qubes of the table's rows, by name. `gap 0.5` and `gap 1.5` scale the nonidealities of `lab`
/// and the distance of its parameters from nominal.
fn kinds(lab: QubeModel) -> Vec<(&'static str, Kind)> {
    let plain = |model| Kind { model, beyond_the_model: Beyond::Nothing };
    let late = |delay_s| {
        plain(QubeModel {
            nonidealities: Nonidealities { command_delay_s: delay_s, ..lab.nonidealities },
            ..lab
        })
    };
    let beyond = |beyond_the_model| Kind { model: lab, beyond_the_model };
    vec![
        ("ideal", plain(QubeModel::NOMINAL)),
        ("`lab`", plain(lab)),
        ("gap 0.5", plain(lab.scaled(0.5))),
        ("gap 1.5", plain(lab.scaled(1.5))),
        ("no delay", late(0.0)),
        ("16 ms of delay", late(0.016)),
        ("play of 0.5 degrees", beyond(Beyond::Play(0.5_f64.to_radians()))),
        ("play of 1 degree", beyond(Beyond::Play(1.0_f64.to_radians()))),
        ("presliding over 0.02 rad", beyond(Beyond::Presliding(0.02))),
    ]
}

/// Counts the rollouts that foresight ends if the Qube's parameters are known only up to the
/// relative error `within`.
fn ended_unknown(good: &[Vec<Tick>], within: f64) -> usize {
    let belief = Belief::of_any_qube(within);
    let mut foresight = ForesightSettings { belief, ..ForesightSettings::default() }
        .foresight(None, &PlantModel::QUBE);
    let mut is_ended = |ticks: &&Vec<Tick>| {
        ticks.iter().any(|tick| {
            let state = tick.state.cast();
            foresight.too_late_for(&state, &tick.sent_v, tick.voltage_v).is_some()
        })
    };
    good.iter().filter(|ticks| is_ended(ticks)).count()
}

/// Counts the rollouts that foresight ends for an identified Qube: first those in which the brake
/// would come too late, then those whose motion the profile did not predict.
fn ended_identified(good: &[Vec<Tick>], profile: &Profile, guard: &Arguments) -> [usize; 2] {
    let known = IdentifiedQube::of(profile, &PlantModel::QUBE);
    let usual = ForesightSettings::default();
    let held_periods = guard.held.unwrap_or(known.held_periods);
    let identified = Some(IdentifiedQube { held_periods, ..known });
    let margin_rad = guard.margin.unwrap_or(usual.margin_rad);
    let settings = ForesightSettings { identified, margin_rad, ..usual };
    let mut ended = [0; 2];
    for ticks in good {
        let mut foresight = settings.foresight(None, &PlantModel::QUBE);
        foresight.begin_policy();
        let end = (0_u64..).zip(ticks).find_map(|(index, tick)| {
            let time_us = (index + 1) * 10_000;
            let unpredicted = foresight.contradiction(&tick.state, time_us, &tick.sent_v).is_some();
            let (state, voltage_v) = (tick.state.cast(), tick.voltage_v);
            let too_late = foresight.too_late_for(&state, &tick.sent_v, voltage_v).is_some();
            (too_late || unpredicted).then_some(usize::from(!too_late))
        });
        if let Some(end) = end {
            ended[end] += 1;
        }
    }
    ended
}

fn main() {
    let arguments = Arguments::parse();
    let profile = Profile::lab();
    let mut files =
        vec!["policies/robust.safetensors".to_owned(), "policies/nominal.safetensors".to_owned()];
    files.extend(arguments.policies.iter().cloned());
    println!(
        "| Qube | policy | succeed in the box | ended at 10, 15, 20, 30 % | identified: ended by the brake, by \
         the prediction |"
    );
    println!("| --- | --- | --- | --- | --- |");
    let (mut all, mut all_ended) = (0, [0; 6]);
    for (name, kind) in kinds(profile.model()) {
        for file in files.iter().map(Some).chain([None]) {
            let new_policy = || -> Box<dyn Controller> {
                match file {
                    Some(file) => {
                        Box::new(Policy::load(Path::new(file)).expect("the policy can be read"))
                    }
                    None => Box::new(ClassicalController::new(ClassicalGains::default())),
                }
            };
            let starts = around(&kind).into_iter().flat_map(|kind| [(kind, -0.08), (kind, 0.08)]);
            let good: Vec<Vec<Tick>> = starts
                .filter_map(|(kind, theta)| rollout(&kind, new_policy().as_mut(), theta))
                .collect();
            let unknown = [0.1, 0.15, 0.2, 0.3].map(|within| ended_unknown(&good, within));
            let identified =
                ended_identified(&good, &profile.around(name, &kind.model), &arguments);
            let stem = file.and_then(|file| Path::new(file).file_stem()?.to_str());
            println!(
                "| {name} | {} | {} | {unknown:?} | {identified:?} |",
                stem.unwrap_or("classical"),
                good.len()
            );
            all += good.len();
            for (sum, ended) in all_ended.iter_mut().zip(unknown.iter().chain(&identified)) {
                *sum += ended;
            }
        }
    }
    println!("| all | | {all} | {:?} | {:?} |", &all_ended[..4], &all_ended[4..]);
}
