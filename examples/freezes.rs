//! How soon an arm's encoder that freezes in a rollout is found, and what the zero is worth where it is
//! not: `cargo run --release --example freezes -- SEEDS [FIRST_SEED]`.
//!
//! Each rollout is frozen at a random instant at which the policy has the motor: for good, its tachometer at 0
//! or at its last value, or for 500 ms in which counts are lost.

#[path = "../tests/harmless/wire.rs"]
#[allow(dead_code)]
mod wire;

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use qube_hil::clock::{Clock, VirtualClock};
use qube_hil::control::{
    ControlState, Homing, HomingSettings, Motion, Tick, TickInput, TickOutput, drive,
};
use qube_hil::device::emulator::{EmulatorFault, EmulatorSettings};
use qube_hil::device::{Device, SerialLink};
use qube_hil::estimation::EstimatorSettings;
use qube_hil::policy::{ClassicalController, ClassicalGains, Policy};
use qube_hil::qube::{Profile, QubeModel};
use qube_hil::safety::SafetyBox;
use qube_hil::telemetry::{Ending, Fault, TickRules, TickSettings};
use wire::SharedWire;

/// An arm that is faster moves, rad/s.
const MOVES_RAD_S: f64 = 2.0;

/// A motion that notes when the policy got the motor and when the rollout was over.
struct Noted<'a> {
    tick: &'a mut Tick,
    clock: VirtualClock,
    wire: SharedWire,
    ran_s: Option<(f64, f64)>,
    onset_s: f64,
    /// When the arm was first faster than an arm may be that only drifts, s.
    moved_s: Option<f64>,
}

impl Motion for Noted<'_> {
    fn decide(&mut self, input: &TickInput) -> TickOutput {
        let now_s = self.clock.now_ns() as f64 * 1e-9;
        let output = self.tick.decide(input);
        if self.tick.control_state() == ControlState::Running {
            self.ran_s = Some((self.ran_s.map_or(now_s, |(first, _)| first), now_s));
        }
        if now_s >= self.onset_s && self.wire.state().theta_dot.abs() > MOVES_RAD_S {
            self.moved_s.get_or_insert(now_s);
        }
        output
    }

    fn control_state(&self) -> ControlState {
        self.tick.control_state()
    }

    fn device_mv(&self, voltage_mv: i16) -> i16 {
        self.tick.device_mv(voltage_mv)
    }
}

struct Outcome {
    ending: Ending,
    ran_s: (f64, f64),
    over_s: f64,
    moved_s: Option<f64>,
    zero_off_rad: f64,
}

fn rollout(
    model: QubeModel,
    policy: &Policy,
    seed: u64,
    fault: Option<(EmulatorFault, f64)>,
) -> Option<Outcome> {
    let clock = VirtualClock::default();
    let onset_s = fault.map_or(f64::INFINITY, |(_, at_s)| at_s);
    let settings = EmulatorSettings {
        model,
        seed,
        fault: fault.map(|(fault, _)| fault),
        ..Default::default()
    };
    let wire = SharedWire::new(settings, clock.clone());
    let shared: Arc<dyn Clock> = Arc::new(clock.clone());
    let mut device = SerialLink::new(wire.clone(), shared);
    device.hello().expect("an emulated Qube answers");
    let stop = AtomicBool::new(false);
    let mut homing = Homing::new(&HomingSettings::default());
    drive(&mut device, &clock, &mut homing, None, &stop).expect("it arms");
    let calibration = homing.calibration()?;
    let settings = TickSettings {
        calibration,
        estimator: EstimatorSettings::default(),
        safety_box: SafetyBox::GUARDED,
        max_steps: 600,
        start_theta_rad: 0.05,
        stops: None,
        rules: TickRules::Witnessed,
    };
    let mut tick = Tick::new(&settings, policy.clone());
    let mut noted = Noted {
        tick: &mut tick,
        clock: clock.clone(),
        wire: wire.clone(),
        ran_s: None,
        onset_s,
        moved_s: None,
    };
    let report = drive(&mut device, &clock, &mut noted, None, &stop).expect("it arms");
    let (ran_s, moved_s) = (noted.ran_s, noted.moved_s);
    let over_s = clock.now_ns() as f64 * 1e-9;
    let sample = device.sample(clock.now_ns() + 6_000_000).ok()?;
    let zero_off_rad = (calibration.angles_rad(&sample).0 - wire.state().theta).abs();
    Some(Outcome { ending: report.outcome.ending, ran_s: ran_s?, over_s, moved_s, zero_off_rad })
}

