use nalgebra::{DMatrix, DVector};
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::gaussian::standard_normal;

/// Number of neurons of each of the two hidden layers.
const HIDDEN: usize = 48;

/// Number of samples of a gradient step.
const BATCH: usize = 64;

/// Bound on a standardised feature: hardly any simulation lies beyond it, so a larger value adds no
/// information.
const FARTHEST_FEATURE: f64 = 5.0;

/// One in this many samples is held out. Their loss chooses between the networks after each pass.
const HELD_OUT_EVERY: usize = 10;

/// Adam's learning rate in the first and the last step.
const LEARNING_RATES: [f64; 2] = [3e-3, 1e-4];

/// A mixture density network (Bishop 1994): the density of a target given features, as a mixture of
/// normal distributions with full covariances whose parameters are the outputs of a network with
/// two hidden layers of tanh.
#[derive(Clone, Debug)]
pub struct MixtureDensity {
    layers: [Layer; 3],
    centre: DVector<f64>,
    scale: DVector<f64>,
    dimensions: usize,
}

/// The extent of a fit.
#[derive(Clone, Copy, Debug)]
pub struct Fit {
    /// Number of components of the mixture.
    pub components: usize,
    /// Number of passes over the samples.
    pub passes: usize,
}

/// A mixture of one or more normal distributions.
#[derive(Clone, Debug)]
pub struct Mixture {
    components: Vec<Component>,
}

#[derive(Clone, Debug)]
struct Component {
    weight: f64,
    mean: DVector<f64>,
    /// Upper triangular; its transpose times itself is the inverse of the covariance.
    whitener: DMatrix<f64>,
}

#[derive(Clone, Debug)]
struct Layer {
    weight: DMatrix<f64>,
    bias: DVector<f64>,
}

/// Adam's moments of one array.
struct Moments {
    first: Vec<f64>,
    second: Vec<f64>,
}

impl MixtureDensity {
    /// Fits the density of targets given features by maximum likelihood over `passes` passes; each
    /// sample has its weight. One sample in ten is held out, and the network with the highest
    /// likelihood of these samples is kept; with fewer than ten samples, the last network.
    pub fn fit(
        features: &[DVector<f64>],
        targets: &[DVector<f64>],
        weights: &[f64],
        Fit { components, passes }: Fit,
        seed: u64,
    ) -> Self {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let dimensions = targets.first().map_or(0, DVector::len);
        let (centre, scale) = standardisation(features);
        let outputs = components * outputs_of_component(dimensions);
        let layers = [
            Layer::random(centre.len(), HIDDEN, 1.0, &mut random),
            Layer::random(HIDDEN, HIDDEN, 1.0, &mut random),
            Layer::random(HIDDEN, outputs, 0.1, &mut random),
        ];
        let mut network = Self { layers, centre, scale, dimensions };
        // Components with equal means would all learn the same.
        for component in 0..components {
            let first = component * outputs_of_component(dimensions) + 1;
            for entry in 0..dimensions {
                network.layers[2].bias[first + entry] = 0.5 * standard_normal(1, &mut random)[0];
            }
        }
        let inputs: Vec<DVector<f64>> =
            features.iter().map(|it| network.standardised(it)).collect();
        let (held_out, learned): (Vec<usize>, Vec<usize>) =
            (0..inputs.len()).partition(|index| index % HELD_OUT_EVERY == HELD_OUT_EVERY - 1);
        let loss = |network: &Self, samples: &[usize]| {
            let weighted = |&index: &usize| {
                -weights[index] * network.mixture(&inputs[index]).log_density(&targets[index])
            };
            samples.iter().map(weighted).sum::<f64>() / samples.len().max(1) as f64
        };
        let mut best = network.clone();
        let mut least = loss(&network, &held_out);
        let mut moments: Vec<Moments> =
            network.arrays().map(|it| Moments::zero(it.len())).collect();
        let steps = (passes * learned.len().div_ceil(BATCH)).max(1);
        let mut step = 0;
        let mut order = learned;
        for _ in 0..passes {
            for last in (1..order.len()).rev() {
                order.swap(last, random.random_range(0..=last));
            }
            for batch in order.chunks(BATCH) {
                let gradient = network.gradient(batch, &inputs, targets, weights);
                let done = step as f64 / steps as f64;
                step += 1;
                let rate = LEARNING_RATES[0].powf(1.0 - done) * LEARNING_RATES[1].powf(done);
                for ((own, gradient), moments) in
                    network.arrays_mut().zip(gradient.arrays()).zip(&mut moments)
                {
                    moments.step(own, gradient, rate, step);
                }
            }
            let current = loss(&network, &held_out);
            if held_out.is_empty() || current < least {
                (least, best) = (current, network.clone());
            }
        }
        best
    }

