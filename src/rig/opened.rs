use std::cell::Cell;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{SystemTime, UNIX_EPOCH};

use super::connection::connect;
use super::error::link_fault;
use super::{
    ClockChoice, DeviceChoice, Doubt, DoubtStore, MotorMemory, RigError, RigSettings,
    UnfinishedCheck,
};
use crate::clock::{Clock, RealtimeRefusals};
use crate::control::{
    ControlError, ControlThread, DriveReport, HelloRetries, HomingMethod, HomingSettings,
    Scheduling, fault_after,
};
use crate::device::emulator::EmulatedQube;
use crate::device::{DeviceError, Identity, LinkFault};
use crate::estimation::MeasuredRig;
use crate::preflight::{
    Examination, ExaminationSettings, OtherSigns, admit_processor, examine, foresight_time_us,
    homed, homing_left_out, measure_link, not_homed,
};
use crate::qube::PlantModel;
use crate::recording::Viewer;
use crate::safety::{HardwareLimits, IdentifiedQube, MotorHeat};
use crate::telemetry::{CheckResult, Consequence, Fault, MeasuredLink, MotorState, Preflight};

/// Pauses before the second and third attempt at homing, ns. A link or computer that is late for
/// two seconds does not use up all attempts.
const HOMING_PAUSES_NS: [u64; 2] = [1_000_000_000, 2_000_000_000];

/// A Qube that has answered a hello, with the thread that drives it. [`Rig::open`] also homes it;
/// after [`Rig::connect`] it is not homed yet.
pub struct Rig {
    pub(super) control: ControlThread,
    pub(super) identity: Identity,
    pub(super) measured: MeasuredRig,
    pub(super) plant: PlantModel,
    pub(super) homing: Cell<HomingSettings>,
    pub(super) preflight: Preflight,
    /// Measured link; `None` before the measurement, and for the embedded emulator, unless it
    /// emulates a USB bridge.
    pub(super) link: Option<MeasuredLink>,
    /// True if the device adds its own time to each sample; otherwise the age of a sample is
    /// unknown.
    pub(super) has_device_clock: bool,
    clock: ClockChoice,
    pub(super) limits: HardwareLimits,
    stop: Arc<AtomicBool>,
    link_patience_s: f64,
    doubts: Option<DoubtStore>,
    /// Time that foresight's longest prediction takes on this processor, us; 0 for an emulated
    /// Qube.
    pub(super) foresight_time_us: f64,
    /// Identified model that the guard uses, until a rollout contradicts it.
    pub(super) identified: Cell<Option<IdentifiedQube>>,
    /// Viewers that show rollouts while they are recorded.
    pub(super) viewers: Vec<Arc<dyn Viewer>>,
    /// Fault of the last motion, or fault that kept it from beginning, until the Qube is homed
    /// again.
    pub(super) last_fault: Cell<Option<Fault>>,
    /// State of the motor after the last motion, until the device answers a hello.
    pub(super) motor: Cell<MotorState>,
    /// Memory for the motor's heat, with the clock of the device; `None` for an emulated Qube and
    /// in virtual time, where each opening makes a Qube anew.
    motor_memory: Option<(MotorMemory, Arc<dyn Clock>)>,
    /// Emulator, which serves the rig until it is closed; dropped after the control thread.
    _emulator: Option<EmulatedQube>,
}

impl Drop for Rig {
    fn drop(&mut self) {
        if let Some((memory, clock)) = &self.motor_memory {
            memory.store(self.control.motor_heat().ok(), clock.now_ns());
        }
    }
}

impl Rig {
    /// Opens the device, reads its identity and homes it. Before homing, a Qube in doubt is
    /// examined, and a real one too unless the settings skip the check.
    ///
    /// # Errors
    /// A doubt is not acknowledged, the processor is too slow for foresight, or a step fails. The
    /// motor is then off, unless the error says that it may be on.
    pub fn open(settings: &RigSettings, stop: &Arc<AtomicBool>) -> Result<Self, RigError> {
        Self::open_announced(settings, stop, |_| {})
    }

