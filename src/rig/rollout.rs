use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use super::error::link_fault;
use super::{Rig, RigError, RigSettingError};
use crate::control::{
    ControlError, DriveReport, HomingMethod, LARGEST_CREEP_RAD, Moved, RING_CAPACITY,
};
use crate::estimation::MeasuredStops;
use crate::policy::{Controller, External, Policy};
use crate::preflight::admit_processor;
use crate::qube::State;
use crate::recording::Recorder;
use crate::safety::{ForesightSettings, Guard, Limit, SafetyBox};
use crate::storage::Disk;
use crate::telemetry::{
    DeviceFacts, Ending, Fault, MeasuredLink, RolloutHeader, RolloutOutcome, TickSettings,
};

/// A rollout whose recording is complete on disk.
#[derive(Debug)]
pub struct Recorded {
    /// Path of the recording.
    pub path: PathBuf,
    /// Outcome of the rollout.
    pub outcome: RolloutOutcome,
}

/// Smallest distance between the box and the nearer stop, rad. It is the distance of the thesis:
/// its box ends at 2.3 rad, the stop is at 2.39 rad.
const INSIDE_STOP_RAD: f64 = 0.09;

/// Largest age of a sample in the driver's buffer when its read begins, s. The driver refreshes the
/// buffer at 1 kHz or faster.
const BUFFERED_S: f64 = 0.001;

/// Smallest age that is assumed for a sample without a device time, s.
const LEAST_AGE_S: f64 = 0.002;

/// Largest age that is assumed for a sample without a device time, s.
const LONGEST_AGE_S: f64 = 0.01;

/// Returns whether the arm's count is probably wrong after a rest between two rollouts, because it
/// jumped or moved farther than a cable pulls the arm. Homing by hand touches no stop, so it would
/// not notice the error.
fn is_no_creep(moved: Moved) -> bool {
    match moved {
        Moved::Arm(angle_rad) => angle_rad.abs() > LARGEST_CREEP_RAD,
        Moved::Jumped => true,
        // A wrong profile is the likely cause, and a hand would have to show the middle again.
        Moved::Unpredicted | Moved::Pendulum(_) | Moved::Unseen => false,
    }
}

/// Age that the guard assumes for a sample without a device time, s: the 99th percentile of the
/// link's round trip plus [`BUFFERED_S`], from [`LEAST_AGE_S`] to [`LONGEST_AGE_S`]. Without a
/// measured link it is [`LONGEST_AGE_S`].
fn unknown_age_s(link: Option<&MeasuredLink>) -> f64 {
    let read_s = link.map_or(LONGEST_AGE_S, |link| link.round_trip_us.p99 * 1e-6);
    (read_s + BUFFERED_S).clamp(LEAST_AGE_S, LONGEST_AGE_S)
}

/// The task's box, narrowed so that on both sides it ends at least [`INSIDE_STOP_RAD`] before the
/// nearer of the rig's own stops. Without measured stops it stays as it is.
fn inside_stops(of_the_task: &SafetyBox, stops: Option<MeasuredStops>) -> SafetyBox {
    let widest_rad = stops.map_or(f64::INFINITY, |stops| stops.nearer_rad() - INSIDE_STOP_RAD);
    SafetyBox { theta: of_the_task.theta.min(widest_rad), ..*of_the_task }
}

/// A controller that stores the last voltage that it returned.
struct RecordingController {
    controller: Box<dyn Controller>,
    /// Bits of the last voltage, V; NaN before the first.
    last_v: Arc<AtomicU64>,
}

impl Controller for RecordingController {
    fn start(&mut self) {
        self.controller.start();
    }

    fn applied(&mut self, voltage_v: f64) {
        self.controller.applied(voltage_v);
    }

    fn voltage_v(&mut self, state: &State) -> f64 {
        let answer_v = self.controller.voltage_v(state);
        self.last_v.store(answer_v.to_bits(), Ordering::Relaxed);
        answer_v
    }
}

/// The controller that drives a rollout.
struct ChosenController<'a> {
    /// Bytes of the policy file that the recording contains.
    policy_file: &'a [u8],
    controller: Box<dyn Controller>,
    /// Bits of the last voltage of an external controller, V; `None` for a policy from a file.
    last_v: Option<&'a AtomicU64>,
}

