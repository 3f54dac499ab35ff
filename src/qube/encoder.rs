use std::f64::consts::PI;

use crate::elementary::Scalar;

/// Encoder counts in one revolution, on both axes: 512 lines, four edges each.
pub const COUNTS_PER_REVOLUTION: i32 = 2048;

/// The angle of one count in rad.
pub const RAD_PER_COUNT: f64 = 2.0 * PI / COUNTS_PER_REVOLUTION as f64;

/// The encoder's count at an angle: the index of the last edge passed, rounded towards minus infinity.
#[must_use]
pub fn counts(angle_rad: f64) -> i32 {
    (angle_rad / RAD_PER_COUNT).floor() as i32
}

/// The angle of a count's edge, in rad.
#[must_use]
pub fn angle_rad(counts: i32) -> f64 {
    f64::from(counts) * RAD_PER_COUNT
}

/// An angle rounded down to its encoder count, in rad: [`angle_rad`] of [`counts`], for any number type.
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
        for count in [-3000, -1, 0, 1, 2048] {
            let edge = angle_rad(count);
            assert_eq!(counts(edge + 0.1 * RAD_PER_COUNT), count);
            assert_eq!(counts(edge + 0.9 * RAD_PER_COUNT), count);
        }
    }

    #[test]
    fn a_quantised_angle_is_the_angle_of_its_count() {
        for step in -10_000..10_000 {
            let angle = f64::from(step) * 1.234e-3;
            assert!((quantised(angle) - angle_rad(counts(angle))).abs() < 1e-12);
            let single = f64::from(quantised(angle as f32));
            assert!((single - angle).abs() < 1.01 * RAD_PER_COUNT, "{angle} became {single}");
        }
    }
}
