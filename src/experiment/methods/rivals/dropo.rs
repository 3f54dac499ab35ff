use nalgebra::DVector;

use super::belief::RivalBelief;
use super::evolution::minimise;
use super::gaussian::{Gaussian, standard_normal};
use super::offline_likelihood::log_likelihood;
use super::rival::{Data, Rival, RivalInput};
use super::transitions::{NOISE, Transition};
use crate::learning::TrainError;
use crate::replay::MotionLog;

/// Largest number of transitions in the likelihood.
const TRANSITIONS: usize = 40;

/// Number of pairs of Qubes that are drawn from a distribution to estimate the mean and covariance
/// of each transition's end. The Qubes of a pair lie on opposite sides of the mean, so that the
/// draws have the distribution's mean. There are more pairs than a Qube has coordinates, so that
/// the sample covariance of the Qubes is not singular.
const PAIRS: usize = 16;

/// Range of the logarithms of the standard deviations, relative to the prior's.
const LOG_DEVIATIONS: [f64; 2] = [-4.0, 0.0];

/// DROPO (Tiboni, Arndt and Kyrki 2023): finds the distribution of simulations under which recorded
/// transitions are most likely, without any rollout of a policy.
pub struct Dropo {
    /// Number of evaluations of the likelihood, rounded up to whole generations of CMA-ES.
    pub evaluations: usize,
    /// Factor on the noise of a transition's end.
    pub noise: f64,
}

impl Dropo {
    /// The method with as many evaluations as in a comparison.
    pub fn with_noise(noise: f64) -> Self {
        Self { evaluations: 3000, noise }
    }
}

impl Rival for Dropo {
    fn data(&self) -> Data {
        Data::Excitations
    }

    fn update(&self, given: &RivalInput) -> Result<RivalBelief, TrainError> {
        let logs: Vec<&MotionLog> = given.recorded.iter().map(|it| &it.log).collect();
        let transitions = Transition::of_logs(&logs, TRANSITIONS);
        let real: Vec<[f64; 4]> = transitions.iter().map(|it| it.end).collect();
        let noise = NOISE.map(|it| self.noise * it);
        let dimensions = given.space.dimensions();
        let mut random = given.random();
        // All distributions share the draws, so that the likelihood is a function of the
        // distribution alone.
        let draws: Vec<DVector<f64>> = (0..PAIRS)
            .map(|_| standard_normal(dimensions, &mut random))
            .flat_map(|draw| [draw.clone(), -draw])
            .collect();
        let cost = |point: &DVector<f64>| {
            let (mean, deviation) = parts(point);
            let models: Vec<_> = draws
                .iter()
                .map(|draw| given.space.model(&(&mean + deviation.component_mul(draw))))
                .collect();
            let ends = |transition: &Transition| {
                models.iter().map(|model| transition.predicted(model)).collect::<Vec<_>>()
            };
            let simulated: Vec<Vec<[f64; 4]>> = transitions.iter().map(ends).collect();
            -log_likelihood(&real, &simulated, &noise)
        };
        // The means move within all that can be simulated.
        let (lower, upper) = given.space.ranges();
        let [least, most] = LOG_DEVIATIONS.map(|end| vec![end; dimensions]);
        let (lower, upper) = ([lower, least].concat(), [upper, most].concat());
        Ok(match minimise(&lower, &upper, self.evaluations, given.seed, cost) {
            Ok(found) if !transitions.is_empty() => {
                let (mean, deviation) = parts(&found);
                let variances = deviation.component_mul(&deviation);
                RivalBelief::Gaussian(Gaussian {
                    mean,
                    covariance: nalgebra::DMatrix::from_diagonal(&variances),
                })
            }
            _ => given.before.clone(),
        })
    }
}

/// Means and standard deviations at a point of the search.
fn parts(point: &DVector<f64>) -> (DVector<f64>, DVector<f64>) {
    let half = point.len() / 2;
    (point.rows(0, half).into_owned(), point.rows(half, half).map(f64::exp))
}