impl Rig {
    /// Runs one rollout and records it to `path`. The rig itself fills in the entries of the header
    /// about device, plant, check, heat of the motor, calibration, stops, guard and time, and it
    /// narrows the box to its own stops.
    ///
    /// # Errors
    /// The policy is invalid, was made for another plant, or only names an external controller; a
    /// number of the estimator is out of range; this hardware does not allow the box or the guard;
    /// the guard is the envelope, which exists for replays only; the processor is too slow for
    /// foresight; the rig needs a hello or homing first; the device could not be armed; the counts
    /// have moved since homing; a stop was requested before the rollout began; the control thread
    /// has ended; or the recording could not be written. A rollout that a fault ended is `Ok`: its
    /// outcome names the fault.
    pub fn rollout(
        &self,
        disk: &dyn Disk,
        path: &Path,
        header: RolloutHeader,
        policy_file: &[u8],
    ) -> Result<Recorded, RigError> {
        let policy = Policy::from_bytes(policy_file)?;
        policy.check_plant(&self.plant)?;
        if let Policy::External(external) = &policy {
            return Err(RigError::External { name: external.name().to_owned() });
        }
        let controller = Box::new(policy);
        self.recorded(
            disk,
            path,
            header,
            ChosenController { policy_file, controller, last_v: None },
        )
    }

    /// Runs one rollout like [`Self::rollout`], but with an external controller in place of a
    /// policy from a file. The guard is the same. The recording contains the voltages that the
    /// controller requested, so that a replay recomputes everything else.
    ///
    /// # Errors
    /// The errors of [`Self::rollout`], except those about the policy.
    pub fn rollout_by(
        &self,
        disk: &dyn Disk,
        path: &Path,
        header: RolloutHeader,
        name: &str,
        controller: Box<dyn Controller>,
    ) -> Result<Recorded, RigError> {
        let policy_file = &Policy::External(External::new(name)).to_bytes();
        let last_v = &Arc::new(AtomicU64::new(f64::NAN.to_bits()));
        let controller = Box::new(RecordingController { controller, last_v: Arc::clone(last_v) });
        self.recorded(
            disk,
            path,
            header,
            ChosenController { policy_file, controller, last_v: Some(last_v) },
        )
    }

    /// Runs and records one rollout.
    fn recorded(
        &self,
        disk: &dyn Disk,
        path: &Path,
        header: RolloutHeader,
        ChosenController { policy_file, controller, last_v }: ChosenController<'_>,
    ) -> Result<Recorded, RigError> {
        self.check_settings(&header.settings)?;
        let header = self.filled_in(header)?;
        let settings = header.settings;
        let (producer, consumer) = rtrb::RingBuffer::new(RING_CAPACITY);
        let recorder =
            Recorder::start(disk, path, header, policy_file, consumer, self.viewers.clone())?;
        // A program that is killed while the arm is still damped leaves its doubt behind.
        let mut on_latched = |fault| self.store_doubt(fault);
        let driven = self.control.rollout(settings, controller, producer, &mut on_latched);
        let report = match driven {
            Ok(report) => with_last_answer(report, last_v),
            Err(ControlError::ThreadGone(gone)) => return Err(gone.into()),
            Err(error) => {
                recorder.discard(disk);
                return Err(self.not_begun(error));
            }
        };
        let fault = self.react_to(&report);
        if report.outcome.ending == Ending::LeftBox(Limit::Unpredicted) {
            let detail =
                report.outcome.contradiction.map_or_else(String::new, |it| format!(" ({it})"));
            tracing::warn!(
                "the Qube does not move as its profile predicts{detail}, so it is guarded as an unknown one. Is the \
                 pendulum another one, is the supply weak, or is a cable of an encoder or of the motor loose?"
            );
            self.distrust_profile();
        }
        match recorder.finish(report.outcome.clone(), report.last_ticks) {
            Ok(path) => Ok(Recorded { path, outcome: report.outcome }),
            Err(source) => Err(match fault {
                Some(fault) => RigError::Unrecorded {
                    fault,
                    motor: self.motor.get(),
                    doubt: fault.leaves_doubt().then(|| Box::new(self.doubt(fault))),
                    source,
                },
                None => source.into(),
            }),
        }
    }

    /// Checks that the rig may be driven with these settings.
    fn check_settings(&self, settings: &TickSettings) -> Result<(), RigError> {
        settings.safety_box.guard.check_driven()?;
        settings.estimator.check().map_err(RigSettingError::Estimator)?;
        if self.is_hardware() {
            self.limits.admit(&settings.safety_box)?;
            if settings.safety_box.guard == Guard::Foresight {
                admit_processor(self.foresight_time_us)?;
            }
        }
        Ok(())
    }

    /// The header of a rollout that begins now, with the entries that the rig fills in.
    fn filled_in(&self, header: RolloutHeader) -> Result<RolloutHeader, RigError> {
        let settings = self.tick_settings(header.settings);
        Ok(RolloutHeader {
            started_unix_ns: self.wall_time_ns(),
            device: self.device_facts(),
            preflight: self.preflight.clone(),
            motor_heat: Some(self.control.cool_motor()?),
            hard_stop_accepted: self.is_hardware() && settings.safety_box.guard.is_box(),
            settings,
            ..header
        })
    }

