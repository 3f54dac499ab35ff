//! Measures lag and noise of each estimator, and how well policies transfer with each estimator to
//! Qubes on which they were not trained: the tables of docs/estimation.md.
//!
//! ```text
//! cargo run --release --example estimator_study -- errors POLICY [NOISE ...]
//! cargo run --release --example estimator_study -- delays POLICY ...
//! cargo run --release --example estimator_study -- plants POLICY ...
//! ```
//!
//! `errors`: the policy, which sees the true state at the instant at which its command acts, swings
//! up the Qube of profiles/lab.toml; every estimator gets the same samples and commands. Each NOISE
//! adds two observers with this process noise, rad/s^2. `delays` and `plants`: each policy, with
//! each estimator, drives the emulated Qube over its wire in virtual time.

use std::path::Path;
use std::sync::atomic::AtomicBool;

use anyhow::Context;
use qube_hil::clock::VirtualClock;
use qube_hil::control::{Homing, HomingSettings, RING_CAPACITY, Tick, drive};
use qube_hil::device::emulator::EmulatorSettings;
use qube_hil::device::{Device, SerialLink};
use qube_hil::estimation::{
    Calibration, Estimates, Estimator, EstimatorSettings, ObserverSettings, SentVoltages,
};
use qube_hil::policy::{Controller, Policy};
use qube_hil::qube::{
    DomainParameter, Measurement, NonidealDynamics, Profile, QubeModel, RewardWeights, State,
    counts, runge_kutta_4,
};
use qube_hil::safety::{Guard, MotorHeat, SafetyBox};
use qube_hil::scoring::criterion::{SUCCESS_RETURN, balanced_to_the_end};
use qube_hil::scoring::return_of;
use qube_hil::telemetry::{Ending, Phase, TickRecord, TickSettings};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Number of rollouts of a policy on a Qube. Each of the [`PLANTS`] Qubes that share a column has
/// one rollout only.
const ROLLOUTS: u64 = 5;

/// Number of Qubes around the profile, each parameter within 10 % of the profile's value.
const PLANTS: u64 = 20;

/// Number of true states that are stored in each control period.
const GRID: usize = 20;
/// Time between two true states, us.
const GRID_US: u64 = 500;

fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [mode, policies @ ..] = arguments.as_slice() else {
        anyhow::bail!(
            "usage: estimator_study errors POLICY [NOISE ...]|delays POLICY ...|plants POLICY ..."
        );
    };
    let lab = Profile::lab().model();
    match (mode.as_str(), policies) {
        ("errors", [policy, noises @ ..]) => {
            let noises = noises.iter().map(|text| text.parse()).collect::<Result<Vec<f64>, _>>()?;
            errors(&lab, &load(policy)?, &noises);
        }
        ("delays", [_, ..]) => delays(&lab, &all(policies)?),
        ("plants", [_, ..]) => plants(&lab, &all(policies)?),
        _ => anyhow::bail!(
            "usage: estimator_study errors POLICY [NOISE ...]|delays POLICY ...|plants POLICY ..."
        ),
    }
    Ok(())
}

fn load(path: &str) -> anyhow::Result<Policy> {
    Policy::load(Path::new(path)).with_context(|| path.to_owned())
}

fn all(paths: &[String]) -> anyhow::Result<Vec<Policy>> {
    paths.iter().map(|path| load(path)).collect()
}

/// The estimators to compare on a Qube with the delay `delay_s`, by name.
fn estimators(lab: &QubeModel, delay_s: f64) -> Vec<(String, EstimatorSettings)> {
    let observer = |model: &QubeModel, delay_s: f64| {
        EstimatorSettings::observer(ObserverSettings::of(*model).with_delay(delay_s.max(0.0)))
    };
    let nominal = QubeModel::NOMINAL;
    vec![
        ("filter 50".into(), EstimatorSettings::filter(50.0)),
        ("filter 200".into(), EstimatorSettings::filter(200.0)),
        ("filter 1000".into(), EstimatorSettings::filter(1000.0)),
        ("observer lab".into(), observer(lab, delay_s)),
        ("observer lab, delay 5 ms too long".into(), observer(lab, delay_s + 0.005)),
        ("observer lab, delay 5 ms too short".into(), observer(lab, delay_s - 0.005)),
        ("observer lab, no delay".into(), observer(lab, 0.0)),
        ("observer nominal".into(), observer(&nominal, delay_s)),
        ("observer nominal, no delay".into(), observer(&nominal, 0.0)),
    ]
}

