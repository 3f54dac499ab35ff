//! Detects an arm's count that departs from the tachometer's velocity because counts are lost or
//! added.

use std::time::Duration;

/// Time constant with which older differences are forgotten while the arm is driven, s.
const FORGOTTEN_S: f64 = 2.0;

/// The same while the arm comes to rest with the motor off, s. The arm is slow then, and a late
/// tachometer or one of a wrong scale differs little.
const FORGOTTEN_AT_REST_S: f64 = 10.0;

/// Largest difference between the motions that count and tachometer show, rad. A tachometer whose
/// scale is wrong by a tenth differs by less.
const LARGEST_RAD: f64 = 0.4;

/// Velocity up to which the difference is evaluated, rad/s. A tachometer that is late by a time
/// differs by the velocity times this time, which is no drift.
const SLOW_RAD_S: f64 = 2.0;

/// Time for which a count must be constant, while the tachometer shows motion, to reset the
/// difference, s. A tachometer that measures the time between edges shows the last velocity for
/// 0.21 s after a sudden stop, and a frozen count has tests of its own.
const CONSTANT_S: f64 = 0.05;

/// The leaky integral of the count's velocity minus the tachometer's.
#[derive(Clone, Copy, Debug)]
pub(super) struct CountDrift {
    forgotten_s: f64,
    /// Whether a constant count resets the difference.
    resets: bool,
    difference_rad: f64,
    tachometer_rad_s: Option<f64>,
    /// Time for which the count has been constant, s.
    constant_s: f64,
}

impl CountDrift {
    /// The integral for an arm that is driven.
    pub(super) fn driven() -> Self {
        Self {
            forgotten_s: FORGOTTEN_S,
            resets: true,
            difference_rad: 0.0,
            tachometer_rad_s: None,
            constant_s: 0.0,
        }
    }

    /// The integral for an arm that comes to rest. A constant count does not reset it, because no
    /// other test finds a count that freezes then. An arm that a cable throws into a stop may seem
    /// to have drifted, and is homed again.
    pub(super) fn coming_to_rest() -> Self {
        Self { forgotten_s: FORGOTTEN_AT_REST_S, resets: false, ..Self::driven() }
    }

    /// Takes the motion of the count over the time since the last sample, rad, and the tachometer's
    /// velocity at its end, rad/s. Returns whether the difference is too large while the arm is
    /// slow and its count changes.
    pub(super) fn has_drifted(
        &mut self,
        moved_rad: f64,
        elapsed: Duration,
        tachometer_rad_s: f64,
    ) -> bool {
        let elapsed_s = elapsed.as_secs_f64();
        let before_rad_s = self.tachometer_rad_s.replace(tachometer_rad_s);
        let mean_rad_s = 0.5 * (before_rad_s.unwrap_or(tachometer_rad_s) + tachometer_rad_s);
        // Without `exp`, whose bits depend on the computer.
        self.difference_rad *= (1.0 - elapsed_s / self.forgotten_s).max(0.0);
        self.difference_rad += moved_rad - mean_rad_s * elapsed_s;
        let fastest_rad_s = (moved_rad / elapsed_s).abs().max(tachometer_rad_s.abs());
        self.constant_s = if moved_rad == 0.0 { self.constant_s + elapsed_s } else { 0.0 };
        if self.resets && self.constant_s >= CONSTANT_S && mean_rad_s != 0.0 {
            self.difference_rad = 0.0;
        }
        let is_slow = moved_rad != 0.0 && fastest_rad_s < SLOW_RAD_S;
        is_slow && self.is_large()
    }

    /// Returns whether the difference is too large, however fast the arm is.
    pub(super) fn is_large(&self) -> bool {
        self.difference_rad.abs() > LARGEST_RAD
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Time, s, after which the count of an arm that swings with 1 rad at 1 Hz has drifted; `shown`
    /// gives the count's angle and the tachometer's velocity, from time, angle and velocity.
    fn drifted_after(shown: impl Fn(f64, f64, f64) -> (f64, f64)) -> Option<f64> {
        let mut drift = CountDrift::driven();
        let at = |tick: u32| {
            let (time_s, omega) = (f64::from(tick) * 0.01, std::f64::consts::TAU);
            let (sin, cos) = (omega * time_s).sin_cos();
            (time_s, shown(time_s, sin, omega * cos))
        };
        (1..2000).find_map(|tick| {
            let ((_, (before_rad, _)), (time_s, (angle_rad, shown_rad_s))) =
                (at(tick - 1), at(tick));
            let elapsed = Duration::from_millis(10);
            drift.has_drifted(angle_rad - before_rad, elapsed, shown_rad_s).then_some(time_s)
        })
    }

    #[test]
    fn a_count_that_creeps_or_loses_counts_has_drifted_and_a_poor_tachometer_has_not() {
        let creeps = drifted_after(|time_s, angle, speed| (angle + 0.5 * time_s, speed));
        assert!(creeps.is_some_and(|time_s| time_s < 3.0), "{creeps:?}");
        let exact = drifted_after(|_, angle, speed| (angle, speed));
        let by_a_tenth = drifted_after(|_, angle, speed| (angle, 1.1 * speed));
        let late = drifted_after(|time_s, angle, _| {
            (angle, std::f64::consts::TAU * (std::f64::consts::TAU * (time_s - 0.03)).cos())
        });
        assert_eq!([exact, by_a_tenth, late], [None; 3]);
    }

    #[test]
    fn a_count_that_loses_a_fifth_of_one_direction_has_drifted() {
        let mut drift = CountDrift::driven();
        let omega = 0.01 * std::f64::consts::TAU;
        let found = (1..1000).find(|tick| {
            let angle_rad = |tick: i32| (omega * f64::from(tick)).sin();
            let moved_rad = angle_rad(*tick) - angle_rad(tick - 1);
            let counted_rad = if moved_rad > 0.0 { 0.8 * moved_rad } else { moved_rad };
            let shown_rad_s = std::f64::consts::TAU * (omega * f64::from(*tick)).cos();
            drift.has_drifted(counted_rad, Duration::from_millis(10), shown_rad_s)
        });
        assert!(found.is_some_and(|tick| tick < 300), "{found:?}");
    }

    #[test]
    fn a_tachometer_that_holds_its_last_velocity_after_a_sudden_stop_is_no_drift() {
        let mut drift = CountDrift::driven();
        let elapsed = Duration::from_millis(10);
        for _ in 0..3 {
            for _ in 0..20 {
                assert!(!drift.has_drifted(0.05, elapsed, 5.0));
            }
            // A stop catches the arm; then it creeps on.
            for tick in 0..100 {
                let shown_rad_s = if tick < 21 { 5.0 } else { 0.0 };
                assert!(!drift.has_drifted(0.0, elapsed, shown_rad_s));
            }
            for _ in 0..100 {
                assert!(!drift.has_drifted(0.003, elapsed, 0.3));
            }
        }
    }
}
