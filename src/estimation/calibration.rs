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
        let off_counts = nearest_counts(self.encoders.theta, theta_rad, self.theta_inverted);
        self.theta_zero_counts.wrapping_add(off_counts)
    }

    /// The pendulum encoder's count that is nearest to an angle, rad.
    #[must_use]
    pub fn alpha_counts_at(&self, alpha_rad: f64) -> i32 {
        let off_counts = nearest_counts(self.encoders.alpha, alpha_rad, self.alpha_inverted);
        self.alpha_zero_counts.wrapping_add(off_counts)
    }

    /// This calibration with the zeros from which the arm is `off_theta_rad` and the pendulum
    /// `off_alpha_rad` away in this measurement, rad.
    #[must_use]
    pub fn with_zeros_behind(
        &self,
        measurement: &Measurement,
        off_theta_rad: f64,
        off_alpha_rad: f64,
    ) -> Self {
        let Encoders { theta, alpha } = self.encoders;
        let theta_counts = nearest_counts(theta, off_theta_rad, self.theta_inverted);
        let alpha_counts = nearest_counts(alpha, off_alpha_rad, self.alpha_inverted);
        Self {
            theta_zero_counts: measurement.theta_counts.wrapping_sub(theta_counts),
            alpha_zero_counts: measurement.alpha_counts.wrapping_sub(alpha_counts),
            ..*self
        }
    }

    /// This calibration with the pendulum's zero moved by whole turns, positive towards positive
    /// alpha.
    #[must_use]
    pub fn with_alpha_zero_turned(&self, turns: i32) -> Self {
        let turns_counts = turns * self.encoders.alpha.counts_per_revolution();
        let moved_counts = if self.alpha_inverted { -turns_counts } else { turns_counts };
        Self { alpha_zero_counts: self.alpha_zero_counts.wrapping_add(moved_counts), ..*self }
    }

    /// The motor's current, A, whose positive sign turns the arm towards positive theta.
    #[must_use]
    pub fn current_a(&self, measurement: &Measurement) -> f32 {
        if self.voltage_inverted { -measurement.current_a } else { measurement.current_a }
    }

    /// The voltage to send to the device, mV, for a voltage whose positive sign turns the arm
    /// towards positive theta.
    #[must_use]
    pub fn device_mv(&self, voltage_mv: i16) -> i16 {
        if self.voltage_inverted { voltage_mv.saturating_neg() } else { voltage_mv }
    }
}

/// The counts by which an encoder changes while it turns by an angle, rad, rounded to the nearest
/// count; `inverted` if it counts down while the angle grows.
fn nearest_counts(encoder: Encoder, angle_rad: f64, inverted: bool) -> i32 {
    let counts = (angle_rad / encoder.rad_per_count()).round() as i32;
    if inverted { -counts } else { counts }
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

    /// Calibrations with zeros other than 0, without inverted signs and with all of them.
    fn either_way_round() -> [Calibration; 2] {
        [false, true].map(|inverted| Calibration {
            theta_zero_counts: 700,
            alpha_zero_counts: -300,
            theta_inverted: inverted,
            alpha_inverted: inverted,
            voltage_inverted: inverted,
            ..Calibration::IDENTITY
        })
    }

    #[test]
    fn counts_and_angles_agree_either_way_round() {
        let is_near = |a_rad: f64, b_rad: f64| (a_rad - b_rad).abs() <= 0.5 * RAD_PER_COUNT + 1e-12;
        for calibration in either_way_round() {
            for (theta_rad, alpha_rad) in [(-1.0, 0.7), (0.0, 0.0), (0.3, -4.0)] {
                let measurement = Measurement {
                    theta_counts: calibration.theta_counts_at(theta_rad),
                    alpha_counts: calibration.alpha_counts_at(alpha_rad),
                    ..Measurement::default()
                };
                let (theta, alpha) = calibration.angles_rad(&measurement);
                assert!(is_near(theta, theta_rad) && is_near(alpha, alpha_rad));
                // The same zeros follow from the measurement and the angles.
                let signs =
                    Calibration { theta_zero_counts: 0, alpha_zero_counts: 0, ..calibration };
                let found = signs.with_zeros_behind(&measurement, theta_rad, alpha_rad);
                assert_eq!(found, calibration);
            }
        }
    }

    #[test]
    fn a_turned_zero_takes_whole_turns_from_alpha_and_the_current_has_the_voltages_sign() {
        for calibration in either_way_round() {
            let measurement =
                Measurement { alpha_counts: 5000, current_a: 0.1, ..Measurement::default() };
            let turned = calibration.with_alpha_zero_turned(2);
            let before_rad = calibration.angles_rad(&measurement).1;
            let after_rad = turned.angles_rad(&measurement).1;
            assert!((before_rad - after_rad - 4.0 * std::f64::consts::PI).abs() < 1e-12);
            let is_positive = calibration.current_a(&measurement) > 0.0;
            assert_eq!(is_positive, calibration.device_mv(1000) > 0);
        }
    }
}