    /// The density of the target given these features.
    pub fn given(&self, features: &DVector<f64>) -> Mixture {
        self.mixture(&self.standardised(features))
    }

    fn standardised(&self, features: &DVector<f64>) -> DVector<f64> {
        (features - &self.centre)
            .component_div(&self.scale)
            .map(|it| if it.is_nan() { 0.0 } else { it.clamp(-FARTHEST_FEATURE, FARTHEST_FEATURE) })
    }

    fn mixture(&self, input: &DVector<f64>) -> Mixture {
        let [first, second, last] = &self.layers;
        let hidden = first.of(input).map(f64::tanh);
        let hidden = second.of(&hidden).map(f64::tanh);
        Mixture::of_outputs(last.of(&hidden).as_slice(), self.dimensions)
    }

    /// The gradient of the mean weighted negative log likelihood of the samples of a batch, in the
    /// form of a network.
    fn gradient(
        &self,
        batch: &[usize],
        inputs: &[DVector<f64>],
        targets: &[DVector<f64>],
        weights: &[f64],
    ) -> Self {
        let [first, second, last] = &self.layers;
        let columns: Vec<DVector<f64>> = batch.iter().map(|&it| inputs[it].clone()).collect();
        let input = DMatrix::from_columns(&columns);
        let hidden_1 = first.of_all(&input).map(f64::tanh);
        let hidden_2 = second.of_all(&hidden_1).map(f64::tanh);
        let outputs = last.of_all(&hidden_2);
        let mut errors = DMatrix::zeros(outputs.nrows(), batch.len());
        for (column, &index) in batch.iter().enumerate() {
            let own = outputs.column(column);
            let mixture = Mixture::of_outputs(own.as_slice(), self.dimensions);
            let share = weights[index] / batch.len() as f64;
            mixture.loss_gradient(&targets[index], share, errors.column_mut(column).as_mut_slice());
        }
        let back_propagated = |layer: &Layer, errors: &DMatrix<f64>, hidden: &DMatrix<f64>| {
            (layer.weight.transpose() * errors)
                .zip_map(hidden, |error, active| error * (1.0 - active * active))
        };
        let errors_2 = back_propagated(last, &errors, &hidden_2);
        let errors_1 = back_propagated(second, &errors_2, &hidden_1);
        let layer = |errors: &DMatrix<f64>, input: &DMatrix<f64>| Layer {
            weight: errors * input.transpose(),
            bias: errors.column_sum(),
        };
        let layers =
            [layer(&errors_1, &input), layer(&errors_2, &hidden_1), layer(&errors, &hidden_2)];
        Self { layers, ..self.clone() }
    }

    fn arrays(&self) -> impl Iterator<Item = &[f64]> {
        self.layers.iter().flat_map(|layer| [layer.weight.as_slice(), layer.bias.as_slice()])
    }

    fn arrays_mut(&mut self) -> impl Iterator<Item = &mut [f64]> {
        self.layers
            .iter_mut()
            .flat_map(|layer| [layer.weight.as_mut_slice(), layer.bias.as_mut_slice()])
    }
}

/// Number of outputs of the network for a component: the logarithm of its weight up to a constant,
/// its mean, and its whitener row by row, with the diagonal as logarithms.
fn outputs_of_component(dimensions: usize) -> usize {
    1 + dimensions + dimensions * (dimensions + 1) / 2
}

/// Mean and standard deviation of each feature; a feature that never changes has the deviation 1.
fn standardisation(features: &[DVector<f64>]) -> (DVector<f64>, DVector<f64>) {
    let length = features.first().map_or(0, DVector::len);
    let count = features.len().max(1) as f64;
    let centre = features.iter().fold(DVector::zeros(length), |sum, it| sum + it) / count;
    let squares = features
        .iter()
        .fold(DVector::zeros(length), |sum, it| sum + (it - &centre).map(|entry| entry * entry));
    let scale = squares.map(|it: f64| {
        let deviation = (it / count).sqrt();
        if deviation > 1e-12 { deviation } else { 1.0 }
    });
    (centre, scale)
}

impl Mixture {
    fn of_outputs(outputs: &[f64], dimensions: usize) -> Self {
        let parts: Vec<&[f64]> = outputs.chunks(outputs_of_component(dimensions)).collect();
        let largest = parts.iter().map(|part| part[0]).fold(f64::NEG_INFINITY, f64::max);
        let total: f64 = parts.iter().map(|part| (part[0] - largest).exp()).sum();
        let component = |part: &&[f64]| {
            let mut entries = part[1 + dimensions..].iter();
            let mut whitener = DMatrix::zeros(dimensions, dimensions);
            for row in 0..dimensions {
                for column in row..dimensions {
                    let entry = entries.next().copied().unwrap_or_default();
                    whitener[(row, column)] = if row == column { entry.exp() } else { entry };
                }
            }
            let mean = DVector::from_column_slice(&part[1..=dimensions]);
            Component { weight: (part[0] - largest).exp() / total, mean, whitener }
        };
        Self { components: parts.iter().map(component).collect() }
    }

