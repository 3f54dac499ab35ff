use std::f64::consts::PI;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::elementary::Scalar;

/// Encoder counts in one revolution of a Qube, on both axes: 512 lines, four edges each.
pub const COUNTS_PER_REVOLUTION: i32 = 2048;

/// The angle of one count of a Qube in rad.
pub const RAD_PER_COUNT: f64 = 2.0 * PI / COUNTS_PER_REVOLUTION as f64;

/// The resolution of an incremental encoder, in counts a revolution.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "i32", into = "i32")]
pub struct Encoder {
    counts_per_revolution: i32,
}

/// The encoders of arm and pendulum.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Encoders {
    /// Encoder of the arm.
    #[serde(rename = "theta_counts_per_revolution")]
    pub theta: Encoder,
    /// Encoder of the pendulum.
    #[serde(rename = "alpha_counts_per_revolution")]
    pub alpha: Encoder,
}

/// The quantiser of an encoder, which rounds angles down to its counts, in any number type.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Quantiser<T = f64> {
    counts_per_rad: T,
    rad_per_count: T,
}

impl Encoder {
    /// The encoder of a Qube, the same on both axes.
    pub const QUBE: Self = Self { counts_per_revolution: COUNTS_PER_REVOLUTION };

    /// Fewest counts a revolution: 250 lines, four edges each. At this limit one count in a control
    /// period of 10 ms is 0.6 rad/s; the watches of the sensors would report healthy encoders that
    /// are coarser as frozen.
    const FEWEST: i32 = 1000;

    /// Most counts a revolution. With more, the 32-bit count of a pendulum that spins could
    /// overflow within a session: at this limit the count holds 2048 turns.
    const MOST: i32 = 1 << 20;

    /// Counts in one revolution.
    #[must_use]
    pub fn counts_per_revolution(self) -> i32 {
        self.counts_per_revolution
    }

    /// The angle of one count, rad.
    #[must_use]
    pub fn rad_per_count(self) -> f64 {
        2.0 * PI / f64::from(self.counts_per_revolution)
    }

    /// Counts of this encoder for each count of a Qube's encoder.
    #[must_use]
    pub fn counts_per_qube_count(self) -> f64 {
        f64::from(self.counts_per_revolution) / f64::from(COUNTS_PER_REVOLUTION)
    }

    /// The smallest number of counts of this encoder that covers the angle of `qube_counts` counts
    /// of a Qube's encoder.
    #[must_use]
    pub fn covering_qube_counts(self, qube_counts: f64) -> i32 {
        (qube_counts * self.counts_per_qube_count()).ceil() as i32
    }

    /// The count at an angle: the index of the last edge passed, rounded towards minus infinity.
    #[must_use]
    pub fn counts(self, angle_rad: f64) -> i32 {
        (angle_rad / self.rad_per_count()).floor() as i32
    }

    /// The angle of a count's edge, rad.
    #[must_use]
    pub fn angle_rad(self, counts: i32) -> f64 {
        f64::from(counts) * self.rad_per_count()
    }

    /// The quantiser that rounds angles to the counts of this encoder.
    #[must_use]
    pub fn quantiser<T: Scalar>(self) -> Quantiser<T> {
        let rad_per_count = self.rad_per_count();
        Quantiser {
            counts_per_rad: T::from_f64(1.0 / rad_per_count),
            rad_per_count: T::from_f64(rad_per_count),
        }
    }
}

/// The error for a resolution that no encoder of a plant may have.
#[derive(Clone, Copy, Debug, Error, PartialEq, Eq)]
#[error(
    "{counts_per_revolution} counts a revolution: give a number from {fewest} to {most}",
    fewest = Encoder::FEWEST, most = Encoder::MOST
)]
pub struct UnfitResolution {
    /// Number of counts in one revolution that was given.
    pub counts_per_revolution: i32,
}

impl TryFrom<i32> for Encoder {
    type Error = UnfitResolution;

    fn try_from(counts_per_revolution: i32) -> Result<Self, UnfitResolution> {
        if (Self::FEWEST..=Self::MOST).contains(&counts_per_revolution) {
            Ok(Self { counts_per_revolution })
        } else {
            Err(UnfitResolution { counts_per_revolution })
        }
    }
}

impl From<Encoder> for i32 {
    fn from(encoder: Encoder) -> Self {
        encoder.counts_per_revolution
    }
}

impl Encoders {
    /// The encoders of a Qube.
    pub const QUBE: Self = Self { theta: Encoder::QUBE, alpha: Encoder::QUBE };

    /// Returns whether both encoders have the resolution of a Qube's.
    #[must_use]
    pub fn are_qube(&self) -> bool {
        *self == Self::QUBE
    }
}

impl Default for Encoders {
    fn default() -> Self {
        Self::QUBE
    }
}

impl<T: Scalar> Quantiser<T> {
    /// The angle rounded down to its count, rad.
    #[must_use]
    #[inline(always)]
    pub fn quantised(&self, angle_rad: T) -> T {
        (angle_rad * self.counts_per_rad).floor() * self.rad_per_count
    }
}

/// The count of a Qube's encoder at an angle: the index of the last edge passed, rounded towards
/// minus infinity.
#[must_use]
pub fn counts(angle_rad: f64) -> i32 {
    Encoder::QUBE.counts(angle_rad)
}

/// Rounds an angle, rad, down to the angle of its count ([`counts`]) on a Qube's encoder, in any
/// number type.
#[must_use]
#[inline(always)]
pub fn quantised<T: Scalar>(angle_rad: T) -> T {
    (angle_rad * T::from_f64(1.0 / RAD_PER_COUNT)).floor() * T::from_f64(RAD_PER_COUNT)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_count_covers_the_angles_from_its_edge_to_the_next() {
        for encoder in [Encoder::QUBE, Encoder { counts_per_revolution: 5000 }] {
            let rad_per_count = encoder.rad_per_count();
            for count in [-3000, -1, 0, 1, 2048] {
                let edge = encoder.angle_rad(count);
                assert_eq!(encoder.counts(edge + 0.1 * rad_per_count), count);
                assert_eq!(encoder.counts(edge + 0.9 * rad_per_count), count);
            }
        }
        assert_eq!(Encoder::QUBE.rad_per_count(), RAD_PER_COUNT);
    }

    #[test]
    fn a_quantised_angle_is_the_angle_of_its_count() {
        for encoder in [Encoder::QUBE, Encoder { counts_per_revolution: 5000 }] {
            let (double, single) = (encoder.quantiser::<f64>(), encoder.quantiser::<f32>());
            for step in -10_000..10_000 {
                let angle = f64::from(step) * 1.234e-3;
                let of_count = encoder.angle_rad(encoder.counts(angle));
                assert!((double.quantised(angle) - of_count).abs() < 1e-12);
                let single = f64::from(single.quantised(angle as f32));
                let off_counts = (single - angle).abs() / encoder.rad_per_count();
                assert!(off_counts < 1.01, "{angle} became {single}");
                if encoder == Encoder::QUBE {
                    assert_eq!(double.quantised(angle), quantised(angle));
                }
            }
        }
    }

    #[test]
    fn a_resolution_that_no_encoder_has_is_refused() {
        for (counts, words) in [(0, "from 1000"), (-2048, "from 1000"), (1 << 21, "to 1048576")] {
            let refused = Encoder::try_from(counts).unwrap_err();
            assert!(refused.to_string().contains(words), "{refused}");
        }
        assert_eq!(Encoder::try_from(COUNTS_PER_REVOLUTION), Ok(Encoder::QUBE));
    }
}
