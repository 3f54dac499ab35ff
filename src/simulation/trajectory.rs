use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::DomainDistribution;
use crate::qube::{QubeModel, START_REACH_RAD, State};

/// The random part of one trajectory: its Qube and its start.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Trajectory {
    /// The Qube: domain parameters xi and nonidealities.
    pub model: QubeModel,
    /// State at step 0, rad and rad/s.
    pub start: State,
}

impl Trajectory {
    /// Draws the trajectory that has this number under this seed. Each trajectory has its own
    /// random stream, so that it does not depend on earlier draws or on the number of threads.
    #[must_use]
    pub fn draw(distribution: &DomainDistribution, seed: u64, number: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(number);
        let mut angle = || START_REACH_RAD * (2.0 * rng.random::<f64>() - 1.0);
        let start = State { theta: angle(), alpha: angle(), ..State::default() };
        Self { model: distribution.sample(&mut rng), start }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulation::Family;

    #[test]
    fn a_trajectory_depends_on_its_seed_and_number_alone() {
        let distribution = DomainDistribution::handcrafted(Family::Normal);
        let draw = |seed, number| Trajectory::draw(&distribution, seed, number);
        assert_eq!(draw(1, 5), draw(1, 5));
        assert_ne!(draw(1, 5), draw(1, 6));
        assert_ne!(draw(1, 5), draw(2, 5));
    }

    #[test]
    fn start_is_the_same_under_every_distribution_and_fills_its_range() {
        let (mut lowest, mut highest) = (f64::MAX, f64::MIN);
        for number in 0..1000 {
            let nominal = Trajectory::draw(&DomainDistribution::nominal(), 9, number);
            let other =
                Trajectory::draw(&DomainDistribution::handcrafted(Family::Normal), 9, number);
            assert_eq!(nominal.start, other.start);
            assert_eq!((nominal.start.theta_dot, nominal.start.alpha_dot), (0.0, 0.0));
            for angle in [nominal.start.theta, nominal.start.alpha] {
                lowest = lowest.min(angle);
                highest = highest.max(angle);
            }
        }
        assert!((-0.1..-0.099).contains(&lowest) && (0.099..0.1).contains(&highest));
    }
}
