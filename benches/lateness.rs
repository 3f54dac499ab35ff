//! Measures how late the control thread wakes up while policies are trained on the same computer,
//! in real time on an emulated Qube: `cargo bench --bench lateness`.
//!
//! Rollouts with and without trainings alternate in one run. For each of five pairs the program
//! prints the 99th percentile of the lateness with trainings, divided by the 99th percentile
//! without; after the pairs it prints the median of these ratios. It does so for trainings that
//! leave a core free, then for trainings on all cores.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use qube_hil::device::emulator::EmulatorSettings;
use qube_hil::jobs::{Executor, JobEvent, LocalExecutor, TrainingJob};
use qube_hil::learning::TrainSettings;
use qube_hil::policy::{ClassicalController, ClassicalGains, Policy};
use qube_hil::recording::read;
use qube_hil::rig::{ClockChoice, NotBegun, Rig, RigSettings, RolloutPlan};
use qube_hil::safety::SafetyBox;
use qube_hil::scoring::Latencies;
use qube_hil::simulation::DomainDistribution;
use qube_hil::storage::MachineDisk;
use qube_hil::telemetry::LatencySummary;

const PAIRS: usize = 5;

/// Number of rollouts on either side of a pair. In a single rollout fewer than ten ticks are later
/// than the 99th percentile, so that one interruption of the computer decides it.
const ROLLOUTS: usize = 4;

/// Time that the host of a virtual machine has taken from its processors so far, ms; 0 where Linux
/// does not report this time. This loss makes ticks late whatever this program does.
fn stolen_ms() -> f64 {
    let text = std::fs::read_to_string("/proc/stat").unwrap_or_default();
    let hundredths =
        text.lines().next().and_then(|all| all.split_whitespace().nth(8)?.parse().ok());
    // Linux reports the time in hundredths of a second (proc(5)).
    10.0 * hundredths.unwrap_or(0.0)
}

/// The lateness in `ROLLOUTS` rollouts of the classical controller, us.
fn lateness_us(rig: &mut Rig, path: &Path) -> LatencySummary {
    let plan = RolloutPlan {
        safety_box: SafetyBox::THESIS,
        ..RolloutPlan::single("lateness", "classical")
    };
    let policy = Policy::Classical(ClassicalController::new(ClassicalGains::default())).to_bytes();
    let mut latencies = Latencies::default();
    for _ in 0..ROLLOUTS {
        // If the host of this virtual machine takes the processors for long, the pendulum may move
        // unseen between two rollouts, and the rig must start again.
        let mut not_begun = NotBegun::default();
        while let Err(error) = rig.rollout(&MachineDisk, path, plan.header(), &policy) {
            assert!(not_begun.may_repeat(&error), "{error}");
            rig.start_again().unwrap();
        }
        let recording = read(path).unwrap();
        assert!(recording.ticks.len() > 600, "{} ticks", recording.ticks.len());
        latencies.add(&recording.ticks);
        std::fs::remove_file(path).unwrap();
    }
    latencies.lateness_us()
}

/// The lateness in `ROLLOUTS` rollouts, us, while an executor trains as many policies as it can.
fn lateness_beside_us(executor: &LocalExecutor, rig: &mut Rig, path: &Path) -> LatencySummary {
    let stop = AtomicBool::new(false);
    let job = |seed| TrainingJob {
        distribution: DomainDistribution::robust(),
        // The trainings last longer than the rollouts, after which they are stopped.
        settings: TrainSettings { updates: 10_000, ..TrainSettings::thesis() },
        seed,
    };
    let jobs: Vec<TrainingJob> = (0..executor.concurrency() as u64).map(job).collect();
    std::thread::scope(|scope| {
        let trainings = scope.spawn(|| {
            let mut updates = 0;
            executor.train(&jobs, &stop, &mut |event| {
                updates += u32::from(matches!(event, JobEvent::Update { .. }));
            });
            updates
        });
        let lateness_us = lateness_us(rig, path);
        stop.store(true, Ordering::Relaxed);
        assert!(trainings.join().unwrap() > 0, "nothing was trained");
        lateness_us
    })
}

fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted[sorted.len() / 2]
}

/// Measures [`PAIRS`] pairs with this executor and prints each of them and the median ratio.
fn measure(name: &str, executor: &LocalExecutor) {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("rollout.mcap");
    let settings = RigSettings {
        clock: ClockChoice::Wall,
        ..RigSettings::emulated(EmulatorSettings::default())
    };
    let mut rig = Rig::open(&settings, &Arc::default()).unwrap();
    println!("{name}: {} trainings at a time", executor.concurrency());
    let mut ratios = Vec::new();
    for pair in 0..PAIRS {
        let before_ms = stolen_ms();
        // The order alternates, so that a drift of the computer's speed hardly favours either side.
        let (without, with) = if pair % 2 == 0 {
            let without = lateness_us(&mut rig, &path);
            (without, lateness_beside_us(executor, &mut rig, &path))
        } else {
            let with = lateness_beside_us(executor, &mut rig, &path);
            (lateness_us(&mut rig, &path), with)
        };
        ratios.push(with.p99 / without.p99);
        println!(
            "pair {}: lateness p99 {:.2} us without, {:.2} us with trainings: {:.2} times; largest {:.0} and {:.0} us; \
             a host took {:.0} ms of processor time from this computer",
            pair + 1,
            without.p99,
            with.p99,
            ratios[pair],
            without.max,
            with.max,
            stolen_ms() - before_ms
        );
    }
    println!("{name}: median of the ratios {:.2}", median(&ratios));
}

fn main() {
    measure("trainings that leave a core", &LocalExecutor::beside_control_thread());
    measure("trainings on all cores", &LocalExecutor::on_all_cores());
}
