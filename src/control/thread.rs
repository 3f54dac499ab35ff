use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use crossbeam_channel::{Receiver, RecvTimeoutError, Sender, bounded};

use super::between_motions::{MotorCooling, RestMonitor};
use super::latched_fault::{LatchedFault, ShownRollout};
use super::reconnect::{HelloRetries, greet_until_answered};
use super::{
    ControlAction, ControlError, ControlEvent, ControlState, DriveReport, Homing, HomingSettings,
    Motion, Moved, ThreadGone, Tick, drive_warm,
};
use crate::clock::{Clock, RealtimeRefusals, enter_realtime};
use crate::device::{Device, DeviceError, Identity};
use crate::estimation::MeasuredRig;
use crate::policy::Controller;
use crate::safety::MotorHeat;
use crate::telemetry::{Fault, TickRecord, TickSettings};

/// The result of a homing.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Homed {
    /// Zeros of the encoders and angles of the stops; `None` unless homing completed.
    pub rig: Option<MeasuredRig>,
    /// Distance between the stops, rad; `None` unless both were touched.
    pub travel_rad: Option<f64>,
}

/// Time between two looks at the fault that a running rollout may have latched.
const LATCHED_FAULT_POLL: Duration = Duration::from_millis(20);

/// A command to the thread. It carries everything that the motion needs, so that the tick neither
/// allocates nor loads a file.
enum Command {
    Hello(HelloRetries),
    Cool,
    TellHeat,
    SetHeat(MotorHeat),
    Home(Box<HomingSettings>),
    Rollout(Box<TickSettings>, Box<dyn Controller>, rtrb::Producer<TickRecord>),
    Lend(Borrower),
}

/// A task that uses the device, its clock, the motor's heat and the request to stop.
type Borrower = Box<dyn FnOnce(&mut dyn Device, &dyn Clock, &mut MotorHeat, &AtomicBool) + Send>;

enum Event {
    /// Identity of the device, and whether it is hardware.
    Identified(Result<Identity, DeviceError>, bool),
    Homed(Result<(DriveReport, Homed), ControlError>),
    Finished(Result<DriveReport, ControlError>),
    Returned(Result<(), ControlError>),
    Heat(MotorHeat),
}

/// Handle of the thread that owns the device. The thread executes one command at a time; in between
/// the amplifier is off.
pub struct ControlThread {
    commands: Option<Sender<Command>>,
    events: Receiver<Event>,
    handle: Option<JoinHandle<()>>,
    realtime: RealtimeRefusals,
    is_hardware: AtomicBool,
    latched: Arc<LatchedFault>,
}

/// The scheduling of a control thread by the operating system.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scheduling {
    /// The thread asks for SCHED_FIFO and locked memory.
    RealTime,
    /// As any thread; enough on a virtual clock.
    Ordinary,
}

