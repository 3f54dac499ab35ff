use std::cell::Cell;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use super::connection::connect;
use super::{ClockChoice, DeviceChoice, Doubt, DoubtStore, MotorMemory, RigError, RigSettings};
use crate::clock::{Clock, RealtimeRefusals, since_1970};
use crate::control::{
    ControlError, ControlThread, DriveReport, HomingSettings, Scheduling, fault_after,
};
use crate::device::emulator::EmulatedQube;
use crate::device::{DeviceError, Identity, LinkFault};
use crate::estimation::MeasuredRig;
use crate::preflight::{Examination, OtherSigns, admit_processor, foresight_time_us, homed};
use crate::qube::PlantModel;
use crate::recording::Viewer;
use crate::safety::{HardwareLimits, IdentifiedQube, MotorHeat};
use crate::telemetry::{CheckResult, Fault, MeasuredLink, MotorState, Preflight};

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
    pub(super) clock: ClockChoice,
    pub(super) limits: HardwareLimits,
    pub(super) stop: Arc<AtomicBool>,
    pub(super) link_patience_s: f64,
    pub(super) doubts: Option<DoubtStore>,
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

    /// Lets the guard use the identified model of these settings from the next rollout on.
    pub fn use_profile_of(&self, settings: &RigSettings) {
        self.identified.set(settings.identified());
    }

    /// Makes the guard treat the Qube as not identified from the next rollout on, because its
    /// motion has contradicted its profile.
    pub fn distrust_profile(&self) {
        self.identified.set(None);
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
        let time = since_1970()?;
        (self.clock == ClockChoice::Wall).then_some(time.as_nanos() as u64)
    }
}

#[cfg(test)]
#[path = "open_tests.rs"]
mod tests;
