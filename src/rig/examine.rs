//! Examines the Qube of a rig, or only its link.

use super::{Rig, RigError, UnfinishedCheck};
use crate::control::HomingSettings;
use crate::preflight::{
    Examination, ExaminationSettings, OtherSigns, examine, homed, homing_left_out, measure_link,
    not_homed,
};
use crate::telemetry::Fault;

impl Rig {
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

    /// Performs all checks of the examination except homing, and latches the fault of a push like
    /// the fault of any motion.
    pub(super) fn examine(&mut self, other_signs: OtherSigns) -> Result<Examination, RigError> {
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

    /// Measures the link of a Qube that is not examined; the result determines how long ticks wait
    /// for their samples.
    pub(super) fn measure_link(&mut self) -> Result<(), RigError> {
        let port = self.identity.port.clone();
        let link = self
            .control
            .lend(move |device, clock, _, stop| measure_link(device, clock, stop, &port))?
            .map_err(|error| self.in_doubt(error))?;
        self.link = Some(link.ok_or(RigError::Stopped { during: "the measurement of the link" })?);
        Ok(())
    }
}
