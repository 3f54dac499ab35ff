//! Tests the permission to drive, in virtual time: a device that declares nothing counts as
//! hardware, and on hardware neither a file nor a caller can widen a limit.

use std::sync::Arc;

use qube_hil::clock::{Clock, VirtualClock};
use qube_hil::device::emulator::EmulatorSettings;
use qube_hil::device::{
    Device, DeviceError, Identity, InProcessWire, LinkFault, SerialLink, Transport,
};
use qube_hil::policy::{ClassicalController, ClassicalGains, Policy};
use qube_hil::qube::{Measurement, PlantModel, Profile, QubeModel};
use qube_hil::recording::{parse, read};
use qube_hil::rig::{Connect, DeviceChoice, Rig, RigError, RigSettings, RolloutPlan, TimedDevice};
use qube_hil::safety::{
    Guard, GuardConsent, HardwareLimits, HardwareRefusal, IdentifiedQube, SafetyBox,
};
use qube_hil::storage::MachineDisk;

/// A Qube that does not declare whether it is hardware.
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

/// A transport to an [`Undeclared`] Qube; the transport declares hardware or an emulator.
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

/// A transport to an [`Undeclared`] Qube; the transport declares nothing either.
#[derive(Debug)]
struct SilentWay;

impl Connect for SilentWay {
    fn connect(&self, emulator: &EmulatorSettings) -> Result<TimedDevice, DeviceError> {
        Way { declares_emulated: true }.connect(emulator)
    }
}

#[test]
fn a_device_that_declares_nothing_is_hardware_before_and_after_it_has_answered() {
    let silent = RigSettings::in_virtual_time(DeviceChoice::Other(Arc::new(SilentWay)));
    assert!(silent.is_hardware() && silent.checks());
    assert!(RigSettings::in_virtual_time(DeviceChoice::Port("/dev/null".into())).is_hardware());
    assert!(!RigSettings::in_virtual_time(DeviceChoice::Emulated).is_hardware());
    let rig = Rig::connect(&silent, &Arc::default()).unwrap();
    assert!(rig.is_hardware());
    // This device does not declare that it is emulated, so it is hardware, even if its transport
    // declares an emulator.
    let way = Way { declares_emulated: true };
    let rig = Rig::connect(
        &RigSettings::in_virtual_time(DeviceChoice::Other(Arc::new(way))),
        &Arc::default(),
    );
    assert!(rig.unwrap().is_hardware());
    let rig = Rig::connect(&RigSettings::in_virtual_time(DeviceChoice::Emulated), &Arc::default())
        .unwrap();
    assert!(!rig.is_hardware());
}

