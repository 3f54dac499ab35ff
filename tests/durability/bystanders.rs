//! Tests that failures beside the tick do not reach it (a disk that stalls, a recorder that dies,
//! an orchestrator that hangs), and that the amplifier is switched off when the control thread
//! dies.

use std::ffi::OsString;
use std::fmt;
use std::fs::TryLockError;
use std::io::{self, Write};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::Duration;

use firmware_protocol::DeviceState;
use qube_hil::clock::VirtualClock;
use qube_hil::control::{HomingMethod, HomingSettings};
use qube_hil::device::emulator::EmulatorSettings;
use qube_hil::device::{Device, DeviceError, Identity, LinkFault, SerialLink};
use qube_hil::qube::{CONTROL_PERIOD_NS, Measurement};
use qube_hil::recording::RecordingError;
use qube_hil::rig::{Connect, DeviceChoice, Rig, RigError, RigSettings, TimedDevice};
use qube_hil::scoring::{Verdict, score};
use qube_hil::session::{Session, SessionEvent, SessionFolder};
use qube_hil::storage::{Disk, DiskFile, Existing, FolderLock};

use crate::schedules;
use crate::simulated_disk::SimulatedDisk;
use crate::sweep::rollout_plan;
use crate::watched_wire::WatchedWire;
use crate::world::Wiring;

/// A disk with slow or fatal operations: it calls `trick` before each write or sync of a file that
/// it has created, with the number of earlier writes and whether it is a sync.
#[derive(Clone)]
struct TrickyDisk {
    disk: SimulatedDisk,
    trick: Arc<dyn Fn(u32, bool) + Send + Sync>,
    writes: Arc<AtomicU32>,
}

impl TrickyDisk {
    fn new(trick: impl Fn(u32, bool) + Send + Sync + 'static) -> Self {
        Self { disk: SimulatedDisk::default(), trick: Arc::new(trick), writes: Arc::default() }
    }
}

impl fmt::Debug for TrickyDisk {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("TrickyDisk")
    }
}

impl Disk for TrickyDisk {
    fn create_folder(&self, path: &Path) -> io::Result<()> {
        self.disk.create_folder(path)
    }

    fn create(&self, path: &Path, existing: Existing) -> io::Result<Box<dyn DiskFile>> {
        let file = self.disk.create(path, existing)?;
        Ok(Box::new(TrickyFile { file, disk: self.clone() }))
    }

    fn append(&self, path: &Path) -> io::Result<Box<dyn DiskFile>> {
        self.disk.append(path)
    }

    fn read_beginning(&self, path: &Path, limit: u64) -> io::Result<Vec<u8>> {
        self.disk.read_beginning(path, limit)
    }

    fn exists(&self, path: &Path) -> bool {
        self.disk.exists(path)
    }

    fn names(&self, folder: &Path) -> io::Result<Vec<OsString>> {
        self.disk.names(folder)
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        self.disk.rename(from, to)
    }

    fn remove(&self, path: &Path) -> io::Result<()> {
        self.disk.remove(path)
    }

    fn remove_folder(&self, path: &Path) -> io::Result<()> {
        self.disk.remove_folder(path)
    }

    fn sync_folder(&self, path: &Path) -> io::Result<()> {
        self.disk.sync_folder(path)
    }

    fn lock_folder(&self, folder: &Path) -> Result<FolderLock, TryLockError> {
        self.disk.lock_folder(folder)
    }
}

#[derive(Debug)]
struct TrickyFile {
    file: Box<dyn DiskFile>,
    disk: TrickyDisk,
}

impl Write for TrickyFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        (self.disk.trick)(self.disk.writes.fetch_add(1, Ordering::SeqCst), false);
        self.file.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

impl DiskFile for TrickyFile {
    fn sync(&mut self) -> io::Result<()> {
        (self.disk.trick)(self.disk.writes.load(Ordering::SeqCst), true);
        self.file.sync()
    }

    fn cut_to(&mut self, length: u64) -> io::Result<()> {
        self.file.cut_to(length)
    }
}

fn rig(wiring: &Wiring) -> Rig {
    let stop = Arc::new(AtomicBool::new(false));
    Rig::open(&wiring.clone().rig_settings(HomingMethod::Hand), &stop).unwrap()
}

const PATH: &str = "/rollout.mcap";

fn rollout(rig: &Rig, disk: &dyn Disk) -> Result<(), RigError> {
    let (plan, policy) = rollout_plan();
    rig.rollout(disk, Path::new(PATH), plan.header(), &policy).map(drop)
}

#[test]
fn a_disk_that_stalls_for_five_seconds_costs_no_tick() {
    const STALL: Duration = Duration::from_secs(5);
    let wiring = Wiring::default();
    let rig = rig(&wiring);
    let has_stalled = Arc::new(AtomicBool::new(false));
    let (stalled, armed_then) = (Arc::clone(&has_stalled), Arc::new(AtomicBool::new(true)));
    let (wire, armed) = (wiring.last_wire().unwrap(), Arc::clone(&armed_then));
    // The second write is the first block of ticks.
    let disk = TrickyDisk::new(move |write, is_sync| {
        if write == 1 && !is_sync {
            std::thread::sleep(STALL);
            // In virtual time the whole rollout passes meanwhile; a busy computer may need longer.
            for _ in 0..600 {
                if wire.state() != DeviceState::Armed {
                    break;
                }
                std::thread::sleep(Duration::from_millis(100));
            }
            armed.store(wire.state() == DeviceState::Armed, Ordering::SeqCst);
            stalled.store(true, Ordering::SeqCst);
        }
    });
    rollout(&rig, &disk).unwrap();
    assert!(has_stalled.load(Ordering::SeqCst), "the disk never stalled");
    assert!(!armed_then.load(Ordering::SeqCst), "the tick waited for the disk");
    let verdict = score(&disk, Path::new(PATH)).unwrap();
    assert!(matches!(verdict, Verdict::Result { .. }), "{verdict:?}");
}

