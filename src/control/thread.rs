use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::thread::JoinHandle;

use crossbeam_channel::{Receiver, Sender, bounded};
use thiserror::Error;

use super::{DriveReport, Homing, HomingSettings, Tick, drive};
use crate::clock::{Clock, RealtimeReport, enter_realtime};
use crate::device::{Device, DeviceError, Identity};
use crate::estimation::Calibration;
use crate::policy::Policy;
use crate::telemetry::{TickRecord, TickSettings};

/// The control thread has ended before its time: it panicked.
#[derive(Clone, Copy, Debug, Error, PartialEq, Eq)]
#[error(
    "the control thread has ended unexpectedly; the device's watchdog has switched the motor off"
)]
pub struct ThreadGone;

/// Prepared work: everything is loaded before the first tick.
enum Command {
    Hello,
    Home(HomingSettings),
    Rollout(TickSettings, Box<Policy>, rtrb::Producer<TickRecord>),
    Lend(Borrower),
}

/// Somebody who needs the device itself for a while, its clock and the request to stop.
type Borrower = Box<dyn FnOnce(&mut dyn Device, &dyn Clock, &AtomicBool) + Send>;

enum Event {
    Identified(Result<Identity, DeviceError>),
    Homed(Result<(DriveReport, Option<Calibration>), DeviceError>),
    Finished(Result<DriveReport, DeviceError>),
    Returned,
}

/// The thread that owns the device. One command at a time; in between the amplifier is off.
pub struct ControlThread {
    commands: Option<Sender<Command>>,
    events: Receiver<Event>,
    handle: Option<JoinHandle<()>>,
    realtime: RealtimeReport,
}

impl ControlThread {
    /// Starts the thread. With `realtime` it asks for SCHED_FIFO and locked memory; a virtual clock
    /// needs neither. A set `stop` ends each motion by braking.
    ///
    /// # Errors
    /// The operating system gave no thread.
    pub fn spawn(
        mut device: Box<dyn Device>,
        clock: Arc<dyn Clock>,
        realtime: bool,
        stop: Arc<AtomicBool>,
    ) -> std::io::Result<Self> {
        let (commands, inbox) = bounded::<Command>(1);
        let (outbox, events) = bounded::<Event>(1);
        let (ready, readiness) = bounded(1);
        let handle = std::thread::Builder::new().name("control".into()).spawn(move || {
            let report = if realtime { enter_realtime() } else { RealtimeReport::default() };
            let _ = ready.send(report);
            for command in inbox {
                let event = obey(command, device.as_mut(), clock.as_ref(), &stop);
                if outbox.send(event).is_err() {
                    return;
                }
            }
        })?;
        let realtime = readiness.recv().unwrap_or_default();
        Ok(Self { commands: Some(commands), events, handle: Some(handle), realtime })
    }

    /// What the operating system granted.
    #[must_use]
    pub fn realtime(&self) -> &RealtimeReport {
        &self.realtime
    }

    /// Asks the device who it is.
    ///
    /// # Errors
    /// The outer one when the thread is gone, the inner one as [`Device::hello`] says.
    pub fn hello(&self) -> Result<Result<Identity, DeviceError>, ThreadGone> {
        match self.ask(Command::Hello)? {
            Event::Identified(result) => Ok(result),
            _ => Err(ThreadGone),
        }
    }

    /// Finds the zeros of the encoders; none where homing did not complete.
    ///
    /// # Errors
    /// The outer one when the thread is gone, the inner one when the device could not be armed.
    pub fn home(
        &self,
        settings: HomingSettings,
    ) -> Result<Result<(DriveReport, Option<Calibration>), DeviceError>, ThreadGone> {
        match self.ask(Command::Home(settings))? {
            Event::Homed(result) => Ok(result),
            _ => Err(ThreadGone),
        }
    }

    /// Runs one rollout to its end, its records going into `records`.
    ///
    /// # Errors
    /// The outer one when the thread is gone, the inner one when the device could not be armed.
    pub fn rollout(
        &self,
        settings: TickSettings,
        policy: Policy,
        records: rtrb::Producer<TickRecord>,
    ) -> Result<Result<DriveReport, DeviceError>, ThreadGone> {
        match self.ask(Command::Rollout(settings, Box::new(policy), records))? {
            Event::Finished(result) => Ok(result),
            _ => Err(ThreadGone),
        }
    }

    /// Lends the device to a task between motions, on this thread and with its priority: what a
    /// check measures is then what a tick will see.
    ///
    /// # Errors
    /// The thread is gone.
    pub fn lend<R: Send + 'static>(
        &self,
        task: impl FnOnce(&mut dyn Device, &dyn Clock, &AtomicBool) -> R + Send + 'static,
    ) -> Result<R, ThreadGone> {
        let (results, result) = bounded(1);
        let borrower: Borrower = Box::new(move |device, clock, stop| {
            // Its receiver waits below, and there is room for one.
            let _ = results.send(task(device, clock, stop));
        });
        match self.ask(Command::Lend(borrower))? {
            Event::Returned => result.recv().map_err(|_| ThreadGone),
            _ => Err(ThreadGone),
        }
    }

    fn ask(&self, command: Command) -> Result<Event, ThreadGone> {
        let commands = self.commands.as_ref().ok_or(ThreadGone)?;
        commands.send(command).map_err(|_| ThreadGone)?;
        self.events.recv().map_err(|_| ThreadGone)
    }
}

impl Drop for ControlThread {
    fn drop(&mut self) {
        self.commands = None;
        if let Some(handle) = self.handle.take() {
            let _ = handle.join();
        }
    }
}

fn obey(command: Command, device: &mut dyn Device, clock: &dyn Clock, stop: &AtomicBool) -> Event {
    match command {
        Command::Hello => Event::Identified(device.hello()),
        Command::Home(settings) => {
            let mut homing = Homing::new(&settings);
            let driven = drive(device, clock, &mut homing, None, stop);
            Event::Homed(driven.map(|report| (report, homing.calibration())))
        }
        Command::Rollout(settings, policy, mut records) => {
            let mut tick = Tick::new(&settings, *policy);
            Event::Finished(drive(device, clock, &mut tick, Some(&mut records), stop))
        }
        Command::Lend(borrower) => {
            borrower(device, clock, stop);
            Event::Returned
        }
    }
}
