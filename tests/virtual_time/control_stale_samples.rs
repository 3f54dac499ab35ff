//! Tests that every act needs a fresh sample of its own: with lost samples, with a host that hangs,
//! and with a device that repeats one sample.

use std::sync::atomic::AtomicBool;

use qube_hil::clock::{Clock, VirtualClock};
use qube_hil::control::{ControlState, Motion, Tick, TickInput, TickOutput, drive};
use qube_hil::device::emulator::EmulatorSettings;
use qube_hil::device::{Device, DeviceError, Identity, InProcessWire, LinkFault, SerialLink};
use qube_hil::estimation::Calibration;
use qube_hil::policy::{ClassicalController, ClassicalGains, Policy};
use qube_hil::qube::{Measurement, State};
use qube_hil::rig::RolloutPlan;
use qube_hil::safety::{MotorHeat, SafetyBox};
use qube_hil::telemetry::{Ending, Fault, TickSettings};

/// The delivery of a sample from the device to the tick.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Delivery {
    Comes,
    Lost,
    /// The first sample with this delivery comes again instead.
    Repeats,
}

/// The emulated Qube in virtual time, with a planned delivery of the sample of each tick.
struct PlannedQube {
    link: SerialLink<InProcessWire>,
    clock: VirtualClock,
    delivery: fn(u32) -> Delivery,
    ticks: u32,
    repeated: Option<Measurement>,
    /// Tick and result of each act.
    acts: Vec<(u32, Result<(), LinkFault>)>,
}

impl PlannedQube {
    fn new(delivery: fn(u32) -> Delivery) -> Self {
        let clock = VirtualClock::default();
        let link = SerialLink::in_process(EmulatorSettings::default(), clock.clone());
        let mut device = Self { link, clock, delivery, ticks: 0, repeated: None, acts: Vec::new() };
        device.hello().expect("the emulated Qube answers");
        device
    }
}

impl Device for PlannedQube {
    fn hello(&mut self) -> Result<Identity, DeviceError> {
        self.link.hello()
    }

    fn arm(&mut self) -> Result<(), DeviceError> {
        self.link.arm()
    }

    fn sample(&mut self, deadline_ns: u64) -> Result<Measurement, LinkFault> {
        let sample = self.link.sample(deadline_ns)?;
        self.ticks += 1;
        match (self.delivery)(self.ticks - 1) {
            Delivery::Comes => Ok(sample),
            Delivery::Lost => {
                self.clock.sleep_until(deadline_ns);
                Err(LinkFault::Timeout)
            }
            Delivery::Repeats => Ok(*self.repeated.get_or_insert(sample)),
        }
    }

    fn act(&mut self, voltage_mv: i16, sampled_at_us: u64) -> Result<(), LinkFault> {
        let sent = self.link.act(voltage_mv, sampled_at_us);
        self.acts.push((self.ticks - 1, sent));
        sent
    }

    fn disarm(&mut self) -> Result<(), DeviceError> {
        self.link.disarm()
    }

    fn is_hardware(&self) -> bool {
        false
    }
}

/// A motion of constant voltage that records the samples that it gets.
struct Constant {
    ticks: u32,
    /// The tick in which the host hangs for 25 ms before it acts.
    hangs_at: Option<(u32, VirtualClock)>,
    seen: Vec<Measurement>,
}

const TICKS: u32 = 100;

impl Constant {
    fn new(hangs_at: Option<(u32, VirtualClock)>) -> Self {
        Self { ticks: 0, hangs_at, seen: Vec::new() }
    }
}

impl Motion for Constant {
    fn decide(&mut self, input: &TickInput) -> TickOutput {
        if let Some((tick, clock)) = &self.hangs_at
            && *tick == self.ticks
        {
            clock.advance(25_000_000);
        }
        self.ticks += 1;
        self.seen.extend(input.measurement);
        let ending = (self.ticks == TICKS).then_some(Ending::Completed);
        TickOutput::outside_rollout(State::default(), 200, None, ending)
    }

    fn control_state(&self) -> ControlState {
        ControlState::Ready
    }

    fn device_mv(&self, voltage_mv: i16) -> i16 {
        voltage_mv
    }
}

/// Drives the motion on the device and returns the motion's ending.
fn drives(device: &mut PlannedQube, motion: &mut dyn Motion) -> Ending {
    let clock = device.clock.clone();
    let report =
        drive(device, &clock, motion, &mut MotorHeat::default(), None, &AtomicBool::new(false))
            .expect("an armed board");
    assert!(report.disarmed.is_ok());
    report.outcome.ending
}

/// Three of four samples are lost, the most that is tolerated: one act in tick 0, the next in tick
/// 4. That is within the device's watchdog of 50 ms.
#[test]
fn a_voltage_that_is_held_through_lost_samples_is_no_new_act() {
    let mut device =
        PlannedQube::new(|tick| if tick % 4 == 0 { Delivery::Comes } else { Delivery::Lost });
    let mut motion = Constant::new(None);
    assert_eq!(drives(&mut device, &mut motion), Ending::Completed);
    assert!(motion.seen.iter().all(|it| it.status.armed && !it.status.watchdog_tripped));
    assert_eq!(motion.seen.len() as u32, TICKS / 4);
    let acted: Vec<u32> = device.acts.iter().map(|(tick, _)| *tick).collect();
    assert_eq!(
        acted,
        (0..TICKS).step_by(4).collect::<Vec<_>>(),
        "an act in a tick without a sample"
    );
    assert!(device.acts.iter().all(|(_, sent)| sent.is_ok()));
}

#[test]
fn a_host_that_hangs_between_sample_and_act_sends_no_act() {
    let mut device = PlannedQube::new(|_| Delivery::Comes);
    let mut motion = Constant::new(Some((10, device.clock.clone())));
    assert_eq!(drives(&mut device, &mut motion), Ending::Completed);
    let refused: Vec<_> = device.acts.iter().filter(|(_, sent)| sent.is_err()).collect();
    assert_eq!(refused, [&(10, Err(LinkFault::StaleSample))]);
    assert!(motion.seen.iter().all(|it| it.status.armed), "a hang of 25 ms switched the motor off");
}

/// The checks of the sensors do not end such a motion: they ignore a sample that has the same
/// device time as the sample before.
#[test]
fn a_device_that_repeats_one_sample_is_a_fault_in_the_next_tick() {
    let mut device =
        PlannedQube::new(|tick| if tick < 30 { Delivery::Comes } else { Delivery::Repeats });
    let settings = TickSettings {
        calibration: Calibration::IDENTITY,
        safety_box: SafetyBox { theta: 100.0, alpha: 1e4, ..SafetyBox::THESIS },
        start_theta_rad: 0.0,
        ..RolloutPlan::single("test", "test").header().settings
    };
    let policy = Policy::Classical(ClassicalController::new(ClassicalGains::default()));
    let ending = drives(&mut device, &mut Tick::new(&settings, policy));
    assert_eq!(ending, Ending::Fault(Fault::DeviceClock));
    assert_eq!(device.ticks, 32, "the sample came again in tick 31, which is not the last");
    assert_eq!(device.link.transport().board().applied_mv(), 0);
}
