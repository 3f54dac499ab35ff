use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::{SystemTime, UNIX_EPOCH};

use thiserror::Error;

use crate::clock::{Clock, MonotonicClock, RealtimeReport, VirtualClock};
use crate::control::{ControlThread, HomingSettings, RING_CAPACITY, ThreadGone};
use crate::device::emulator::{EmulatedQube, EmulatorSettings};
use crate::device::{Device, DeviceError, Identity, SerialLink};
use crate::estimation::Calibration;
use crate::policy::{Policy, PolicyFault};
use crate::recording::{Recorder, RecordingError};
use crate::telemetry::{Ending, Fault, RolloutHeader, RolloutOutcome, TickSettings};

/// Where the Qube is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum DeviceChoice {
    /// The embedded emulator.
    Emulated,
    /// A serial port.
    Port(String),
}

/// Which time passes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ClockChoice {
    /// The wall clock; the emulator sits behind a real pty.
    Wall,
    /// Virtual time; the emulator sits in this process.
    Virtual,
}

/// What can stop a rig from working.
#[derive(Debug, Error)]
pub enum RigError {
    /// A real device cannot be hurried.
    #[error(
        "--clock virtual works with the emulated Qube only, not with {port}: leave one of the two out"
    )]
    VirtualPort {
        /// The port asked for.
        port: String,
    },
    /// The emulator could not be started.
    #[error("the emulated Qube could not be started: {0}")]
    Emulator(std::io::Error),
    /// No thread could be started.
    #[error("the control thread could not be started: {0}")]
    Thread(std::io::Error),
    /// The device.
    #[error(transparent)]
    Device(#[from] DeviceError),
    /// The control thread has died.
    #[error(transparent)]
    ThreadGone(#[from] ThreadGone),
    /// Homing ended by a fault.
    #[error("homing failed: {0}. The motor is off; look at the Qube, then start again")]
    Homing(Fault),
    /// Somebody asked to stop during homing.
    #[error("stopped while homing")]
    Stopped,
    /// The recording.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// The bytes are no policy.
    #[error("the policy cannot be run: {0}")]
    Policy(#[from] PolicyFault),
}

/// What a rig is opened with.
#[derive(Clone, Debug)]
pub struct RigSettings {
    /// Where the Qube is.
    pub device: DeviceChoice,
    /// Which time passes.
    pub clock: ClockChoice,
    /// What the emulator is made of, where it is used.
    pub emulator: EmulatorSettings,
    /// How homing is done.
    pub homing: HomingSettings,
}

/// A Qube that has said hello and is homed, with the thread that drives it.
pub struct Rig {
    control: ControlThread,
    identity: Identity,
    calibration: Calibration,
    homing: HomingSettings,
    clock: ClockChoice,
    /// Served until the rig is closed; dropped after the control thread.
    _emulator: Option<EmulatedQube>,
}

/// What came of one rollout: its recording is whole and on disk.
#[derive(Debug)]
pub struct Recorded {
    /// The recording.
    pub path: PathBuf,
    /// How it ended.
    pub outcome: RolloutOutcome,
}

impl Rig {
    /// Opens the device, asks who it is, and homes it.
    ///
    /// # Errors
    /// Each step has its own; the motor is off after any of them.
    pub fn open(settings: &RigSettings, stop: &Arc<AtomicBool>) -> Result<Self, RigError> {
        let (device, clock, emulator) = connect(settings)?;
        let realtime = settings.clock == ClockChoice::Wall;
        let control = ControlThread::spawn(device, clock, realtime, Arc::clone(stop))
            .map_err(RigError::Thread)?;
        let identity = control.hello()??;
        let mut rig = Self {
            control,
            identity,
            calibration: settings.homing.signs,
            homing: settings.homing,
            clock: settings.clock,
            _emulator: emulator,
        };
        rig.home()?;
        Ok(rig)
    }

    /// After a fault: a new hello, which clears the device's latch, and homing from the start.
    ///
    /// # Errors
    /// The device does not answer, or homing fails.
    pub fn start_again(&mut self) -> Result<(), RigError> {
        self.identity = self.control.hello()??;
        self.home()
    }

    fn home(&mut self) -> Result<(), RigError> {
        let (report, found) = self.control.home(self.homing)??;
        match (report.outcome.ending, found) {
            (_, Some(calibration)) => {
                self.calibration = calibration;
                Ok(())
            }
            (Ending::Fault(fault), None) => Err(RigError::Homing(fault)),
            (_, None) => Err(RigError::Stopped),
        }
    }

    /// Who answered.
    #[must_use]
    pub fn identity(&self) -> &Identity {
        &self.identity
    }

    /// What the operating system granted the control thread.
    #[must_use]
    pub fn realtime(&self) -> &RealtimeReport {
        self.control.realtime()
    }

    /// Runs one rollout and records it to `path`. What the rig knows (device, calibration, time) is
    /// filled into the header.
    ///
    /// # Errors
    /// The device could not be armed, the policy is none, the recording could not be written. A
    /// rollout that ended by a fault is no error here: its outcome says so.
    pub fn rollout(
        &self,
        path: &Path,
        header: RolloutHeader,
        policy_file: &[u8],
    ) -> Result<Recorded, RigError> {
        let policy = Policy::from_bytes(policy_file)?;
        let settings = TickSettings { calibration: self.calibration, ..header.settings };
        let header = RolloutHeader {
            started_unix_ns: self.wall_time_ns(),
            device: self.device_by_name(),
            settings,
            ..header
        };
        let (producer, consumer) = rtrb::RingBuffer::new(RING_CAPACITY);
        let recorder = Recorder::start(path, header, policy_file, consumer)?;
        let report = self.control.rollout(settings, policy, producer)??;
        let path = recorder.finish(report.outcome.clone())?;
        Ok(Recorded { path, outcome: report.outcome })
    }

    fn wall_time_ns(&self) -> Option<u64> {
        let since_1970 = SystemTime::now().duration_since(UNIX_EPOCH).ok()?;
        (self.clock == ClockChoice::Wall).then_some(since_1970.as_nanos() as u64)
    }

    fn device_by_name(&self) -> std::collections::BTreeMap<String, String> {
        let identity = &self.identity;
        [
            ("kind", identity.kind.clone()),
            ("serial", identity.serial.clone()),
            ("firmware_version", identity.firmware_version.clone()),
            ("protocol_version", identity.protocol_version.to_string()),
            // A pty has another name each time; under virtual time nothing may differ.
            ("port", identity.port.clone()),
        ]
        .map(|(name, value)| (name.to_owned(), value))
        .into()
    }
}

type Connection = (Box<dyn Device>, Arc<dyn Clock>, Option<EmulatedQube>);

fn connect(settings: &RigSettings) -> Result<Connection, RigError> {
    match (&settings.device, settings.clock) {
        (DeviceChoice::Emulated, ClockChoice::Virtual) => {
            let clock = VirtualClock::default();
            let link = SerialLink::in_process(settings.emulator, clock.clone());
            Ok((Box::new(link), Arc::new(clock), None))
        }
        (DeviceChoice::Emulated, ClockChoice::Wall) => {
            let emulator = EmulatedQube::spawn(settings.emulator).map_err(RigError::Emulator)?;
            let clock: Arc<dyn Clock> = Arc::new(MonotonicClock);
            let port = emulator.port().to_string_lossy().into_owned();
            let link = SerialLink::open(&port, Arc::clone(&clock))?;
            Ok((Box::new(link), clock, Some(emulator)))
        }
        (DeviceChoice::Port(port), ClockChoice::Wall) => {
            let clock: Arc<dyn Clock> = Arc::new(MonotonicClock);
            Ok((Box::new(SerialLink::open(port, Arc::clone(&clock))?), clock, None))
        }
        (DeviceChoice::Port(port), ClockChoice::Virtual) => {
            Err(RigError::VirtualPort { port: port.clone() })
        }
    }
}
