use nalgebra::DVector;
use rand::RngExt as _;

use super::belief::RivalBelief;
use super::gaussian::standard_normal;
use super::rival::{Data, POINTS, Rival, RivalInput};
use super::scored::scored;
use super::simulator::{Demonstration, simulate};
use super::space::distribution_of;
use crate::learning::{StagedTraining, TrainError, Trained};
use crate::policy::Network;
use crate::search::{BayRn, BayRnSettings, Observation};

/// Number of stages of the training, each in a distribution of its own.
const STAGES: u32 = 12;

/// Number of first stages whose distribution is drawn at random.
const RANDOM_STAGES: u32 = 3;

/// Number of distributions among which the next one is chosen.
const CHOICES: usize = 300;

/// Lower ends of psi: the logarithm of the width relative to the prior, and the shifts along three
/// random directions.
const LOWER: [f64; 4] = [-1.5, -1.0, -1.0, -1.0];
/// Upper ends of psi.
const UPPER: [f64; 4] = [0.4, 1.0, 1.0, 1.0];

/// Number of entries of a policy's fingerprint.
const FINGERPRINT: usize = 4;
/// Range of each entry of a fingerprint.
const FINGERPRINT_RANGE: [f64; 2] = [-2.0, 2.0];

/// Fingerprint policy optimisation (Paul, Osborne and Whiteson 2019, reference 21 of the thesis):
/// chooses for each stage of a training, except the first `RANDOM_STAGES`, the distribution with
/// the highest upper confidence bound of the return after the stage. Bayesian optimisation predicts
/// the return from the distribution and from the fingerprint of the policy before the stage. The
/// policy with the highest return after any stage is kept.
pub struct FingerprintOptimisation {
    /// Weight of the standard deviation in the upper confidence bound.
    pub beta: f64,
}

impl Rival for FingerprintOptimisation {
    fn data(&self) -> Data {
        Data::None
    }

    fn update(&self, given: &RivalInput) -> Result<RivalBelief, TrainError> {
        Ok(given.before.clone())
    }

    fn trained(&self, given: &RivalInput) -> Result<Option<Trained>, TrainError> {
        let mut random = given.random();
        let dimensions = given.space.dimensions();
        // Three directions, fixed for the whole training, in which all quantities may shift
        // together, in standard deviations of the prior.
        let directions: Vec<DVector<f64>> =
            (0..3).map(|_| standard_normal(dimensions, &mut random)).collect();
        let scoring_points = given.space.draws(POINTS, &mut random);
        let settings = given.training_on_one_thread();
        let mut training = StagedTraining::new(&settings, STAGES, given.seed)?;
        let mut data: Vec<Observation> = Vec::new();
        // The policy before the first stage has the fingerprint 0.
        let mut fingerprint_before = [0.0; FINGERPRINT];
        let mut best: Option<(f64, Trained)> = None;
        for stage in 0..STAGES {
            let mut random_psi = || -> Vec<f64> {
                LOWER
                    .iter()
                    .zip(UPPER)
                    .map(|(lower, upper)| random.random_range(*lower..upper))
                    .collect()
            };
            let choices: Vec<Vec<f64>> = (0..CHOICES).map(|_| random_psi()).collect();
            let psi = match stage < RANDOM_STAGES {
                true => choices[0].clone(),
                false => self.highest_ucb(&data, &choices, &fingerprint_before, given.seed),
            };
            let mut shift = DVector::zeros(dimensions);
            for (direction, by) in directions.iter().zip(&psi[1..]) {
                shift += *by * direction;
            }
            let points = given.space.draws_within(POINTS, || {
                psi[0].exp() * standard_normal(dimensions, &mut random) + &shift
            });
            let Some(distribution) = distribution_of(given.space, &points) else { break };
            let trained = training.train_stage(distribution, given.stop)?;
            let network = &trained.network;
            let (_, scores) =
                scored(network, given.training, given.space, &scoring_points, given.seed);
            let mean_return = scores.iter().sum::<f64>() / scores.len().max(1) as f64;
            data.push(Observation {
                point: [&psi[..], &fingerprint_before].concat(),
                returns: vec![mean_return],
            });
            fingerprint_before = fingerprint(network, given, &scoring_points[..32]);
            if best.as_ref().is_none_or(|(most, _)| mean_return > *most) {
                best = Some((mean_return, trained));
            }
        }
        Ok(best.map(|(_, trained)| trained))
    }
}

