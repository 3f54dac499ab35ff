use crate::elementary::Scalar;
use crate::qube::State;

/// Estimator of a velocity from angles by the filter omega s / (s + omega), discretised exactly for
/// an angle that moves linearly between samples:
///
/// ```text
/// v_k = e^(-omega T) v_(k-1) + (1 - e^(-omega T)) (x_k - x_(k-1)) / T
/// ```
///
/// The exact pole e^(-omega T) keeps any corner usable: at omega = 2/T, forward Euler has its pole
/// at -1 and oscillates, and Tustin's method degenerates to a plain difference. The lag of a
/// velocity that changes linearly is (T/2) coth(omega T/2): 6.6 ms at 200 rad/s and 10 ms, and
/// about 1/omega where omega T is small.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct VelocityFilter<T = f64> {
    angle: T,
    velocity: T,
}

/// The filter's two coefficients for one period.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FilterGains<T = f64> {
    /// Factor of the last velocity, e^(-omega T).
    pub decay: T,
    /// Factor of the change of angle, (1 - e^(-omega T)) / T, 1/s.
    pub rate: T,
}

impl FilterGains<f64> {
    /// The coefficients for a corner of `corner_rad_s` and a period of `period_s`; both above 0.
    #[must_use]
    pub fn new(corner_rad_s: f64, period_s: f64) -> Self {
        let exponent = -corner_rad_s * period_s;
        Self { decay: libm::exp(exponent), rate: -libm::expm1(exponent) / period_s }
    }

    /// Converts the gains to another number type.
    #[must_use]
    pub fn cast<T: Scalar>(self) -> FilterGains<T> {
        FilterGains { decay: T::from_f64(self.decay), rate: T::from_f64(self.rate) }
    }
}

impl<T: Scalar> VelocityFilter<T> {
    /// A filter at rest at an angle.
    #[inline(always)]
    pub fn at_rest(angle: T) -> Self {
        Self::at(angle, T::from_f64(0.0))
    }

    /// A filter whose last input was this angle and whose last output was this velocity; they are
    /// its whole state.
    #[inline(always)]
    pub fn at(angle: T, velocity: T) -> Self {
        Self { angle, velocity }
    }

    /// Takes the next angle and returns the velocity in angle units per second.
    #[inline(always)]
    pub fn update(&mut self, angle: T, gains: &FilterGains<T>) -> T {
        self.velocity = gains.decay * self.velocity + gains.rate * (angle - self.angle);
        self.angle = angle;
        self.velocity
    }
}

/// The state at new angles, with both velocities from filters whose last input and output are in
/// `before`.
#[inline(always)]
pub fn through_filters<T: Scalar>(
    before: &State<T>,
    theta: T,
    alpha: T,
    gains: &FilterGains<T>,
) -> State<T> {
    State {
        theta,
        alpha,
        theta_dot: VelocityFilter::at(before.theta, before.theta_dot).update(theta, gains),
        alpha_dot: VelocityFilter::at(before.alpha, before.alpha_dot).update(alpha, gains),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ramp_gives_its_slope_and_the_step_response_follows_the_continuous_filter() {
        for corner_rad_s in [50.0, 200.0, 1000.0] {
            let period_s = 0.01;
            let gains = FilterGains::new(corner_rad_s, period_s);
            let mut filter = VelocityFilter::at_rest(0.0);
            for step in 1..=100 {
                let time_s = f64::from(step) * period_s;
                let velocity = filter.update(3.0 * time_s, &gains);
                let continuous = 3.0 * (1.0 - (-corner_rad_s * time_s).exp());
                assert!((velocity - continuous).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn unequal_periods_stay_exact() {
        let mut filter = VelocityFilter::at_rest(0.0);
        let mut time_s = 0.0;
        for period_s in [0.01, 0.02, 0.01, 0.005, 0.03] {
            time_s += period_s;
            let velocity = filter.update(2.0 * time_s, &FilterGains::new(50.0, period_s));
            assert!((velocity - 2.0 * (1.0 - (-50.0 * time_s).exp())).abs() < 1e-12);
        }
    }
}