#[test]
fn a_recorder_that_hangs_while_it_closes_a_recording_finds_the_amplifier_off() {
    let wiring = Wiring::default();
    let rig = rig(&wiring);
    let wire = wiring.last_wire().unwrap();
    let syncs = Arc::new(AtomicU32::new(0));
    let counted = Arc::clone(&syncs);
    let disk = TrickyDisk::new(move |_, is_sync| {
        if is_sync {
            counted.fetch_add(1, Ordering::SeqCst);
            assert_ne!(wire.state(), DeviceState::Armed);
        }
    });
    rollout(&rig, &disk).unwrap();
    assert!(syncs.load(Ordering::SeqCst) > 0);
}

#[test]
fn a_recorder_that_dies_does_not_stop_the_rollout_and_is_named() {
    let wiring = Wiring::default();
    let rig = rig(&wiring);
    let disk = TrickyDisk::new(|write, is_sync| {
        assert!(is_sync || write != 3, "the recorder dies here, on purpose");
    });
    match rollout(&rig, &disk) {
        Err(RigError::Recording(RecordingError::Stopped { path })) => {
            assert_eq!(path, Path::new(PATH));
        }
        other => panic!("{other:?}"),
    }
    assert_ne!(wiring.last_wire().unwrap().state(), DeviceState::Armed);
    assert_eq!(score(&disk, Path::new(PATH)).unwrap(), Verdict::Unfinished);
    // Nothing is latched: the next rollout runs.
    let disk = SimulatedDisk::default();
    rollout(&rig, &disk).unwrap();
    assert!(matches!(score(&disk, Path::new(PATH)).unwrap(), Verdict::Result { .. }));
}

/// A session that hangs in any of its steps hangs with the amplifier off, because the control
/// thread arms and disarms on its own.
#[test]
fn an_orchestrator_that_hangs_anywhere_finds_the_amplifier_off() {
    let settings = schedules::settings(3);
    let disk: Arc<dyn Disk> = Arc::new(SimulatedDisk::default());
    let folder =
        SessionFolder::create_on(disk, &schedules::root(), &settings.to_toml().unwrap()).unwrap();
    let wiring = Wiring::default();
    let rig = wiring.clone().rig_settings(settings.homing.method);
    let mut session = Session::open(folder, settings, rig, Arc::default()).unwrap();
    let mut looked = 0;
    session
        .run(&mut |progress| {
            let Some(wire) = wiring.last_wire() else { return };
            assert_ne!(wire.state(), DeviceState::Armed);
            // A second passes, as in a session that hangs here.
            if matches!(progress, SessionEvent::Rollout { .. }) {
                wire.must_end_safe();
            }
            looked += 1;
        })
        .unwrap();
    assert!(looked > 5);
}

/// A device in which the control thread panics once it has read `samples_left` samples.
struct Panicking {
    link: SerialLink<WatchedWire>,
    samples_left: u32,
}

impl Device for Panicking {
    fn hello(&mut self) -> Result<Identity, DeviceError> {
        self.link.hello()
    }

    fn arm(&mut self) -> Result<(), DeviceError> {
        self.link.arm()
    }

    fn sample(&mut self, deadline_ns: u64) -> Result<Measurement, LinkFault> {
        assert!(self.samples_left > 0, "the control thread dies here, on purpose");
        self.samples_left -= 1;
        self.link.sample(deadline_ns)
    }

    fn act(&mut self, voltage_mv: i16, sampled_at_us: u64) -> Result<(), LinkFault> {
        self.link.act(voltage_mv, sampled_at_us)
    }

    fn disarm(&mut self) -> Result<(), DeviceError> {
        self.link.disarm()
    }

    fn is_hardware(&self) -> bool {
        self.link.is_hardware()
    }
}

#[derive(Debug)]
struct PanickingWiring {
    samples: u32,
    wire: WatchedWire,
}

impl Connect for PanickingWiring {
    fn connect(&self, _emulator: &EmulatorSettings) -> Result<TimedDevice, DeviceError> {
        let clock = self.wire.clock();
        let link = SerialLink::new(self.wire.clone(), Arc::new(clock.clone()));
        Ok((Box::new(Panicking { link, samples_left: self.samples }), Arc::new(clock)))
    }

    fn is_hardware(&self) -> bool {
        false
    }
}

#[test]
fn a_control_thread_that_panics_switches_the_amplifier_off_and_is_named() {
    for samples in [3, 50] {
        let wire = WatchedWire::new(EmulatorSettings::default(), VirtualClock::default());
        let wiring = PanickingWiring { samples, wire: wire.clone() };
        let settings = RigSettings {
            homing: HomingSettings { method: HomingMethod::Hand, ..HomingSettings::default() },
            ..RigSettings::in_virtual_time(DeviceChoice::Other(Arc::new(wiring)))
        };
        let error = Rig::open(&settings, &Arc::default()).err().unwrap();
        assert!(matches!(error, RigError::ThreadGone(_)), "{error}");
        assert!(error.to_string().contains("control thread"), "{error}");
        // The link disarms the device when the panic drops it, in the tick after the last act. The
        // device's own watchdog would take 50 ms.
        let later_us = wire.must_end_safe().expect("the amplifier was on");
        assert!(
            later_us <= 2 * CONTROL_PERIOD_NS / 1000,
            "the amplifier went off only after {later_us} us"
        );
    }
}
