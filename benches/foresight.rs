//! What it costs to try the brake at each tick of a rollout, for 64 Qubes that this one may be.
//!
//! `cargo bench --bench foresight`; pin it to one core for figures to compare. The rollout is one of the
//! shipped policy `robust` on `lab`, the particles lie within 10 % of it, delays within 30 %. Two kinds
//! of figures: the mean over all ticks of the rollout, by criterion, and before that the mean, the 99th
//! percentile and the maximum of single ticks over fifty such rollouts, each tick's shortest time
//! of five.

use std::path::Path;
use std::time::Instant;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use qube_hil::elementary::{Level, dispatch};
use qube_hil::policy::{Controller, Policy};
use qube_hil::qube::{
    BLOCK, ControlPeriod, DomainParameter, InLanes, MAX_HISTORY, Profile, QubeLanes, QubeModel,
    State, limited_voltage,
};
use qube_hil::safety::{CentringBrake, Ends, Foresight, Particle, Reach};
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

const PARTICLES: usize = 64;
const HORIZON: u32 = 75;
const ROLLOUTS: u64 = 50;
const REACH: Reach = Reach { held: 2, horizon: HORIZON };
const STEPS: usize = 600;
const ENDS: Ends = Ends { low_rad: -2.2, high_rad: 2.2 };

/// A tick: what is known and asked for.
struct Tick {
    state: State<f32>,
    sent_v: [f32; MAX_HISTORY],
    voltage_v: f32,
}

fn lab() -> QubeModel {
    let text = std::fs::read_to_string("profiles/lab.toml").expect("the shipped profile");
    Profile::parse(&text).expect("the shipped profile").model()
}

fn particles() -> Vec<Particle> {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let mut about = |reach: f64| 1.0 + reach * (2.0 * rng.random::<f64>() - 1.0);
    (0..PARTICLES)
        .map(|_| {
            let mut model = lab();
            for parameter in DomainParameter::ALL {
                let own = model.parameters.get(parameter);
                model.parameters.set(parameter, own * about(0.1));
            }
            model.gap.coulomb_torque_n_m *= about(0.1);
            model.gap.cable_stiffness_n_m_rad *= about(0.1);
            model.gap.command_delay_s *= about(0.3);
            Particle::exact(model)
        })
        .collect()
}

fn rollout(seed: u64) -> Vec<Tick> {
    let mut policy = Policy::load(Path::new("policies/robust.safetensors")).expect("the policy");
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut angle = || 0.1 * (2.0 * rng.random::<f32>() - 1.0);
    let start = State { theta: angle(), alpha: angle(), theta_dot: 0.0, alpha_dot: 0.0 };
    let mut qubes = [QubeLanes::hanging()];
    qubes[0].restart(0, &lab(), &start);
    policy.start();
    let mut ticks = Vec::new();
    for _ in 0..STEPS {
        let state = qubes[0].state.lane(0);
        let sent_v = qubes[0].sent_v().map(|sent_v| sent_v[0]);
        let seen = State {
            theta: f64::from(state.theta),
            alpha: f64::from(state.alpha),
            theta_dot: f64::from(state.theta_dot),
            alpha_dot: f64::from(state.alpha_dot),
        };
        let voltage_v = limited_voltage(policy.voltage_v(&seen) as f32);
        policy.applied(f64::from(voltage_v));
        ticks.push(Tick { state, sent_v, voltage_v });
        dispatch(ControlPeriod { qubes: &mut qubes, commands_v: &[[voltage_v; BLOCK]] });
    }
    ticks
}

fn single_ticks(level: Level, foresight: &mut Foresight<CentringBrake>) {
    let (mut times_us, mut whole_us) = (Vec::new(), Vec::new());
    let (mut periods, mut held) = (0.0, 0);
    for tick in (0..ROLLOUTS).flat_map(rollout) {
        let mut shortest_us = f64::INFINITY;
        for _ in 0..5 {
            let begin = Instant::now();
            let outlook = foresight.look(&tick.state, &tick.sent_v, tick.voltage_v);
            shortest_us = shortest_us.min(1e6 * begin.elapsed().as_secs_f64());
            std::hint::black_box(outlook);
        }
        let outlook = foresight.look(&tick.state, &tick.sent_v, tick.voltage_v);
        periods += f64::from(outlook.periods);
        held += u32::from(outlook.holds);
        times_us.push(shortest_us);
        if outlook.periods == HORIZON {
            whole_us.push(shortest_us);
        }
    }
    let count = times_us.len();
    let figures = |mut times_us: Vec<f64>| {
        times_us.sort_by(f64::total_cmp);
        let Some(&largest) = times_us.last() else { return "none".to_owned() };
        let mean = times_us.iter().sum::<f64>() / times_us.len() as f64;
        let p99 = times_us[times_us.len() * 99 / 100];
        format!("mean {mean:.1}, p99 {p99:.1}, largest {largest:.1} us of {}", times_us.len())
    };
    println!(
        "{level:?}: {held} of {count} ticks hold, {:.1} periods a tick",
        periods / count as f64
    );
    println!("  all ticks: {}", figures(times_us));
    println!("  whole horizon: {}", figures(whole_us));
}

fn foresight(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("foresight/rollout");
    group.throughput(Throughput::Elements(STEPS as u64));
    let ticks = rollout(0);
    for level in Level::ALL.into_iter().filter(|level| level.is_available()) {
        let brake = CentringBrake::default();
        let mut foresight = Foresight::new(&particles(), brake, ENDS, REACH).at_level(level);
        if level != Level::Plain {
            single_ticks(level, &mut foresight);
        }
        group.bench_function(format!("{level:?}"), |bencher| {
            bencher.iter(|| {
                for tick in &ticks {
                    let outlook = foresight.look(&tick.state, &tick.sent_v, tick.voltage_v);
                    std::hint::black_box(outlook);
                }
            });
        });
    }
    group.finish();
}

criterion_group!(benches, foresight);
criterion_main!(benches);
