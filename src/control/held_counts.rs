//! Travel of the arm that is no motion.

use crate::qube::PlantModel;

/// Travel within which an arm counts as not moving, counts.
pub(super) const HELD_COUNTS: i32 = 3;

/// Travel within which an arm counts as not moving, rad.
pub fn at_rest_rad(plant: &PlantModel) -> f64 {
    (f64::from(HELD_COUNTS) + 0.5) * plant.encoders.theta.rad_per_count()
}
