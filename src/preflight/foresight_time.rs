use std::time::Instant;

use thiserror::Error;

use crate::qube::{MAX_HISTORY, PlantModel, State};
use crate::safety::ForesightSettings;

/// Number of measurements. The shortest one counts, because a busy computer is not a slow
/// processor.
const TRIES: usize = 25;

/// Longest prediction of the guard on a processor that needs no advice, us, out of the 10 ms of a
/// control period.
pub const SLOW_US: f64 = 500.0;

/// Longest prediction of the guard that is accepted for hardware, us. A tick whose voltage the
/// guard refuses predicts five times, for that voltage and for four of the brake; these five take
/// eight tenths of a control period, in which the sample and the command must also pass the link.
pub const TOO_SLOW_US: f64 = 1600.0;

/// Measures how long this processor needs for the longest prediction that the guard may have to
/// make in a tick with this plant, us: a prediction in which every particle (a Qube that this one
/// may be) is simulated to the horizon. The result is the shortest of 25 measurements.
#[must_use]
pub fn foresight_time_us(plant: &PlantModel) -> f64 {
    let mut foresight = ForesightSettings::default().foresight(None, plant);
    // Of 33 696 states of a Qube on a grid, this one has the longest prediction: the pendulum is
    // about to go over the top. Other plants are timed in the same state.
    let swinging = State { theta: -0.5, alpha: 4.0, theta_dot: 0.0, alpha_dot: -8.0 };
    let times_us = (0..TRIES).map(|_| {
        let begin = Instant::now();
        std::hint::black_box(foresight.too_late_for(&swinging, &[0.0; MAX_HISTORY], 0.0));
        1e6 * begin.elapsed().as_secs_f64()
    });
    times_us.fold(f64::INFINITY, f64::min)
}

/// The error that the processor is so slow that the guard would make ticks late.
#[derive(Clone, Copy, Debug, Error, PartialEq)]
#[error(
    "the guard's longest prediction takes {longest_us:.0} us on this processor, and {TOO_SLOW_US:.0} us is the most \
     for a real Qube: use a processor with AVX2 or AVX-512"
)]
pub struct TooSlow {
    /// Result of [`foresight_time_us`], us.
    pub longest_us: f64,
}

/// Refuses hardware with foresight as its guard if this longest prediction, us, is too long.
///
/// # Errors
/// The prediction takes more than [`TOO_SLOW_US`], or the number is NaN.
pub fn admit_processor(longest_us: f64) -> Result<(), TooSlow> {
    if longest_us <= TOO_SLOW_US { Ok(()) } else { Err(TooSlow { longest_us }) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_processor_that_predicts_too_slowly_is_refused() {
        assert_eq!(admit_processor(TOO_SLOW_US), Ok(()));
        let refused = admit_processor(1700.0).unwrap_err();
        assert!(refused.to_string().contains("1700 us on this processor"), "{refused}");
        assert!(admit_processor(f64::NAN).is_err());
    }

    #[test]
    fn the_measurement_is_a_time() {
        let longest_us = foresight_time_us(&PlantModel::QUBE);
        assert!(longest_us.is_finite() && longest_us > 1.0, "{longest_us}");
    }
}