// --- lag and noise ---

/// A swing-up: each sample with its command, V, and the true states on a fine grid.
struct SwingUp {
    samples: Vec<(Measurement, f64)>,
    truth: Vec<State>,
}

/// Runs the policy on a Qube. The policy sees the true state at the instant at which its command
/// acts.
fn swing_up_of(model: &QubeModel, policy: &Policy, start: State) -> SwingUp {
    let (dynamics, mut policy) = (NonidealDynamics::<f64>::new(model), policy.clone());
    policy.start();
    let mut sent = SentVoltages::new(model.nonidealities.command_delay_s, 0.0);
    let mut state = start;
    let mut swing_up = SwingUp { samples: Vec::new(), truth: Vec::new() };
    let moved = |sent: &SentVoltages, mut state: State, from_us: u64, until_us: u64| {
        for piece in sent.between(from_us, until_us) {
            state = runge_kutta_4(&dynamics, state, piece.voltage, 1e-6 * piece.duration_us as f64);
        }
        state
    };
    for tick in 0..600_u64 {
        let now_us = tick * 10_000;
        let mut ahead = state;
        let (mut at_us, acts_us) = (now_us, now_us + sent.delay_us());
        while at_us < acts_us {
            let next_us = (at_us + GRID_US).min(acts_us);
            ahead = moved(&sent, ahead, at_us, next_us);
            at_us = next_us;
        }
        let voltage_v = policy.voltage_v(&ahead).clamp(-5.0, 5.0);
        policy.applied(voltage_v);
        let measurement = Measurement {
            device_time_us: now_us,
            theta_counts: counts(state.theta),
            alpha_counts: counts(state.alpha),
            ..Measurement::default()
        };
        sent.send(now_us, voltage_v);
        swing_up.samples.push((measurement, voltage_v));
        for step in 0..GRID as u64 {
            swing_up.truth.push(state);
            let at_us = now_us + step * GRID_US;
            state = moved(&sent, state, at_us, at_us + GRID_US);
        }
    }
    swing_up
}

/// The estimate at each sample of a swing-up, and the number of times that the observer was reset.
fn estimate(swing_up: &SwingUp, settings: EstimatorSettings) -> (Vec<State>, u32) {
    let mut estimator = Estimator::new(settings, Calibration::IDENTITY);
    let seen = swing_up
        .samples
        .iter()
        .map(|(measurement, voltage_v)| {
            let Estimates { seen, .. } = estimator.update(measurement);
            estimator.send(*voltage_v);
            seen
        })
        .collect();
    (seen, estimator.observer_resets())
}

/// Errors of one velocity over all swing-ups.
struct Errors {
    /// Root mean square error against the true velocity at the instant at which the command acts,
    /// rad/s.
    at_command: f64,
    /// Lag of the estimate behind that instant, ms.
    lag_ms: f64,
    /// Root mean square error against the true velocity earlier by the lag, rad/s.
    noise: f64,
}

fn velocity_errors(
    swing_ups: &[(SwingUp, Vec<State>)],
    delay_s: f64,
    velocity: fn(&State) -> f64,
) -> Errors {
    let delay = (delay_s * 1e6 / GRID_US as f64).round() as isize;
    // The root mean square error against the true values `shift` steps of the grid after the
    // samples.
    let off = |shift: isize| {
        let (mut sum, mut count) = (0.0, 0.0);
        for (swing_up, seen) in swing_ups {
            for (tick, state) in seen.iter().enumerate().skip(10) {
                let at = (tick * GRID) as isize + shift;
                if let Some(truth) = usize::try_from(at).ok().and_then(|at| swing_up.truth.get(at))
                {
                    sum += (velocity(state) - velocity(truth)).powi(2);
                    count += 1.0;
                }
            }
        }
        f64::sqrt(sum / count)
    };
    // Shifts of up to 30 ms in either direction.
    let reach = 60;
    let best =
        (-reach..=reach).min_by(|one, other| off(*one).total_cmp(&off(*other))).unwrap_or_default();
    Errors {
        at_command: off(delay),
        lag_ms: (delay - best) as f64 * GRID_US as f64 * 1e-3,
        noise: off(best),
    }
}

