use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;

use crossbeam_channel::{Receiver, Sender, bounded};
use thiserror::Error;

use super::reconnect::{Patience, greet_patiently};
use super::{
    ControlAction, ControlEvent, ControlState, DriveReport, Homing, HomingSettings, Motion, Moved,
    RestWatch, RestingCounts, SAMPLE_TIMEOUT_NS, Tick, drive_warm,
};
use crate::clock::{Clock, Nanoseconds, RealtimeReport, enter_realtime};
use crate::device::{Device, DeviceError, Identity, LinkFault};
use crate::estimation::MeasuredRig;
use crate::policy::Policy;
use crate::qube::{CONTROL_PERIOD_NS, Measurement};
use crate::safety::MotorHeat;
use crate::telemetry::{TickRecord, TickSettings};

/// Error: the control thread has panicked.
#[derive(Clone, Copy, Debug, Error, PartialEq, Eq)]
#[error(
    "the control thread has ended unexpectedly; the device's watchdog has switched the motor off"
)]
pub struct ThreadGone;

/// Interval at which a cooling pause checks for a request to stop, ns.
const COOLING_STEP_NS: Nanoseconds = 100_000_000;

/// Time that arm and pendulum may take to come to rest with the amplifier off, ns. If they do not,
/// the arm is homed before the next rollout.
const REST_TIME_NS: Nanoseconds = 15_000_000_000;

/// A reason why control cannot carry out a command.
#[derive(Debug, Error)]
pub enum ControlError {
    /// The device failed.
    #[error(transparent)]
    Device(#[from] DeviceError),
    /// The state table does not allow the command.
    #[error(
        "{wanted:?} is not possible while control is {state:?}: after a fault or a start the Qube \
         needs a new hello and homing first"
    )]
    Refused {
        /// The refused command.
        wanted: ControlEvent,
        /// The current state.
        state: ControlState,
    },
    /// The zeros of the last homing no longer hold; nothing has been armed.
    #[error("{0}: the arm is homed again first")]
    Moved(#[from] Moved),
}

/// The result of a homing.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Homed {
    /// Zeros and stops; `None` unless homing completed.
    pub rig: Option<MeasuredRig>,
    /// Distance between the stops, rad; `None` unless both were touched.
    pub travel_rad: Option<f64>,
}

/// A command with everything loaded before the first tick.
enum Command {
    Hello(Patience),
    Cool,
    Motor(MotorHeat),
    Home(Box<HomingSettings>),
    Rollout(Box<TickSettings>, Box<Policy>, rtrb::Producer<TickRecord>),
    Lend(Borrower),
}

/// A task that uses the device, its clock and the request to stop.
type Borrower = Box<dyn FnOnce(&mut dyn Device, &dyn Clock, &AtomicBool) + Send>;

enum Event {
    /// Identity of the device, and whether it is hardware.
    Identified(Result<Identity, DeviceError>, bool),
    Homed(Result<(DriveReport, Homed), ControlError>),
    Finished(Result<DriveReport, ControlError>),
    Returned(Result<(), ControlError>),
    Cooled(MotorHeat),
}

/// The thread that owns the device. It executes one command at a time; in between the amplifier is
/// off.
pub struct ControlThread {
    commands: Option<Sender<Command>>,
    events: Receiver<Event>,
    handle: Option<JoinHandle<()>>,
    realtime: RealtimeReport,
    is_hardware: AtomicBool,
}

