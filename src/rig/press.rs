use super::{Rig, RigError};
use crate::control::{PressKind, PressOutcome, StopPress, drive, fault_after};
use crate::device::DeviceError;
use crate::telemetry::{Ending, Fault, MotorState};

/// The result of pressing the arm against its stop.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pressed {
    /// Ending of the motion.
    pub ending: Ending,
    /// Motion of the arm.
    pub outcome: PressOutcome,
    /// Fault that ended the press, or that only the whole press shows, as [`fault_after`] finds it.
    pub fault: Option<Fault>,
    /// State of the motor after the press.
    pub motor: MotorState,
}

impl Rig {
    /// Presses the arm outward against the stop that it touches, with `push_v` volts for at most
    /// `ticks` control periods.
    ///
    /// # Errors
    /// The device does not answer a hello; control needs homing after a fault; the board has
    /// restarted, which makes its zeros void; or the device could not be armed.
    pub fn press(&mut self, push_v: f64, ticks: u32, kind: PressKind) -> Result<Pressed, RigError> {
        let (plant, calibration) = (self.plant, self.measured.calibration);
        let is_hardware = self.is_hardware();
        let before = self.identity.clone();
        let pressed = self.control.lend(move |device, clock, heat, stop| {
            let identity = device.hello()?;
            if !before.is_same_start(&identity) {
                return Err(DeviceError::Restarted { port: identity.port });
            }
            let mut press = StopPress::new(&plant, calibration, push_v, ticks, kind);
            let report = drive(device, clock, &mut press, heat, None, stop)?;
            Ok(Pressed {
                ending: report.outcome.ending,
                outcome: press.outcome(),
                fault: fault_after(&report, is_hardware),
                motor: report.motor(),
            })
        })?;
        let pressed = pressed.map_err(|error: DeviceError| self.in_doubt(error))?;
        self.motor.set(pressed.motor);
        if let Some(fault) = pressed.fault {
            self.latch(fault);
        }
        Ok(pressed)
    }
}
