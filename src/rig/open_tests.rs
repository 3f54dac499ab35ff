use super::*;
use crate::clock::VirtualClock;
use crate::device::emulator::EmulatorSettings;
use crate::device::{Device, InProcessWire, SerialLink};
use crate::policy::{ClassicalController, ClassicalGains, Policy};
use crate::preflight::TOO_SLOW_US;
use crate::qube::Measurement;
use crate::recording::samples;
use crate::rig::{Connect, TimedDevice};
use crate::safety::{Guard, GuardConsent, SafetyBox};
use crate::storage::MachineDisk;
use crate::telemetry::{RolloutHeader, TickSettings};

/// An emulated Qube that does not declare itself as emulated, so that it counts as hardware.
struct Undeclared(SerialLink<InProcessWire>);

impl Device for Undeclared {
    fn hello(&mut self) -> Result<Identity, DeviceError> {
        self.0.hello()
    }

    fn arm(&mut self) -> Result<(), DeviceError> {
        self.0.arm()
    }

    fn sample(&mut self, deadline_ns: u64) -> Result<Measurement, LinkFault> {
        self.0.sample(deadline_ns)
    }

    fn act(&mut self, voltage_mv: i16, sampled_at_us: u64) -> Result<(), LinkFault> {
        self.0.act(voltage_mv, sampled_at_us)
    }

    fn disarm(&mut self) -> Result<(), DeviceError> {
        self.0.disarm()
    }
}

/// The connection to an [`Undeclared`] Qube.
#[derive(Debug)]
struct ToUndeclared;

impl Connect for ToUndeclared {
    fn connect(&self, emulator: &EmulatorSettings) -> Result<TimedDevice, DeviceError> {
        let clock = VirtualClock::default();
        let link = SerialLink::in_process(*emulator, clock.clone());
        Ok((Box::new(Undeclared(link)), Arc::new(clock)))
    }
}

/// Settings of a rig with an [`Undeclared`] Qube, whose examination is left out.
fn hardware(limits: HardwareLimits) -> RigSettings {
    let device = DeviceChoice::Other(Arc::new(ToUndeclared));
    RigSettings { limits, skip_check: true, ..RigSettings::in_virtual_time(device) }
}

fn header(safety_box: SafetyBox) -> RolloutHeader {
    let header = samples::header();
    let settings = TickSettings { safety_box, max_steps: 10, ..header.settings };
    RolloutHeader { settings, ..header }
}

#[test]
fn no_real_qube_is_driven_under_foresight_on_a_processor_that_predicts_too_slowly() {
    let consent = GuardConsent::given(Some(Guard::Box), true);
    let without_guard = HardwareLimits::of(SafetyBox::THESIS, consent).unwrap();
    let classical = ClassicalController::new(ClassicalGains::default());
    let policy = Policy::Classical(classical).to_bytes();
    let folder = tempfile::tempdir().unwrap();
    let slow_us = TOO_SLOW_US + 1.0;
    for (limits, safety_box, foresight_time_us, is_refused) in [
        (HardwareLimits::default(), SafetyBox::GUARDED, slow_us, true),
        (HardwareLimits::default(), SafetyBox::GUARDED, TOO_SLOW_US, false),
        (without_guard, SafetyBox::THESIS, slow_us, false),
    ] {
        let settings = hardware(limits);
        let reached = |settings: &RigSettings| {
            let mut rig = Rig::connect(settings, &Arc::default()).unwrap();
            rig.foresight_time_us = foresight_time_us;
            rig.accepted(settings)
        };
        let refused = matches!(reached(&settings), Err(RigError::TooSlow(_)));
        assert_eq!(refused, is_refused, "before the first motion, {foresight_time_us} us");

        let mut rig = Rig::open(&settings, &Arc::default()).unwrap();
        rig.foresight_time_us = foresight_time_us;
        let path = folder.path().join(format!("{safety_box:?} {foresight_time_us}.mcap"));
        let ended = rig.rollout(&MachineDisk, &path, header(safety_box), &policy);
        let refused = matches!(ended, Err(RigError::TooSlow(_)));
        assert_eq!(refused, is_refused, "{ended:?}");
        assert_eq!(ended.is_ok(), !is_refused, "{ended:?}");
    }
}