    /// Opens a rig like [`open`](Self::open). Calls `before_motion` once port, board and doubt are
    /// accepted, right before the arm moves; its argument is whether the Qube is examined first.
    ///
    /// # Errors
    /// The errors of [`open`](Self::open).
    pub fn open_announced(
        settings: &RigSettings,
        stop: &Arc<AtomicBool>,
        before_motion: impl FnOnce(bool),
    ) -> Result<Self, RigError> {
        let (mut rig, doubt) = Self::reach(settings, stop)?;
        let is_hardware = settings.is_hardware() || rig.is_hardware();
        // After a doubt no flag skips the examination.
        let is_examined = doubt.is_some() || (is_hardware && !settings.skip_check);
        before_motion(is_examined);
        if is_examined {
            let Examination { mut results, fault, .. } = rig.examine(OtherSigns::Fail)?;
            if results.iter().any(CheckResult::failed) {
                let doubt = fault.filter(|fault| fault.leaves_doubt());
                let doubt = doubt.map(|fault| Box::new(rig.doubt(fault)));
                return Err(RigError::CheckFailed { results, fault, doubt });
            }
            rig.home()?;
            results.push(homed(&rig.measured.calibration));
            rig.preflight = Preflight::Done(results);
        } else {
            let skipped = Preflight::SkippedByFlag;
            rig.preflight = if is_hardware { skipped } else { Preflight::NotNeeded };
            if is_hardware || settings.emulator.bridge.is_some() {
                rig.measure_link()?;
            }
            rig.home()?;
        }
        if let Some(doubts) = rig.doubts.as_ref().filter(|_| doubt.is_some()) {
            doubts.remove(&rig.identity.serial);
        }
        Ok(rig)
    }

    /// Opens the device and checks that the Qube may be driven; moves nothing. Returns the rig and
    /// its acknowledged doubt, if there is one.
    ///
    /// # Errors
    /// The errors of [`connect`](Self::connect); a doubt is not acknowledged, or the processor is
    /// too slow for foresight.
    pub fn reach(
        settings: &RigSettings,
        stop: &Arc<AtomicBool>,
    ) -> Result<(Self, Option<Doubt>), RigError> {
        Self::connect(settings, stop)?.accepted(settings)
    }

    /// Checks that the Qube may be driven, and returns this rig with its acknowledged doubt, if
    /// there is one.
    ///
    /// # Errors
    /// A doubt is not acknowledged, or the processor is too slow for foresight.
    fn accepted(self, settings: &RigSettings) -> Result<(Self, Option<Doubt>), RigError> {
        let doubt = self.remembered_doubt().or_else(|| settings.recovery.doubt.clone());
        if let Some(doubt) = doubt.clone().filter(|_| !settings.recovery.acknowledged) {
            return Err(RigError::InDoubt(Box::new(doubt)));
        }
        let is_hardware = settings.is_hardware() || self.is_hardware();
        if let Some(doubts) = self.doubts.as_ref().filter(|_| is_hardware) {
            doubts.warn_if_unwritable(&self.identity.serial);
        }
        if is_hardware && settings.limits.needs_foresight() {
            admit_processor(self.foresight_time_us)?;
        }
        Ok((self, doubt))
    }

