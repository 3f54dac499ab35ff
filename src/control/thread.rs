use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use crossbeam_channel::{Receiver, Sender, TryRecvError, bounded, select};

use super::device_owner::{DeviceOwner, Homed};
use super::latched_fault::LatchedFault;
use super::reconnect::HelloRetries;
use super::{ControlError, DriveReport, HomingSettings, ThreadGone};
use crate::clock::{Clock, RealtimeRefusals, enter_realtime};
use crate::device::{Device, Identity};
use crate::policy::Controller;
use crate::safety::MotorHeat;
use crate::telemetry::{Fault, TickRecord, TickSettings};

/// Interval at which the caller of a rollout checks for a latched fault.
const LATCHED_FAULT_POLL: Duration = Duration::from_millis(20);

/// A task for the control thread. It carries everything that a motion needs, so that the tick
/// neither allocates nor loads a file.
type Task = Box<dyn FnOnce(&mut DeviceOwner) + Send>;

/// Waits for the next task, and meanwhile watches the counts; returns `None` once the handle is
/// dropped.
fn next_task(inbox: &Receiver<Task>, owner: &mut DeviceOwner) -> Option<Task> {
    while owner.watches_pause() {
        match inbox.try_recv() {
            Err(TryRecvError::Empty) => owner.watch_pause(),
            received => return received.ok(),
        }
    }
    inbox.recv().ok()
}

/// Handle of the thread that owns the device. The thread carries out one task at a time; in
/// between the amplifier is off, and the thread watches the counts.
pub struct ControlThread {
    tasks: Option<Sender<Task>>,
    /// Channel without messages, which disconnects once the device is dropped.
    ended: Receiver<()>,
    handle: Option<JoinHandle<()>>,
    realtime: RealtimeRefusals,
    is_hardware: AtomicBool,
    latched: Arc<LatchedFault>,
}

/// The scheduling of a control thread by the operating system.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scheduling {
    /// The thread requests SCHED_FIFO and locked memory.
    RealTime,
    /// The thread keeps the ordinary priority; enough on a virtual clock.
    Ordinary,
}

impl ControlThread {
    /// Starts the thread. Setting `stop` ends every motion and wait: a rollout by braking, homing
    /// by switching the amplifier off.
    ///
    /// # Errors
    /// The operating system cannot start a thread.
    pub fn spawn(
        device: Box<dyn Device>,
        clock: Arc<dyn Clock>,
        scheduling: Scheduling,
        stop: Arc<AtomicBool>,
    ) -> std::io::Result<Self> {
        let (tasks, inbox) = bounded::<Task>(1);
        let (ready, readiness) = bounded(1);
        let (alive, ended) = bounded(0);
        let latched = Arc::new(LatchedFault::default());
        let shown = Arc::clone(&latched);
        let handle = std::thread::Builder::new().name("control".into()).spawn(move || {
            let report = match scheduling {
                Scheduling::RealTime => enter_realtime(),
                Scheduling::Ordinary => RealtimeRefusals::default(),
            };
            let _ = ready.send(report);
            // Dropped after the device and the inbox, also if a task panics: no task can be handed
            // to a thread that has ended.
            let _alive = alive;
            let inbox = inbox;
            let mut owner = DeviceOwner::new(device, clock, stop, shown);
            while let Some(task) = next_task(&inbox, &mut owner) {
                task(&mut owner);
            }
        })?;
        let realtime = readiness.recv().unwrap_or_default();
        Ok(Self {
            tasks: Some(tasks),
            ended,
            handle: Some(handle),
            realtime,
            is_hardware: AtomicBool::new(true),
            latched,
        })
    }