    /// The settings of a rollout's ticks on this rig, derived from the settings of the task.
    fn tick_settings(&self, of_the_task: TickSettings) -> TickSettings {
        let safety_box = of_the_task.safety_box.inside_travel(&self.plant);
        let foresight = (of_the_task.safety_box.guard == Guard::Foresight).then(|| {
            let foresight = ForesightSettings {
                identified: self.identified.get(),
                ..ForesightSettings::of_plant(&self.plant)
            };
            match self.has_device_clock {
                true => foresight,
                false => foresight.with_sample_age(unknown_age_s(self.link())),
            }
        });
        TickSettings {
            calibration: self.measured.calibration,
            stops: self.measured.stops,
            safety_box: inside_stops(&safety_box, self.measured.stops),
            plant: self.plant,
            foresight,
            ..of_the_task
        }
    }

    fn not_begun(&self, error: ControlError) -> RigError {
        match error {
            ControlError::Device(source) => match link_fault(&source) {
                Some(fault) if fault.leaves_doubt() => self.in_doubt(source),
                Some(fault) => {
                    self.last_fault.set(Some(fault));
                    RigError::NotBegun { fault, source: ControlError::Device(source) }
                }
                None => RigError::Device(source),
            },
            // The motion before this rollout has latched a fault although it came to its end.
            refused @ ControlError::Refused { .. } => match self.last_fault.get() {
                Some(fault) => RigError::NotBegun { fault, source: refused },
                None => refused.into(),
            },
            ControlError::Moved(moved)
                if self.homing.get().method == HomingMethod::Hand && is_no_creep(moved) =>
            {
                self.forget_middle();
                RigError::MiddleLost { fault: Fault::CountsMoved }
            }
            ControlError::Moved(moved) => {
                tracing::warn!("{moved}: the rollout does not begin, and the arm is homed again");
                ControlError::from(moved).into()
            }
            refused => refused.into(),
        }
    }

    fn device_facts(&self) -> DeviceFacts {
        let identity = &self.identity;
        let link = self.link.as_ref();
        // The recorded samples already contain the effect of these figures, so a replay does not
        // need them. They inform a reader of the recording.
        let link = link.into_iter().flat_map(|link| {
            [
                ("link_p50_us", format!("{:.0}", link.round_trip_us.p50)),
                ("link_p99_us", format!("{:.0}", link.round_trip_us.p99)),
                ("sample_time_us", link.sample_time_us.to_string()),
            ]
        });
        let itself = [
            (DeviceFacts::KIND, identity.kind.clone()),
            (DeviceFacts::SERIAL, identity.serial.clone()),
            ("firmware_version", identity.firmware_version.clone()),
            ("protocol_version", identity.protocol_version.to_string()),
            (DeviceFacts::PORT, identity.port.clone()),
        ];
        let clock = (!self.has_device_clock).then(|| {
            let age_ms = unknown_age_s(self.link()) * 1e3;
            ("sample_age", format!("unknown, no clock; up to {age_ms:.1} ms assumed"))
        });
        itself.into_iter().chain(link).chain(clock).collect()
    }
}

/// The report with the last voltage of an external controller, if it is a finite number.
fn with_last_answer(mut report: DriveReport, last_v: Option<&AtomicU64>) -> DriveReport {
    let answer_v = last_v.map(|last_v| f64::from_bits(last_v.load(Ordering::Relaxed)));
    report.outcome.last_answer_v = answer_v.filter(|answer_v| answer_v.is_finite());
    report
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::Profile;
    use crate::safety::IdentifiedQube;
    use crate::telemetry::LatencySummary;

    #[test]
    fn a_sample_without_a_clock_lengthens_every_delay_that_the_guard_allows_for() {
        let link = |p99| {
            let round_trip_us = LatencySummary { p99, ..LatencySummary::default() };
            MeasuredLink { round_trip_us, lost: 0, sample_time_us: 6000 }
        };
        assert_eq!(unknown_age_s(Some(&link(3_000.0))), 0.004);
        assert_eq!(unknown_age_s(Some(&link(10.0))), LEAST_AGE_S);
        assert_eq!(unknown_age_s(Some(&link(50_000.0))), LONGEST_AGE_S);
        assert_eq!(unknown_age_s(None), LONGEST_AGE_S);

        let profile = Profile::exact("lab", &crate::qube::QubeModel::NOMINAL);
        let identified = Some(IdentifiedQube::of(&profile, &crate::qube::PlantModel::QUBE));
        let known = ForesightSettings { identified, ..ForesightSettings::default() };
        let delay_s = |belief: crate::safety::Belief| belief.high.nonidealities.command_delay_s;
        let older = known.with_sample_age(0.004);
        assert!((delay_s(older.belief) - delay_s(known.belief) - 0.004).abs() < 1e-12);
        let (known, older) = (known.identified.unwrap(), older.identified.unwrap());
        assert!((delay_s(older.belief) - delay_s(known.belief) - 0.004).abs() < 1e-12);
    }
}
