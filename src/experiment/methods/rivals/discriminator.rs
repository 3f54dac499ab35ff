use nalgebra::DVector;

/// Number of steps of the gradient descent.
const STEPS: usize = 300;
/// Rate of the gradient descent.
const RATE: f64 = 0.5;
/// Factor in the loss of half the sum of the squared weights; it keeps the weights small.
const SHRINKAGE: f64 = 0.01;

/// A logistic regression that tells two kinds of feature vectors apart.
pub struct Discriminator {
    centre: DVector<f64>,
    scale: DVector<f64>,
    weight: DVector<f64>,
    bias: f64,
}

impl Discriminator {
    /// Fits the discriminator to feature vectors of both kinds, by gradient descent on the
    /// cross-entropy. Each kind counts half in the loss, however many vectors it has.
    pub fn fit(reference: &[DVector<f64>], other: &[DVector<f64>]) -> Self {
        let length = reference.first().map_or(0, DVector::len);
        let all = || reference.iter().chain(other);
        let count = (reference.len() + other.len()).max(1) as f64;
        let centre = all().fold(DVector::zeros(length), |sum, it| sum + it) / count;
        let squares = all().fold(DVector::zeros(length), |sum: DVector<f64>, it| {
            sum + (it - &centre).map(|entry| entry * entry)
        });
        let scale = squares.map(|it: f64| (it / count).sqrt().max(1e-9));
        let mut own = Self { centre, scale, weight: DVector::zeros(length), bias: 0.0 };
        let kinds = [(reference, 0.0), (other, 1.0)];
        for _ in 0..STEPS {
            let (mut of_weight, mut of_bias) = (SHRINKAGE * &own.weight, 0.0);
            for (features, kind) in kinds {
                for feature in features {
                    let error = own.probability(feature) - kind;
                    let share = 0.5 * error / features.len() as f64;
                    of_weight += share * own.standardised(feature);
                    of_bias += share;
                }
            }
            // The step shrinks with the length of the features, because each entry moves the logit.
            own.weight -= RATE / (1.0 + 0.1 * length as f64) * of_weight;
            own.bias -= RATE * of_bias;
        }
        own
    }

    /// The probability that features are of the kind `other` of [`Discriminator::fit`].
    pub fn probability(&self, features: &DVector<f64>) -> f64 {
        let logit = self.weight.dot(&self.standardised(features)) + self.bias;
        1.0 / (1.0 + (-logit).exp())
    }

    fn standardised(&self, features: &DVector<f64>) -> DVector<f64> {
        (features - &self.centre).component_div(&self.scale).map(|it: f64| it.clamp(-5.0, 5.0))
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng as _;
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::experiment::methods::rivals::gaussian::Gaussian;

    /// Two normal distributions with deviation 1 around -1 and 1 have the log odds 2x.
    #[test]
    fn the_odds_of_two_normal_distributions_match_their_formula() {
        let mut random = ChaCha8Rng::seed_from_u64(9);
        let mut around = |mean: f64| -> Vec<DVector<f64>> {
            Gaussian::standard(1)
                .draws(3000, &mut random)
                .iter()
                .map(|it| it.add_scalar(mean))
                .collect()
        };
        let discriminator = Discriminator::fit(&around(-1.0), &around(1.0));
        for x in [-1.0_f64, -0.3, 0.0, 0.8] {
            let known = 1.0 / (1.0 + (-2.0 * x).exp());
            let found = discriminator.probability(&DVector::from_vec(vec![x]));
            assert!((found - known).abs() < 0.06, "{x}: {found} instead of {known}");
        }
    }
}
