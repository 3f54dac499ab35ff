//! One start, executed as a rig does it: hello, homing, then rollouts until a fault ends them or
//! time is up.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use qube_hil::clock::{Clock, VirtualClock};
use qube_hil::control::{
    ControlState, Homing, HomingSettings, Motion, Tick, TickInput, TickOutput, drive,
};
use qube_hil::device::{Device, SerialLink};
use qube_hil::policy::{ClassicalController, ClassicalGains};
use qube_hil::qube::{CONTROL_PERIOD_NS, State};
use qube_hil::rig::RolloutPlan;
use qube_hil::safety::MotorHeat;
use qube_hil::telemetry::{Ending, TickSettings};

use super::case::{Case, Start};
use super::wire::SharedWire;

/// Time after which a start begins no further rollout, s. The latest fault begins 15 s before it.
const LONGEST_S: f64 = 75.0;

/// Error of the zero that makes a result false, rad.
const ZERO_WITHIN_RAD: f64 = 0.05;

/// The result of a start.
#[derive(Clone, Copy, Debug)]
pub struct Trial {
    /// Fastest contact with a stop while homing or settling, and while the arm coasted after it,
    /// rad/s. A contact counts only if it was faster than all before it.
    pub contact_before_policy_rad_s: f64,
    /// Fastest contact in a rollout, its braking, and while the arm coasted after it, rad/s. A
    /// contact counts only if it was faster than all before it.
    pub rollout_contact_rad_s: f64,
    /// Fastest contact of the same start with the amplifier off, rad/s.
    pub contact_off_rad_s: f64,
    /// Duration of homing, s; `None` if it did not succeed.
    pub homed_after_s: Option<f64>,
    /// Ending of the last motion.
    pub ending: Ending,
    /// State of control when the fault began; `None` if the start ended before.
    pub struck_in: Option<ControlState>,
    /// Total duration, s.
    pub lasted_s: f64,
    /// Time from the fault until the amplifier was off, s.
    pub off_after_s: f64,
    /// Rollouts that counted as results although the fault began before the policy lost the motor
    /// and the arm's zero was off by more than [`ZERO_WITHIN_RAD`].
    pub false_results: u32,
}

/// A motion that records contacts of the arm with a stop, and the state of control at each.
struct Watched<'a, M> {
    motion: M,
    notes: &'a mut Notes,
}

struct Notes {
    wire: SharedWire,
    clock: VirtualClock,
    onset_s: f64,
    so_far_rad_s: f64,
    gentle_rad_s: f64,
    rollout_rad_s: f64,
    struck_in: Option<ControlState>,
    /// Last state of control in which the motor was on.
    last_state: ControlState,
    /// Time at which the policy last had the motor, s.
    ran_until_s: f64,
    /// Beginning and end of the time in which the motor has 0 V, as with the amplifier off, s.
    off: Option<(f64, f64)>,
}

impl Notes {
    fn note(&mut self, state: ControlState) {
        let fastest = self.wire.fastest_contact_rad_s();
        if fastest > self.so_far_rad_s {
            self.so_far_rad_s = fastest;
            match state {
                ControlState::Running | ControlState::Braking | ControlState::Faulting => {
                    self.rollout_rad_s = fastest;
                }
                _ => self.gentle_rad_s = fastest,
            }
        }
        if !matches!(state, ControlState::Ready | ControlState::Faulted) {
            self.last_state = state;
        }
        if state == ControlState::Running {
            self.ran_until_s = seconds(&self.clock);
        }
        if self.struck_in.is_none() && seconds(&self.clock) >= self.onset_s {
            self.struck_in = Some(state);
        }
    }

    /// Drives a motion to its end and returns its ending.
    fn drive(&mut self, device: &mut dyn Device, motion: &mut dyn Motion) -> Ending {
        let clock = self.clock.clone();
        let stop = AtomicBool::new(false);
        let mut watched = Watched { motion, notes: self };
        let report = drive(device, &clock, &mut watched, &mut MotorHeat::default(), None, &stop)
            .expect("an armed board");
        report.outcome.ending
    }

    /// Lets the arm coast for 3 s with the amplifier off.
    fn coast(&mut self) {
        self.clock.advance(3_000_000_000);
        self.note(self.last_state);
    }
}

fn seconds(clock: &VirtualClock) -> f64 {
    clock.now_ns() as f64 * 1e-9
}

