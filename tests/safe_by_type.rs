//! What may be driven how: whether something is hardware is declared and never guessed, and on
//! hardware no file and no caller widens a limit. In virtual time.

use std::sync::Arc;

use qube_hil::clock::{Clock, VirtualClock};
use qube_hil::device::emulator::EmulatorSettings;
use qube_hil::device::{
    Device, DeviceError, Identity, InProcessWire, LinkFault, SerialLink, Transport,
};
use qube_hil::qube::Measurement;
use qube_hil::session::{ClockChoice, Connect, DeviceChoice, Rig, RigSettings, TimedDevice};

/// A Qube of which nobody has said whether it is hardware.
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

/// A way to it that declares nothing either, or that it is an emulator.
#[derive(Debug)]
struct Way {
    declares_emulated: bool,
}

impl Connect for Way {
    fn connect(&self, emulator: &EmulatorSettings) -> Result<TimedDevice, DeviceError> {
        let clock = VirtualClock::default();
        let link = SerialLink::in_process(*emulator, clock.clone());
        Ok((Box::new(Undeclared(link)), Arc::new(clock)))
    }

    fn is_hardware(&self) -> bool {
        !self.declares_emulated
    }
}

/// As [`Way`], with nothing said at all.
#[derive(Debug)]
struct SilentWay;

impl Connect for SilentWay {
    fn connect(&self, emulator: &EmulatorSettings) -> Result<TimedDevice, DeviceError> {
        Way { declares_emulated: true }.connect(emulator)
    }
}

fn rig_settings(device: DeviceChoice) -> RigSettings {
    RigSettings {
        device,
        clock: ClockChoice::Virtual,
        emulator: EmulatorSettings::default(),
        homing: Default::default(),
        skip_check: false,
        board: None,
        limits: Default::default(),
    }
}

#[test]
fn what_declares_nothing_is_hardware_before_and_after_it_has_answered() {
    let silent = rig_settings(DeviceChoice::Other(Arc::new(SilentWay)));
    assert!(silent.is_hardware() && silent.checks());
    assert!(rig_settings(DeviceChoice::Port("/dev/null".into())).is_hardware());
    assert!(!rig_settings(DeviceChoice::Emulated).is_hardware());
    let rig = Rig::connect(&silent, &Arc::default()).unwrap();
    assert!(rig.is_hardware());
    // The device's own word counts, whatever the way to it says.
    let way = Way { declares_emulated: true };
    let rig = Rig::connect(&rig_settings(DeviceChoice::Other(Arc::new(way))), &Arc::default());
    assert!(rig.unwrap().is_hardware());
    let rig = Rig::connect(&rig_settings(DeviceChoice::Emulated), &Arc::default()).unwrap();
    assert!(!rig.is_hardware());
}

#[test]
fn a_link_is_hardware_until_an_emulator_has_answered() {
    let mut link = SerialLink::in_process(EmulatorSettings::default(), VirtualClock::default());
    assert!(link.is_hardware());
    link.hello().unwrap();
    assert!(!link.is_hardware());

    /// A port at which nobody answers.
    struct Silence(VirtualClock);

    impl Transport for Silence {
        fn read(&mut self, _buffer: &mut [u8], deadline_ns: u64) -> Result<usize, LinkFault> {
            self.0.sleep_until(deadline_ns);
            Ok(0)
        }

        fn write(&mut self, _bytes: &[u8]) -> Result<(), LinkFault> {
            Ok(())
        }

        fn name(&self) -> &str {
            "silence"
        }

        fn boot_time_ns(&self) -> u64 {
            0
        }
    }

    let clock = VirtualClock::default();
    let mut link = SerialLink::new(Silence(clock.clone()), Arc::new(clock));
    assert!(link.hello().is_err());
    assert!(link.is_hardware());
}

#[test]
fn what_is_hardware_is_examined_before_its_first_motion() {
    for way in [
        Arc::new(SilentWay) as Arc<dyn Connect>,
        Arc::new(Way { declares_emulated: true }),
        Arc::new(Way { declares_emulated: false }),
    ] {
        let rig = Rig::open(&rig_settings(DeviceChoice::Other(way)), &Arc::default()).unwrap();
        let preflight = rig.preflight();
        assert!(matches!(preflight, qube_hil::telemetry::Preflight::Done(_)), "{preflight:?}");
    }
}
