use rand::{RngExt as _, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::qube::START_REACH_RAD;

/// Kind of the random streams of start angles, in the highest 8 bits of a stream's number. A
/// session draws from streams of other kinds under the same seed.
pub(crate) const START_STREAMS: u64 = 1;

/// The start angle of the arm in a rollout, rad: drawn from the same range as in training, and the
/// same for each attempt at the rollout.
pub(super) fn start_theta_rad(seed: u64, candidate: u32, rollout: u32) -> f64 {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let rollout = u64::from(rollout & 0xffff);
    random.set_stream(START_STREAMS << 56 | u64::from(candidate) << 32 | rollout << 16);
    random.random_range(-START_REACH_RAD..START_REACH_RAD)
}