fn errors(lab: &QubeModel, policy: &Policy, noises: &[f64]) {
    let delay_s = lab.nonidealities.command_delay_s;
    let mut rows = estimators(lab, delay_s);
    for &noise in noises {
        for (name, model) in [("lab", *lab), ("nominal", QubeModel::NOMINAL)] {
            let observer = ObserverSettings {
                theta_noise_rad_s2: noise,
                alpha_noise_rad_s2: noise,
                ..ObserverSettings::of(model).with_delay(delay_s)
            };
            let settings = EstimatorSettings::observer(observer);
            rows.push((format!("observer {name}, noise {noise} rad/s^2"), settings));
        }
    }
    println!(
        "| estimator | arm: at command, rad/s | lag, ms | noise, rad/s | pendulum: at command | lag | noise | resets |"
    );
    println!("| --- | --- | --- | --- | --- | --- | --- | --- |");
    for (name, settings) in rows {
        let mut resets = 0;
        let swing_ups: Vec<_> = (0..ROLLOUTS)
            .map(|number| {
                let theta = -0.1 + 0.05 * number as f64;
                let swing_up = swing_up_of(lab, policy, State { theta, ..State::default() });
                let (seen, times) = estimate(&swing_up, settings);
                resets += times;
                (swing_up, seen)
            })
            .collect();
        let theta = velocity_errors(&swing_ups, delay_s, |state| state.theta_dot);
        let alpha = velocity_errors(&swing_ups, delay_s, |state| state.alpha_dot);
        println!(
            "| {name} | {:.2} | {:.1} | {:.2} | {:.2} | {:.1} | {:.2} | {resets} |",
            theta.at_command,
            theta.lag_ms,
            theta.noise,
            alpha.at_command,
            alpha.lag_ms,
            alpha.noise
        );
    }
}

// --- transfer ---

/// The results of the rollouts in a cell of a table.
#[derive(Default)]
struct Tally {
    rollouts: u32,
    successes: u32,
    return_sum: f64,
    resets: u32,
}

impl Tally {
    fn cell(&self) -> String {
        let rollouts = f64::from(self.rollouts);
        format!(
            "{:.0} % ({:.0}{})",
            100.0 * f64::from(self.successes) / rollouts,
            self.return_sum / rollouts,
            if self.resets > 0 {
                format!(", {} observer resets", self.resets)
            } else {
                String::new()
            }
        )
    }

    /// Runs one rollout on the emulated Qube after homing, guarded by the box alone.
    fn add(&mut self, model: &QubeModel, estimator: EstimatorSettings, policy: &Policy, seed: u64) {
        let clock = VirtualClock::default();
        let emulator = EmulatorSettings { model: *model, seed, ..EmulatorSettings::default() };
        let mut device = SerialLink::in_process(emulator, clock.clone());
        let stop = AtomicBool::new(false);
        let mut homing = Homing::new(&HomingSettings::default());
        self.rollouts += 1;
        let homed = device.hello().is_ok()
            && drive(&mut device, &clock, &mut homing, &mut MotorHeat::default(), None, &stop)
                .is_ok();
        let Some(measured) = homing.measured().filter(|_| homed) else { return };
        let settings = TickSettings {
            calibration: measured.calibration,
            estimator,
            safety_box: SafetyBox { guard: Guard::Box, ..SafetyBox::THESIS },
            max_steps: 600,
            start_theta_rad: 0.1 * (seed as f64).sin(),
            stops: None,
            foresight: None,
            rules: qube_hil::telemetry::TickRules::NEWEST,
            plant: qube_hil::qube::PlantModel::QUBE,
        };
        let (mut producer, mut consumer) = rtrb::RingBuffer::new(RING_CAPACITY);
        let mut tick = Tick::new(&settings, policy.clone());
        let Ok(report) = drive(
            &mut device,
            &clock,
            &mut tick,
            &mut MotorHeat::default(),
            Some(&mut producer),
            &stop,
        ) else {
            return;
        };
        let records: Vec<TickRecord> = std::iter::from_fn(|| consumer.pop().ok()).collect();
        let running = records.iter().filter(|tick| tick.phase == Phase::Running);
        let seen: Vec<State> = running.map(|tick| tick.state).collect();
        let return_ = return_of(&records, &RewardWeights::THESIS);
        self.count(&seen, return_, report.outcome.ending == Ending::Completed);
        self.resets += report.outcome.observer_resets;
    }