fn within(found_ms: &[f64]) -> usize {
    found_ms.iter().filter(|ms| **ms <= 300.0).count()
}

/// Median, 90 % and longest.
fn quantiles(found_ms: &mut [f64]) -> String {
    found_ms.sort_by(f64::total_cmp);
    let last = found_ms.len().saturating_sub(1) as f64;
    let texts = [0.5, 0.9, 1.0].map(|share| {
        found_ms
            .get((share * last).round() as usize)
            .map_or_else(|| "-".to_owned(), |ms| format!("{ms:.0}"))
    });
    texts.join(", ")
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let number = |index: usize, default: u64| {
        arguments.get(index).map_or(default, |text| text.parse().expect("a number"))
    };
    let (seeds, first_seed) = (number(0, 20), number(1, 0));
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let lab = std::fs::read_to_string(root.join("profiles/lab.toml")).expect("the profile lab");
    let lab = Profile::parse(&lab).expect("the profile lab").model();
    let robust = Policy::load(&root.join("policies/robust.safetensors")).expect("the policy");
    let classical = Policy::Classical(ClassicalController::new(ClassicalGains::default()));
    println!(
        "| Qube | policy | fault | freezes | found | of them within 300 ms | ms: median, 90 %, longest | arm moved (faster than 2 rad/s) | found within 300 ms of that | ms after that: median, 90 %, longest | counted, zero off by more than 0.05 rad | largest error of theta there, rad | named otherwise |\n| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |"
    );
    for (qube, model) in
        [("nominal", QubeModel::NOMINAL), ("lab", lab), ("gap 1.5", lab.scaled(1.5))]
    {
        for (name, policy) in [("robust", &robust), ("classical", &classical)] {
            let mut rows: [Vec<Outcome>; 3] = Default::default();
            let mut onsets: [Vec<f64>; 3] = Default::default();
            let mut false_alarms = 0;
            for seed in first_seed..first_seed + seeds {
                let Some(healthy) = rollout(model, policy, seed, None) else { continue };
                false_alarms += u32::from(matches!(healthy.ending, Ending::Fault(_)));
                let (from_s, to_s) = healthy.ran_s;
                // The golden ratio spreads the instants evenly.
                let share = (seed as f64 * 0.618_033_988_75).fract();
                let at_s = from_s + share * (to_s - from_s - 0.35).max(0.0);
                let faults = [
                    EmulatorFault::FrozenTheta { after_s: at_s },
                    EmulatorFault::StuckTheta { after_s: at_s },
                    EmulatorFault::LapsingTheta { after_s: at_s, lasts_s: 0.5 },
                ];
                for (index, fault) in faults.into_iter().enumerate() {
                    if let Some(outcome) = rollout(model, policy, seed, Some((fault, at_s))) {
                        rows[index].push(outcome);
                        onsets[index].push(at_s);
                    }
                }
            }
            for ((outcomes, onsets), fault) in
                rows.iter().zip(&onsets).zip(["dead", "stuck", "500 ms"])
            {
                let (mut found_ms, mut moved_ms) = (Vec::new(), Vec::new());
                let (mut moved, mut counted, mut otherwise, mut error_rad) = (0, 0, 0, 0.0_f64);
                for (outcome, onset_s) in outcomes.iter().zip(onsets) {
                    let is_fault = matches!(outcome.ending, Ending::Fault(_));
                    moved += u32::from(outcome.moved_s.is_some());
                    if is_fault {
                        found_ms.push(1e3 * (outcome.over_s - onset_s));
                        moved_ms.extend(outcome.moved_s.map(|at_s| 1e3 * (outcome.over_s - at_s)));
                        otherwise +=
                            u32::from(outcome.ending != Ending::Fault(Fault::EncoderFrozen));
                    }
                    if !is_fault && outcome.zero_off_rad > 0.05 {
                        counted += 1;
                        error_rad = error_rad.max(outcome.zero_off_rad);
                    }
                }
                println!(
                    "| {qube} | {name} | {fault} | {} | {} | {} | {} | {moved} | {} | {} | {counted} | {error_rad:.2} | {otherwise} |",
                    outcomes.len(),
                    found_ms.len(),
                    within(&found_ms),
                    quantiles(&mut found_ms),
                    within(&moved_ms),
                    quantiles(&mut moved_ms),
                );
            }
            println!("{qube}, {name}: {false_alarms} false alarms in {seeds} healthy rollouts");
        }
    }
}
