//! Faults of an emulated Qube's encoders, motor, arm and pendulum, over the Qube's own time. The
//! board itself makes some of these faults: [`EmulatorFault::FrozenTheta`],
//! [`EmulatorFault::FrozenAlpha`], connections in reverse, a dead motor and a blocked arm.

use firmware_protocol::scaling::{TACHOMETER_NEGATIVE, TACHOMETER_STILL};

use super::EmulatorFault;

/// The readings of intact encoders.
#[derive(Clone, Copy, Debug)]
pub struct TrueReadings {
    /// Count of the arm's encoder.
    pub theta_counts: i32,
    /// Count of the pendulum's encoder.
    pub alpha_counts: i32,
    /// Register of the tachometer, as
    /// [`EmulatedPlant::tachometer_raw`](super::EmulatedPlant::tachometer_raw) describes it.
    pub tachometer_raw: u32,
    /// Register of the tachometer if the pendulum's encoder were plugged in as the arm's.
    pub pendulum_tachometer_raw: u32,
}

/// The progress of a fault of encoders, motor, arm or pendulum. Any other fault also passes through
/// the stages, without an effect here.
#[derive(Clone, Copy, Debug)]
pub struct FaultProgress {
    fault: Option<EmulatorFault>,
    stage: Stage,
    /// Readings of intact encoders at the onset of the fault.
    held: TrueReadings,
    /// Shift of the counts: counts that were lost, or that a jump or disturbances added.
    theta_shift: i32,
    alpha_shift: i32,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Stage {
    Before,
    During,
    After,
}

impl FaultProgress {
    /// A fault before its onset.
    pub fn new(fault: Option<EmulatorFault>) -> Self {
        let held = TrueReadings {
            theta_counts: 0,
            alpha_counts: 0,
            tachometer_raw: 0,
            pendulum_tachometer_raw: 0,
        };
        Self { fault, stage: Stage::Before, held, theta_shift: 0, alpha_shift: 0 }
    }

    /// Time at which the fault begins, adds its next count or ends, whichever is next, us; `None`
    /// if none of these will come.
    pub fn next_us(&self) -> Option<u64> {
        let fault = self.fault?;
        if let (Stage::During, EmulatorFault::DriftingTheta { counts_s, .. }) = (self.stage, fault)
        {
            let counted = u64::from(self.theta_shift.unsigned_abs()) + 1;
            let counts_s = u64::from(counts_s.unsigned_abs()).max(1);
            let after_us = counted.saturating_mul(1_000_000) / counts_s;
            return Some(fault.onset_us().saturating_add(after_us));
        }
        let lasts_s = match fault {
            EmulatorFault::LapsingTheta { lasts_s, .. }
            | EmulatorFault::LapsingAlpha { lasts_s, .. }
            | EmulatorFault::PushedArm { lasts_s, .. }
            | EmulatorFault::HeldPendulum { lasts_s, .. } => Some(lasts_s),
            _ => None,
        };
        match self.stage {
            Stage::Before => Some(fault.onset_us()),
            Stage::During => Some(fault.onset_us().saturating_add((lasts_s? * 1e6) as u64)),
            Stage::After => None,
        }
    }

    /// Carries out the change that is due, with the readings of intact encoders at this time:
    /// enters the next stage, or adds a count of [`EmulatorFault::DriftingTheta`]. Returns the
    /// fraction of the current that the motor draws from here on, if the fault changes it.
    pub fn advance_stage(&mut self, intact: TrueReadings) -> Option<f64> {
        match (self.stage, self.fault?) {
            (Stage::Before, fault) => {
                self.stage = Stage::During;
                self.held = intact;
                match fault {
                    EmulatorFault::JumpTheta { counts, .. } => self.theta_shift = counts,
                    EmulatorFault::JumpAlpha { counts, .. } => self.alpha_shift = counts,
                    EmulatorFault::WeakMotor { share } => return Some(share),
                    _ => {}
                }
            }
            (Stage::During, EmulatorFault::DriftingTheta { counts_s, .. }) => {
                self.theta_shift = self.theta_shift.wrapping_add(counts_s.signum());
            }
            (Stage::During, EmulatorFault::LapsingTheta { .. }) => {
                self.stage = Stage::After;
                self.theta_shift = self.held.theta_counts.wrapping_sub(intact.theta_counts);
            }
            (Stage::During, EmulatorFault::LapsingAlpha { .. }) => {
                self.stage = Stage::After;
                self.alpha_shift = self.held.alpha_counts.wrapping_sub(intact.alpha_counts);
            }
            (
                Stage::During,
                EmulatorFault::PushedArm { .. } | EmulatorFault::HeldPendulum { .. },
            ) => self.stage = Stage::After,
            _ => {}
        }
        None
    }

