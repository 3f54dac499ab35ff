use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use super::latched_fault::{LatchedFault, ShownRollout};
use super::motor_cooling::MotorCooling;
use super::reconnect::{HelloRetries, greet_until_answered};
use super::rest_monitor::RestMonitor;
use super::{
    ControlAction, ControlError, ControlEvent, ControlState, DriveReport, Homing, HomingSettings,
    Motion, Moved, Tick, drive,
};
use crate::clock::Clock;
use crate::device::{Device, DeviceError, Identity};
use crate::estimation::MeasuredRig;
use crate::policy::Controller;
use crate::safety::{Limit, MotorHeat};
use crate::telemetry::{Ending, TickRecord, TickSettings};

/// The result of a homing.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Homed {
    /// Zeros of the encoders and angles of the stops; `None` unless homing completed.
    pub rig: Option<MeasuredRig>,
    /// Distance between the stops, rad; `None` unless both were touched.
    pub travel_rad: Option<f64>,
    /// Count of the arm before homing moved it; `None` if no sample came.
    pub first_theta_counts: Option<i32>,
}

/// The owner of the device on the control thread: carries out one motion at a time and keeps the
/// knowledge that the next one needs. Between motions the amplifier is off, and the counts are
/// watched for a minute.
pub(super) struct DeviceOwner {
    device: Box<dyn Device>,
    clock: Arc<dyn Clock>,
    stop: Arc<AtomicBool>,
    latched: Arc<LatchedFault>,
    state: ControlState,
    motor: MotorCooling,
    rest_monitor: RestMonitor,
}

impl DeviceOwner {
    /// The owner of a device that has answered nothing yet. `stop` ends every motion and wait;
    /// `latched` shows other threads the fault of a rollout.
    pub fn new(
        device: Box<dyn Device>,
        clock: Arc<dyn Clock>,
        stop: Arc<AtomicBool>,
        latched: Arc<LatchedFault>,
    ) -> Self {
        Self {
            device,
            clock,
            stop,
            latched,
            state: ControlState::default(),
            motor: MotorCooling::default(),
            rest_monitor: RestMonitor::default(),
        }
    }

    /// Returns whether the device counts as hardware.
    pub fn is_hardware(&self) -> bool {
        self.device.is_hardware()
    }

    /// Sets the motor's rating and heat.
    pub fn set_motor(&mut self, heat: MotorHeat) {
        self.motor = MotorCooling::off_from_now(heat, &*self.clock);
    }

    /// The motor's heat at this moment.
    pub fn motor_heat(&mut self) -> MotorHeat {
        self.motor.cool(&*self.clock);
        self.motor.heat
    }

    /// Waits until the motor is cool enough for the next motion or a stop is requested; returns the
    /// motor's heat.
    pub fn cool_motor(&mut self) -> MotorHeat {
        self.motor.cool_down(&*self.clock, &self.stop);
        self.motor.heat
    }

    /// Sends hellos until the device answers or the time of `retries` is over.
    ///
    /// # Errors
    /// As for [`greet_until_answered`].
    pub fn hello(&mut self, retries: HelloRetries) -> Result<Identity, DeviceError> {
        let identified = greet_until_answered(&mut *self.device, &*self.clock, &self.stop, retries);
        // A hello does not change how the cable pulls the arm.
        let waits_for = self.rest_monitor.waits_for;
        self.rest_monitor = RestMonitor { waits_for, ..RestMonitor::default() };
        if let Ok(identity) = &identified {
            self.rest_monitor.port.clone_from(&identity.port);
        }
        let answered = identified.is_ok();
        self.state.take(if answered { ControlEvent::Hello } else { ControlEvent::NoAnswer });
        identified
    }

    /// Measures the zeros of the encoders and, unless the operator has put the arm into the middle,
    /// the stops.
    ///
    /// # Errors
    /// The state of control refuses a homing, or the device could not be armed.
    pub fn home(
        &mut self,
        settings: &HomingSettings,
    ) -> Result<(DriveReport, Homed), ControlError> {
        // A homing that is refused does not wait until the motor has cooled.
        self.take(ControlEvent::Home)?;
        self.cool_motor();
        self.rest_monitor.encoders = settings.plant.encoders;
        self.rest_monitor.crept_counts = 0;
        let mut homing = match self.state {
            ControlState::Cleared => Homing::after_fault(settings),
            _ => Homing::new(settings),
        };
        let report = self.drive(&mut homing, None)?;
        let report = self.keep_at_rest(report);
        let homed = Homed {
            rig: homing.measured(),
            travel_rad: homing.travel_rad(),
            first_theta_counts: homing.first_theta_counts(),
        };
        Ok((report, homed))
    }

