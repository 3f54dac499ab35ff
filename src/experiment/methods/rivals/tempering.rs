use nalgebra::DVector;
use rand::RngExt as _;
use rand_chacha::ChaCha8Rng;

use super::gaussian::Gaussian;

/// Smallest effective sample size under a stage's weights, as a share of the particles.
const EFFECTIVE: f64 = 0.5;

/// Factor by which particles approach their mean before a stage adds noise. Shrinkage and noise
/// together keep mean and covariance (Liu and West 2001).
const SHRINKAGE: f64 = 0.95;

/// Largest number of stages; the last stage takes the whole rest of the likelihood.
const STAGES: usize = 40;

/// Particles of the posterior, weighted in stages (tempering). Each stage takes the largest part of
/// the log likelihood that leaves half of the particles effective, draws particles by these
/// weights, and moves each a little. A single stage would leave one particle if the data are
/// informative.
pub fn posterior_particles(
    mut particles: Vec<DVector<f64>>,
    log_likelihood: impl Fn(&DVector<f64>) -> f64,
    within: impl Fn(&mut dyn FnMut() -> DVector<f64>) -> DVector<f64>,
    random: &mut ChaCha8Rng,
) -> Vec<DVector<f64>> {
    let mut taken = 0.0;
    for stage in 0..STAGES {
        let logs: Vec<f64> = particles.iter().map(&log_likelihood).collect();
        let rest = 1.0 - taken;
        let part = if stage + 1 == STAGES { rest } else { effective_part(&logs, rest) };
        let weights = weights_of(&logs, part);
        taken += part;
        let chosen = resampled(&weights, random);
        let moments = Gaussian::of_points(&particles, &weights);
        let around_zero = Gaussian { mean: DVector::zeros(moments.mean.len()), ..moments.clone() };
        let mut noise = around_zero.drawing(random);
        let spread = (1.0 - SHRINKAGE * SHRINKAGE).sqrt();
        particles = chosen
            .into_iter()
            .map(|index| {
                let kept = &moments.mean + SHRINKAGE * (&particles[index] - &moments.mean);
                within(&mut || &kept + spread * noise())
            })
            .collect();
        if taken >= 1.0 {
            break;
        }
    }
    particles
}

/// The largest part of the log likelihood, at most `rest`, that leaves the share [`EFFECTIVE`] of
/// the particles effective.
fn effective_part(logs: &[f64], rest: f64) -> f64 {
    let is_effective = |part: f64| {
        let squares: f64 = weights_of(logs, part).iter().map(|weight| weight * weight).sum();
        1.0 / squares >= EFFECTIVE * logs.len() as f64
    };
    if is_effective(rest) {
        return rest;
    }
    let (mut allowed, mut too_large) = (0.0, rest);
    for _ in 0..50 {
        let middle = 0.5 * (allowed + too_large);
        if is_effective(middle) {
            allowed = middle;
        } else {
            too_large = middle;
        }
    }
    // A stage must take a part above 0, or it would achieve nothing.
    allowed.max(1e-6 * rest)
}

/// Weights that sum to 1, in proportion to the likelihood to the power of `part`.
fn weights_of(logs: &[f64], part: f64) -> Vec<f64> {
    let largest = logs.iter().copied().filter(|it| it.is_finite()).fold(f64::MIN, f64::max);
    let weight = |log: &f64| if log.is_finite() { (part * (log - largest)).exp() } else { 0.0 };
    let total: f64 = logs.iter().map(weight).sum();
    if total <= 0.0 {
        return vec![1.0 / logs.len() as f64; logs.len()];
    }
    logs.iter().map(|log| weight(log) / total).collect()
}

/// Draws as many indices as there are weights, each in proportion to its weight, by one random
/// number (systematic resampling).
fn resampled(weights: &[f64], random: &mut ChaCha8Rng) -> Vec<usize> {
    let offset: f64 = random.random();
    let count = weights.len() as f64;
    let (mut sum, mut index) = (weights.first().copied().unwrap_or_default(), 0);
    (0..weights.len())
        .map(|number| {
            let place = (number as f64 + offset) / count;
            while sum < place && index + 1 < weights.len() {
                index += 1;
                sum += weights[index];
            }
            index
        })
        .collect()
}

/// The logarithm of the density of Student's t distribution with `degrees` degrees of freedom,
/// without its constant, at a difference in standard deviations. Its tails are heavy: one large
/// difference, such as the error of an upright pendulum that falls to the other side, does not
/// outweigh the others.
pub fn log_student(standardised: f64, degrees: f64) -> f64 {
    -0.5 * (degrees + 1.0) * (standardised * standardised / degrees).ln_1p()
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng as _;

    use super::*;

    /// The posterior of a normal mean is known: prior N(0, 1), and 50 data of deviation 0.7 whose
    /// mean is 1.2, in the first coordinate alone.
    #[test]
    fn particles_have_the_moments_of_the_known_posterior() {
        const PARTICLES: usize = 8000;
        let mut random = ChaCha8Rng::seed_from_u64(4);
        let precision = 50.0 / 0.49;
        let log = |point: &DVector<f64>| -0.5 * precision * (point[0] - 1.2).powi(2);
        let prior = Gaussian::standard(3).draws(PARTICLES, &mut random);
        let posterior = posterior_particles(prior, log, |draw| draw(), &mut random);
        let found = Gaussian::of_points(&posterior, &[1.0; PARTICLES]);
        let (mean, variance) = (1.2 * precision / (1.0 + precision), 1.0 / (1.0 + precision));
        assert!((found.mean[0] - mean).abs() < 0.01, "{}", found.mean);
        let part = found.covariance[(0, 0)] / variance;
        assert!((0.9..1.1).contains(&part), "{part}");
        for other in 1..3 {
            assert!(found.mean[other].abs() < 0.06, "{}", found.mean);
            assert!((0.9..1.1).contains(&found.covariance[(other, other)]), "{found:?}");
        }
    }

    #[test]
    fn most_particles_leave_an_impossible_region() {
        let mut random = ChaCha8Rng::seed_from_u64(4);
        let log = |point: &DVector<f64>| if point[0] > 0.0 { 0.0 } else { f64::NAN };
        let prior = Gaussian::standard(1).draws(400, &mut random);
        let posterior = posterior_particles(prior, log, |draw| draw(), &mut random);
        let above = posterior.iter().filter(|point| point[0] > 0.0).count();
        assert!(above > 350, "{above}");
    }
}