    /// Runs one rollout in which the policy sees the true state at the instant at which its command
    /// acts.
    fn add_exact(&mut self, model: &QubeModel, policy: &Policy, seed: u64) {
        let theta = 0.1 * (seed as f64).sin();
        let swing_up = swing_up_of(model, policy, State { theta, ..State::default() });
        let states: Vec<State> = swing_up.truth.iter().step_by(GRID).copied().collect();
        let stays = |state: &&State| SafetyBox::THESIS.violation(state).is_none();
        let inside = states.iter().take_while(stays).count();
        let earned = states.iter().zip(&swing_up.samples).take(inside);
        let return_ = earned
            .map(|(state, (_, voltage_v))| RewardWeights::THESIS.reward(state, *voltage_v))
            .sum();
        self.rollouts += 1;
        self.count(&states[..inside], return_, inside == states.len());
    }

    fn count(&mut self, states: &[State], return_: f64, completed: bool) {
        let succeeds = completed && return_ >= SUCCESS_RETURN && balanced_to_the_end(states.iter());
        self.successes += u32::from(succeeds);
        self.return_sum += return_;
    }
}

fn delays(lab: &QubeModel, policies: &[Policy]) {
    let plants = [0.0, 6.0, 10.0, 16.0, 20.0].map(|delay_ms| {
        let mut plant = *lab;
        plant.nonidealities.command_delay_s = 1e-3 * delay_ms;
        Column { plants: vec![plant], rollouts: ROLLOUTS, delay_s: 1e-3 * delay_ms }
    });
    println!("| estimator | 0 ms | 6 ms | 10 ms | 16 ms | 20 ms |");
    println!("| --- | --- | --- | --- | --- | --- |");
    transfer(lab, &plants, policies);
}

fn plants(lab: &QubeModel, policies: &[Policy]) {
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let around = (0..PLANTS)
        .map(|_| {
            let mut model = *lab;
            for parameter in DomainParameter::ALL {
                let factor = random.random_range(0.9..1.1);
                model.parameters.set(parameter, factor * model.parameters.get(parameter));
            }
            model
        })
        .collect();
    let column =
        |plants, rollouts| Column { plants, rollouts, delay_s: lab.nonidealities.command_delay_s };
    let columns =
        [column(vec![*lab], ROLLOUTS), column(around, 1), column(vec![lab.scaled(1.5)], ROLLOUTS)];
    println!("| estimator | lab | each parameter within 10 %, {PLANTS} Qubes | `--gap 1.5` |");
    println!("| --- | --- | --- | --- |");
    transfer(lab, &columns, policies);
}

/// The Qubes whose rollouts are counted together in a column of a table.
struct Column {
    plants: Vec<QubeModel>,
    /// Rollouts of each policy on each Qube.
    rollouts: u64,
    /// Delay that the estimators assume, s.
    delay_s: f64,
}

/// Prints a row for each estimator, after a row for policies that see the true state.
fn transfer(lab: &QubeModel, columns: &[Column], policies: &[Policy]) {
    let cells = |rollout: &dyn Fn(&mut Tally, &QubeModel, f64, &Policy, u64)| {
        let cells: Vec<String> = columns
            .iter()
            .map(|column| {
                let mut tally = Tally::default();
                for plant in &column.plants {
                    for policy in policies {
                        for seed in 0..column.rollouts {
                            rollout(&mut tally, plant, column.delay_s, policy, seed);
                        }
                    }
                }
                tally.cell()
            })
            .collect();
        cells.join(" | ")
    };
    let exact = cells(&|tally, plant, _, policy, seed| tally.add_exact(plant, policy, seed));
    println!("| the true state at the command | {exact} |");
    for (row, (name, _)) in estimators(lab, 0.0).into_iter().enumerate() {
        let row = cells(&|tally, plant, delay_s, policy, seed| {
            let (_, estimator) = estimators(lab, delay_s).swap_remove(row);
            tally.add(plant, estimator, policy, seed);
        });
        println!("| {name} | {row} |");
    }
}
