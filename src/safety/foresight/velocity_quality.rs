use crate::estimation::FilterGains;
use crate::qube::CONTROL_PERIOD_S;

/// Lag of an estimated velocity behind the angles, and the factor by which lost samples enlarge its
/// error.
///
/// An estimated velocity is a filtered difference of angles, so it lags. The lag and the error are
/// larger after lost samples.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct VelocityQuality {
    /// Lag behind the angles, s.
    pub lag_s: f32,
    /// Factor on the velocity errors of the particles, which hold for consecutive samples.
    pub error_factor: f32,
}

impl VelocityQuality {
    /// The quality if the last two samples are this many control periods apart, from 1 to
    /// `MAX_PERIODS`, and all earlier ones one period. The error grows with the power `error_power`
    /// of that number.
    pub fn after(periods: u32, filter: &FilterGains<f32>, error_power: u32) -> Self {
        let periods = periods.clamp(1, MAX_PERIODS);
        let error_factor = (periods as f32).powi(error_power as i32);
        Self { lag_s: lag_s(filter, periods), error_factor }
    }
}

/// Number of control periods above which lag and error grow no further; a rollout without a sample
/// ends long before.
const MAX_PERIODS: u32 = 100;

/// Lag of the filtered velocity behind the angles, s, if the last two samples are `periods` apart.
/// The new difference lags by half that time and has the weight 1 - decay^periods; the filter's
/// earlier output is older by the whole time and has the weight decay^periods.
fn lag_s(filter: &FilterGains<f32>, periods: u32) -> f32 {
    let regular_s = CONTROL_PERIOD_S as f32 * (0.5 + filter.decay / (1.0 - filter.decay));
    if periods == 1 {
        return regular_s;
    }
    let half_s = 0.5 * CONTROL_PERIOD_S as f32 * periods as f32;
    half_s + filter.decay.powi(periods as i32) * (half_s + regular_s)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimation::GUARD_CORNER_RAD_S;

    #[test]
    fn a_velocity_lags_more_and_is_less_exact_after_lost_samples() {
        let filter = FilterGains::new(GUARD_CORNER_RAD_S, CONTROL_PERIOD_S).cast();
        let after = |periods, power| VelocityQuality::after(periods, &filter, power);
        assert_eq!(after(0, 2), after(1, 2));
        assert_eq!([1, 2, 4].map(|periods| after(periods, 2).error_factor), [1.0, 4.0, 16.0]);
        assert_eq!(after(4, 0).error_factor, 1.0);
        assert_eq!(after(1, 2), after(1, 0), "the power has no effect on consecutive samples");
        let lags = [1, 2, 3, 4].map(|periods| after(periods, 2).lag_s);
        assert!(lags.is_sorted() && lags[0] > 0.005 && lags[3] < 0.022, "{lags:?}");
        assert_eq!(after(1000, 2), after(MAX_PERIODS, 2));
    }
}