impl ControlThread {
    /// Starts the thread. With `realtime` it asks for SCHED_FIFO and locked memory, which a virtual
    /// clock does not need. Setting `stop` ends each motion by braking.
    ///
    /// # Errors
    /// The operating system cannot start a thread.
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
            let mut state = ControlState::default();
            let mut motor = Motor::default();
            let mut undriven = Undriven::default();
            for command in inbox {
                let (device, clock) = (device.as_mut(), clock.as_ref());
                let event =
                    obey(&mut state, &mut motor, &mut undriven, command, device, clock, &stop);
                if outbox.send(event).is_err() {
                    return;
                }
            }
        })?;
        let realtime = readiness.recv().unwrap_or_default();
        Ok(Self {
            commands: Some(commands),
            events,
            handle: Some(handle),
            realtime,
            is_hardware: AtomicBool::new(true),
        })
    }

    /// The real-time privileges that the operating system granted.
    #[must_use]
    pub fn realtime(&self) -> &RealtimeReport {
        &self.realtime
    }

    /// Sends a hello to the device.
    ///
    /// # Errors
    /// The outer error: the thread is gone. The inner one: as for [`Device::hello`].
    pub fn hello(&self) -> Result<Result<Identity, DeviceError>, ThreadGone> {
        self.hello_patiently(Patience::default())
    }

    /// Sends hellos to the device until it answers, the patience is over, or `stop` is set.
    ///
    /// # Errors
    /// As for [`hello`](Self::hello).
    pub fn hello_patiently(
        &self,
        patience: Patience,
    ) -> Result<Result<Identity, DeviceError>, ThreadGone> {
        match self.ask(Command::Hello(patience))? {
            Event::Identified(result, is_hardware) => {
                self.is_hardware.store(is_hardware, Ordering::Relaxed);
                Ok(result)
            }
            _ => Err(ThreadGone),
        }
    }

    /// Whether the device that answered the last hello is hardware, by [`Device::is_hardware`];
    /// true before the first answer.
    #[must_use]
    pub fn is_hardware(&self) -> bool {
        self.is_hardware.load(Ordering::Relaxed)
    }

    /// Measures the zeros of the encoders and the stops.
    ///
    /// # Errors
    /// The outer error: the thread is gone. The inner one: the device has not answered a hello or
    /// could not be armed.
    pub fn home(
        &self,
        settings: HomingSettings,
    ) -> Result<Result<(DriveReport, Homed), ControlError>, ThreadGone> {
        match self.ask(Command::Home(Box::new(settings)))? {
            Event::Homed(result) => Ok(result),
            _ => Err(ThreadGone),
        }
    }

    /// Runs one rollout to its end and sends its records to `records`.
    ///
    /// # Errors
    /// The outer error: the thread is gone. The inner one: the device has not been homed since its
    /// hello or could not be armed.
    pub fn rollout(
        &self,
        settings: TickSettings,
        policy: Policy,
        records: rtrb::Producer<TickRecord>,
    ) -> Result<Result<DriveReport, ControlError>, ThreadGone> {
        match self.ask(Command::Rollout(Box::new(settings), Box::new(policy), records))? {
            Event::Finished(result) => Ok(result),
            _ => Err(ThreadGone),
        }
    }

    /// Sets the motor's rating and heat; at the start the motor is a nominal one and cold.
    ///
    /// # Errors
    /// The thread is gone.
    pub fn set_motor(&self, heat: MotorHeat) -> Result<(), ThreadGone> {
        self.ask(Command::Motor(heat)).map(|_| ())
    }

    /// Waits until the motor is cool enough for the next motion, or `stop` is set. Returns the heat
    /// with which the next motion begins.
    ///
    /// # Errors
    /// The thread is gone.
    pub fn cool_motor(&self) -> Result<MotorHeat, ThreadGone> {
        match self.ask(Command::Cool)? {
            Event::Cooled(heat) => Ok(heat),
            _ => Err(ThreadGone),
        }
    }

    /// Lends the device to a task between motions. The task runs on this thread with its priority,
    /// so that a check measures the latencies that a tick will have.
    ///
    /// # Errors
    /// The outer error: the thread is gone. The inner one: the device has not answered a hello, or
    /// a fault is latched.
    pub fn lend<R: Send + 'static>(
        &self,
        task: impl FnOnce(&mut dyn Device, &dyn Clock, &AtomicBool) -> R + Send + 'static,
    ) -> Result<Result<R, ControlError>, ThreadGone> {
        let (results, result) = bounded(1);
        let borrower: Borrower = Box::new(move |device, clock, stop| {
            // The receiver waits below, and the channel has room for one result.
            let _ = results.send(task(device, clock, stop));
        });
        match self.ask(Command::Lend(borrower))? {
            Event::Returned(Ok(())) => result.recv().map(Ok).map_err(|_| ThreadGone),
            Event::Returned(Err(refused)) => Ok(Err(refused)),
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

/// The motor's heat between motions.
#[derive(Debug, Default)]
struct Motor {
    heat: MotorHeat,
    /// Time since which the motor has been without current and which `heat` does not include;
    /// `None` before the first motion.
    off_since_ns: Option<Nanoseconds>,
}

impl Motor {
    /// Cools the motor for the time without current since the last update.
    fn cool(&mut self, clock: &dyn Clock) {
        if let Some(off_since_ns) = &mut self.off_since_ns {
            let now_ns = clock.now_ns();
            let off_ns = now_ns.saturating_sub(*off_since_ns);
            self.heat = self.heat.cooled(off_ns as f64 * 1e-9);
            *off_since_ns = now_ns;
        }
    }

    /// Waits with the amplifier off while the motor is too hot for the next motion.
    fn cool_down(&mut self, clock: &dyn Clock, stop: &AtomicBool) {
        self.cool(clock);
        let end_ns = clock.now_ns() + (self.heat.cooling_s() * 1e9) as Nanoseconds;
        while clock.now_ns() < end_ns && !stop.load(Ordering::Relaxed) {
            clock.sleep_until(end_ns.min(clock.now_ns() + COOLING_STEP_NS));
            self.cool(clock);
        }
    }
}

/// Knowledge about the encoder counts between motions.
#[derive(Debug, Default)]
struct Undriven {
    /// Name of the port for errors.
    port: String,
    /// Counts at which arm and pendulum came to rest after the last motion; `None` if they were not
    /// seen at rest.
    left_at: Option<RestingCounts>,
}

impl Undriven {
    /// Watches, with the amplifier off, where arm and pendulum come to rest after a motion.
    fn keep(
        &mut self,
        last: Option<&Measurement>,
        device: &mut dyn Device,
        clock: &dyn Clock,
        stop: &AtomicBool,
    ) {
        let mut watch = RestWatch::after(last);
        self.left_at = match watch_rest(&mut watch, device, clock, stop) {
            Ok(rest) if !watch.has_jumped() => rest,
            Ok(_) | Err(_) => None,
        };
    }

    /// Checks before a rollout arms the device that arm and pendulum are where they were left.
    fn compare(
        &self,
        settings: &TickSettings,
        device: &mut dyn Device,
        clock: &dyn Clock,
        stop: &AtomicBool,
    ) -> Result<(), ControlError> {
        let link = |fault| match fault {
            LinkFault::NotArmed => DeviceError::Restarted { port: self.port.clone() },
            fault => DeviceError::Link { port: self.port.clone(), fault },
        };
        let rest = watch_rest(&mut RestWatch::default(), device, clock, stop).map_err(link)?;
        let rest = rest.ok_or(Moved::Unseen)?;
        Ok(rest.compare(self.left_at, settings.calibration.alpha_zero_counts)?)
    }
}

/// Samples at 100 Hz until arm and pendulum are at rest; `None` if they are not in time or `stop`
/// is set.
///
/// # Errors
/// The port is gone, or the board has restarted. Lost samples are tolerated.
fn watch_rest(
    watch: &mut RestWatch,
    device: &mut dyn Device,
    clock: &dyn Clock,
    stop: &AtomicBool,
) -> Result<Option<RestingCounts>, LinkFault> {
    let sample_time_ns = device.sample_time_ns().unwrap_or(SAMPLE_TIMEOUT_NS);
    let begin_ns = clock.now_ns();
    let mut deadline_ns = begin_ns;
    while deadline_ns < begin_ns + REST_TIME_NS && !stop.load(Ordering::Relaxed) {
        match device.sample(clock.now_ns() + sample_time_ns) {
            Ok(sample) => {
                if let Some(rest) = watch.update(&sample) {
                    return Ok(Some(rest));
                }
            }
            Err(fault @ (LinkFault::Gone | LinkFault::NotArmed)) => return Err(fault),
            Err(_) => {}
        }
        deadline_ns = (deadline_ns + CONTROL_PERIOD_NS).max(clock.now_ns());
        clock.sleep_until(deadline_ns);
    }
    Ok(None)
}

fn obey(
    state: &mut ControlState,
    motor: &mut Motor,
    undriven: &mut Undriven,
    command: Command,
    device: &mut dyn Device,
    clock: &dyn Clock,
    stop: &AtomicBool,
) -> Event {
    match command {
        Command::Hello(patience) => {
            let identified = greet_patiently(device, clock, stop, patience);
            let answered = identified.is_ok();
            *undriven = Undriven::default();
            if let Ok(identity) = &identified {
                undriven.port.clone_from(&identity.port);
            }
            state.take(if answered { ControlEvent::Hello } else { ControlEvent::NoAnswer });
            Event::Identified(identified, device.is_hardware())
        }
        Command::Cool => {
            motor.cool_down(clock, stop);
            Event::Cooled(motor.heat)
        }
        Command::Motor(heat) => {
            *motor = Motor { heat, off_since_ns: Some(clock.now_ns()) };
            Event::Cooled(motor.heat)
        }
        Command::Home(settings) => {
            motor.cool_down(clock, stop);
            let mut homing = match state {
                ControlState::Cleared => Homing::after_fault(&settings),
                _ => Homing::new(&settings),
            };
            let driven = allowed(state, ControlEvent::Home)
                .and_then(|()| driven(state, motor, device, clock, &mut homing, None, stop));
            if let (Ok(report), ControlState::Ready) = (&driven, *state) {
                undriven.keep(report.last_measurement.as_ref(), device, clock, stop);
            }
            let homed = Homed { rig: homing.measured(), travel_rad: homing.travel_rad() };
            Event::Homed(driven.map(|report| (report, homed)))
        }
        Command::Rollout(settings, policy, mut records) => {
            let before = *state;
            let driven = allowed(state, ControlEvent::Rollout).and_then(|()| {
                if let Err(error) = undriven.compare(&settings, device, clock, stop) {
                    *state = before;
                    if matches!(error, ControlError::Device(_)) {
                        state.take(ControlEvent::NoAnswer);
                    }
                    return Err(error);
                }
                let mut tick = Tick::new(&settings, *policy);
                driven(state, motor, device, clock, &mut tick, Some(&mut records), stop)
            });
            undriven.left_at = None;
            if let (Ok(report), ControlState::Ready) = (&driven, *state) {
                undriven.keep(report.last_measurement.as_ref(), device, clock, stop);
            }
            Event::Finished(driven)
        }
        Command::Lend(borrower) => {
            let lent = allowed(state, ControlEvent::Check).map(|()| {
                borrower(device, clock, stop);
                state.take(ControlEvent::Checked);
            });
            Event::Returned(lent)
        }
    }
}

/// Applies a command to the state table.
fn allowed(state: &mut ControlState, wanted: ControlEvent) -> Result<(), ControlError> {
    match state.take(wanted) {
        ControlAction::Refuse => Err(ControlError::Refused { wanted, state: *state }),
        _ => Ok(()),
    }
}

/// Drives a motion and takes over the state in which it ends.
fn driven(
    state: &mut ControlState,
    motor: &mut Motor,
    device: &mut dyn Device,
    clock: &dyn Clock,
    motion: &mut dyn Motion,
    records: Option<&mut rtrb::Producer<TickRecord>>,
    stop: &AtomicBool,
) -> Result<DriveReport, ControlError> {
    let driven = drive_warm(device, clock, motion, &mut motor.heat, records, stop);
    motor.off_since_ns = Some(clock.now_ns());
    match driven {
        Ok(report) => {
            *state = motion.control_state();
            Ok(report)
        }
        Err(error) => {
            state.take(ControlEvent::NoAnswer);
            Err(error.into())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::plant_device::{Mishap, PlantDevice};
    use super::*;
    use crate::clock::VirtualClock;
    use crate::control::RING_CAPACITY;
    use crate::estimation::Calibration;
    use crate::estimation::EstimatorSettings;
    use crate::policy::{ClassicalController, ClassicalGains};
    use crate::qube::{PlantModel, State};
    use crate::safety::{COOLED_LOAD, SafetyBox};
    use crate::telemetry::{Ending, Fault};

    /// A thread whose device loses its port at this sample, and settings for a short rollout on it.
    fn control(gone_at: u32) -> (ControlThread, TickSettings) {
        let mut device = PlantDevice::new(State::default());
        device.mishap = Box::new(move |sample| (sample == gone_at).then_some(Mishap::Gone));
        let clock: Arc<dyn Clock> = Arc::new(device.clock.clone());
        let stop = Arc::new(AtomicBool::new(false));
        let thread = ControlThread::spawn(Box::new(device), clock, false, stop).unwrap();
        let settings = TickSettings {
            calibration: Calibration::IDENTITY,
            estimator: EstimatorSettings::default(),
            safety_box: SafetyBox::THESIS,
            max_steps: 100,
            start_theta_rad: 0.0,
            stops: None,
            foresight: None,
            rules: crate::telemetry::TickRules::NEWEST,
            plant: PlantModel::QUBE,
        };
        (thread, settings)
    }

    fn rollout(thread: &ControlThread, settings: TickSettings) -> Result<Ending, ControlError> {
        let policy = Policy::Classical(ClassicalController::new(ClassicalGains::default()));
        let (producer, _consumer) = rtrb::RingBuffer::new(RING_CAPACITY);
        thread.rollout(settings, policy, producer).unwrap().map(|report| report.outcome.ending)
    }

    fn is_refused(result: &Result<Ending, ControlError>) -> bool {
        matches!(result, Err(ControlError::Refused { .. }))
    }

    #[test]
    fn a_rollout_needs_a_hello_and_homing_and_again_after_a_fault() {
        // Enough samples for homing and the beginning of a rollout.
        let (thread, settings) = control(3000);
        assert!(is_refused(&rollout(&thread, settings)));
        assert!(thread.home(HomingSettings::default()).unwrap().is_err());
        thread.hello().unwrap().unwrap();
        assert!(is_refused(&rollout(&thread, settings)));
        let (_, homed) = thread.home(HomingSettings::default()).unwrap().unwrap();
        assert!(homed.rig.is_some());
        let ended = loop {
            let ended = rollout(&thread, settings);
            if !matches!(ended, Ok(Ending::Completed)) {
                break ended;
            }
        };
        // During a rollout, or before one while arm and pendulum come to rest.
        assert!(
            matches!(
                ended,
                Ok(Ending::Fault(Fault::LinkGone))
                    | Err(ControlError::Device(DeviceError::Link { fault: LinkFault::Gone, .. }))
            ),
            "{ended:?}"
        );
        // Latched: homing and rollouts are refused until a new hello, and rollouts until homing.
        assert!(is_refused(&rollout(&thread, settings)));
        assert!(thread.home(HomingSettings::default()).unwrap().is_err());
        assert!(thread.lend(|_, _, _| ()).unwrap().is_err());
        thread.hello().unwrap().unwrap();
        assert!(is_refused(&rollout(&thread, settings)));
        let (_, homed) = thread.home(HomingSettings::default()).unwrap().unwrap();
        assert!(homed.rig.is_some());
        assert_eq!(rollout(&thread, settings).unwrap(), Ending::Completed);
    }

    #[test]
    fn homing_and_rollouts_warm_the_motor_and_time_cools_it() {
        let device = PlantDevice::new(State::default());
        let clock = device.clock.clone();
        let stop = Arc::new(AtomicBool::new(false));
        let thread =
            ControlThread::spawn(Box::new(device), Arc::new(clock.clone()), false, stop).unwrap();
        assert_eq!(thread.cool_motor().unwrap().load, 0.0);
        thread.hello().unwrap().unwrap();
        thread.home(HomingSettings::default()).unwrap().unwrap();
        let homed = thread.cool_motor().unwrap();
        assert!(homed.load > 1e-4, "{homed:?}");
        clock.advance(20_000_000_000);
        let cooled = thread.cool_motor().unwrap();
        assert!((cooled.load - homed.cooled(20.0).load).abs() < 1e-12, "{cooled:?}");
        // The heat can be set, as after the port was reopened.
        let told = MotorHeat { load: 0.6, ..cooled };
        thread.set_motor(told).unwrap();
        assert_eq!(thread.cool_motor().unwrap(), told);
        thread.set_motor(cooled).unwrap();
        // Reading the heat does not cool the motor.
        assert_eq!(thread.cool_motor().unwrap(), cooled);
        let (_, settings) = control(u32::MAX);
        assert_eq!(rollout(&thread, settings).unwrap(), Ending::Completed);
        assert!(thread.cool_motor().unwrap().load > cooled.load);
    }

    #[test]
    fn a_hot_motor_cools_down_before_the_next_motion_unless_a_stop_is_asked_for() {
        let clock = VirtualClock::default();
        let heat = MotorHeat { load: 0.85, ..MotorHeat::default() };
        let mut motor = Motor { heat, off_since_ns: Some(0) };
        motor.cool_down(&clock, &AtomicBool::new(false));
        assert!((motor.heat.load - COOLED_LOAD).abs() < 1e-3, "{motor:?}");
        let waited_s = clock.now_ns() as f64 * 1e-9;
        assert!((waited_s - heat.cooling_s()).abs() < 1e-3, "{waited_s} s");

        let now_ns = clock.now_ns();
        let mut motor = Motor { heat, off_since_ns: Some(now_ns) };
        motor.cool_down(&clock, &AtomicBool::new(true));
        assert_eq!((clock.now_ns(), motor.heat), (now_ns, heat));
    }
}
