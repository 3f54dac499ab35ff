//! An emulated Qube whose switching off a test watches or disturbs.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use qube_hil::clock::{Clock, Nanoseconds, VirtualClock};
use qube_hil::device::emulator::EmulatorSettings;
use qube_hil::device::{Device, DeviceError, Identity, LinkFault, SerialLink};
use qube_hil::qube::Measurement;
use qube_hil::rig::{Connect, TimedDevice};

use crate::shared::PATIENCE;

/// An emulated Qube in the test's own virtual time.
#[derive(Clone, Debug)]
pub struct Timed {
    pub clock: VirtualClock,
    /// Time from which the device confirms no disarm, ns.
    pub off_unconfirmed_from_ns: Nanoseconds,
    /// Place in which each disarm looks for a stored doubt; with `None` it does not look.
    pub awaited: Option<AwaitedDoubt>,
    /// True if the computer stalls for 60 ms before the next disarm, so that the watchdog trips.
    pub stalls: Arc<AtomicBool>,
}

/// A folder of doubts in which a doubt is to appear before the motor is switched off.
#[derive(Clone, Debug)]
pub struct AwaitedDoubt {
    pub doubts: PathBuf,
    /// Virtual time before which no doubt is expected, ns.
    pub from_ns: Nanoseconds,
    pub has_come: Arc<AtomicBool>,
}

impl AwaitedDoubt {
    /// Waits for the doubt for at most [`PATIENCE`], because another thread stores it.
    fn wait(&self) {
        let begun = Instant::now();
        while !has_files(&self.doubts) && begun.elapsed() < PATIENCE {
            std::thread::sleep(Duration::from_millis(1));
        }
        self.has_come.store(has_files(&self.doubts), Ordering::Relaxed);
    }
}

pub fn has_files(folder: &Path) -> bool {
    folder.read_dir().is_ok_and(|mut files| files.next().is_some())
}

struct WatchedDisarm {
    link: Box<dyn Device>,
    timed: Timed,
}

impl Device for WatchedDisarm {
    fn hello(&mut self) -> Result<Identity, DeviceError> {
        self.link.hello()
    }

    fn arm(&mut self) -> Result<(), DeviceError> {
        self.link.arm()
    }

    fn sample(&mut self, deadline_ns: Nanoseconds) -> Result<Measurement, LinkFault> {
        self.link.sample(deadline_ns)
    }

    fn act(&mut self, voltage_mv: i16, sampled_at_us: u64) -> Result<(), LinkFault> {
        self.link.act(voltage_mv, sampled_at_us)
    }

    fn disarm(&mut self) -> Result<(), DeviceError> {
        let now_ns = self.timed.clock.now_ns();
        if let Some(awaited) = self.timed.awaited.as_ref().filter(|it| now_ns >= it.from_ns) {
            awaited.wait();
        }
        if self.timed.stalls.swap(false, Ordering::Relaxed) {
            self.timed.clock.sleep_until(now_ns + 60_000_000);
        }
        self.link.disarm()?;
        if self.timed.clock.now_ns() >= self.timed.off_unconfirmed_from_ns {
            return Err(DeviceError::Link { port: "test".into(), fault: LinkFault::Timeout });
        }
        Ok(())
    }

    fn is_hardware(&self) -> bool {
        false
    }
}

impl Connect for Timed {
    fn connect(&self, emulator: &EmulatorSettings) -> Result<TimedDevice, DeviceError> {
        let clock = self.clock.clone();
        let link = Box::new(SerialLink::in_process(*emulator, clock.clone()));
        Ok((Box::new(WatchedDisarm { link, timed: self.clone() }), Arc::new(clock)))
    }

    fn is_hardware(&self) -> bool {
        false
    }
}
