//! Compares the motor's current with its voltage to detect a disconnected or badly connected motor.
//!
//! The least currents are a Qube's. For another plant they are multiplied by
//! [`PlantModel::current_per_qube_current`], which is exactly 1 for a Qube.

use crate::qube::{CONTROL_PERIOD_S, Encoder, Measurement, PlantModel};
use crate::safety::{CURRENT_OFFSET_A, Winding};
use crate::telemetry::Fault;

/// Least voltage at which a dead motor is detected, mV.
const LEAST_MV: i16 = 400;

/// Least current per volt of a connected motor at rest, A/V: 50 ohm.
const DEAD_A_V: f64 = 0.02;

/// Least current per volt of a motor with a good contact, A/V: 17 ohm. Known Qubes have 3.7 to 9.1
/// ohm; the amplifier's loss at 1 V adds about half as much again.
pub const WEAK_A_V: f64 = 1.0 / 17.0;

/// Least voltage at which a bad contact can be distinguished from a dead zone, mV.
const WEAK_MV: i16 = 1200;

/// Travel within which an arm counts as still, counts.
const STILL_COUNTS: i32 = 3;

/// Ticks (0.25 s) for which the arm must be still, or the motor without current, before a fault is
/// reported.
const STILL_TICKS: u32 = 25;

/// Ticks (0.1 s) for which more current must flow than the voltage explains, before a fault is
/// reported.
const UNEXPLAINED_TICKS: u32 = 10;

/// Current below which a sensor counts as blind if the motor has moved the arm, and below which the
/// motor of a fast arm counts as without current, A.
const BLIND_A: f64 = 0.004;

/// Returns whether the current is less than a connected motor at rest draws under this voltage, mV.
/// The plant's motor draws `current_per_qube_current` amperes for each ampere of a Qube's motor.
///
/// The comparison stays in `f32`: a replay must decide as the recorded tick did, and at whole
/// milliamperes the last bit decides.
#[must_use]
pub fn draws_no_current(
    sample: &Measurement,
    voltage_mv: i16,
    current_per_qube_current: f32,
) -> bool {
    let least_a_v = DEAD_A_V as f32 * current_per_qube_current;
    let least_a = least_a_v * f32::from(voltage_mv.saturating_abs()) * 1e-3;
    sample.current_a.abs() < least_a
}

/// Watches the motor's current during homing, where the arm is too slow for its back-EMF to hide
/// the current for long. A bad contact is reported only for an arm at rest.
#[derive(Clone, Copy, Debug)]
pub struct CurrentWatch {
    current_per_qube_current: f64,
    /// Sum and number of the readings at 0 V, which give the sensor's offset.
    idle_a: f64,
    idle_samples: u32,
    largest_a: f64,
    is_blind: bool,
    without_ticks: u32,
    still_at_counts: i32,
    still_ticks: u32,
    winding: Winding,
    arm: Encoder,
    /// The arm's count in the sample before; `None` before the first.
    counts_before: Option<i32>,
    unexplained_ticks: u32,
}

impl CurrentWatch {
    /// A watch of this plant's motor that has seen no sample.
    pub fn of(plant: &PlantModel) -> Self {
        Self {
            current_per_qube_current: plant.current_per_qube_current(),
            idle_a: 0.0,
            idle_samples: 0,
            largest_a: 0.0,
            is_blind: false,
            without_ticks: 0,
            still_at_counts: 0,
            still_ticks: 0,
            winding: Winding::of(plant),
            arm: plant.encoders.theta,
            counts_before: None,
            unexplained_ticks: 0,
        }
    }

    /// The limit of this plant for a limit of a Qube's current.
    fn like(&self, of_qube: f64) -> f64 {
        of_qube * self.current_per_qube_current
    }

    /// Notes that the motor has moved the arm: a sensor that has shown no current until then is
    /// blind.
    pub fn motor_works(&mut self) {
        self.is_blind = self.largest_a < self.like(BLIND_A);
    }

    /// Returns whether the motor has drawn no current although it had `largest_v`, V.
    pub fn is_dead(&self, largest_v: f64) -> bool {
        self.largest_a < self.like(DEAD_A_V) * largest_v
    }

    /// Returns whether the motor draws no current at this voltage, mV, while the arm is fast. In a
    /// connected motor the back-EMF alone drives a current.
    pub fn draws_no_current_at_speed(&self, sample: &Measurement, voltage_mv: i16) -> bool {
        draws_no_current(sample, voltage_mv, self.current_per_qube_current as f32)
            || f64::from(sample.current_a).abs() < self.like(BLIND_A)
    }