    /// The real-time rights that the operating system refused to the thread; none if it requested
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
    /// set. An error that waiting does not cure, such as another version of the protocol, ends the
    /// attempts at once.
    ///
    /// # Errors
    /// As for [`hello`](Self::hello).
    pub fn hello_until_answered(&self, retries: HelloRetries) -> Result<Identity, ControlError> {
        let (identified, is_hardware) =
            self.run_task(move |owner| (owner.hello(retries), owner.is_hardware()))?;
        self.is_hardware.store(is_hardware, Ordering::Relaxed);
        Ok(identified?)
    }

    /// Returns whether the device counted as hardware after the last hello, by
    /// [`Device::is_hardware`]; true before the first hello.
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
        self.run_task(move |owner| owner.home(&settings))?
    }

    /// Runs one rollout to its end and writes a record of each tick to `records`. Before it, arm
    /// and pendulum must be at rest where the last motion left them. If the rollout latches a fault
    /// and the arm is being damped or braked when the caller checks next, `on_latched` is called
    /// with the fault on the calling thread.
    ///
    /// # Errors
    /// The thread is gone; the device has not been homed since its last hello or loan, or could not
    /// be armed; arm or pendulum has moved or was not seen at rest since the last motion; or a stop
    /// was requested or the device failed before the rollout began.
    pub fn rollout(
        &self,
        settings: TickSettings,
        controller: Box<dyn Controller>,
        mut records: rtrb::Producer<TickRecord>,
        on_latched: &mut dyn FnMut(Fault),
    ) -> Result<DriveReport, ControlError> {
        let result = self.begin(move |owner| owner.rollout(&settings, controller, &mut records))?;
        let mut is_reported = false;
        loop {
            if let Some(finished) = self.receive(&result, LATCHED_FAULT_POLL)? {
                return finished;
            }
            if let Some(fault) = self.latched.get().filter(|_| !is_reported) {
                is_reported = true;
                on_latched(fault);
            }
        }
    }

    /// Sets the motor's rating and heat. A new thread assumes a nominal motor that is cold.
    ///
    /// # Errors
    /// The thread is gone.
    pub fn set_motor(&self, heat: MotorHeat) -> Result<(), ThreadGone> {
        self.run_task(move |owner| owner.set_motor(heat))
    }

    /// The motor's heat at this moment.
    ///
    /// # Errors
    /// The thread is gone.
    pub fn motor_heat(&self) -> Result<MotorHeat, ThreadGone> {
        self.run_task(DeviceOwner::motor_heat)
    }

    /// Waits until the motor is cool enough for the next motion, or `stop` is set. Returns the heat
    /// with which the next motion begins.
    ///
    /// # Errors
    /// The thread is gone.
    pub fn cool_motor(&self) -> Result<MotorHeat, ThreadGone> {
        self.run_task(DeviceOwner::cool_motor)
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
        self.run_task(move |owner| owner.lend(task))?
    }

    /// Runs a task on the thread, and returns its result.
    fn run_task<R: Send + 'static>(
        &self,
        task: impl FnOnce(&mut DeviceOwner) -> R + Send + 'static,
    ) -> Result<R, ThreadGone> {
        let result = self.begin(task)?;
        loop {
            if let Some(result) = self.receive(&result, Duration::MAX)? {
                return Ok(result);
            }
        }
    }

    /// Waits for the result of a task for at most `timeout`.
    ///
    /// # Errors
    /// The thread is gone. A task that was handed over while the thread ended stays in the channel,
    /// and its result never comes.
    fn receive<R>(&self, result: &Receiver<R>, timeout: Duration) -> Result<Option<R>, ThreadGone> {
        select! {
            recv(result) -> result => result.map(Some).map_err(|_| self.gone()),
            recv(self.ended) -> _ => result.try_recv().map(Some).map_err(|_| ThreadGone),
            default(timeout) => Ok(None),
        }
    }

    /// The error of a thread that ends. Waits until the thread has dropped the device, which
    /// switches the motor off.
    fn gone(&self) -> ThreadGone {
        let _ = self.ended.recv();
        ThreadGone
    }

    /// Hands a task to the thread, and returns the channel of its result.
    fn begin<R: Send + 'static>(
        &self,
        task: impl FnOnce(&mut DeviceOwner) -> R + Send + 'static,
    ) -> Result<Receiver<R>, ThreadGone> {
        let (results, result) = bounded(1);
        let task: Task = Box::new(move |owner| {
            // The channel has room for the one result; the caller waits for it.
            let _ = results.send(task(owner));
        });
        self.tasks.as_ref().ok_or(ThreadGone)?.send(task).map_err(|_| self.gone())?;
        Ok(result)
    }
}

