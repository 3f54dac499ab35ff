//! Rollouts in which the arm's encoder freezes: the time until the freeze is found, and the error
//! of the arm's zero after it.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use qube_hil::clock::{Clock, VirtualClock};
use qube_hil::control::{
    ControlState, Homing, HomingSettings, Motion, Tick, TickInput, TickOutput, drive,
};
use qube_hil::device::emulator::{EmulatorFault, EmulatorSettings};
use qube_hil::device::{Device, SerialLink};
use qube_hil::policy::{ClassicalController, ClassicalGains, Policy};
use qube_hil::qube::{Profile, QubeModel};
use qube_hil::rig::RolloutPlan;
use qube_hil::safety::{MotorHeat, SafetyBox};
use qube_hil::telemetry::{Ending, Fault, TickSettings};

use super::wire::SharedWire;

/// A motion that records the times at which the policy gets and loses control of the motor.
struct Noted<'a> {
    tick: &'a mut Tick,
    clock: VirtualClock,
    ran_s: Option<(f64, f64)>,
}

impl Motion for Noted<'_> {
    fn decide(&mut self, input: &TickInput) -> TickOutput {
        let now_s = self.clock.now_ns() as f64 * 1e-9;
        let previous = self.tick.control_state();
        let output = self.tick.decide(input);
        if self.tick.control_state() == ControlState::Running {
            self.ran_s = Some((self.ran_s.map_or(now_s, |(first, _)| first), now_s));
        } else if previous == ControlState::Running
            && let Some((_, last_s)) = &mut self.ran_s
        {
            *last_s = now_s;
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

/// A rollout's ending, the time of its policy, and the final error of the zero.
pub struct Outcome {
    pub ending: Ending,
    /// Times at which the policy got and lost control of the motor, s of the emulated Qube.
    pub ran_s: (f64, f64),
    /// Final error of the arm's zero, rad.
    pub zero_off_rad: f64,
}

/// Homes an emulated Qube and runs a rollout, optionally with a fault; `None` if homing fails, the
/// policy never gets the motor, or the Qube gives no sample afterwards.
pub fn rollout(
    qube: EmulatorSettings,
    policy: &Policy,
    fault: Option<EmulatorFault>,
) -> Option<Outcome> {
    let clock = VirtualClock::default();
    let settings = EmulatorSettings { fault, ..qube };
    let wire = SharedWire::new(settings, clock.clone());
    let shared: Arc<dyn Clock> = Arc::new(clock.clone());
    let mut device = SerialLink::new(wire.clone(), shared);
    device.hello().expect("an emulated Qube answers");
    let stop = AtomicBool::new(false);
    let mut homing = Homing::new(&HomingSettings::default());
    drive(&mut device, &clock, &mut homing, &mut MotorHeat::default(), None, &stop)
        .expect("an armed board");
    let calibration = homing.measured()?.calibration;
    let settings = TickSettings {
        calibration,
        safety_box: SafetyBox::THESIS,
        start_theta_rad: 0.05,
        ..RolloutPlan::single("test", "test").header().settings
    };
    let mut tick = Tick::new(&settings, policy.clone());
    let mut noted = Noted { tick: &mut tick, clock: clock.clone(), ran_s: None };
    let report = drive(&mut device, &clock, &mut noted, &mut MotorHeat::default(), None, &stop)
        .expect("an armed board");
    let ran_s = noted.ran_s;
    let sample = device.sample(clock.now_ns() + 6_000_000).ok()?;
    let zero_off_rad = (calibration.angles_rad(&sample).0 - wire.state().theta).abs();
    Some(Outcome { ending: report.outcome.ending, ran_s: ran_s?, zero_off_rad })
}

/// Function from an onset, s of the emulated Qube's time, to a fault that begins then.
type FaultFrom = fn(f64) -> EmulatorFault;

/// The kinds of freeze of the arm's encoder: a name, and the fault as a function of its onset.
pub const KINDS: [(&str, FaultFrom); 3] = [
    ("dead", |after_s| EmulatorFault::FrozenTheta { after_s }),
    ("stuck", |after_s| EmulatorFault::StuckTheta { after_s }),
    ("500 ms", |after_s| EmulatorFault::LapsingTheta { after_s, lasts_s: 0.5 }),
];

/// A rollout with a freeze.
pub struct Freeze {
    pub outcome: Outcome,
    /// Onset of the freeze, s of the emulated Qube's time.
    pub onset_s: f64,
}

impl Freeze {
    /// Time from the freeze until the policy lost the motor in a rollout that ended with a fault,
    /// ms; `None` if the rollout counts as a result.
    pub fn found_ms(&self) -> Option<f64> {
        let is_fault = matches!(self.outcome.ending, Ending::Fault(_));
        is_fault.then_some(1e3 * (self.outcome.ran_s.1 - self.onset_s).max(0.0))
    }

    /// Returns whether a fault other than the frozen encoder ended the rollout.
    pub fn is_named_otherwise(&self) -> bool {
        matches!(self.outcome.ending, Ending::Fault(fault) if fault != Fault::EncoderFrozen)
    }

    /// Returns whether the rollout counts as a result although its zero is wrong by more than
    /// 0.05 rad.
    pub fn counts_wrongly(&self) -> bool {
        self.found_ms().is_none() && self.outcome.zero_off_rad > 0.05
    }
}

/// One [`Freeze`] for each of the [`KINDS`]; `None` where [`rollout`] returns `None`.
pub type Freezes = [Option<Freeze>; KINDS.len()];

/// Runs an undisturbed rollout, then the same rollout with a freeze of each of the [`KINDS`];
/// `None` if [`rollout`] returns `None` for the undisturbed one. The seed determines the instant of the freeze:
/// over many seeds the instants are spread evenly over the time in which the policy drives, except
/// its last 0.35 s.
pub fn freezes(qube: EmulatorSettings, policy: &Policy) -> Option<(Outcome, Freezes)> {
    let healthy = rollout(qube, policy, None)?;
    let (from_s, to_s) = healthy.ran_s;
    let share = (qube.seed as f64 * 0.618_033_988_75).fract();
    let onset_s = from_s + share * (to_s - from_s - 0.35).max(0.0);
    let frozen = KINDS.map(|(_, fault)| {
        let outcome = rollout(qube, policy, Some(fault(onset_s)))?;
        Some(Freeze { outcome, onset_s })
    });
    Some((healthy, frozen))
}

/// Qubes by name: nominal, like a real one, farther from nominal, with much friction, with play.
pub fn qubes() -> [(&'static str, EmulatorSettings); 5] {
    let lab = Profile::lab().model();
    let mut sticky = lab;
    sticky.nonidealities.coulomb_torque_n_m *= 3.0;
    let of = |model| EmulatorSettings { model, ..EmulatorSettings::default() };
    [
        ("nominal", of(QubeModel::NOMINAL)),
        ("lab", of(lab)),
        ("gap 1.5", of(lab.scaled(1.5))),
        ("friction x 3", of(sticky)),
        ("play 1 degree", EmulatorSettings { play_rad: 1_f64.to_radians(), ..of(lab) }),
    ]
}

/// The shipped policy for an unknown Qube and the classical controller.
pub fn policies() -> [(&'static str, Policy); 2] {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let robust =
        Policy::load(&root.join("policies/robust.safetensors")).expect("the shipped policy");
    let classical = Policy::Classical(ClassicalController::new(ClassicalGains::default()));
    [("robust", robust), ("classical", classical)]
}