    /// Takes a sample; returns whether the motor has had more current for 0.1 s than its voltage
    /// and the arm's velocity explain. An amplifier with a short circuit drives a motor in this way
    /// although its board reports the voltage that it was sent.
    fn draws_unexplained_current(&mut self, sample: &Measurement) -> bool {
        let counts_before = self.counts_before.replace(sample.theta_counts);
        let moved = sample.theta_counts.wrapping_sub(counts_before.unwrap_or(sample.theta_counts));
        let speed_rad_s = f64::from(moved) * self.arm.rad_per_count() / CONTROL_PERIOD_S;
        let volts = f64::from(sample.applied_mv) * 1e-3;
        let back_emf_v = self.winding.back_emf_v_s * speed_rad_s;
        let largest_a = self.winding.largest_current_a(volts, back_emf_v);
        let is_explained = f64::from(sample.current_a).abs() <= largest_a;
        self.unexplained_ticks = if is_explained { 0 } else { self.unexplained_ticks + 1 };
        self.unexplained_ticks >= UNEXPLAINED_TICKS
    }

    /// Checks one sample; returns the fault if the motor is dead, has a bad contact, or more
    /// current than its voltage explains.
    pub fn check(&mut self, sample: &Measurement) -> Option<Fault> {
        if self.draws_unexplained_current(sample) {
            return Some(Fault::CurrentUnexplained);
        }
        let current_a = f64::from(sample.current_a);
        let voltage_mv = sample.applied_mv.saturating_abs();
        if voltage_mv == 0 {
            self.idle_a += current_a;
            self.idle_samples += 1;
        }
        // A larger current at 0 V is no offset of the sensor, and must not hide the motor's
        // current.
        let idle_a = (self.idle_a / f64::from(self.idle_samples.max(1)))
            .clamp(-CURRENT_OFFSET_A, CURRENT_OFFSET_A);
        let taken_a = (current_a - idle_a).abs();
        self.largest_a = self.largest_a.max(taken_a);
        let volts = f64::from(voltage_mv) * 1e-3;
        // Homing never moves the arm so fast that the back-EMF hides the current for long.
        let draws_no_current = voltage_mv >= LEAST_MV && taken_a < self.like(DEAD_A_V) * volts;
        self.without_ticks = if draws_no_current { self.without_ticks + 1 } else { 0 };
        if !self.is_blind && self.without_ticks >= STILL_TICKS {
            return Some(Fault::MotorDead);
        }
        let stays =
            sample.theta_counts.wrapping_sub(self.still_at_counts).wrapping_abs() <= STILL_COUNTS;
        let takes_little = taken_a < self.like(WEAK_A_V) * volts;
        if voltage_mv < WEAK_MV || !stays || !takes_little {
            (self.still_at_counts, self.still_ticks) = (sample.theta_counts, 0);
            return None;
        }
        self.still_ticks += 1;
        let is_weak = !self.is_blind && self.still_ticks > STILL_TICKS;
        is_weak.then_some(Fault::MotorWeak)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The fault after at most a second of these samples: voltage (mV), current (A), and counts of
    /// the arm a tick.
    fn fault(applied_mv: i16, current_a: f32, counts_a_tick: i32) -> Option<Fault> {
        let mut watch = CurrentWatch::of(&PlantModel::QUBE);
        (0..100).find_map(|tick| {
            let theta_counts = tick * counts_a_tick;
            watch.check(&Measurement {
                applied_mv,
                current_a,
                theta_counts,
                ..Measurement::default()
            })
        })
    }

    #[test]
    fn a_current_without_a_voltage_is_unexplained_and_an_offset_of_the_sensor_is_not() {
        assert_eq!(fault(0, 0.24, 0), Some(Fault::CurrentUnexplained));
        assert_eq!(fault(0, -0.24, 0), Some(Fault::CurrentUnexplained));
        assert_eq!(fault(250, 32.767, 0), Some(Fault::CurrentUnexplained));
        assert_eq!(fault(0, 0.09, 0), None);
        // An arm that coasts at 20 rad/s drives a current by its back EMF.
        assert_eq!(fault(0, 0.2, 65), None);
        assert_eq!(fault(3000, 0.36, 0), None);
    }

    #[test]
    fn a_current_at_0_v_does_not_make_a_motor_dead() {
        let mut watch = CurrentWatch::of(&PlantModel::QUBE);
        let sample =
            |applied_mv, current_a| Measurement { applied_mv, current_a, ..Measurement::default() };
        for _ in 0..50 {
            assert_eq!(watch.check(&sample(0, 0.0995)), None);
        }
        for _ in 0..50 {
            assert_eq!(watch.check(&sample(1000, 0.3)), None);
        }
        assert!(!watch.is_dead(1.0));
    }
}
