//! Which share of good swing-ups foresight of the brake would end, by how much is not known of the Qube, and of
//! one that is identified: with the standard errors and correlations of `lab`, at the middle of the Qubes it is
//! asked of.
//!
//! `cargo run --release --example ended_by_foresight [-- HELD_PERIODS]`. Rollouts of the shipped policy `robust` and of the
//! classical controller on `lab`, half and one and a half times its gap and the nominal Qube, and on each of
//! them with one parameter 10 % off, run in the thesis's box alone; those that succeed are looked at again.

use std::collections::VecDeque;
use std::path::Path;

use qube_hil::estimation::{Calibration, Estimator, EstimatorSettings};
use qube_hil::policy::{ClassicalController, ClassicalGains, Controller, Policy};
use qube_hil::qube::{
    CONTROL_PERIOD_S, DomainParameter, GapDynamics, MAX_HISTORY, Measurement, Profile, QubeModel,
    State, counts, runge_kutta_4, wrap_angle,
};
use qube_hil::safety::{Belief, ForesightSettings, IdentifiedQube, SafetyBox};

/// Steps of a rollout, and those at its end in which the pendulum must stand.
const STEPS: u64 = 600;
const STANDING: u64 = 200;

/// Integration steps in a control period.
const FINE_STEPS: u32 = 20;

/// What the guard is asked in a tick.
struct Tick {
    state: State,
    sent_v: [f32; MAX_HISTORY],
    voltage_v: f32,
}

/// A Qube whose commands arrive late.
struct Plant {
    dynamics: GapDynamics,
    delay_s: f64,
    state: State,
    /// Newest first.
    commands_v: VecDeque<f64>,
}

impl Plant {
    fn advance(&mut self, voltage_v: f64) {
        self.commands_v.push_front(voltage_v);
        self.commands_v.truncate(MAX_HISTORY + 2);
        let step_s = CONTROL_PERIOD_S / f64::from(FINE_STEPS);
        for step in 0..FINE_STEPS {
            let sent_s = (f64::from(step) + 0.5) * step_s - self.delay_s;
            let age = (-sent_s / CONTROL_PERIOD_S).ceil().max(0.0) as usize;
            let voltage_v = self.commands_v.get(age).copied().unwrap_or(0.0);
            self.state = runge_kutta_4(&self.dynamics, self.state, voltage_v, step_s);
        }
    }
}

/// The ticks of a rollout in the box alone; none if it does not succeed.
fn rollout(model: &QubeModel, policy: &mut dyn Controller, theta: f64) -> Option<Vec<Tick>> {
    let mut plant = Plant {
        dynamics: GapDynamics::new(model),
        delay_s: model.gap.command_delay_s,
        state: State { theta, ..State::default() },
        commands_v: VecDeque::new(),
    };
    let mut estimator = Estimator::new(EstimatorSettings::default(), Calibration::IDENTITY);
    let (mut sent_v, mut ticks) = ([0.0; MAX_HISTORY], Vec::new());
    policy.start();
    for step in 0..STEPS {
        let estimates = estimator.update(&Measurement {
            device_time_us: (step + 1) * 10_000,
            theta_counts: counts(plant.state.theta),
            alpha_counts: counts(plant.state.alpha),
            ..Measurement::default()
        });
        let upright = wrap_angle(plant.state.alpha - std::f64::consts::PI).abs() < 0.2;
        if SafetyBox::THESIS.violation(&estimates.guarded).is_some()
            || (step + STANDING >= STEPS && !upright)
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

/// The Qube itself, and with each parameter but gravity 10 % more and less.
fn around(model: &QubeModel) -> Vec<QubeModel> {
    let mut models = vec![*model];
    for parameter in DomainParameter::ALL {
        if parameter != DomainParameter::Gravity {
            for factor in [0.9, 1.1] {
                let mut other = *model;
                other.parameters.set(parameter, factor * model.parameters.get(parameter));
                models.push(other);
            }
        }
    }
    models
}

/// Another Qube, known as well as this one.
fn around_model(profile: &Profile, model: &QubeModel) -> Profile {
    let mut other = Profile { parameters: model.parameters, gap: model.gap, ..profile.clone() };
    for parameter in DomainParameter::ALL {
        let grown = model.parameters.get(parameter) / profile.parameters.get(parameter);
        if let Some(error) = other.standard_errors.get_mut(parameter.symbol()) {
            *error *= grown;
        }
    }
    other
}

fn main() {
    let held_periods =
        std::env::args().nth(1).map_or(ForesightSettings::default().held_periods, |held| {
            held.parse().expect("control periods")
        });
    let text = std::fs::read_to_string("profiles/lab.toml").expect("the shipped profile");
    let profile = Profile::parse(&text).expect("the shipped profile");
    let lab = profile.model();
    let plants = [
        ("lab", lab),
        ("gap 0.5", lab.scaled(0.5)),
        ("gap 1.5", lab.scaled(1.5)),
        ("nominal", QubeModel::NOMINAL),
    ];
    let shares = [0.1, 0.15, 0.2, 0.3];
    println!(
        "| Qube | policy | succeed in the box | ended at 10, 15, 20, 30 % | identified: ended by the brake, by \
         the prediction |"
    );
    println!("| --- | --- | --- | --- | --- |");
    for (name, plant) in plants {
        for kind in ["robust", "classical"] {
            let mut good = Vec::new();
            for (model, theta) in
                around(&plant).iter().flat_map(|model| [(model, -0.08), (model, 0.08)])
            {
                let mut policy: Box<dyn Controller> = if kind == "robust" {
                    let path = Path::new("policies/robust.safetensors");
                    Box::new(Policy::load(path).expect("the shipped policy"))
                } else {
                    Box::new(ClassicalController::new(ClassicalGains::default()))
                };
                good.extend(rollout(model, policy.as_mut(), theta));
            }
            let ended = shares.map(|within| {
                let belief = Belief::of_any_qube(within);
                let settings =
                    ForesightSettings { belief, held_periods, ..ForesightSettings::default() };
                let mut foresight = settings.foresight(None);
                let mut ends = |ticks: &&Vec<Tick>| {
                    ticks.iter().any(|tick| {
                        let state = tick.state.cast();
                        foresight.too_late_for(&state, &tick.sent_v, tick.voltage_v).is_some()
                    })
                };
                good.iter().filter(|ticks| ends(ticks)).count()
            });
            let settings = ForesightSettings {
                identified: Some(IdentifiedQube::of(&around_model(&profile, &plant))),
                held_periods,
                ..ForesightSettings::default()
            };
            let mut identified = [0; 2];
            for ticks in &good {
                let mut foresight = settings.foresight(None);
                foresight.begin_policy();
                let end = (0_u64..).zip(ticks).find_map(|(index, tick)| {
                    let time_us = (index + 1) * 10_000;
                    let unpredicted = foresight.is_contradicted(&tick.state, time_us, &tick.sent_v);
                    let (state, voltage_v) = (tick.state.cast(), tick.voltage_v);
                    let too_late =
                        foresight.too_late_for(&state, &tick.sent_v, voltage_v).is_some();
                    (too_late || unpredicted).then_some(usize::from(!too_late))
                });
                if let Some(end) = end {
                    identified[end] += 1;
                }
            }
            println!("| {name} | {kind} | {} | {ended:?} | {identified:?} |", good.len());
        }
    }
}