impl FingerprintOptimisation {
    /// The choice with the highest upper confidence bound of the return after the next stage, for a
    /// policy with this fingerprint; the first choice where the data cannot be fitted.
    fn highest_ucb(
        &self,
        data: &[Observation],
        choices: &[Vec<f64>],
        fingerprint: &[f64],
        seed: u64,
    ) -> Vec<f64> {
        let [least, most] = FINGERPRINT_RANGE;
        let lower = [&LOWER[..], &[least; FINGERPRINT]].concat();
        let upper = [&UPPER[..], &[most; FINGERPRINT]].concat();
        let settings = BayRnSettings { initial_points: 1, ..BayRnSettings::default() };
        let process =
            BayRn::between(&lower, &upper, settings, seed).and_then(|it| it.surrogate(data));
        let Ok(process) = process else { return choices[0].clone() };
        let bound = |psi: &Vec<f64>| {
            let posterior = process.posterior(&[&psi[..], fingerprint].concat());
            posterior.mean + self.beta * posterior.deviation()
        };
        let bounds = choices.iter().map(|psi| (bound(psi), psi));
        bounds
            .max_by(|a, b| a.0.total_cmp(&b.0))
            .map_or_else(|| choices[0].clone(), |it| it.1.clone())
    }
}

/// The fingerprint of a policy, numbers that tell policies apart by their behaviour: mean and
/// standard deviation of the voltage (as a fraction of 5 V), mean height of the pendulum (from -1
/// hanging to 1 upright), and standard deviation of the arm's angle (rad), over the Qubes of
/// `points`.
fn fingerprint(
    network: &Network,
    given: &RivalInput,
    points: &[DVector<f64>],
) -> [f64; FINGERPRINT] {
    let models: Vec<_> = points.iter().map(|point| given.space.model(point)).collect();
    let demonstration = Demonstration::of_policy(network, &given.simulation.plant, 0.05);
    let motions = simulate(&demonstration, given.simulation, &models);
    let moments = |values: &mut dyn Iterator<Item = f64>| {
        let (mut count, mut sum, mut squares) = (0.0, 0.0, 0.0);
        for value in values.map(|it| if it.is_finite() { it.clamp(-10.0, 10.0) } else { 0.0 }) {
            count += 1.0;
            sum += value;
            squares += value * value;
        }
        let mean = sum / f64::max(count, 1.0);
        [mean, (squares / f64::max(count, 1.0) - mean * mean).max(0.0).sqrt()]
    };
    let states = || motions.iter().flat_map(|motion| &motion.states);
    let voltages =
        &mut motions.iter().flat_map(|it| &it.voltages_v).map(|it| it.clamp(-5.0, 5.0) / 5.0);
    let [mean_v, deviation_v] = moments(voltages);
    let [height, _] = moments(&mut states().map(|state| -state.alpha.cos()));
    let [_, travel] = moments(&mut states().map(|state| state.theta));
    let [least, most] = FINGERPRINT_RANGE;
    [mean_v, deviation_v, height, travel].map(|it| it.clamp(least, most))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The return after a stage is highest at a width that depends on the policy's fingerprint; the
    /// choice must follow the fingerprint.
    #[test]
    fn the_choice_follows_a_known_optimum_that_depends_on_the_policy() {
        let value = |width: f64, fingerprint: f64| 1.0 - (width - 0.5 * fingerprint).powi(2);
        let mut data = Vec::new();
        for step in 0..36 {
            let width = -1.4 + 1.7 * f64::from(step % 6) / 5.0;
            let fingerprint = -2.0 + 4.0 * f64::from(step / 6) / 5.0;
            let point = vec![width, 0.0, 0.0, 0.0, fingerprint, 0.0, 0.0, 0.0];
            data.push(Observation { point, returns: vec![value(width, fingerprint)] });
        }
        let choices: Vec<Vec<f64>> =
            (0..40).map(|it| vec![-1.45 + 0.045 * f64::from(it), 0.0, 0.0, 0.0]).collect();
        let rival = FingerprintOptimisation { beta: 2.0 };
        for fingerprint in [-1.6, -0.6, 0.4] {
            let chosen = rival.highest_ucb(&data, &choices, &[fingerprint, 0.0, 0.0, 0.0], 1);
            assert!((chosen[0] - 0.5 * fingerprint).abs() < 0.3, "{fingerprint}: {chosen:?}");
        }
    }
}
