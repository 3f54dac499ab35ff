use std::f64::consts::PI;

/// Counts of one revolution, on both axes: 512 lines, four edges each.
pub const COUNTS_PER_REVOLUTION: i32 = 2048;

/// The angle of one count in rad.
pub const RAD_PER_COUNT: f64 = 2.0 * PI / COUNTS_PER_REVOLUTION as f64;

/// What the encoder reads at an angle: the last edge passed, rounded towards minus infinity.
#[must_use]
pub fn counts(angle_rad: f64) -> i32 {
    (angle_rad / RAD_PER_COUNT).floor() as i32
}

/// The angle that stands for a count, in rad.
#[must_use]
pub fn angle_rad(counts: i32) -> f64 {
    f64::from(counts) * RAD_PER_COUNT
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
}