    /// Runs one rollout to its end, and writes a record of each tick to `records`.
    ///
    /// # Errors
    /// The state of control refuses a rollout; arm or pendulum are not at rest where the last
    /// motion left them; a stop is requested or the device fails before the rollout; or the device
    /// could not be armed.
    pub fn rollout(
        &mut self,
        settings: &TickSettings,
        controller: Box<dyn Controller>,
        records: &mut rtrb::Producer<TickRecord>,
    ) -> Result<DriveReport, ControlError> {
        let driven = self.drive_from_rest(settings, controller, records);
        // The resting counts of the last motion do not hold after this rollout, however it ended.
        self.rest_monitor.left_at = Err(Moved::Unseen);
        let report = self.keep_at_rest(driven?);
        if report.outcome.ending == Ending::LeftBox(Limit::Unpredicted) {
            self.rest_monitor.left_at = Err(Moved::Unpredicted);
            self.rest_monitor.end_pause();
        }
        Ok(report)
    }

    /// Drives a rollout if arm and pendulum are at rest where the last motion left them.
    fn drive_from_rest(
        &mut self,
        settings: &TickSettings,
        controller: Box<dyn Controller>,
        records: &mut rtrb::Producer<TickRecord>,
    ) -> Result<DriveReport, ControlError> {
        let before = self.state;
        self.take(ControlEvent::Rollout)?;
        self.cool_motor();
        let (device, clock) = (&mut *self.device, &*self.clock);
        if let Err(error) = self.rest_monitor.compare(settings, device, clock, &self.stop) {
            self.state = before;
            if matches!(error, ControlError::Device(_)) {
                self.state.take(ControlEvent::NoAnswer);
            }
            return Err(error);
        }
        let latched = Arc::clone(&self.latched);
        let mut rollout = ShownRollout::new(Tick::new(settings, controller), &latched);
        self.drive(&mut rollout, Some(records))
    }

    /// Lends the device to a task between motions, once the motor is cool enough.
    ///
    /// # Errors
    /// The state of control refuses a loan.
    pub fn lend<R>(
        &mut self,
        task: impl FnOnce(&mut dyn Device, &dyn Clock, &mut MotorHeat, &AtomicBool) -> R,
    ) -> Result<R, ControlError> {
        self.take(ControlEvent::Check)?;
        self.rest_monitor.end_pause();
        self.cool_motor();
        let result = task(&mut *self.device, &*self.clock, &mut self.motor.heat, &self.stop);
        self.motor.switched_off(&*self.clock);
        self.state.take(ControlEvent::Checked);
        Ok(result)
    }

    /// Returns whether the counts are watched until the next task.
    pub fn watches_pause(&self) -> bool {
        self.rest_monitor.watches_pause()
    }

    /// Samples the counts once in the pause between two tasks, and waits for one period.
    pub fn watch_pause(&mut self) {
        self.rest_monitor.watch_pause(&mut *self.device, &*self.clock);
    }

    /// Applies a command to the state table.
    ///
    /// # Errors
    /// The table refuses the command.
    fn take(&mut self, wanted: ControlEvent) -> Result<(), ControlError> {
        match self.state.take(wanted) {
            ControlAction::Refuse => Err(ControlError::Refused { wanted, state: self.state }),
            _ => Ok(()),
        }
    }

    /// Drives a motion and adopts the state of control in which the motion ends. If the device has
    /// not confirmed that its amplifier is off, a fault is latched, whatever ended the motion.
    ///
    /// # Errors
    /// The device could not be armed; the fault is latched.
    fn drive(
        &mut self,
        motion: &mut dyn Motion,
        records: Option<&mut rtrb::Producer<TickRecord>>,
    ) -> Result<DriveReport, ControlError> {
        self.rest_monitor.end_pause();
        let (device, clock) = (&mut *self.device, &*self.clock);
        let driven = drive(device, clock, motion, &mut self.motor.heat, records, &self.stop);
        self.motor.switched_off(clock);
        match driven {
            Ok(report) => {
                self.state = motion.control_state();
                if report.disarmed.is_err() {
                    self.state.take(ControlEvent::SwitchOffFault);
                }
                Ok(report)
            }
            Err(error) => {
                self.state.take(ControlEvent::NoAnswer);
                Err(error.into())
            }
        }
    }

