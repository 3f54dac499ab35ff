use serde::{Deserialize, Serialize};

use crate::qube::{Encoder, Encoders, Measurement};

/// Conversion of one rig's encoder counts to angles, and of voltages to the device's sign. Signs
/// differ between rigs; zeros change from day to day.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Calibration {
    /// Count of the arm's encoder at theta 0, the middle between the stops.
    pub theta_zero_counts: i32,
    /// Count of the pendulum's encoder at alpha 0: the count while the pendulum hangs, or a count
    /// that is whole turns away from it.
    pub alpha_zero_counts: i32,
    /// True if the arm's encoder counts down while theta grows.
    pub theta_inverted: bool,
    /// True if the pendulum's encoder counts down while alpha grows.
    pub alpha_inverted: bool,
    /// True if a positive voltage of the device turns the arm towards negative theta.
    pub voltage_inverted: bool,
    /// Resolution of the encoders; a file without this entry means a Qube's encoders.
    #[serde(default, skip_serializing_if = "Encoders::are_qube")]
    pub encoders: Encoders,
}

impl Calibration {
    /// The calibration without inverted signs and with both zeros at count 0.
    pub const IDENTITY: Self = Self {
        theta_zero_counts: 0,
        alpha_zero_counts: 0,
        theta_inverted: false,
        alpha_inverted: false,
        voltage_inverted: false,
        encoders: Encoders::QUBE,
    };

    /// Theta and alpha of a measurement, rad. The subtraction of counts wraps, so a counter that
    /// overflows does no harm.
    #[must_use]
    pub fn angles_rad(&self, measurement: &Measurement) -> (f64, f64) {
        let Encoders { theta, alpha } = self.encoders;
        let angle = |encoder: Encoder, counts: i32, zero: i32, inverted: bool| {
            let angle = encoder.angle_rad(counts.wrapping_sub(zero));
            if inverted { -angle } else { angle }
        };
        (
            angle(theta, measurement.theta_counts, self.theta_zero_counts, self.theta_inverted),
            angle(alpha, measurement.alpha_counts, self.alpha_zero_counts, self.alpha_inverted),
        )
    }

    /// The arm's velocity by the device's tachometer, rad/s.
    #[must_use]
    pub fn tachometer_rad_s(&self, measurement: &Measurement) -> f64 {
        let rad_per_count = self.encoders.theta.rad_per_count();
        let rad_per_count = if self.theta_inverted { -rad_per_count } else { rad_per_count };
        f64::from(measurement.tachometer_counts_s) * rad_per_count
    }

    /// The arm encoder's count that is nearest to an angle, rad.
    #[must_use]
    pub fn theta_counts_at(&self, theta_rad: f64) -> i32 {
        let off_counts = (theta_rad / self.encoders.theta.rad_per_count()).round() as i32;
        self.theta_zero_counts.wrapping_add(if self.theta_inverted {
            -off_counts
        } else {
            off_counts
        })
    }

    /// The voltage to send to the device, mV, for a voltage whose positive sign turns the arm
    /// towards positive theta.
    #[must_use]
    pub fn device_mv(&self, voltage_mv: i16) -> i16 {
        if self.voltage_inverted { voltage_mv.saturating_neg() } else { voltage_mv }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::{PlantModel, RAD_PER_COUNT};

    #[test]
    fn the_tachometer_agrees_with_the_angles_of_any_encoder_either_way_round() {
        let furuta = PlantModel::parse(include_str!("../../plants/furuta-130.toml")).unwrap();
        for (theta_inverted, encoders) in
            [false, true].into_iter().flat_map(|it| [(it, Encoders::QUBE), (it, furuta.encoders)])
        {
            let calibration = Calibration { theta_inverted, encoders, ..Calibration::IDENTITY };
            // The arm moves by 500 counts within a second.
            let sample = |theta_counts| Measurement {
                theta_counts,
                tachometer_counts_s: 500,
                ..Measurement::default()
            };
            let (before, now) = (sample(700), sample(1200));
            let moved_rad = calibration.angles_rad(&now).0 - calibration.angles_rad(&before).0;
            assert!((calibration.tachometer_rad_s(&now) - moved_rad).abs() < 1e-12);
        }
    }

    #[test]
    fn counts_and_angles_of_the_arm_agree_either_way_round() {
        for theta_inverted in [false, true] {
            let calibration =
                Calibration { theta_zero_counts: 700, theta_inverted, ..Calibration::IDENTITY };
            for theta_rad in [-1.0, 0.0, 0.3] {
                let measurement = Measurement {
                    theta_counts: calibration.theta_counts_at(theta_rad),
                    ..Measurement::default()
                };
                let (back_rad, _) = calibration.angles_rad(&measurement);
                assert!((back_rad - theta_rad).abs() <= 0.5 * RAD_PER_COUNT + 1e-12);
            }
        }
    }
}
