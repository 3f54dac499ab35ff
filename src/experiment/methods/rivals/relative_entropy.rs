use nalgebra::DVector;

use super::gaussian::Gaussian;

/// Smallest and largest logarithm of the temperature, relative to the spread of the costs.
const LOG_TEMPERATURES: [f64; 2] = [-9.0, 9.0];

/// Number of steps of the golden section that finds the temperature.
const SECTIONS: usize = 60;

/// Number of halvings by which bisection finds the largest allowed step.
const HALVINGS: usize = 40;

/// The weights of samples by episodic relative entropy policy search (Peters, Mülling and Altün
/// 2010): the weights with the lowest expected cost whose divergence from equal weights is at most
/// `bound` (in nats). The weights sum to 1.
pub fn weights(costs: &[f64], bound: f64) -> Vec<f64> {
    let least = costs.iter().copied().fold(f64::INFINITY, f64::min);
    let count = costs.len() as f64;
    let spread = costs.iter().map(|cost| cost - least).sum::<f64>() / count;
    if spread.is_nan() || spread <= 0.0 {
        return vec![1.0 / count; costs.len()];
    }
    let exponentials =
        |temperature: f64| costs.iter().map(move |cost| (-(cost - least) / temperature).exp());
    // The dual function, which is convex in the temperature; the least cost is left out, because it
    // is a constant.
    let dual = |log_temperature: f64| {
        let temperature = spread * log_temperature.exp();
        temperature * (bound + (exponentials(temperature).sum::<f64>() / count).ln())
    };
    let temperature = spread * golden_section(dual, LOG_TEMPERATURES).exp();
    let total: f64 = exponentials(temperature).sum();
    exponentials(temperature).map(|weight| weight / total).collect()
}

/// The next distribution: the weighted fit to points with costs, or the farthest distribution on
/// the way to this fit whose divergence from `before` is at most `bound`. The fit alone may go
/// farther, because few points have weight.
pub fn bounded_update(
    before: &Gaussian,
    points: &[DVector<f64>],
    costs: &[f64],
    bound: f64,
) -> Gaussian {
    let fitted = Gaussian::of_points(points, &weights(costs, bound));
    let within = |share: f64| before.towards(&fitted, share).divergence_from(before) <= bound;
    if within(1.0) {
        return fitted;
    }
    let (mut allowed, mut too_far) = (0.0, 1.0);
    for _ in 0..HALVINGS {
        let middle = 0.5 * (allowed + too_far);
        if within(middle) {
            allowed = middle;
        } else {
            too_far = middle;
        }
    }
    before.towards(&fitted, allowed)
}

/// The argument at which a function with one minimum is least, by golden section.
fn golden_section(function: impl Fn(f64) -> f64, [mut lower, mut upper]: [f64; 2]) -> f64 {
    const GOLDEN: f64 = 0.618_033_988_749_894_9;
    for _ in 0..SECTIONS {
        let (left, right) = (upper - GOLDEN * (upper - lower), lower + GOLDEN * (upper - lower));
        if function(left) < function(right) {
            upper = right;
        } else {
            lower = left;
        }
    }
    0.5 * (lower + upper)
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng as _;
    use rand_chacha::ChaCha8Rng;

    use super::*;

    #[test]
    fn weights_have_the_divergence_that_is_allowed_and_no_more() {
        let costs: Vec<f64> = (0..200).map(|it| (0.37 * f64::from(it)).sin() + 4.0).collect();
        for bound in [0.1, 0.5, 1.5] {
            let weights = weights(&costs, bound);
            let divergence: f64 =
                weights.iter().map(|weight| weight * (200.0 * weight).max(1e-300).ln()).sum();
            assert!((weights.iter().sum::<f64>() - 1.0).abs() < 1e-9);
            assert!((divergence - bound).abs() < 0.01 * bound, "{divergence} instead of {bound}");
        }
        assert_eq!(weights(&[2.0; 4], 1.0), [0.25; 4]);
    }

    /// The minimum of a quadratic cost is known, and no step may be longer than the bound.
    #[test]
    fn bounded_steps_reach_the_minimum_of_a_quadratic_cost() {
        let bottom = DVector::from_vec(vec![1.5, -2.0, 0.5]);
        let mut random = ChaCha8Rng::seed_from_u64(3);
        let mut gaussian = Gaussian::standard(3);
        for _ in 0..25 {
            let points = gaussian.draws(200, &mut random);
            let costs: Vec<f64> =
                points.iter().map(|point| 7.0 + (point - &bottom).norm_squared()).collect();
            let next = bounded_update(&gaussian, &points, &costs, 0.8);
            assert!(next.divergence_from(&gaussian) <= 0.8 + 1e-9);
            gaussian = next;
        }
        assert!((&gaussian.mean - bottom).norm() < 0.05, "{}", gaussian.mean);
        assert!(gaussian.covariance.trace() < 0.05, "{}", gaussian.covariance);
    }
}
