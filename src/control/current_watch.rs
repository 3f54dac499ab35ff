//! The motor's current against its voltage: is the motor connected, and well?

use crate::qube::Measurement;
use crate::telemetry::Fault;

/// Below this nothing is said, mV.
const LEAST_MV: i16 = 400;

/// A motor that takes less than this for each volt while the arm stands is not connected, A: 50 ohm.
const DEAD_A_V: f64 = 0.02;

/// One that takes less than this has a bad contact, A: 17 ohm. Qubes have been found to have 3.7 to 9.1
/// ohm, and what the amplifier swallows of 1 V looks like half as much again.
const WEAK_A_V: f64 = 1.0 / 17.0;

/// From this on a bad contact can be told from a dead zone, mV.
const WEAK_MV: i16 = 1200;

/// An arm within so many counts stays where it is.
const STANDS_COUNTS: i32 = 3;

/// An arm stands that has stayed for so many ticks.
const STANDS_TICKS: u32 = 25;

/// A current sensor that has shown less than this although the motor moved the arm shows nothing, A.
const BLIND_A: f64 = 0.004;

/// Whether the motor takes less of this voltage, mV, than one that is connected takes while the arm
/// stands.
///
/// Computed in `f32`, as the first recordings were: at whole milliamperes the last bit decides.
#[must_use]
pub fn takes_nothing(sample: &Measurement, voltage_mv: i16) -> bool {
    let least_a = DEAD_A_V as f32 * f32::from(voltage_mv.saturating_abs()) * 1e-3;
    sample.current_a.abs() < least_a
}

/// Watches the current of a motor whose arm stands, where no back-EMF hides anything.
#[derive(Clone, Copy, Debug, Default)]
pub struct CurrentWatch {
    /// What the sensor shows while the motor has no voltage: its sum and count.
    idle_a: f64,
    idle_samples: u32,
    largest_a: f64,
    is_blind: bool,
    without_ticks: u32,
    stands_at: i32,
    stands_ticks: u32,
}

impl CurrentWatch {
    /// The motor has moved the arm: a sensor that has shown nothing meanwhile is none.
    pub fn motor_works(&mut self) {
        self.is_blind = self.largest_a < BLIND_A;
    }

    /// Whether the motor has taken nothing although it had this much, V.
    pub fn is_dead(&self, largest_v: f64) -> bool {
        self.largest_a < DEAD_A_V * largest_v
    }

    /// Whether the motor takes nothing of this voltage, mV, from an arm that is fast: a motor that is
    /// connected has at least its back-EMF's current.
    pub fn takes_nothing_at_speed(&self, sample: &Measurement, voltage_mv: i16) -> bool {
        takes_nothing(sample, voltage_mv) || f64::from(sample.current_a).abs() < BLIND_A
    }

    /// Looks at one sample.
    pub fn check(&mut self, sample: &Measurement) -> Option<Fault> {
        let current_a = f64::from(sample.current_a);
        let voltage_mv = sample.applied_mv.saturating_abs();
        if voltage_mv == 0 {
            self.idle_a += current_a;
            self.idle_samples += 1;
        }
        let idle_a = self.idle_a / f64::from(self.idle_samples.max(1));
        let taken_a = (current_a - idle_a).abs();
        self.largest_a = self.largest_a.max(taken_a);
        let volts = f64::from(voltage_mv) * 1e-3;
        // An arm that homing leads is never so fast that its back-EMF hides the current for long.
        let takes_nothing = voltage_mv >= LEAST_MV && taken_a < DEAD_A_V * volts;
        self.without_ticks = if takes_nothing { self.without_ticks + 1 } else { 0 };
        if !self.is_blind && self.without_ticks >= STANDS_TICKS {
            return Some(Fault::MotorDead);
        }
        let stays =
            sample.theta_counts.wrapping_sub(self.stands_at).wrapping_abs() <= STANDS_COUNTS;
        let takes_little = taken_a < WEAK_A_V * volts;
        if voltage_mv < WEAK_MV || !stays || !takes_little {
            (self.stands_at, self.stands_ticks) = (sample.theta_counts, 0);
            return None;
        }
        self.stands_ticks += 1;
        let is_weak = !self.is_blind && self.stands_ticks > STANDS_TICKS;
        is_weak.then_some(Fault::MotorWeak)
    }
}