impl Motion for Watched<'_, &mut dyn Motion> {
    fn decide(&mut self, input: &TickInput) -> TickOutput {
        self.notes.note(self.motion.control_state());
        let now_s = seconds(&self.notes.clock);
        if let Some((from_s, until_s)) = self.notes.off
            && now_s >= from_s
        {
            let ending = (now_s >= until_s).then_some(Ending::Stopped);
            return TickOutput::outside_rollout(State::default(), 0, None, ending);
        }
        self.motion.decide(input)
    }

    fn control_state(&self) -> ControlState {
        self.motion.control_state()
    }

    fn device_mv(&self, voltage_mv: i16) -> i16 {
        self.motion.device_mv(voltage_mv)
    }
}

/// Executes a start; the same start gives the same trial.
pub fn play(start: &Start) -> Trial {
    let trial = play_until(start, None);
    let contact_off_rad_s = contact_off_rad_s(start, &trial);
    Trial { contact_off_rad_s, ..trial }
}

/// Executes a start; with `off`, the motor has 0 V from the first of these times until the second,
/// at which the start ends.
fn play_until(start: &Start, off: Option<(f64, f64)>) -> Trial {
    let clock = VirtualClock::default();
    let wire = SharedWire::new(start.settings, clock.clone());
    let shared: Arc<dyn Clock> = Arc::new(clock.clone());
    let mut device = SerialLink::new(wire.clone(), shared);
    let mut notes = Notes {
        wire,
        clock: clock.clone(),
        onset_s: start.fault_onset_s,
        so_far_rad_s: 0.0,
        gentle_rad_s: 0.0,
        rollout_rad_s: 0.0,
        struck_in: None,
        last_state: ControlState::Homing,
        ran_until_s: 0.0,
        off,
    };
    device.hello().expect("an emulated Qube answers");
    let mut homing = Homing::new(&HomingSettings::default());
    let mut ending = notes.drive(&mut device, &mut homing);
    let homed_after_s = (ending == Ending::Completed).then(|| seconds(&clock));
    let mut off_s = seconds(&clock);
    let mut false_results = 0;
    if ending == Ending::Completed {
        let calibration = homing.measured().expect("a homed Qube").calibration;
        while seconds(&clock) < LONGEST_S {
            let settings = TickSettings {
                calibration,
                start_theta_rad: 0.05,
                ..RolloutPlan::single("test", "test").header().settings
            };
            let controller = ClassicalController::new(ClassicalGains::default());
            let mut tick = Tick::new(&settings, controller);
            ending = notes.drive(&mut device, &mut tick);
            off_s = seconds(&clock);
            if matches!(ending, Ending::Fault(_) | Ending::Stopped) {
                break;
            }
            // An encoder that fails while the arm is at rest loses no counts: the zero decides.
            let sample = device.sample(clock.now_ns() + 6_000_000).expect("a sample of the Qube");
            let zero_error_rad = calibration.angles_rad(&sample).0 - notes.wire.state().theta;
            let strikes = start.settings.fault.is_some() && notes.ran_until_s > start.fault_onset_s;
            false_results += u32::from(strikes && zero_error_rad.abs() > ZERO_WITHIN_RAD);
            // A session needs this time between two rollouts.
            clock.advance(20 * CONTROL_PERIOD_NS);
        }
    }
    notes.coast();
    Trial {
        contact_before_policy_rad_s: notes.gentle_rad_s,
        rollout_contact_rad_s: notes.rollout_rad_s,
        contact_off_rad_s: 0.0,
        homed_after_s,
        ending,
        struck_in: notes.struck_in,
        off_after_s: off_s - start.fault_onset_s,
        lasted_s: seconds(&clock),
        false_results,
    }
}

/// Fastest contact of the same start with the amplifier off, rad/s: from the beginning if the arm
/// starts beside a stop, from the instant of the fault in [`Case::MotorDeadLater`]. It is 0 in all
/// other cases, and if the start itself had no contact while homing or settling.
///
/// It is computed with the same ticks, because a falling pendulum amplifies every rounding error.
fn contact_off_rad_s(start: &Start, trial: &Trial) -> f64 {
    let from_s = match start.case {
        Case::MotorDeadLater => start.fault_onset_s,
        Case::BesideAStop | Case::BesideAStopFalling => 0.0,
        _ => return 0.0,
    };
    if trial.contact_before_policy_rad_s == 0.0 {
        return 0.0;
    }
    let off = play_until(start, Some((from_s, trial.lasted_s)));
    off.contact_before_policy_rad_s.max(off.rollout_contact_rad_s)
}
