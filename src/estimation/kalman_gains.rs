use crate::elementary::Scalar;
use crate::qube::Encoder;

/// Steady-state Kalman gains of one axis: the correction of angle and velocity for each rad of
/// prediction error.
///
/// The axis is modelled as angle and velocity, driven by an unmodelled acceleration that is
/// constant over one interval T and white from interval to interval with standard deviation
/// `sigma_a`. The angle's noise is an encoder's, uniform over one count: `sigma_r` = (2 pi / counts
/// a revolution) / sqrt(12). The Riccati equation then has a closed solution in the tracking index
/// `Lambda = sigma_a T^2 / sigma_r` (P. R. Kalata, IEEE Trans. AES 20 (1984) 174):
///
/// ```text
/// r = (4 + Lambda - sqrt(8 Lambda + Lambda^2)) / 4
/// angle gain = 1 - r^2,  velocity gain = 2 (1 - r)^2 / T
/// ```
///
/// The prediction uses the full equations of motion and so accounts for the coupling of the axes;
/// the gains neglect it, because they would otherwise change with every angle of the pendulum.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KalmanGains<T = f64> {
    /// Correction of the angle for each rad of prediction error.
    pub angle: T,
    /// Correction of the velocity for each rad of prediction error, 1/s.
    pub velocity: T,
}

impl KalmanGains {
    /// The gains for the angles of this encoder and an unmodelled acceleration of `noise_rad_s2`
    /// (standard deviation) that is constant over intervals of `interval_s`; both numbers are above
    /// 0.
    #[must_use]
    pub fn steady_state(encoder: Encoder, noise_rad_s2: f64, interval_s: f64) -> Self {
        let quantisation_rad = encoder.rad_per_count() / 12.0_f64.sqrt();
        let index = noise_rad_s2 * interval_s * interval_s / quantisation_rad;
        // (4 + index)^2 - (8 index + index^2) = 16: this form of r avoids a difference of large
        // numbers.
        let r = 4.0 / (4.0 + index + (index * (8.0 + index)).sqrt());
        Self { angle: 1.0 - r * r, velocity: 2.0 * (1.0 - r) * (1.0 - r) / interval_s }
    }

    /// Converts the gains to another number type.
    #[must_use]
    pub fn cast<T: Scalar>(self) -> KalmanGains<T> {
        KalmanGains { angle: T::from_f64(self.angle), velocity: T::from_f64(self.velocity) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The gains to which the Riccati recursion converges.
    fn iterated(noise_rad_s2: f64, interval_s: f64) -> (f64, f64) {
        let (t, variance) = (interval_s, noise_rad_s2 * noise_rad_s2);
        let angle_variance = Encoder::QUBE.rad_per_count().powi(2) / 12.0;
        let (mut p11, mut p12, mut p22) = (1.0, 0.0, 1.0);
        let mut gains = (0.0, 0.0);
        for _ in 0..20_000 {
            p11 += 2.0 * t * p12 + t * t * p22 + 0.25 * variance * t.powi(4);
            p12 += t * p22 + 0.5 * variance * t.powi(3);
            p22 += variance * t * t;
            gains = (p11 / (p11 + angle_variance), p12 / (p11 + angle_variance));
            (p22, p12, p11) = (p22 - gains.1 * p12, (1.0 - gains.0) * p12, (1.0 - gains.0) * p11);
        }
        gains
    }

    #[test]
    fn the_riccati_recursion_converges_to_the_closed_form() {
        for noise_rad_s2 in [0.3, 10.0, 300.0] {
            for interval_s in [0.005, 0.01, 0.03] {
                let gains = KalmanGains::steady_state(Encoder::QUBE, noise_rad_s2, interval_s);
                let (angle, velocity) = iterated(noise_rad_s2, interval_s);
                assert!((gains.angle - angle).abs() < 1e-9, "{gains:?} {angle}");
                assert!((gains.velocity / velocity - 1.0).abs() < 1e-9, "{gains:?} {velocity}");
            }
        }
    }

    #[test]
    fn a_small_model_error_gives_small_gains_and_a_large_error_takes_the_measured_angle() {
        let gains = KalmanGains::steady_state(Encoder::QUBE, 1e-3, 0.01);
        assert!(gains.angle < 0.05 && gains.velocity < 0.1, "{gains:?}");
        let gains = KalmanGains::steady_state(Encoder::QUBE, 1e5, 0.01);
        assert!(gains.angle > 0.999 && (gains.velocity - 200.0).abs() < 2.0, "{gains:?}");
    }
}