    /// The readings that the faulty encoders give in place of the readings `intact`.
    pub fn readings(&self, intact: TrueReadings) -> TrueReadings {
        let mut seen = TrueReadings {
            theta_counts: intact.theta_counts.wrapping_add(self.theta_shift),
            alpha_counts: intact.alpha_counts.wrapping_add(self.alpha_shift),
            ..intact
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
            Some(EmulatorFault::ScaledTheta { factor }) => {
                let gone_counts = intact.theta_counts.wrapping_sub(self.held.theta_counts);
                let counted = (f64::from(gone_counts) * factor).round() as i32;
                seen.theta_counts = self.held.theta_counts.wrapping_add(counted);
                seen.tachometer_raw = scaled_tachometer(intact.tachometer_raw, factor);
            }
            Some(EmulatorFault::ExchangedEncoders) => {
                seen.theta_counts = intact.alpha_counts;
                seen.alpha_counts = intact.theta_counts;
                seen.tachometer_raw = intact.pendulum_tachometer_raw;
            }
            _ => {}
        }
        seen
    }

    /// The voltage that drives the motor, V, when `voltage_v` is commanded.
    pub fn driven_v(&self, voltage_v: f64) -> f64 {
        match self.fault {
            Some(EmulatorFault::OneSidedMotor { positive, .. }) if self.stage == Stage::During => {
                if positive {
                    voltage_v.max(0.0)
                } else {
                    voltage_v.min(0.0)
                }
            }
            _ => voltage_v,
        }
    }

    /// The push of a hand on the arm as an equivalent voltage, V.
    pub fn push_equivalent_v(&self) -> f64 {
        match self.fault {
            Some(EmulatorFault::PushedArm { like_v, .. }) if self.stage == Stage::During => like_v,
            _ => 0.0,
        }
    }

    /// Returns whether a hand holds the pendulum.
    pub fn holds_pendulum(&self) -> bool {
        self.stage == Stage::During
            && matches!(self.fault, Some(EmulatorFault::HeldPendulum { .. }))
    }
}

/// The tachometer's register when `factor` times as many edges pass as for `raw`.
fn scaled_tachometer(raw: u32, factor: f64) -> u32 {
    if raw == TACHOMETER_STILL {
        return raw;
    }
    let interval = f64::from(raw & !TACHOMETER_NEGATIVE) / factor;
    if interval >= f64::from(TACHOMETER_STILL) {
        return TACHOMETER_STILL;
    }
    (raw & TACHOMETER_NEGATIVE) | interval.round().max(1.0) as u32
}

#[cfg(test)]
mod tests {
    use super::*;

    const START: TrueReadings = TrueReadings {
        theta_counts: 500,
        alpha_counts: 7,
        tachometer_raw: 1000,
        pendulum_tachometer_raw: 2000,
    };

    #[test]
    fn an_encoder_with_other_lines_scales_its_count_and_its_tachometer() {
        for (factor, counts, interval) in [(0.5, 400, 2000), (2.0, 100, 500)] {
            let mut fault_progress =
                FaultProgress::new(Some(EmulatorFault::ScaledTheta { factor }));
            fault_progress.advance_stage(START);
            let seen = fault_progress.readings(TrueReadings { theta_counts: 300, ..START });
            assert_eq!((seen.theta_counts, seen.tachometer_raw), (counts, interval));
            let still = TrueReadings { tachometer_raw: TACHOMETER_STILL, ..START };
            assert_eq!(fault_progress.readings(still).tachometer_raw, TACHOMETER_STILL);
            let back = TrueReadings { tachometer_raw: TACHOMETER_NEGATIVE | 1000, ..START };
            let seen = fault_progress.readings(back);
            assert_eq!(seen.tachometer_raw, TACHOMETER_NEGATIVE | interval);
        }
    }

    #[test]
    fn exchanged_encoders_count_and_show_speed_in_each_others_place() {
        let fault_progress = FaultProgress::new(Some(EmulatorFault::ExchangedEncoders));
        let seen = fault_progress.readings(START);
        assert_eq!((seen.theta_counts, seen.alpha_counts, seen.tachometer_raw), (7, 500, 2000));
    }

    #[test]
    fn a_fault_may_last_longer_than_the_clock_can_count() {
        let fault = EmulatorFault::HeldPendulum { after_s: 3.0, lasts_s: 1e20 };
        let mut fault_progress = FaultProgress::new(Some(fault));
        fault_progress.advance_stage(START);
        assert_eq!(fault_progress.next_us(), Some(u64::MAX));
        assert!(fault_progress.holds_pendulum());
    }

    #[test]
    fn a_one_sided_amplifier_gives_0_v_in_the_other_direction() {
        let fault = EmulatorFault::OneSidedMotor { after_s: 1.0, positive: false };
        let mut fault_progress = FaultProgress::new(Some(fault));
        assert_eq!(fault_progress.driven_v(2.0), 2.0);
        fault_progress.advance_stage(START);
        assert_eq!((fault_progress.driven_v(2.0), fault_progress.driven_v(-2.0)), (0.0, -2.0));
    }
}