    /// Opens the device and reads its identity without moving the motor.
    ///
    /// # Errors
    /// A setting cannot be used; the emulator or the control thread cannot be started; the device
    /// does not exist or does not answer, is another board than the settings require, or is
    /// hardware with a plant that needs a consent that the settings lack.
    pub fn connect(settings: &RigSettings, stop: &Arc<AtomicBool>) -> Result<Self, RigError> {
        settings.check()?;
        let (device, clock, emulator) = connect(settings)?;
        let scheduling = match settings.clock {
            ClockChoice::Wall => Scheduling::RealTime,
            ClockChoice::Virtual => Scheduling::Ordinary,
        };
        let has_device_clock = device.has_device_clock();
        let motor_memory = (settings.is_hardware() && settings.clock == ClockChoice::Wall)
            .then(|| (settings.recovery.motor.clone(), Arc::clone(&clock)));
        let control = ControlThread::spawn(device, clock, scheduling, Arc::clone(stop))
            .map_err(RigError::Thread)?;
        let cold = MotorHeat::cold(&settings.plant, settings.limits.motor());
        control.set_motor(
            motor_memory.as_ref().map_or(cold, |(memory, clock)| memory.warm(cold, clock.now_ns())),
        )?;
        let identity = control.hello()?;
        if let Some(expected) = settings.board.as_ref().filter(|board| **board != identity.serial) {
            // The port of the emulated Qube is made by this program, so its name would tell the
            // operator nothing.
            let port = match settings.device {
                DeviceChoice::Emulated => "the emulated Qube".to_owned(),
                _ => identity.port,
            };
            return Err(RigError::WrongBoard {
                port,
                expected: expected.clone(),
                found: identity.serial,
            });
        }
        let is_hardware = settings.is_hardware() || control.is_hardware();
        if is_hardware {
            settings.limits.admit_plant(&settings.plant)?;
        }
        let homing = settings.homing.of_plant(&settings.plant);
        Ok(Self {
            control,
            identity,
            measured: MeasuredRig { calibration: homing.signs, stops: None },
            plant: settings.plant,
            homing: Cell::new(homing),
            preflight: Preflight::Unknown,
            link: None,
            has_device_clock,
            clock: settings.clock,
            limits: settings.limits,
            stop: Arc::clone(stop),
            link_patience_s: settings.recovery.link_patience_s,
            doubts: settings.recovery.doubts.clone(),
            foresight_time_us: if is_hardware { foresight_time_us(&settings.plant) } else { 0.0 },
            identified: Cell::new(settings.identified()),
            viewers: settings.viewers.clone(),
            last_fault: Cell::new(None),
            motor: Cell::new(MotorState::Off),
            motor_memory,
            _emulator: emulator,
        })
    }

    /// The doubt about this Qube that outlived an earlier program, if there is one.
    #[must_use]
    pub fn remembered_doubt(&self) -> Option<Doubt> {
        self.doubts.as_ref()?.load(&self.identity.serial)
    }

    /// Lets the guard use the identified model of these settings from the next rollout on.
    pub fn identify(&self, settings: &RigSettings) {
        self.identified.set(settings.identified());
    }

    /// Makes the guard treat the Qube as not identified from the next rollout on, because its
    /// motion has contradicted its profile.
    pub fn distrust_profile(&self) {
        self.identified.set(None);
    }

    /// Examines the Qube. Homing is the last check; it is left out if an earlier check failed. The
    /// rig adopts the signs of the examination.
    ///
    /// # Errors
    /// The device stops answering, refuses to drive its Qube, or is another board; the board has
    /// restarted and a hand had shown the arm's middle; or a stop was requested. A failed check is
    /// not an error here.
    pub fn check(&mut self, other_signs: OtherSigns) -> Result<Examination, UnfinishedCheck> {
        let mut examination = self.examine(other_signs)?;
        examination.results.push(if examination.passed() {
            match self.home() {
                Ok(()) => homed(&self.measured.calibration),
                Err(RigError::Homing { fault, .. }) => not_homed(fault),
                Err(RigError::Travel { .. }) => not_homed(Fault::TravelWrong),
                Err(error) => {
                    let mut results = examination.results;
                    results.extend(error.fault().map(not_homed));
                    return Err(UnfinishedCheck { results, error });
                }
            }
        } else {
            homing_left_out()
        });
        Ok(examination)
    }

