//! Detects a motor that draws no current while a policy drives it.

use super::current_watch::draws_no_current;
use crate::qube::{Measurement, PlantModel};

/// Voltage from which on a motor must draw current, mV: no arm is fast enough for its back EMF to
/// cancel the current for long.
const DRIVEN_MV: i16 = 800;

/// Current of a driven Qube's motor below which it counts as zero, A.
const LEAST_DRIVEN_A: f32 = 0.012;

/// Driven samples without current, and without a current between them, after which the motor counts
/// as dead.
const WITHOUT_CURRENT_TICKS: u32 = 15;

/// Detector of a motor that has drawn current earlier and draws none.
#[derive(Clone, Copy, Debug)]
pub(super) struct DeadMotor {
    current_per_qube_current: f32,
    has_taken_current: bool,
    without_current_ticks: u32,
    /// True if only driven samples are evaluated, as by the earlier rules.
    looks_when_driven: bool,
}

impl DeadMotor {
    /// A watch of this plant's motor that has seen no sample.
    pub(super) fn of(plant: &PlantModel) -> Self {
        Self {
            current_per_qube_current: plant.current_per_qube_current() as f32,
            has_taken_current: false,
            without_current_ticks: 0,
            looks_when_driven: false,
        }
    }

    /// This watch by the rules before
    /// [`TickRules::AlternatingAllowed`](crate::telemetry::TickRules::AlternatingAllowed): a
    /// current between two driven samples is not seen.
    pub(super) fn by_earlier_rules(self) -> Self {
        Self { looks_when_driven: true, ..self }
    }

    /// Takes a sample; returns whether a motor that has drawn current earlier draws none under
    /// voltage. Under a voltage that alternates between two samples, the current may appear when
    /// the voltage seems to be low.
    pub(super) fn takes_no_current(&mut self, sample: &Measurement) -> bool {
        let is_driven = sample.applied_mv.saturating_abs() >= DRIVEN_MV;
        if !is_driven && self.looks_when_driven {
            return false;
        }
        let takes_some = sample.current_a.abs() >= LEAST_DRIVEN_A * self.current_per_qube_current;
        self.has_taken_current |= takes_some && is_driven;
        if takes_some {
            self.without_current_ticks = 0;
        } else if is_driven {
            self.without_current_ticks += 1;
        }
        is_driven && self.has_taken_current && self.without_current_ticks >= WITHOUT_CURRENT_TICKS
    }

    /// Returns whether this sample shows no current under the voltage, mV, and the last driven
    /// sample did not either: at the instant at which a voltage changes its sign every motor draws
    /// none. By the earlier rules this sample alone decides.
    pub(super) fn is_dead(&self, sample: &Measurement, voltage_mv: i16) -> bool {
        let is_dead = draws_no_current(sample, voltage_mv, self.current_per_qube_current);
        is_dead && (self.looks_when_driven || self.without_current_ticks > 0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample(applied_mv: i16, current_a: f32) -> Measurement {
        Measurement { applied_mv, current_a, ..Measurement::default() }
    }

    #[test]
    fn a_motor_whose_current_shows_between_driven_samples_is_not_dead() {
        let calls_dead = |mut motor: DeadMotor, undriven_a: f32| {
            (0..80).any(|tick| {
                motor.takes_no_current(&match tick % 2 {
                    _ if tick < 10 => sample(2000, 0.2),
                    0 => sample(900, 0.001),
                    _ => sample(100, undriven_a),
                })
            })
        };
        let motor = DeadMotor::of(&PlantModel::QUBE);
        assert!(!calls_dead(motor, 0.08));
        assert!(calls_dead(motor.by_earlier_rules(), 0.08));
        assert!(calls_dead(motor, 0.001), "a motor without current is dead");
    }

    #[test]
    fn a_voltage_that_crosses_zero_does_not_make_a_motor_dead() {
        let mut motor = DeadMotor::of(&PlantModel::QUBE);
        motor.takes_no_current(&sample(2000, 0.2));
        let crossing = sample(-430, 0.004);
        motor.takes_no_current(&crossing);
        assert!(!motor.is_dead(&crossing, -430));
        assert!(motor.by_earlier_rules().is_dead(&crossing, -430));
        motor.takes_no_current(&sample(2000, 0.002));
        assert!(motor.is_dead(&crossing, -430));
    }
}