    /// The logarithm of the density at a point.
    pub fn log_density(&self, point: &DVector<f64>) -> f64 {
        log_sum(&self.components.iter().map(|it| it.log_density(point)).collect::<Vec<_>>())
    }

    /// Draws a point.
    pub fn draw(&self, random: &mut ChaCha8Rng) -> DVector<f64> {
        let mut left: f64 = random.random();
        let chosen = self.components.iter().position(|it| {
            left -= it.weight;
            left < 0.0
        });
        // The weights may sum to a little less than 1.
        let number = chosen.unwrap_or(self.components.len() - 1);
        let Component { mean, whitener, .. } = &self.components[number];
        let noise = standard_normal(mean.len(), random);
        // A whitener is singular only if an entry of its diagonal, a power of e, became 0.
        whitener.solve_upper_triangular(&noise).map_or_else(|| mean.clone(), |it| mean + it)
    }

    /// Writes the gradient of `-share * log_density(target)` with respect to the network's outputs.
    fn loss_gradient(&self, target: &DVector<f64>, share: f64, gradient: &mut [f64]) {
        let logs: Vec<f64> = self.components.iter().map(|it| it.log_density(target)).collect();
        let total = log_sum(&logs);
        let dimensions = target.len();
        let parts = gradient.chunks_mut(outputs_of_component(dimensions));
        for ((component, log), part) in self.components.iter().zip(logs).zip(parts) {
            let responsibility = (log - total).exp();
            part[0] = share * (component.weight - responsibility);
            let deviation = target - &component.mean;
            let whitened = &component.whitener * &deviation;
            let pull = component.whitener.tr_mul(&whitened);
            for entry in 0..dimensions {
                part[1 + entry] = -share * responsibility * pull[entry];
            }
            let mut index = 1 + dimensions;
            for row in 0..dimensions {
                for column in row..dimensions {
                    let mut own = whitened[row] * deviation[column];
                    if row == column {
                        own = own * component.whitener[(row, row)] - 1.0;
                    }
                    part[index] = share * responsibility * own;
                    index += 1;
                }
            }
        }
    }
}

impl Component {
    /// The logarithm of the component's weight times its density at a point.
    fn log_density(&self, point: &DVector<f64>) -> f64 {
        let whitened = &self.whitener * (point - &self.mean);
        let log_determinant: f64 = self.whitener.diagonal().iter().map(|it| it.ln()).sum();
        let constant = 0.5 * (2.0 * std::f64::consts::PI).ln() * point.len() as f64;
        self.weight.max(1e-300).ln() + log_determinant - constant - 0.5 * whitened.norm_squared()
    }
}

fn log_sum(logs: &[f64]) -> f64 {
    let largest = logs.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    largest + logs.iter().map(|it| (it - largest).exp()).sum::<f64>().ln()
}

impl Layer {
    fn random(inputs: usize, outputs: usize, gain: f64, random: &mut ChaCha8Rng) -> Self {
        let scale = gain / (inputs.max(1) as f64).sqrt();
        let weight =
            DMatrix::from_fn(outputs, inputs, |_, _| scale * standard_normal(1, random)[0]);
        Self { weight, bias: DVector::zeros(outputs) }
    }

    fn of(&self, input: &DVector<f64>) -> DVector<f64> {
        &self.weight * input + &self.bias
    }

    fn of_all(&self, inputs: &DMatrix<f64>) -> DMatrix<f64> {
        let mut outputs = &self.weight * inputs;
        for mut column in outputs.column_iter_mut() {
            column += &self.bias;
        }
        outputs
    }
}

impl Moments {
    fn zero(length: usize) -> Self {
        Self { first: vec![0.0; length], second: vec![0.0; length] }
    }