impl ControlThread {
    /// Starts the thread. Setting `stop` ends every motion and wait: a rollout by
    /// braking, homing by switching the amplifier off.
    ///
    /// # Errors
    /// The operating system cannot start a thread.
    pub fn spawn(
        mut device: Box<dyn Device>,
        clock: Arc<dyn Clock>,
        scheduling: Scheduling,
        stop: Arc<AtomicBool>,
    ) -> std::io::Result<Self> {
        let (commands, inbox) = bounded::<Command>(1);
        let (outbox, events) = bounded::<Event>(1);
        let (ready, readiness) = bounded(1);
        let latched = Arc::new(LatchedFault::default());
        let shown = Arc::clone(&latched);
        let handle = std::thread::Builder::new().name("control".into()).spawn(move || {
            let report = match scheduling {
                Scheduling::RealTime => enter_realtime(),
                Scheduling::Ordinary => RealtimeRefusals::default(),
            };
            let _ = ready.send(report);
            let mut kept = KeptBetweenCommands::default();
            for command in inbox {
                let (device, clock) = (device.as_mut(), clock.as_ref());
                let event = execute(&mut kept, command, device, clock, &stop, &shown);
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
            latched,
        })
    }

    /// The real-time rights that the operating system refused to the thread; none if it asked for
    /// none.
    #[must_use]
    pub fn realtime(&self) -> &RealtimeRefusals {
        &self.realtime
    }

    /// Sends a hello to the device.
    ///
    /// # Errors
    /// The thread is gone, or as for [`Device::hello`].
    pub fn hello(&self) -> Result<Identity, ControlError> {
        self.hello_until_answered(HelloRetries::default())
    }

    /// Sends hellos to the device until it answers, the time of `retries` is over, or `stop` is
    /// set. A device that speaks another version of the protocol ends the attempts at once.
    ///
    /// # Errors
    /// As for [`hello`](Self::hello).
    pub fn hello_until_answered(&self, retries: HelloRetries) -> Result<Identity, ControlError> {
        match self.ask(Command::Hello(retries))? {
            Event::Identified(result, is_hardware) => {
                self.is_hardware.store(is_hardware, Ordering::Relaxed);
                Ok(result?)
            }
            _ => Err(ThreadGone.into()),
        }
    }

    /// Whether the device counted as hardware after the last hello, by [`Device::is_hardware`];
    /// true before the first hello.
    #[must_use]
    pub fn is_hardware(&self) -> bool {
        self.is_hardware.load(Ordering::Relaxed)
    }

    /// Measures the zeros of the encoders and, unless the operator has put the arm into the middle
    /// by hand, the stops. A fault or a stop of homing is no error; the report gives it as the
    /// ending.
    ///
    /// # Errors
    /// The thread is gone; the device has not answered a hello since the start or since a fault, or
    /// could not be armed.
    pub fn home(&self, settings: HomingSettings) -> Result<(DriveReport, Homed), ControlError> {
        match self.ask(Command::Home(Box::new(settings)))? {
            Event::Homed(result) => result,
            _ => Err(ThreadGone.into()),
        }
    }

    /// Runs one rollout to its end and writes a record of each tick to `records`. Before it, arm
    /// and pendulum must be at rest where the last motion left them. If the rollout latches a fault
    /// and the arm is still damped or braked a moment later, `on_latched` is called with the fault
    /// on the calling thread.
    ///
    /// # Errors
    /// The thread is gone; the device has not been homed since its last hello or loan, or could not
    /// be armed; arm or pendulum has moved or was not seen at rest since the last motion; a stop
    /// was requested before the rollout began; or the link failed.
    pub fn rollout(
        &self,
        settings: TickSettings,
        controller: Box<dyn Controller>,
        records: rtrb::Producer<TickRecord>,
        on_latched: &mut dyn FnMut(Fault),
    ) -> Result<DriveReport, ControlError> {
        self.order(Command::Rollout(Box::new(settings), controller, records))?;
        let mut is_told = false;
        let event = loop {
            match self.events.recv_timeout(LATCHED_FAULT_POLL) {
                Ok(event) => break event,
                Err(RecvTimeoutError::Disconnected) => return Err(ThreadGone.into()),
                Err(RecvTimeoutError::Timeout) => {}
            }
            if let Some(fault) = self.latched.get().filter(|_| !is_told) {
                is_told = true;
                on_latched(fault);
            }
        };
        match event {
            Event::Finished(result) => result,
            _ => Err(ThreadGone.into()),
        }
    }

    /// Sets the motor's rating and heat. A new thread assumes a nominal motor that is cold.
    ///
    /// # Errors
    /// The thread is gone.
    pub fn set_motor(&self, heat: MotorHeat) -> Result<(), ThreadGone> {
        self.ask(Command::SetHeat(heat)).map(|_| ())
    }

    /// The motor's heat at this moment.
    ///
    /// # Errors
    /// The thread is gone.
    pub fn motor_heat(&self) -> Result<MotorHeat, ThreadGone> {
        match self.ask(Command::TellHeat)? {
            Event::Heat(heat) => Ok(heat),
            _ => Err(ThreadGone),
        }
    }

    /// Waits until the motor is cool enough for the next motion, or `stop` is set. Returns the heat
    /// with which the next motion begins.
    ///
    /// # Errors
    /// The thread is gone.
    pub fn cool_motor(&self) -> Result<MotorHeat, ThreadGone> {
        match self.ask(Command::Cool)? {
            Event::Heat(heat) => Ok(heat),
            _ => Err(ThreadGone),
        }
    }

    /// Lends the device to a task between motions, once the motor is cool enough. The task runs on
    /// the control thread with its priority, so that a check measures the latencies that a tick
    /// will have. A task that drives the motor must update the motor's heat. Afterwards the arm
    /// must be homed before a rollout.
    ///
    /// # Errors
    /// The thread is gone; the device has not answered a hello; or a fault occurred after which the
    /// arm has not been homed.
    pub fn lend<R: Send + 'static>(
        &self,
        task: impl FnOnce(&mut dyn Device, &dyn Clock, &mut MotorHeat, &AtomicBool) -> R
        + Send
        + 'static,
    ) -> Result<R, ControlError> {
        let (results, result) = bounded(1);
        let borrower: Borrower = Box::new(move |device, clock, heat, stop| {
            // The receiver waits below, and the channel has room for one result.
            let _ = results.send(task(device, clock, heat, stop));
        });
        match self.ask(Command::Lend(borrower))? {
            Event::Returned(Ok(())) => result.recv().map_err(|_| ThreadGone.into()),
            Event::Returned(Err(refused)) => Err(refused),
            _ => Err(ThreadGone.into()),
        }
    }