    /// Watches where arm and pendulum come to rest, after a motion that ends in
    /// [`ControlState::Ready`]. A device whose samples report that its motor is on has not switched
    /// it off, whatever ended the motion, even if its answer to the disarm said so.
    fn keep_at_rest(&mut self, mut report: DriveReport) -> DriveReport {
        let (last, device) = (report.last_measurement.as_ref(), &mut *self.device);
        let kept = if self.state == ControlState::Ready {
            self.rest_monitor.keep(last, device, &*self.clock, &self.stop)
        } else if report.disarmed.is_ok() {
            self.rest_monitor.check_off(device, &*self.clock)
        } else {
            Ok(())
        };
        if let Err(stays_armed) = kept {
            self.state.take(ControlEvent::SwitchOffFault);
            report.disarmed = Err(stays_armed);
        }
        report
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::Ordering;

    use super::super::plant_device::{PlantDevice, TestDisarm, TestFault, rollout_settings};
    use super::*;
    use crate::policy::{ClassicalController, ClassicalGains, Policy};
    use crate::qube::{State, Status};
    use crate::telemetry::Fault;

    #[test]
    fn a_stopped_homing_whose_motor_nobody_confirmed_to_be_off_latches_a_fault() {
        for (disarm, expected) in [
            (TestDisarm::Obeyed, ControlState::Identified),
            (TestDisarm::Unanswered, ControlState::Faulted),
            (TestDisarm::Ignored, ControlState::Faulted),
        ] {
            let is_off = disarm == TestDisarm::Obeyed;
            let mut device = PlantDevice::new(State::default());
            device.disarm = disarm;
            let (clock, stop) = (Arc::new(device.clock.clone()), Arc::new(AtomicBool::new(false)));
            let mut owner =
                DeviceOwner::new(Box::new(device), clock, Arc::clone(&stop), Arc::default());
            owner.hello(HelloRetries::default()).unwrap();
            stop.store(true, Ordering::Relaxed);
            let (report, _) = owner.home(&HomingSettings::default()).unwrap();
            assert_eq!(report.outcome.ending, Ending::Stopped);
            assert_eq!((owner.state, report.disarmed.is_ok()), (expected, is_off));
            // A homing after a fault first sees the arm at rest.
            stop.store(false, Ordering::Relaxed);
            assert_eq!(owner.home(&HomingSettings::default()).is_ok(), is_off);
            owner.hello(HelloRetries::default()).unwrap();
            let greeted = if is_off { ControlState::Identified } else { ControlState::Cleared };
            assert_eq!(owner.state, greeted);
        }
    }

    #[test]
    fn samples_that_say_that_the_motor_is_on_are_believed_whatever_ended_the_rollout() {
        let policy = || Policy::Classical(ClassicalController::new(ClassicalGains::default()));
        for (stops, fault, expected) in [
            (false, None, Ending::Completed),
            (true, None, Ending::Stopped),
            (false, Some(TestFault::Reports(Status::default())), Ending::Fault(Fault::NotArmed)),
        ] {
            let mut device = PlantDevice::new(State::default());
            device.disturbance = Box::new(move |sample| fault.filter(|_| sample == 70));
            device.disarm = TestDisarm::Ignored;
            let (clock, stop) = (Arc::new(device.clock.clone()), Arc::new(AtomicBool::new(false)));
            let mut owner =
                DeviceOwner::new(Box::new(device), clock, Arc::clone(&stop), Arc::default());
            stop.store(stops, Ordering::Relaxed);
            let report =
                owner.drive(&mut Tick::new(&rollout_settings(100), policy()), None).unwrap();
            assert!(report.disarmed.is_ok());
            let report = owner.keep_at_rest(report);
            assert_eq!(report.outcome.ending, expected);
            assert!(matches!(report.disarmed, Err(DeviceError::StaysArmed { .. })), "{expected:?}");
            assert_eq!(owner.state, ControlState::Faulted);
        }
    }
}
