use std::f64::consts::PI;

use serde::{Deserialize, Serialize};

use super::{Calibration, FilterGains, VelocityFilter};
use crate::qube::{COUNTS_PER_REVOLUTION, Measurement, RAD_PER_COUNT, State, wrap_angle};

/// How velocities are estimated.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EstimatorSettings {
    /// Corner of the velocity filter in rad/s. 200 by default; 50 is the thesis's set-up, whose lag
    /// alone makes a quarter of nominal policies fail.
    pub corner_rad_s: f64,
}

impl Default for EstimatorSettings {
    fn default() -> Self {
        Self { corner_rad_s: 200.0 }
    }
}

/// State from measurements: angles by calibration, velocities by filter over the device's own time.
#[derive(Clone, Copy, Debug)]
pub struct Estimator {
    settings: EstimatorSettings,
    calibration: Calibration,
    previous: Option<Previous>,
}

#[derive(Clone, Copy, Debug)]
struct Previous {
    device_time_us: u64,
    theta: VelocityFilter,
    alpha: VelocityFilter,
    state: State,
}

impl Estimator {
    /// An estimator that takes the first measurement as one at rest.
    #[must_use]
    pub fn new(settings: EstimatorSettings, calibration: Calibration) -> Self {
        Self { settings, calibration, previous: None }
    }

    /// The state after one more measurement. A measurement no newer than the last changes nothing.
    pub fn update(&mut self, measurement: &Measurement) -> State {
        let (theta, alpha) = self.calibration.angles_rad(measurement);
        let Some(previous) = &mut self.previous else {
            let state = State { theta, alpha, ..State::default() };
            self.previous = Some(Previous {
                device_time_us: measurement.device_time_us,
                theta: VelocityFilter::at_rest(theta),
                alpha: VelocityFilter::at_rest(alpha),
                state,
            });
            return state;
        };
        let elapsed_us = measurement.device_time_us.saturating_sub(previous.device_time_us);
        if elapsed_us > 0 {
            let gains = FilterGains::new(self.settings.corner_rad_s, elapsed_us as f64 * 1e-6);
            previous.device_time_us = measurement.device_time_us;
            previous.state = State {
                theta,
                alpha,
                theta_dot: previous.theta.update(theta, &gains),
                alpha_dot: previous.alpha.update(alpha, &gains),
            };
        }
        previous.state
    }

    /// Counts the pendulum's whole turns from here on, so that alpha lies in (-pi, pi] now, and
    /// returns the state as it reads then. Velocities are kept.
    pub fn forget_whole_turns(&mut self) -> State {
        let Some(previous) = &mut self.previous else {
            return State::default();
        };
        let turns =
            ((previous.state.alpha - wrap_angle(previous.state.alpha)) / (2.0 * PI)).round();
        let turns_counts = turns as i32 * COUNTS_PER_REVOLUTION;
        let moved = if self.calibration.alpha_inverted { -turns_counts } else { turns_counts };
        self.calibration.alpha_zero_counts = self.calibration.alpha_zero_counts.wrapping_add(moved);
        // The same count under the new zero, so that the next difference does not see a jump.
        previous.state.alpha -= f64::from(turns_counts) * RAD_PER_COUNT;
        previous.alpha.move_to(previous.state.alpha);
        previous.state
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::counts;

    #[test]
    fn counts_of_a_steady_turn_become_its_velocity_within_one_count_of_noise() {
        let calibration =
            Calibration { theta_zero_counts: -500, alpha_inverted: true, ..Calibration::IDENTITY };
        let mut estimator = Estimator::new(EstimatorSettings::default(), calibration);
        let mut state = State::default();
        for step in 0..100_u64 {
            let time_s = step as f64 * 0.01;
            state = estimator.update(&Measurement {
                device_time_us: step * 10_000,
                theta_counts: counts(2.0 * time_s) - 500,
                alpha_counts: counts(-5.0 * time_s),
                ..Measurement::default()
            });
        }
        assert!((state.theta - 1.98).abs() < 0.004, "{state:?}");
        assert!((state.alpha - 4.95).abs() < 0.004, "{state:?}");
        assert!((state.theta_dot - 2.0).abs() < 0.31, "{state:?}");
        assert!((state.alpha_dot - 5.0).abs() < 0.31, "{state:?}");
    }

    #[test]
    fn forgetting_whole_turns_moves_alpha_and_nothing_else() {
        for alpha_inverted in [false, true] {
            let calibration = Calibration { alpha_inverted, ..Calibration::IDENTITY };
            let mut estimator = Estimator::new(EstimatorSettings::default(), calibration);
            let at = |tick: u64| Measurement {
                device_time_us: tick * 10_000,
                alpha_counts: 3 * COUNTS_PER_REVOLUTION + 7 + tick as i32,
                ..Measurement::default()
            };
            let mut undisturbed = estimator;
            undisturbed.update(&at(0));
            undisturbed.update(&at(1));
            estimator.update(&at(0));
            let before = estimator.update(&at(1));
            let after = estimator.forget_whole_turns();
            assert!((after.alpha - wrap_angle(before.alpha)).abs() < 1e-9);
            assert_eq!(after.alpha_dot, before.alpha_dot);
            let (next, expected) = (estimator.update(&at(2)), undisturbed.update(&at(2)));
            assert!((next.alpha - wrap_angle(expected.alpha)).abs() < 1e-9);
            assert!((next.alpha_dot - expected.alpha_dot).abs() < 1e-9);
        }
    }

    #[test]
    fn an_old_measurement_changes_nothing() {
        let mut estimator = Estimator::new(EstimatorSettings::default(), Calibration::IDENTITY);
        let at = |device_time_us, theta_counts| Measurement {
            device_time_us,
            theta_counts,
            ..Measurement::default()
        };
        estimator.update(&at(0, 0));
        let state = estimator.update(&at(10_000, 5));
        assert_eq!(estimator.update(&at(10_000, 90)), state);
        assert_eq!(estimator.update(&at(5_000, 90)), state);
    }
}
