use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// The use of a stream of random numbers. Each use has its own stream, so that results do not depend on the
/// order in which threads draw.
#[derive(Clone, Copy, Debug)]
pub(super) enum Stream {
    /// Initial weights of the networks.
    Weights,
    /// Order of the transitions in the minibatches of one update.
    Shuffle { update: u32 },
    /// One trajectory: its start and Qube, or the noise on its actions.
    Trajectory { update: u32, lane: usize, number: u16, noise: bool },
}

impl Stream {
    /// The stream's number, different for each use.
    pub fn number(self) -> u64 {
        match self {
            Self::Weights => 0,
            Self::Shuffle { update } => 1 << 62 | u64::from(update),
            Self::Trajectory { update, lane, number, noise } => {
                let trajectory = u64::from(update) << 28 | (lane as u64) << 12 | u64::from(number);
                1 << 63 | trajectory << 1 | u64::from(noise)
            }
        }
    }

    /// The generator of this stream.
    pub fn generator(self, seed: u64) -> ChaCha8Rng {
        let mut generator = ChaCha8Rng::seed_from_u64(seed);
        generator.set_stream(self.number());
        generator
    }
}

/// Draws two independent numbers from N(0, 1) by the Box-Muller transform.
pub(super) fn normal_pair(generator: &mut impl Rng) -> [f64; 2] {
    // 1 - [0, 1) excludes zero, whose logarithm is infinite.
    let radius = libm::sqrt(-2.0 * libm::log(1.0 - generator.random::<f64>()));
    let (sin, cos) = libm::sincos(std::f64::consts::TAU * generator.random::<f64>());
    [radius * cos, radius * sin]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normal_draws_have_the_moments_of_the_normal_distribution() {
        let mut generator = Stream::Weights.generator(1);
        let draws: Vec<f64> = (0..50_000).flat_map(|_| normal_pair(&mut generator)).collect();
        let moment = |power| draws.iter().map(|x| f64::powi(*x, power)).sum::<f64>() / 1e5;
        assert!(moment(1).abs() < 0.015, "{}", moment(1));
        assert!((moment(2) - 1.0).abs() < 0.02, "{}", moment(2));
        assert!((moment(4) - 3.0).abs() < 0.15, "{}", moment(4));
    }

    #[test]
    fn streams_differ() {
        let trajectory =
            |update, lane, number, noise| Stream::Trajectory { update, lane, number, noise };
        let streams = [
            Stream::Weights,
            Stream::Shuffle { update: 0 },
            Stream::Shuffle { update: 1 },
            trajectory(0, 0, 0, false),
            trajectory(1, 0, 0, false),
            trajectory(0, 1, 0, false),
            trajectory(0, 0, 1, false),
            trajectory(0, 0, 0, true),
            trajectory(0, 0, 599, false),
            trajectory(0, 1, 0, true),
        ];
        let mut first: Vec<u64> = streams.map(|s| s.generator(5).random()).to_vec();
        first.sort_unstable();
        first.dedup();
        assert_eq!(first.len(), streams.len());
    }
}
