//! Time that the guard adds to a tick while a policy runs: the prediction of the brake for 64
//! Qubes, and on an identified Qube the comparison of each sample with its particles.
//!
//! `cargo bench --bench foresight`; pin it to one core for comparable figures. In the rollouts the
//! shipped policy `robust` drives `lab`. For each belief about the Qube (any Qube, or an identified
//! one), with AVX-512 and with AVX2 if the processor has them, it prints mean, 99th percentile and
//! maximum over the ticks of fifty rollouts, where the time of a tick is the shortest of five
//! tries. Criterion measures the first of these rollouts as a whole.

use std::path::Path;
use std::time::Instant;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use qube_hil::elementary::{Level, dispatch};
use qube_hil::policy::{Controller, Policy};
use qube_hil::qube::{
    BLOCK, ControlPeriod, InLanes, MAX_HISTORY, MAX_VOLTAGE_V, PlantModel, Profile, QubeLanes,
    QubeModel, State, limited_to,
};
use qube_hil::safety::{ForesightSettings, IdentifiedQube, TrustedForesight};
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

const ROLLOUTS: u64 = 50;
const STEPS: usize = 600;
const TRIES: usize = 5;

/// The guard's input in a tick: the simulated Qube's state, the last voltages sent, V, newest
/// first, and the policy's voltage, V.
#[derive(Clone, Copy)]
struct Tick {
    state: State,
    sent_v: [f32; MAX_HISTORY],
    voltage_v: f32,
}

fn rollout(model: &QubeModel, seed: u64) -> Vec<Tick> {
    let mut policy = Policy::load(Path::new("policies/robust.safetensors"))
        .expect("the shipped policy can be read");
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut angle = || 0.1 * (2.0 * rng.random::<f32>() - 1.0);
    let start = State { theta: angle(), alpha: angle(), theta_dot: 0.0, alpha_dot: 0.0 };
    let mut qubes = [QubeLanes::hanging()];
    qubes[0].restart(0, model, &start);
    policy.start();
    let mut ticks = Vec::new();
    for _ in 0..STEPS {
        let state = qubes[0].state.lane(0);
        let sent_v = qubes[0].sent_v().map(|sent_v| sent_v[0]);
        let state: State = state.into();
        let voltage_v = limited_to(policy.voltage_v(&state) as f32, MAX_VOLTAGE_V as f32);
        policy.applied(f64::from(voltage_v));
        ticks.push(Tick { state, sent_v, voltage_v });
        dispatch(ControlPeriod { qubes: &mut qubes, commands_v: &[[voltage_v; BLOCK]] });
    }
    ticks
}

/// Runs the guard's part of a tick. Returns whether the guard would end the rollout.
fn guard(foresight: &mut TrustedForesight, index: usize, tick: &Tick) -> bool {
    let time_us = 10_000 * index as u64;
    let unpredicted = foresight.contradiction(&tick.state, time_us, &tick.sent_v).is_some();
    let too_late = foresight.too_late_for(&tick.state.cast(), &tick.sent_v, tick.voltage_v);
    unpredicted | too_late.is_some()
}

/// The shortest time of `TRIES` for each tick, us, and the number of ticks in which the guard would
/// end the rollout.
fn times_us(fresh: &TrustedForesight, ticks: &[Tick]) -> (Vec<f64>, usize) {
    let mut shortest_us = vec![f64::INFINITY; ticks.len()];
    let mut ending = 0;
    for _ in 0..TRIES {
        let mut foresight = fresh.clone();
        foresight.begin_policy();
        ending = 0;
        for (index, (tick, shortest_us)) in ticks.iter().zip(&mut shortest_us).enumerate() {
            let begin = Instant::now();
            let ends = std::hint::black_box(guard(&mut foresight, index, tick));
            *shortest_us = shortest_us.min(1e6 * begin.elapsed().as_secs_f64());
            ending += usize::from(ends);
        }
    }
    (shortest_us, ending)
}

fn figures(mut times_us: Vec<f64>) -> String {
    times_us.sort_by(f64::total_cmp);
    let mean = times_us.iter().sum::<f64>() / times_us.len() as f64;
    let p99 = times_us[times_us.len() * 99 / 100];
    let largest = times_us[times_us.len() - 1];
    format!("mean {mean:.1}, p99 {p99:.1}, largest {largest:.1} us of {} ticks", times_us.len())
}

fn foresight(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("foresight/rollout");
    group.throughput(Throughput::Elements(STEPS as u64));
    let profile = Profile::lab();
    let rollouts: Vec<Vec<Tick>> =
        (0..ROLLOUTS).map(|seed| rollout(&profile.model(), seed)).collect();
    let any = ForesightSettings::default();
    let identified = Some(IdentifiedQube::of(&profile, &PlantModel::QUBE));
    for (belief, settings) in
        [("any", any), ("identified", ForesightSettings { identified, ..any })]
    {
        let levels = [Level::Avx512, Level::Avx2].into_iter();
        for level in levels.filter(|level| level.is_available()) {
            let fresh = settings.foresight(None, &PlantModel::QUBE).at_level(level);
            let (mut all_us, mut ending) = (Vec::new(), 0);
            for ticks in &rollouts {
                let (rollout_us, ends) = times_us(&fresh, ticks);
                all_us.extend(rollout_us);
                ending += ends;
            }
            println!("{belief}, {level:?}: {} ({ending} would end the rollout)", figures(all_us));
            group.bench_function(format!("{belief}/{level:?}"), |bencher| {
                bencher.iter(|| {
                    let mut foresight = fresh.clone();
                    foresight.begin_policy();
                    for (index, tick) in rollouts[0].iter().enumerate() {
                        std::hint::black_box(guard(&mut foresight, index, tick));
                    }
                });
            });
        }
    }
    group.finish();
}

criterion_group!(benches, foresight);
criterion_main!(benches);