    /// Measures the link of a Qube that is not examined; the result determines how long ticks wait
    /// for their samples.
    fn measure_link(&mut self) -> Result<(), RigError> {
        let port = self.identity.port.clone();
        let link = self
            .control
            .lend(move |device, clock, _, stop| measure_link(device, clock, stop, &port))?
            .map_err(|error| self.in_doubt(error))?;
        self.link = Some(link.ok_or(RigError::Stopped { during: "the measurement of the link" })?);
        Ok(())
    }

    /// The measured link; `None` before the measurement, and for the embedded emulator, unless it
    /// emulates a USB bridge.
    #[must_use]
    pub fn link(&self) -> Option<&MeasuredLink> {
        self.link.as_ref()
    }

    /// Returns whether the device's port is gone. The port of a board that answers without its
    /// Qube, or that is silent, is not gone.
    ///
    /// # Errors
    /// The control thread has ended.
    pub fn has_lost_port(&self) -> Result<bool, RigError> {
        match self.control.hello() {
            Err(ControlError::ThreadGone(gone)) => Err(gone.into()),
            Err(ControlError::Device(
                DeviceError::NoSuchPort { .. } | DeviceError::Link { fault: LinkFault::Gone, .. },
            )) => Ok(true),
            Ok(_) | Err(_) => Ok(false),
        }
    }

    /// Performs all checks of the examination except homing, and latches the fault of a push like
    /// the fault of any motion.
    fn examine(&mut self, other_signs: OtherSigns) -> Result<Examination, RigError> {
        let settings = ExaminationSettings {
            signs: self.homing.get().signs,
            other_signs,
            identity: self.identity.clone(),
            plant: self.plant,
        };
        let examination = self
            .control
            .lend(move |device, clock, heat, stop| examine(device, clock, heat, stop, &settings))?
            .map_err(|error| self.in_doubt(error))?
            .ok_or(RigError::Stopped { during: "the check" })?;
        self.homing.set(HomingSettings {
            signs: examination.signs,
            hand_counts: examination.start_theta_counts,
            ..self.homing.get()
        });
        self.link = examination.link;
        if let Some(fault) = examination.fault {
            self.latch(fault);
        }
        if examination.passed() {
            // The board may have restarted without ending the examination.
            let identity = self.control.hello()?;
            self.accept_restart(identity)?;
        }
        Ok(examination)
    }

    /// Reacts to the last fault as the table of faults demands: sends a hello again, which reopens
    /// a lost port and clears the device's latch, and homes the arm.
    ///
    /// # Errors
    /// The fault leaves a doubt, or another attempt would end in the same way; the device does not
    /// answer or refuses to drive its Qube; another board answers; the board has restarted and a
    /// hand had shown the arm's middle; homing fails; or a stop was requested.
    pub fn start_again(&mut self) -> Result<(), RigError> {
        if let Some(fault) = self.last_fault.get() {
            match fault.consequence() {
                Consequence::Examine => return Err(RigError::InDoubt(Box::new(self.doubt(fault)))),
                Consequence::End => return Err(RigError::Ended { fault }),
                // The motor may still have its last voltage, so the operator is warned before the
                // wait begins.
                Consequence::Reconnect => {
                    // The operator's step for a motor that may be on was shown when the motion
                    // ended.
                    let step = match fault {
                        Fault::OffUnconfirmed => String::new(),
                        fault => format!(" {}", fault.operator_step()),
                    };
                    tracing::warn!(
                        "{fault}.{step} The program waits up to {} s for the same board",
                        self.link_patience_s
                    );
                }
                Consequence::TryAgain => {}
            }
        }
        self.greet_again(0)?;
        self.home()
    }