    fn order(&self, command: Command) -> Result<(), ThreadGone> {
        let commands = self.commands.as_ref().ok_or(ThreadGone)?;
        commands.send(command).map_err(|_| ThreadGone)
    }

    fn ask(&self, command: Command) -> Result<Event, ThreadGone> {
        self.order(command)?;
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

/// Knowledge that the thread keeps from one command to the next.
#[derive(Default)]
struct KeptBetweenCommands {
    state: ControlState,
    motor: MotorCooling,
    rest_monitor: RestMonitor,
}

fn execute(
    kept: &mut KeptBetweenCommands,
    command: Command,
    device: &mut dyn Device,
    clock: &dyn Clock,
    stop: &AtomicBool,
    latched: &LatchedFault,
) -> Event {
    let KeptBetweenCommands { state, motor, rest_monitor } = kept;
    match command {
        Command::Hello(retries) => {
            let identified = greet_until_answered(device, clock, stop, retries);
            let answered = identified.is_ok();
            // The cable is the same after a hello.
            let waits_for = rest_monitor.waits_for;
            *rest_monitor = RestMonitor { waits_for, ..RestMonitor::default() };
            if let Ok(identity) = &identified {
                rest_monitor.port.clone_from(&identity.port);
            }
            state.take(if answered { ControlEvent::Hello } else { ControlEvent::NoAnswer });
            Event::Identified(identified, device.is_hardware())
        }
        Command::Cool => {
            motor.cool_down(clock, stop);
            Event::Heat(motor.heat)
        }
        Command::TellHeat => {
            motor.cool(clock);
            Event::Heat(motor.heat)
        }
        Command::SetHeat(heat) => {
            *motor = MotorCooling::off_from_now(heat, clock);
            Event::Heat(motor.heat)
        }
        Command::Home(settings) => {
            let home = allowed(state, ControlEvent::Home);
            // A homing that is refused does not wait until the motor has cooled.
            if home.is_ok() {
                motor.cool_down(clock, stop);
            }
            rest_monitor.encoders = settings.plant.encoders;
            let mut homing = match state {
                ControlState::Cleared => Homing::after_fault(&settings),
                _ => Homing::new(&settings),
            };
            let driven = home.and_then(|()| {
                drive_and_adopt_state(state, motor, device, clock, &mut homing, None, stop)
            });
            let driven =
                driven.map(|report| keep_at_rest(report, state, rest_monitor, device, clock, stop));
            let homed = Homed { rig: homing.measured(), travel_rad: homing.travel_rad() };
            Event::Homed(driven.map(|report| (report, homed)))
        }
        Command::Rollout(settings, controller, mut records) => {
            let before = *state;
            let driven = allowed(state, ControlEvent::Rollout).and_then(|()| {
                motor.cool_down(clock, stop);
                if let Err(error) = rest_monitor.compare(&settings, device, clock, stop) {
                    *state = before;
                    if matches!(error, ControlError::Device(_)) {
                        state.take(ControlEvent::NoAnswer);
                    }
                    return Err(error);
                }
                let mut rollout = ShownRollout::new(Tick::new(&settings, controller), latched);
                drive_and_adopt_state(
                    state,
                    motor,
                    device,
                    clock,
                    &mut rollout,
                    Some(&mut records),
                    stop,
                )
            });
            rest_monitor.left_at = Err(Moved::Unseen);
            Event::Finished(
                driven.map(|report| keep_at_rest(report, state, rest_monitor, device, clock, stop)),
            )
        }
        Command::Lend(borrower) => {
            let lent = allowed(state, ControlEvent::Check).map(|()| {
                motor.cool_down(clock, stop);
                borrower(device, clock, &mut motor.heat, stop);
                motor.switched_off(clock);
                state.take(ControlEvent::Checked);
            });
            Event::Returned(lent)
        }
    }
}

/// Applies a command to the state table.
///
/// # Errors
/// The table refuses the command.
fn allowed(state: &mut ControlState, wanted: ControlEvent) -> Result<(), ControlError> {
    match state.take(wanted) {
        ControlAction::Refuse => Err(ControlError::Refused { wanted, state: *state }),
        _ => Ok(()),
    }
}

/// Drives a motion and adopts the state of control in which the motion ends, or latches a fault if
/// the device has not confirmed that its amplifier is off.
///
/// # Errors
/// The device could not be armed; the fault is latched.
fn drive_and_adopt_state(
    state: &mut ControlState,
    motor: &mut MotorCooling,
    device: &mut dyn Device,
    clock: &dyn Clock,
    motion: &mut dyn Motion,
    records: Option<&mut rtrb::Producer<TickRecord>>,
    stop: &AtomicBool,
) -> Result<DriveReport, ControlError> {
    let driven = drive_warm(device, clock, motion, &mut motor.heat, records, stop);
    motor.switched_off(clock);
    match driven {
        Ok(report) => {
            *state = motion.control_state();
            if report.disarmed.is_err() {
                state.take(ControlEvent::NoAnswer);
            }
            Ok(report)
        }
        Err(error) => {
            state.take(ControlEvent::NoAnswer);
            Err(error.into())
        }
    }
}

/// Watches after a motion without a fault where arm and pendulum come to rest. A device whose samples
/// say that its motor is on has not switched it off, whatever it answered.
fn keep_at_rest(
    mut report: DriveReport,
    state: &mut ControlState,
    rest_monitor: &mut RestMonitor,
    device: &mut dyn Device,
    clock: &dyn Clock,
    stop: &AtomicBool,
) -> DriveReport {
    if *state == ControlState::Ready
        && let Err(stays_armed) =
            rest_monitor.keep(report.last_measurement.as_ref(), device, clock, stop)
    {
        state.take(ControlEvent::NoAnswer);
        report.disarmed = Err(stays_armed);
    }
    report
}

#[cfg(test)]
mod tests {
    use super::super::plant_device::{PlantDevice, TestFault};
    use super::*;
    use crate::control::RING_CAPACITY;
    use crate::device::LinkFault;
    use crate::estimation::Calibration;
    use crate::estimation::EstimatorSettings;
    use crate::policy::{ClassicalController, ClassicalGains, Policy};
    use crate::qube::{PlantModel, State};
    use crate::safety::{COOLED_LOAD, SafetyBox};
    use crate::telemetry::Ending;

    /// A thread whose device loses its port at sample `gone_at`, and settings for a short rollout.
    fn control(gone_at: u32) -> (ControlThread, TickSettings) {
        let mut device = PlantDevice::new(State::default());
        device.disturbance = Box::new(move |sample| (sample == gone_at).then_some(TestFault::Gone));
        let clock: Arc<dyn Clock> = Arc::new(device.clock.clone());
        let stop = Arc::new(AtomicBool::new(false));
        let thread =
            ControlThread::spawn(Box::new(device), clock, Scheduling::Ordinary, stop).unwrap();
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
        thread
            .rollout(settings, Box::new(policy), producer, &mut |_| ())
            .map(|report| report.outcome.ending)
    }

    fn is_refused(result: &Result<Ending, ControlError>) -> bool {
        matches!(result, Err(ControlError::Refused { .. }))
    }

    #[test]
    fn a_rollout_needs_a_hello_and_homing_and_again_after_a_fault() {
        // Enough samples for homing and the beginning of a rollout.
        let (thread, settings) = control(3100);
        assert!(is_refused(&rollout(&thread, settings)));
        assert!(thread.home(HomingSettings::default()).is_err());
        thread.hello().unwrap();
        assert!(is_refused(&rollout(&thread, settings)));
        let (_, homed) = thread.home(HomingSettings::default()).unwrap();
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
        assert!(thread.home(HomingSettings::default()).is_err());
        assert!(thread.lend(|_, _, _, _| ()).is_err());
        thread.hello().unwrap();
        assert!(is_refused(&rollout(&thread, settings)));
        let (_, homed) = thread.home(HomingSettings::default()).unwrap();
        assert!(homed.rig.is_some());
        assert_eq!(rollout(&thread, settings).unwrap(), Ending::Completed);
    }

    #[test]
    fn homing_a_rollout_and_a_loan_begin_with_a_motor_that_has_cooled() {
        let device = PlantDevice::new(State::default());
        let clock = device.clock.clone();
        let thread = ControlThread::spawn(
            Box::new(device),
            Arc::new(clock.clone()),
            Scheduling::Ordinary,
            Arc::default(),
        )
        .unwrap();
        thread.hello().unwrap();
        let hot = MotorHeat { load: 0.85, ..MotorHeat::default() };
        let cooling_ns = (hot.cooling_s() * 1e9) as u64;
        let heat = || {
            thread.set_motor(hot).unwrap();
            clock.now_ns()
        };
        // A motion of a few seconds warms the motor by less than a tenth.
        let began_cool = |report: &DriveReport| {
            let largest = report.outcome.largest_motor_load.unwrap();
            assert!(largest < COOLED_LOAD + 0.1, "{largest}");
        };

        let heated_ns = heat();
        let (report, homed) = thread.home(HomingSettings::default()).unwrap();
        assert!(homed.rig.is_some());
        assert!(clock.now_ns() > heated_ns + cooling_ns);
        began_cool(&report);

        let heated_ns = heat();
        let (_, settings) = control(u32::MAX);
        let policy = Policy::Classical(ClassicalController::new(ClassicalGains::default()));
        let (producer, mut records) = rtrb::RingBuffer::new(RING_CAPACITY);
        let report = thread.rollout(settings, Box::new(policy), producer, &mut |_| ()).unwrap();
        assert_eq!(report.outcome.ending, Ending::Completed);
        let first_ns = records.pop().unwrap().deadline_ns;
        assert!(first_ns > heated_ns + cooling_ns, "{first_ns} {heated_ns}");
        began_cool(&report);

        let heated_ns = heat();
        let lent = thread.lend(|_, clock, heat, _| (clock.now_ns(), heat.load)).unwrap();
        let (begun_ns, load) = lent;
        assert!(begun_ns >= heated_ns + cooling_ns, "{begun_ns} {heated_ns}");
        assert!((load - COOLED_LOAD).abs() < 1e-3, "{load}");
    }

    #[test]
    fn whatever_drives_warms_the_motor_and_time_cools_it() {
        let device = PlantDevice::new(State::default());
        let clock = device.clock.clone();
        let stop = Arc::new(AtomicBool::new(false));
        let thread = ControlThread::spawn(
            Box::new(device),
            Arc::new(clock.clone()),
            Scheduling::Ordinary,
            stop,
        )
        .unwrap();
        assert_eq!(thread.cool_motor().unwrap().load, 0.0);
        thread.hello().unwrap();
        thread.home(HomingSettings::default()).unwrap();
        let homed = thread.cool_motor().unwrap();
        assert!(homed.load > 1e-4, "{homed:?}");
        clock.advance(20_000_000_000);
        let cooled = thread.cool_motor().unwrap();
        assert!((cooled.load - homed.cooled(20.0).load).abs() < 1e-12, "{cooled:?}");
        // The heat can be set, as after the port was reopened.
        let warm = MotorHeat { load: 0.6, ..cooled };
        thread.set_motor(warm).unwrap();
        assert_eq!(thread.cool_motor().unwrap(), warm);
        thread.set_motor(cooled).unwrap();
        // Reading the heat does not cool the motor.
        assert_eq!(thread.cool_motor().unwrap(), cooled);
        let (_, settings) = control(u32::MAX);
        assert_eq!(rollout(&thread, settings).unwrap(), Ending::Completed);
        let driven = thread.cool_motor().unwrap();
        assert!(driven.load > cooled.load);
        // A check or a power test drives too, and its time is no pause.
        let pushed = thread.lend(|_, clock, heat, _| {
            let begun = *heat;
            clock.sleep_until(clock.now_ns() + 60_000_000_000);
            heat.load += 0.1;
            (begun, *heat)
        });
        let (begun, pushed) = pushed.unwrap();
        assert_eq!(begun, driven);
        assert_eq!(thread.cool_motor().unwrap(), pushed);
    }
}
