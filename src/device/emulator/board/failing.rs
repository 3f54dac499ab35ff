//! Effects of the configured fault on the emulated board: the onset of the fault, and the changes
//! of the board's reports and actions.

use firmware_protocol::DeviceState;
use firmware_protocol::scaling::motor_counts;

use super::super::EmulatorFault;
use super::Board;

/// Time from a dip of the supply to the program's first frame, us: the chip's start-up time of 65
/// ms with Arduino's fuses, and the program's own start.
pub(super) const BROWN_OUT_DARK_US: u64 = 70_000;

/// Time from a pulse at the reset pin to the program's first frame, us: the Uno's boot loader
/// listens for about a second.
pub(super) const RESTART_DARK_US: u64 = 1_000_000;

/// Time for which the emergency stop is pressed, us.
const STOP_PRESSED_US: u64 = 2_000_000;

impl Board {
    /// Returns whether the port is gone because the cable is pulled or the board has no supply.
    #[must_use]
    pub fn is_unplugged(&self) -> bool {
        let now_s = self.now_us as f64 * 1e-6;
        self.has_begun(|fault| match fault {
            EmulatorFault::Unplugged { .. } | EmulatorFault::PowerLoss { .. } => true,
            EmulatorFault::Replugged { after_s, away_s } => now_s < after_s + away_s,
            _ => false,
        })
    }

    /// Time at which the cable is plugged in again, by the board's clock, us; `None` if the cable
    /// is not pulled or stays out.
    #[must_use]
    pub fn plugged_in_us(&self) -> Option<u64> {
        match self.settings.fault {
            Some(EmulatorFault::Replugged { after_s, away_s }) if self.is_unplugged() => {
                Some(((after_s + away_s) * 1e6).ceil() as u64)
            }
            _ => None,
        }
    }

    /// Returns whether the fault flips a bit of the last reply; the owner then flips it on the
    /// wire.
    #[must_use]
    pub fn garbles_reply(&self) -> bool {
        match self.settings.fault {
            Some(EmulatorFault::Garble { every }) => self.replies.is_multiple_of(every),
            _ => false,
        }
    }

    /// Begins the fault of the settings, whose time has come.
    pub(super) fn begin_fault(&mut self) {
        self.fault_began = true;
        self.plant.advance_to(self.now_us);
        let fails_the_qube = match self.settings.fault {
            Some(EmulatorFault::FrozenAlpha { .. }) => {
                self.frozen_alpha_counts = Some(self.plant.alpha_counts());
                false
            }
            Some(EmulatorFault::FrozenTheta { .. }) => {
                self.frozen_theta_counts = Some(self.plant.theta_counts());
                false
            }
            Some(EmulatorFault::DeadMotor { .. }) => {
                self.plant.disconnect_motor();
                false
            }
            Some(EmulatorFault::StuckOutput { .. }) => {
                if let (DeviceState::Armed, Some(counts)) = (self.state, self.stuck_output_counts())
                {
                    self.drive(counts);
                }
                false
            }
            Some(EmulatorFault::BlockedArm { .. }) => {
                self.plant.block_arm();
                false
            }
            Some(EmulatorFault::StallError { .. }) => {
                self.stall_error = true;
                true
            }
            Some(
                EmulatorFault::AmplifierFault { .. } | EmulatorFault::LapsingAmplifierFault { .. },
            ) => {
                self.amplifier_failed = self.state == DeviceState::Armed;
                true
            }
            Some(EmulatorFault::QubeAbsent { .. }) => true,
            Some(EmulatorFault::SwitchedOffAndOn { off_s, .. }) => {
                self.qube_returns_us = Some(self.now_us.saturating_add((off_s * 1e6) as u64));
                true
            }
            Some(EmulatorFault::EmergencyStop { .. }) => {
                self.emergency_stop = true;
                true
            }
            Some(EmulatorFault::PowerLoss { .. }) => {
                self.stop_program(u64::MAX);
                false
            }
            Some(EmulatorFault::BrownOut { .. }) => {
                self.stop_program(self.now_us + BROWN_OUT_DARK_US);
                false
            }
            Some(EmulatorFault::BoardRestart { .. }) => {
                self.stop_program(self.now_us + RESTART_DARK_US);
                false
            }
            _ => false,
        };
        if fails_the_qube && self.state == DeviceState::Armed {
            self.leave_armed(DeviceState::Faulted);
        }
    }

    /// Returns whether the fault of the settings is of the kind that `is_kind` accepts, and has
    /// begun.
    pub(super) fn has_begun(&self, is_kind: impl Fn(&EmulatorFault) -> bool) -> bool {
        self.fault_began && self.settings.fault.as_ref().is_some_and(is_kind)
    }

    /// Motor command, in the motor's counts, of an armed board that ignores its acts; `None` unless
    /// its output is stuck.
    pub(super) fn stuck_output_counts(&self) -> Option<i16> {
        match self.settings.fault {
            Some(EmulatorFault::StuckOutput { voltage_v, .. }) if self.fault_began => {
                Some(motor_counts((voltage_v * 1e3) as i16))
            }
            _ => None,
        }
    }

    /// Returns whether a disarm has no effect.
    pub(super) fn ignores_disarm(&self) -> bool {
        self.has_begun(|fault| matches!(fault, EmulatorFault::IgnoredDisarm { .. }))
    }

    /// Returns whether the board does not find its Qube.
    pub(super) fn qube_absent(&self) -> bool {
        self.qube_returns_us.is_some()
            || self.has_begun(|fault| matches!(fault, EmulatorFault::QubeAbsent { .. }))
    }

    /// Switches the Qube on again: its counters begin at 0, and the board needs a new hello.
    pub(super) fn switch_on(&mut self) {
        self.qube_returns_us = None;
        self.plant.advance_to(self.now_us);
        self.theta_shift = -self.sense(EmulatorFault::FlippedTheta) * self.plant.theta_counts();
        self.alpha_shift = -self.sense(EmulatorFault::FlippedAlpha) * self.plant.alpha_counts();
        self.leave_armed(DeviceState::Idle);
        self.nonce = 0;
    }

    /// Returns whether the amplifier reports a fault.
    pub(super) fn amplifier_fault(&self) -> bool {
        self.has_begun(|fault| match *fault {
            EmulatorFault::AmplifierFault { .. } => true,
            EmulatorFault::LapsingAmplifierFault { after_s, lasts_s } => {
                self.now_us < ((after_s + lasts_s) * 1e6) as u64
            }
            _ => false,
        })
    }

    /// Returns whether the emergency stop's switch is closed, which lets the motor run.
    pub(super) fn stop_is_closed(&self) -> bool {
        match self.settings.fault {
            Some(fault @ EmulatorFault::EmergencyStop { .. }) => {
                let pressed_us = fault.onset_us();
                !(pressed_us..pressed_us.saturating_add(STOP_PRESSED_US)).contains(&self.now_us)
            }
            _ => true,
        }
    }

    /// The sign of the connection that the fault `flipped` reverses: -1 if the fault or the wiring
    /// reverses it, but not both, otherwise 1.
    pub(super) fn sense(&self, flipped: EmulatorFault) -> i32 {
        let wiring = self.settings.wiring;
        let is_wired_so = match flipped {
            EmulatorFault::FlippedTheta => wiring.theta_inverted,
            EmulatorFault::FlippedAlpha => wiring.alpha_inverted,
            EmulatorFault::FlippedMotor => wiring.motor_inverted,
            _ => false,
        };
        if (self.settings.fault == Some(flipped)) != is_wired_so { -1 } else { 1 }
    }
}