    /// Takes one step of Adam (Kingma and Ba 2015); `step` is its number, from 1.
    fn step(&mut self, parameters: &mut [f64], gradient: &[f64], rate: f64, step: usize) {
        let [keep_1, keep_2] = [0.9_f64, 0.999];
        let corrections = [keep_1, keep_2].map(|keep| 1.0 - keep.powi(step as i32));
        for (index, (parameter, gradient)) in parameters.iter_mut().zip(gradient).enumerate() {
            let (first, second) = (&mut self.first[index], &mut self.second[index]);
            *first = keep_1 * *first + (1.0 - keep_1) * gradient;
            *second = keep_2 * *second + (1.0 - keep_2) * gradient * gradient;
            let deviation = (*second / corrections[1]).sqrt() + 1e-8;
            *parameter -= rate * *first / corrections[0] / deviation;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiment::methods::rivals::gaussian::Gaussian;

    fn fit_of(passes: usize) -> Fit {
        Fit { components: 4, passes }
    }

    fn vector(entries: &[f64]) -> DVector<f64> {
        DVector::from_column_slice(entries)
    }

    #[test]
    fn the_gradient_is_the_slope_of_the_loss() {
        let inputs = [vector(&[0.3, -1.0]), vector(&[1.2, 0.4])];
        let targets = [vector(&[0.5, 0.1]), vector(&[-0.7, 1.3])];
        let weights = [1.0, 0.4];
        let mut network = MixtureDensity::fit(&inputs, &targets, &weights, fit_of(2), 1);
        let loss = |network: &MixtureDensity| {
            let of = |sample: usize| {
                -weights[sample] * network.mixture(&inputs[sample]).log_density(&targets[sample])
            };
            0.5 * (of(0) + of(1))
        };
        let gradient = network.gradient(&[0, 1], &inputs, &targets, &weights);
        for (layer, entry) in [(0, 3), (1, 77), (2, 5), (2, 700)] {
            let slope = gradient.layers[layer].weight.as_slice()[entry];
            let mut moved = |by: f64| {
                network.layers[layer].weight.as_mut_slice()[entry] += by;
                let loss = loss(&network);
                network.layers[layer].weight.as_mut_slice()[entry] -= by;
                loss
            };
            let difference = (moved(1e-5) - moved(-1e-5)) / 2e-5;
            assert!((slope - difference).abs() < 1e-6, "{layer} {entry}: {slope} {difference}");
        }
    }

    #[test]
    fn all_samples_are_learned_where_too_few_exist_to_hold_one_out() {
        let (inputs, targets) =
            ([vector(&[0.3]), vector(&[-1.2])], [vector(&[0.5]), vector(&[-0.7])]);
        let density = |passes| {
            let network = MixtureDensity::fit(&inputs, &targets, &[1.0; 2], fit_of(passes), 1);
            network.given(&inputs[0]).log_density(&targets[0])
        };
        assert!(density(200) > density(1) + 0.5, "{} {}", density(200), density(1));
    }

    /// theta is standard normal in two dimensions, and x = theta_1 + theta_2 + noise: the posterior
    /// is normal, and its moments are known.
    #[test]
    fn a_linear_problem_has_its_normal_posterior() {
        let mut random = ChaCha8Rng::seed_from_u64(5);
        let noise = 0.5;
        let targets = Gaussian::standard(2).draws(4000, &mut random);
        let features: Vec<DVector<f64>> = targets
            .iter()
            .map(|it| vector(&[it.sum() + noise * standard_normal(1, &mut random)[0]]))
            .collect();
        let network = MixtureDensity::fit(&features, &targets, &vec![1.0; 4000], fit_of(40), 2);
        let given = network.given(&vector(&[1.0]));
        let draws: Vec<_> = (0..4000).map(|_| given.draw(&mut random)).collect();
        let found = Gaussian::of_points(&draws, &vec![1.0; draws.len()]);
        // Gain 1 / (2 + noise^2) for each; covariance I minus the gain.
        let gain = 1.0 / (2.0 + noise * noise);
        for entry in 0..2 {
            assert!((found.mean[entry] - gain).abs() < 0.1, "{}", found.mean);
            assert!((found.covariance[(entry, entry)] - (1.0 - gain)).abs() < 0.12, "{found:?}");
        }
        assert!((found.covariance[(0, 1)] + gain).abs() < 0.12, "{}", found.covariance);
    }

    /// x = theta^2 + noise: given x = 1, theta is near -1 or near 1, and nowhere between.
    #[test]
    fn a_posterior_with_two_peaks_has_both() {
        let mut random = ChaCha8Rng::seed_from_u64(6);
        let targets = Gaussian::standard(1).draws(3000, &mut random);
        let features: Vec<DVector<f64>> = targets
            .iter()
            .map(|it| vector(&[it[0] * it[0] + 0.1 * standard_normal(1, &mut random)[0]]))
            .collect();
        let network = MixtureDensity::fit(&features, &targets, &vec![1.0; 3000], fit_of(60), 3);
        let given = network.given(&vector(&[1.0]));
        let draws: Vec<_> = (0..1000).map(|_| given.draw(&mut random)).collect();
        let share = |lower: f64, upper: f64| {
            draws.iter().filter(|it| (lower..upper).contains(&it[0])).count() as f64 / 1000.0
        };
        let (left, right) = (share(-1.3, -0.7), share(0.7, 1.3));
        assert!(left > 0.3 && right > 0.3 && left + right > 0.9, "{left} {right}");
    }
}
