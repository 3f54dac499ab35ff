//! Homes the arm of a rig, again if only the link or the computer failed.

use std::sync::atomic::Ordering;

use super::{Rig, RigError};
use crate::control::{ControlError, HomingMethod, HomingSettings};
use crate::telemetry::{Fault, MotorState};

/// Pauses before the second and third attempt at homing, ns. A link or computer that is late for
/// two seconds does not use up all attempts.
const HOMING_PAUSES_NS: [u64; 2] = [1_000_000_000, 2_000_000_000];

impl Rig {
    /// Homes the arm. Homing is repeated, at most twice, if only the link or the computer failed,
    /// which indicates no defect of the Qube. After a stop request it is not repeated, and the
    /// error is returned if the motor may be on.
    pub(super) fn home(&mut self) -> Result<(), RigError> {
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

    /// Forgets the count at which a hand has put the arm: after this, homing by hand takes the
    /// place where the arm then is.
    pub(super) fn forget_middle(&self) {
        let homing = self.homing.get();
        self.homing.set(HomingSettings { hand_counts: None, ..homing });
    }
}
