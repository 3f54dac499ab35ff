//! Detects a motor that does not have the voltage that the program sends. Each sample reports the
//! voltage that the motor had. A device whose reports contradict the voltages that it was sent
//! cannot be used to brake the arm.

use super::TickInput;
use super::watch::Alarm;
use crate::qube::{Measurement, applied_voltage_mv};
use crate::telemetry::Fault;

/// Number of periods whose voltages the motor may have: the device keeps its last voltage until an
/// act arrives, and its watchdog switches the motor off at most 55 ms after the last act.
const PERIODS: usize = 7;

/// Largest difference that rounding explains, mV: two steps of a Qube's motor driver.
pub const VOLTAGE_TOLERANCE_MV: i32 = 48;

/// Number of consecutive samples that raise the alarm if each contradicts the voltages of all
/// [`PERIODS`].
const STREAK: u32 = 3;

/// Compares the voltage that each sample reports with the voltages that were sent, all as the
/// device counts them.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct VoltageWatch {
    /// Voltages of the last periods, newest first, mV; 0 before the first.
    sent_mv: [i16; PERIODS],
    contradictions: u32,
}

impl VoltageWatch {
    /// Takes the voltage that the device has been sent since the last tick, mV, and checks the
    /// sample of this tick, if there is one.
    pub fn watch(&mut self, device_mv: i16, input: &TickInput) -> Option<Alarm> {
        self.remember_sent(device_mv, input.skipped_periods);
        self.check(input.measurement.as_ref()?)
    }

    /// Remembers the voltage that the device was sent for this period and for `more_periods`
    /// skipped ones, mV.
    fn remember_sent(&mut self, device_mv: i16, more_periods: u32) {
        for _ in 0..=more_periods.min(PERIODS as u32) {
            self.sent_mv.rotate_right(1);
            self.sent_mv[0] = applied_voltage_mv(device_mv);
        }
    }

    /// Checks the voltage that a sample reports.
    fn check(&mut self, sample: &Measurement) -> Option<Alarm> {
        let applied_mv = i32::from(sample.applied_mv);
        let explains =
            |sent_mv: &i16| (applied_mv - i32::from(*sent_mv)).abs() <= VOLTAGE_TOLERANCE_MV;
        let is_explained = self.sent_mv.iter().any(explains);
        self.contradictions = if is_explained { 0 } else { self.contradictions + 1 };
        (self.contradictions >= STREAK).then_some(Alarm::SwitchOff(Fault::VoltageDiffers))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The first of 100 periods with an alarm, where the program sends a sine of 3 V and the motor
    /// has `applied_mv` of the period and of the voltages sent so far, newest last.
    fn alarm(applied_mv: impl Fn(usize, &[i16]) -> i16) -> Option<usize> {
        let mut watch = VoltageWatch::default();
        let mut sent_mv = vec![0];
        (0..100).find(|&period| {
            let applied_mv = applied_mv(period, &sent_mv);
            let found = watch.check(&Measurement { applied_mv, ..Measurement::default() });
            sent_mv.push((3000.0 * (0.3 * period as f64).sin()) as i16);
            watch.remember_sent(sent_mv[period + 1], 0);
            found.is_some()
        })
    }

    #[test]
    fn a_motor_that_follows_late_or_misses_acts_is_no_fault() {
        let newest = |_: usize, sent: &[i16]| applied_voltage_mv(sent[sent.len() - 1]);
        assert_eq!(alarm(newest), None);
        // A command that arrives 20 ms late, and two of three that are lost.
        assert_eq!(alarm(|_, sent| sent[sent.len().saturating_sub(3)]), None);
        assert_eq!(alarm(|period, sent| sent[period - period % 3]), None);
    }

    #[test]
    fn a_voltage_that_nobody_sent_is_found_within_a_tenth_of_a_second() {
        let from_30 = |wrong_mv: fn(i16) -> i16| {
            alarm(move |period, sent| {
                let sent_mv = sent[sent.len() - 1];
                if period < 30 { sent_mv } else { wrong_mv(sent_mv) }
            })
        };
        let wrong: [fn(i16) -> i16; 3] = [|_| 1500, |_| 0, |sent_mv| -sent_mv];
        for wrong_mv in wrong {
            let found = from_30(wrong_mv).expect("a wrong voltage raises an alarm");
            assert!((32..=40).contains(&found), "{found}");
        }
    }
}