    fn greet_again(&mut self, pause_ns: u64) -> Result<(), RigError> {
        let limit_ns = (self.link_patience_s * 1e9) as u64;
        let identity = match self.control.hello_until_answered(HelloRetries { pause_ns, limit_ns })
        {
            Ok(identity) => identity,
            Err(ControlError::Device(source))
                if link_fault(&source).is_some_and(Fault::leaves_doubt) =>
            {
                return Err(self.in_doubt(source));
            }
            Err(ControlError::Device(_)) if self.stop.load(Ordering::Relaxed) => {
                return Err(RigError::Stopped { during: "the wait for the link" });
            }
            Err(ControlError::Device(source)) => {
                return Err(RigError::LinkLost {
                    patience_s: self.link_patience_s,
                    source,
                    last_ticks: Vec::new(),
                });
            }
            Err(error) => return Err(error.into()),
        };
        if !self.identity.is_same_board(&identity) {
            return Err(RigError::BoardChanged {
                port: identity.port,
                expected: self.identity.serial.clone(),
                found: identity.serial,
            });
        }
        // A hello switches the motor off.
        self.motor.set(MotorState::Off);
        self.accept_restart(identity)
    }

    /// Takes over the identity of the same board. If the board or its Qube has restarted since, the
    /// counters have begun anew, and the count at which a hand has put the arm is void. Homing by
    /// hand touches no stop, so it would not notice the error.
    fn accept_restart(&mut self, identity: Identity) -> Result<(), RigError> {
        let cause = if identity.boot_id != self.identity.boot_id {
            Some("the board has restarted")
        } else if identity.counts_anew {
            Some("the Qube was switched off and on")
        } else {
            None
        };
        self.identity = identity;
        let Some(cause) = cause else { return Ok(()) };
        self.forget_middle();
        if self.homing.get().method == HomingMethod::Hand {
            return Err(RigError::MiddleLost { fault: Fault::BoardRestarted });
        }
        tracing::warn!("{cause}: its counters restart, and the arm is homed");
        Ok(())
    }

    /// Forgets the count at which a hand has put the arm: after this, homing by hand takes the
    /// place where the arm then is.
    pub(super) fn forget_middle(&self) {
        let homing = self.homing.get();
        self.homing.set(HomingSettings { hand_counts: None, ..homing });
    }

    /// The doubt about this Qube after a fault.
    fn doubt(&self, fault: Fault) -> Doubt {
        Doubt {
            fault: Some(fault),
            board: self.identity.serial.clone(),
            unix_s: self.wall_time_ns().map(|time_ns| time_ns / 1_000_000_000),
        }
    }

    /// The error of a device that refuses to drive its Qube or whose Qube is off: the fault is
    /// latched as a doubt. Any other error of the device stays as it is.
    pub(super) fn in_doubt(&self, error: DeviceError) -> RigError {
        match link_fault(&error).filter(|fault| fault.leaves_doubt()) {
            Some(fault) => {
                self.latch(fault);
                RigError::InDoubt(Box::new(self.doubt(fault)))
            }
            None => error.into(),
        }
    }

    /// Remembers the fault of a motion; a doubt is also stored so that it outlives the program.
    pub(super) fn latch(&self, fault: Fault) {
        self.last_fault.set(Some(fault));
        self.store_doubt(fault);
    }

    /// Stores the doubt that a fault leaves, if it leaves one.
    pub(super) fn store_doubt(&self, fault: Fault) {
        if let Some(doubts) = self.doubts.as_ref().filter(|_| fault.leaves_doubt()) {
            doubts.store(&self.doubt(fault));
        }
    }

    /// Homes the arm. Homing is repeated, at most twice, if only the link or the computer failed,
    /// which indicates no defect of the Qube. After a stop request it is not repeated, and the
    /// error is returned if the motor may be on.
    fn home(&mut self) -> Result<(), RigError> {
        for pause_ns in HOMING_PAUSES_NS {
            match self.home_once() {
                Err(error) if error.passing_fault().is_some() => {
                    if self.stop.load(Ordering::Relaxed) {
                        return Err(match self.motor.get() {
                            MotorState::Off => RigError::Stopped { during: "homing" },
                            MotorState::Unconfirmed => error,
                        });
                    }
                    tracing::warn!("homing is repeated: {error}");
                    self.greet_again(pause_ns).map_err(|lost| lost.with_ticks_of(error))?;
                }
                homed_or_not => return homed_or_not,
            }
        }
        self.home_once()
    }