impl Drop for ControlThread {
    fn drop(&mut self) {
        self.tasks = None;
        if let Some(handle) = self.handle.take() {
            let _ = handle.join();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::plant_device::{PlantDevice, TestFault, rollout_settings};
    use super::*;
    use crate::control::RING_CAPACITY;
    use crate::device::{DeviceError, LinkFault};
    use crate::policy::{ClassicalController, ClassicalGains, Policy};
    use crate::qube::State;
    use crate::safety::COOLED_LOAD;
    use crate::telemetry::Ending;

    /// A thread whose device loses its port at sample `gone_at`, and settings for a short rollout.
    fn control(gone_at: u32) -> (ControlThread, TickSettings) {
        let mut device = PlantDevice::new(State::default());
        device.disturbance = Box::new(move |sample| (sample == gone_at).then_some(TestFault::Gone));
        let clock: Arc<dyn Clock> = Arc::new(device.clock.clone());
        let stop = Arc::new(AtomicBool::new(false));
        let thread =
            ControlThread::spawn(Box::new(device), clock, Scheduling::Ordinary, stop).unwrap();
        (thread, rollout_settings(100))
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
        // The port is lost during a rollout, or before one while arm and pendulum come to rest.
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

    /// A thread that has sent its hello, and whose device holds this value until it is dropped.
    fn holding<T: Send + 'static>(held: T) -> ControlThread {
        let mut device = PlantDevice::new(State::default());
        device.disturbance = Box::new(move |_| {
            let _ = &held;
            None
        });
        let clock: Arc<dyn Clock> = Arc::new(device.clock.clone());
        let thread =
            ControlThread::spawn(Box::new(device), clock, Scheduling::Ordinary, Arc::default())
                .unwrap();
        thread.hello().unwrap();
        thread
    }

    #[test]
    fn a_thread_that_panics_is_gone_once_its_device_is_dropped() {
        let in_use = Arc::new(());
        let thread = holding(Arc::clone(&in_use));
        let lent: Result<(), _> = thread.lend(|_, _, _, _| panic!("the task panics on purpose"));
        assert!(matches!(lent, Err(ControlError::ThreadGone(_))), "{lent:?}");
        assert_eq!(Arc::strong_count(&in_use), 1);
        assert!(thread.hello().is_err());
    }

    /// Says when it is dropped, and takes a while.
    struct SlowDrop(Sender<()>);

    impl Drop for SlowDrop {
        fn drop(&mut self) {
            self.0.send(()).unwrap();
            std::thread::sleep(Duration::from_millis(200));
        }
    }

    #[test]
    fn a_task_that_is_handed_over_while_the_thread_ends_is_not_waited_for() {
        let (dropped, ends) = bounded(1);
        let thread = holding(SlowDrop(dropped));
        std::thread::scope(|scope| {
            scope.spawn(|| {
                let lent = thread.lend(|_, _, _, _| panic!("the task panics on purpose"));
                let lent: Result<(), _> = lent;
                assert!(matches!(lent, Err(ControlError::ThreadGone(_))), "{lent:?}");
            });
            ends.recv().unwrap();
            let late = thread.hello();
            assert!(matches!(late, Err(ControlError::ThreadGone(_))), "{late:?}");
        });
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
        // A check or a power test drives too, and its time does not cool the motor.
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