#[test]
fn a_link_is_hardware_until_an_emulator_has_answered() {
    let mut link = SerialLink::in_process(EmulatorSettings::default(), VirtualClock::default());
    assert!(link.is_hardware());
    link.hello().unwrap();
    assert!(!link.is_hardware());

    /// A port at which no device answers.
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
fn hardware_is_examined_before_its_first_motion() {
    for way in [
        Arc::new(SilentWay) as Arc<dyn Connect>,
        Arc::new(Way { declares_emulated: true }),
        Arc::new(Way { declares_emulated: false }),
    ] {
        let rig =
            Rig::open(&RigSettings::in_virtual_time(DeviceChoice::Other(way)), &Arc::default())
                .unwrap();
        let preflight = rig.preflight();
        assert!(matches!(preflight, qube_hil::telemetry::Preflight::Done(_)), "{preflight:?}");
    }
}

/// Runs a short rollout of the classical controller in this box; returns the consent that its
/// recording contains.
fn rollout(rig: &Rig, safety_box: SafetyBox) -> Result<bool, RigError> {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("rollout.mcap");
    let plan =
        RolloutPlan { seed: 1, safety_box, steps: 10, ..RolloutPlan::single("test", "classical") };
    let policy = Policy::Classical(ClassicalController::new(ClassicalGains::default())).to_bytes();
    let recorded = rig.rollout(&MachineDisk, &path, plan.header(), &policy);
    assert_eq!(path.exists(), recorded.is_ok(), "a rollout that was refused left a file");
    recorded.map(|recorded| read(&recorded.path).unwrap().header.hard_stop_accepted)
}

#[test]
fn a_rig_on_hardware_refuses_a_wider_box_whoever_asks() {
    let consent = GuardConsent::given(Some(Guard::Box), true);
    let wide = SafetyBox { theta: 9.0, ..SafetyBox::GUARDED };
    let open = |limits| {
        let hardware = DeviceChoice::Other(Arc::new(SilentWay));
        let settings =
            RigSettings { limits, skip_check: true, ..RigSettings::in_virtual_time(hardware) };
        Rig::open(&settings, &Arc::default()).unwrap()
    };
    let rig = open(HardwareLimits::default());
    for safety_box in [wide, SafetyBox::THESIS, SafetyBox { theta: f64::NAN, ..SafetyBox::GUARDED }]
    {
        let refused = rollout(&rig, safety_box).unwrap_err();
        assert!(matches!(refused, RigError::HardwareRefusal(_)), "{refused}");
    }
    assert!(!rollout(&rig, SafetyBox::GUARDED).unwrap());

    let rig = open(HardwareLimits::of(SafetyBox::THESIS, consent).unwrap());
    assert!(rollout(&rig, wide).is_err());
    assert!(rollout(&rig, SafetyBox::THESIS).unwrap(), "the recording does not name the consent");
    assert!(!rollout(&rig, SafetyBox::GUARDED).unwrap());

    // An experiment on an emulated Qube may choose its box, but not the guard of old recordings.
    let rig =
        Rig::open(&RigSettings::in_virtual_time(DeviceChoice::Emulated), &Arc::default()).unwrap();
    assert!(!rollout(&rig, SafetyBox::THESIS).unwrap());
    let of_the_past = SafetyBox { guard: Guard::Envelope, ..SafetyBox::THESIS };
    let refused = rollout(&rig, of_the_past).unwrap_err();
    assert!(
        matches!(refused, RigError::HardwareRefusal(HardwareRefusal::EnvelopeGone)),
        "{refused}"
    );
}

/// A recording of an older program, whose box names no guard.
fn recording_without_guard() -> Vec<u8> {
    let fixtures = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures");
    std::fs::read(fixtures.join("names_no_guard.mcap")).unwrap()
}

#[test]
fn files_without_a_guard_mean_the_box_alone() {
    let bytes = recording_without_guard();
    assert!(!bytes.windows(7).any(|word| word == b"\"guard\""), "the recording names a guard");
    let recording = parse(&bytes).unwrap();
    assert_eq!(recording.header.settings.safety_box, SafetyBox::THESIS);
    assert!(!recording.header.hard_stop_accepted);
    let silent: SafetyBox = serde_json::from_str("{\"theta\":2.0}").unwrap();
    assert_eq!(silent, SafetyBox { theta: 2.0, ..SafetyBox::THESIS });
    let single: SafetyBox<f32> = serde_json::from_str("{}").unwrap();
    assert_eq!(single, SafetyBox::THESIS.cast());

    // The part of an old session.toml that describes the box.
    let part = "[safety_box]\ntheta = 2.3\nalpha = 12.566370614359172\n\
                theta_dot = 30.0\nalpha_dot = 40.0\n";
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("session.toml");
    std::fs::write(&path, part).unwrap();
    let settings = qube_hil::session::SessionSettings::load(&path).unwrap();
    assert_eq!(settings.safety_box, SafetyBox::THESIS);
}

#[test]
fn every_written_file_names_its_guard() {
    let json = serde_json::to_string(&SafetyBox::GUARDED).unwrap();
    let expected = "{\"theta\":2.3,\"alpha\":12.566370614359172,\"theta_dot\":30.0,\
                    \"alpha_dot\":40.0,\"guard\":\"foresight\"}";
    assert_eq!(json, expected);
    let json = serde_json::to_string(&SafetyBox::THESIS).unwrap();
    assert!(json.contains("\"guard\":\"box\""), "{json}");
    let header = parse(&recording_without_guard()).unwrap().header;
    let json = serde_json::to_string(&header).unwrap();
    assert!(json.contains("\"guard\":\"box\""), "{json}");
    assert!(!json.contains("hard_stop_accepted"), "{json}");
}

#[test]
fn a_real_qubes_profile_counts_for_its_own_board_alone() {
    let profile = Profile::exact("mine", &QubeModel::NOMINAL);
    let known = Some(IdentifiedQube::of(&profile, &PlantModel::QUBE));
    let emulated = RigSettings::in_virtual_time(DeviceChoice::Emulated);
    let as_well_as_lab = Profile::lab().around("emulated", &QubeModel::NOMINAL);
    assert_eq!(emulated.identified(), Some(IdentifiedQube::of(&as_well_as_lab, &PlantModel::QUBE)));
    assert!(RigSettings { unidentified: true, ..emulated }.identified().is_none());

    let port = RigSettings::in_virtual_time(DeviceChoice::Port("/dev/null".into()));
    assert!(port.identified().is_none());
    let of_any_board = RigSettings { profile: Some(profile), ..port };
    assert!(of_any_board.identified().is_none());
    let warning = of_any_board.identification_warning(Guard::Foresight);
    assert!(warning.is_some_and(|warning| warning.contains("name profile and board")));
    assert!(of_any_board.identification_warning(Guard::Box).is_none());
    let of_its_board = RigSettings { board: Some("1234".into()), ..of_any_board };
    assert_eq!(of_its_board.identified(), known);
    assert!(of_its_board.identification_warning(Guard::Foresight).is_none());
}
