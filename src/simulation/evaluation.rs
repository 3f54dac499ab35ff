use super::{DomainDistribution, Pendulums, Progress, SimulationSettings, Trajectory};
use crate::qube::{MAX_STEPS, OBSERVATION_SIZE};

/// Starts of an evaluation during training.
pub const DEFAULT_STARTS: usize = 100;

/// Whatever chooses voltages for many pendulums at once.
pub trait Actor {
    /// Voltages in V for `observations`, `[6][lanes]`; `voltages_v` has `lanes` entries, a multiple
    /// of [`super::LANES_MULTIPLE`].
    fn act(&mut self, observations: &[f32], voltages_v: &mut [f32]);
}

impl<F: FnMut(&[f32], &mut [f32])> Actor for F {
    fn act(&mut self, observations: &[f32], voltages_v: &mut [f32]) {
        self(observations, voltages_v);
    }
}

/// What came of an evaluation, one entry for each trajectory.
#[derive(Clone, Debug, PartialEq)]
pub struct Evaluation {
    /// Sums of rewards.
    pub returns: Vec<f64>,
    /// Steps taken; fewer than 600 when the safety box was left.
    pub steps: Vec<u32>,
}

impl Evaluation {
    /// The mean return.
    #[must_use]
    pub fn mean_return(&self) -> f64 {
        self.returns.iter().sum::<f64>() / self.returns.len() as f64
    }

    /// The standard deviation of the returns.
    #[must_use]
    pub fn return_standard_deviation(&self) -> f64 {
        let mean = self.mean_return();
        let squares: f64 = self.returns.iter().map(|r| (r - mean) * (r - mean)).sum();
        (squares / self.returns.len() as f64).sqrt()
    }
}

/// Runs an actor through the trajectories 0 to `starts` - 1 of a seed, each to its end, and adds up
/// what they earn. The same seed gives the same plants and starts to every actor.
pub fn evaluate(
    actor: &mut impl Actor,
    distribution: &DomainDistribution,
    settings: &SimulationSettings,
    seed: u64,
    starts: usize,
) -> Evaluation {
    let mut pendulums = Pendulums::new(starts, settings);
    for lane in 0..starts {
        pendulums.restart(lane, &Trajectory::draw(distribution, seed, lane as u64));
    }
    let lanes = pendulums.lanes();
    let mut observations = vec![0.0; OBSERVATION_SIZE * lanes];
    let mut voltages_v = vec![0.0; lanes];
    let mut rewards = vec![0.0; lanes];
    let mut progress = vec![Progress::Running; lanes];
    let mut evaluation = Evaluation { returns: vec![0.0; starts], steps: vec![0; starts] };
    let mut running = vec![true; starts];
    pendulums.observe(&mut observations);
    for _ in 0..MAX_STEPS {
        actor.act(&observations, &mut voltages_v);
        pendulums.step(&voltages_v, &mut rewards, &mut progress, &mut observations);
        for lane in 0..starts {
            if running[lane] {
                evaluation.returns[lane] += f64::from(rewards[lane]);
                evaluation.steps[lane] += 1;
                running[lane] = progress[lane] == Progress::Running;
            }
        }
        if !running.contains(&true) {
            break;
        }
    }
    evaluation
}
