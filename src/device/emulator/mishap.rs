//! What is wrong with an emulated Qube's encoders and motor, by its own time.

use firmware_protocol::scaling::TACHOMETER_STILL;

use super::EmulatorFault;

/// What the encoders' chip would give if nothing were wrong.
#[derive(Clone, Copy, Debug)]
pub struct TrueReadings {
    /// Encoder of the arm.
    pub theta_counts: i32,
    /// Encoder of the pendulum.
    pub alpha_counts: i32,
    /// The tachometer's register.
    pub tachometer_raw: u32,
}

/// The state of a fault of encoders or motor.
#[derive(Clone, Copy, Debug)]
pub struct Mishap {
    fault: Option<EmulatorFault>,
    stage: Stage,
    /// What froze, as it was then.
    held: TrueReadings,
    /// Counts that were lost, or that a jump added.
    theta_shift: i32,
    alpha_shift: i32,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Stage {
    Before,
    During,
    After,
}

impl Mishap {
    /// A fault that has not begun.
    pub fn new(fault: Option<EmulatorFault>) -> Self {
        let held = TrueReadings { theta_counts: 0, alpha_counts: 0, tachometer_raw: 0 };
        Self { fault, stage: Stage::Before, held, theta_shift: 0, alpha_shift: 0 }
    }

    /// When something changes next, us.
    pub fn next_us(&self) -> Option<u64> {
        let fault = self.fault?;
        let lasts_s = match fault {
            EmulatorFault::LapsingTheta { lasts_s, .. }
            | EmulatorFault::LapsingAlpha { lasts_s, .. } => Some(lasts_s),
            _ => None,
        };
        match self.stage {
            Stage::Before => Some(fault.onset_us()),
            Stage::During => Some(fault.onset_us() + (lasts_s? * 1e6) as u64),
            Stage::After => None,
        }
    }

    /// Goes on to what comes next; gives the share of the current that the motor has from now on, where
    /// that changes.
    pub fn go_on(&mut self, truly: TrueReadings) -> Option<f64> {
        match (self.stage, self.fault?) {
            (Stage::Before, fault) => {
                self.stage = Stage::During;
                self.held = truly;
                match fault {
                    EmulatorFault::JumpTheta { counts, .. } => self.theta_shift = counts,
                    EmulatorFault::JumpAlpha { counts, .. } => self.alpha_shift = counts,
                    EmulatorFault::WeakMotor { share } => return Some(share),
                    _ => {}
                }
            }
            (Stage::During, EmulatorFault::LapsingTheta { .. }) => {
                self.stage = Stage::After;
                self.theta_shift = self.held.theta_counts.wrapping_sub(truly.theta_counts);
            }
            (Stage::During, EmulatorFault::LapsingAlpha { .. }) => {
                self.stage = Stage::After;
                self.alpha_shift = self.held.alpha_counts.wrapping_sub(truly.alpha_counts);
            }
            _ => {}
        }
        None
    }

    /// What the encoders' chip gives.
    pub fn readings(&self, truly: TrueReadings) -> TrueReadings {
        let mut seen = TrueReadings {
            theta_counts: truly.theta_counts.wrapping_add(self.theta_shift),
            alpha_counts: truly.alpha_counts.wrapping_add(self.alpha_shift),
            ..truly
        };
        match self.fault {
            Some(EmulatorFault::StuckTheta { .. }) if self.stage == Stage::During => {
                seen.theta_counts = self.held.theta_counts;
                seen.tachometer_raw = self.held.tachometer_raw;
            }
            Some(EmulatorFault::LapsingTheta { .. }) if self.stage == Stage::During => {
                seen.theta_counts = self.held.theta_counts;
                seen.tachometer_raw = TACHOMETER_STILL;
            }
            Some(EmulatorFault::LapsingAlpha { .. }) if self.stage == Stage::During => {
                seen.alpha_counts = self.held.alpha_counts;
            }
            _ => {}
        }
        seen
    }
}