    fn home_once(&mut self) -> Result<(), RigError> {
        let homing = self.homing.get();
        let (report, found) = self.control.home(homing).map_err(|error| match error {
            ControlError::Device(source) => self.in_doubt(source),
            error => error.into(),
        })?;
        let fault = self.react_to(&report);
        match (fault, found.rig) {
            (None, Some(measured)) => {
                self.measured = measured;
                let calibration = measured.calibration;
                // From here on the middle is known, wherever a fault may leave the arm.
                let hand_counts = Some(calibration.theta_counts_at(-homing.theta_offset_rad));
                self.homing.set(HomingSettings { hand_counts, ..homing });
                self.last_fault.set(None);
                Ok(())
            }
            (Some(Fault::TravelWrong), _) if report.motor() == MotorState::Off => {
                Err(RigError::Travel {
                    travel_rad: found.travel_rad.unwrap_or_default(),
                    expected_rad: homing.expected_travel_rad(),
                    doubt: Box::new(self.doubt(Fault::TravelWrong)),
                })
            }
            (Some(fault), _) => {
                // Homing is repeated after a fault that shows no defect of the Qube; by then the
                // arm may have left the place to which a hand had brought it.
                if fault.is_passing() && homing.method == HomingMethod::Hand {
                    let hand_counts = homing.hand_counts.or(found.first_theta_counts);
                    self.homing.set(HomingSettings { hand_counts, ..homing });
                }
                let motor = self.motor.get();
                let doubt = fault.leaves_doubt().then(|| Box::new(self.doubt(fault)));
                Err(RigError::Homing { fault, motor, doubt, last_ticks: report.last_ticks })
            }
            (None, None) => Err(RigError::Stopped { during: "homing" }),
        }
    }

    /// The fault that ended the last motion, or the fault of the link that kept it from beginning,
    /// until the Qube is homed again.
    #[must_use]
    pub fn last_fault(&self) -> Option<Fault> {
        self.last_fault.get()
    }

    /// Checks, after the last motion, that the device has confirmed that its motor is off.
    ///
    /// # Errors
    /// The device has not confirmed it, for any ending of the motion: [`Fault::OffUnconfirmed`].
    pub fn check_off(&self) -> Result<(), RigError> {
        match self.motor.get() {
            MotorState::Off => Ok(()),
            MotorState::Unconfirmed => Err(RigError::Ended { fault: Fault::OffUnconfirmed }),
        }
    }

    /// Remembers the state of the motor after a motion and latches the motion's fault, which is
    /// returned.
    pub(super) fn react_to(&self, report: &DriveReport) -> Option<Fault> {
        self.motor.set(report.motor());
        let fault = fault_after(report, self.is_hardware());
        if let Some(fault) = fault {
            self.latch(fault);
        }
        fault
    }

    /// The identity of the device.
    #[must_use]
    pub fn identity(&self) -> &Identity {
        &self.identity
    }

    /// The result of the check before the first motion.
    #[must_use]
    pub fn preflight(&self) -> &Preflight {
        &self.preflight
    }

    /// Returns whether the device may have a real motor, according to its hello and not to its port
    /// alone.
    #[must_use]
    pub fn is_hardware(&self) -> bool {
        self.control.is_hardware()
    }

    /// The real-time rights that the operating system refused to the control thread.
    #[must_use]
    pub fn realtime(&self) -> &RealtimeRefusals {
        self.control.realtime()
    }

    pub(super) fn wall_time_ns(&self) -> Option<u64> {
        let since_1970 = SystemTime::now().duration_since(UNIX_EPOCH).ok()?;
        (self.clock == ClockChoice::Wall).then_some(since_1970.as_nanos() as u64)
    }
}

#[cfg(test)]
#[path = "opened_tests.rs"]
mod tests;
