//! Detects an arm's count that moves away from the tachometer: counts are lost, or added.

use std::time::Duration;

/// Time constant with which older differences are forgotten, s.
const FORGOTTEN_S: f64 = 2.0;

/// Largest difference between the motion that the count shows and the one that the tachometer shows,
/// rad. A tachometer whose scale is wrong by a tenth differs by less, as does one that measures the
/// time between edges and shows the last velocity for 0.21 s at each turn.
const LARGEST_RAD: f64 = 0.4;

/// Velocity up to which the difference is judged, rad/s. A tachometer that is late by a time differs
/// by the velocity times this time, which is no drift.
const SLOW_RAD_S: f64 = 2.0;

/// The difference between both, since the first sample.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct CountDrift {
    difference_rad: f64,
    tachometer_rad_s: Option<f64>,
}

impl CountDrift {
    /// Takes the motion of the count over the time since the last sample, rad, and the tachometer's
    /// velocity at its end, rad/s. Returns whether the count has drifted.
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
        self.difference_rad *= (1.0 - elapsed_s / FORGOTTEN_S).max(0.0);
        self.difference_rad += moved_rad - mean_rad_s * elapsed_s;
        let fastest_rad_s = (moved_rad / elapsed_s).abs().max(tachometer_rad_s.abs());
        // A count that is constant although the tachometer moves is a frozen encoder's.
        let is_slow = moved_rad != 0.0 && fastest_rad_s < SLOW_RAD_S;
        is_slow && self.difference_rad.abs() > LARGEST_RAD
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Time, s, after which the count of an arm that swings with 1 rad and 1 Hz has drifted; `shown`
    /// gives the count's angle and the tachometer's velocity, from time, angle and velocity.
    fn drifted_after(shown: impl Fn(f64, f64, f64) -> (f64, f64)) -> Option<f64> {
        let mut drift = CountDrift::default();
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
}
