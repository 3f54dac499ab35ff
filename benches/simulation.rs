//! Speed of two simulations: control steps per second of the randomised simulation, with reward,
//! observation and box; and of 64 bare lanes with friction, dead zones, cable and delays, over 50
//! periods.
//!
//! `cargo bench --bench simulation`; pin it to one core for comparable figures.

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use qube_hil::elementary::{Level, dispatch_at};
use qube_hil::estimation::EstimatorSettings;
use qube_hil::qube::{BLOCK, ControlPeriod, QubeLanes, State};
use qube_hil::simulation::{
    DomainDistribution, Family, LaneStatus, Pendulums, SensorModel, SimulationSettings, Trajectory,
};

/// Measures control steps of moving pendulums. Voltages alternate slowly, so that the pendulums
/// keep moving inside the box; a pendulum that leaves the box or ends its trajectory starts again.
fn control_steps(criterion: &mut Criterion) {
    let encoders = SensorModel::Encoders { estimator: EstimatorSettings::default() };
    let handcrafted = DomainDistribution::handcrafted(Family::Normal);
    for (name, sensors, history, distribution) in [
        ("true_state", SensorModel::TrueState, 0, &handcrafted),
        ("encoders", encoders, 0, &handcrafted),
        ("nonidealities_and_history", encoders, 2, &DomainDistribution::robust()),
    ] {
        let settings = SimulationSettings { sensors, history, ..SimulationSettings::default() };
        let mut group = criterion.benchmark_group(format!("control_step/{name}"));
        for level in Level::ALL.into_iter().filter(|level| level.is_available()) {
            for lanes in [80, 512] {
                bench_level(&mut group, &settings, distribution, level, lanes);
            }
        }
        group.finish();
    }
}

fn bench_level(
    group: &mut criterion::BenchmarkGroup<'_, criterion::measurement::WallTime>,
    settings: &SimulationSettings,
    distribution: &DomainDistribution,
    level: Level,
    lanes: usize,
) {
    let mut pendulums = Pendulums::new(lanes, settings).at_level(level);
    let mut next_trajectory = 0;
    let mut restart = |pendulums: &mut Pendulums, lane| {
        pendulums.restart(lane, &Trajectory::draw(distribution, 1, next_trajectory));
        next_trajectory += 1;
    };
    for lane in 0..lanes {
        restart(&mut pendulums, lane);
    }
    let mut voltages_v = vec![0.0_f32; lanes];
    let mut rewards = vec![0.0; lanes];
    let mut statuses = vec![LaneStatus::Running; lanes];
    let mut observations = vec![0.0; pendulums.observation_size() * lanes];
    let mut steps = 0_usize;
    group.throughput(Throughput::Elements(lanes as u64));
    group.bench_function(BenchmarkId::new(format!("{level:?}"), lanes), |bencher| {
        bencher.iter(|| {
            if steps.is_multiple_of(25) {
                for (lane, voltage_v) in voltages_v.iter_mut().enumerate() {
                    *voltage_v = if (steps / 25 + lane).is_multiple_of(2) { 1.5 } else { -1.5 };
                }
            }
            steps += 1;
            pendulums.step(&voltages_v, &mut rewards, &mut statuses, &mut observations);
            for (lane, status) in statuses.iter().enumerate() {
                if *status != LaneStatus::Running {
                    restart(&mut pendulums, lane);
                }
            }
        });
    });
}

/// Measures the simulation of half a second of 64 different Qubes, the kind of work that foresight
/// does in each tick.
fn qube_lanes(criterion: &mut Criterion) {
    const PERIODS: usize = 50;
    let blocks = 64 / BLOCK;
    let mut start = vec![QubeLanes::hanging(); blocks];
    for lane in 0..64 {
        let Trajectory { mut model, .. } =
            Trajectory::draw(&DomainDistribution::robust(), 1, lane as u64);
        model.nonidealities.command_delay_s = 0.02 * lane as f64 / 63.0;
        let state = State { theta: 0.3, alpha: 2.0, theta_dot: 5.0, alpha_dot: -8.0 };
        start[lane / BLOCK].restart(lane % BLOCK, &model, &state);
    }
    let mut group = criterion.benchmark_group("qube_lanes");
    group.throughput(Throughput::Elements((64 * PERIODS) as u64));
    for level in Level::ALL.into_iter().filter(|level| level.is_available()) {
        group.bench_function(BenchmarkId::new(format!("{level:?}"), "64x50"), |bencher| {
            let mut qubes = start.clone();
            bencher.iter(|| {
                qubes.clone_from(&start);
                for period in 0..PERIODS {
                    let command_v = if period < PERIODS / 2 { -5.0 } else { 1.0 };
                    let commands_v = [[command_v; BLOCK]; 64 / BLOCK];
                    let period = ControlPeriod { qubes: &mut qubes, commands_v: &commands_v };
                    dispatch_at(level, period);
                }
            });
        });
    }
    group.finish();
}

criterion_group!(benches, control_steps, qube_lanes);
criterion_main!(benches);
