use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

/// The use of a stream of random numbers. Each use has its own stream, so that results do not
/// depend on the order in which threads draw.
#[derive(Clone, Copy, Debug)]
pub(super) enum Stream {
    /// Initial weights of the networks.
    Weights,
    /// Order of the transitions in the minibatches of one update.
    Shuffle { update: u32 },
    /// One trajectory: its start and Qube, or, with `noise`, the exploration noise on its actions.
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

#[cfg(test)]
mod tests {
    use rand::RngExt;

    use super::*;

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
