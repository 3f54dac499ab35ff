use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::elementary::dispatch_at;
use crate::learning::network::{
    LOG_STD, MAX_INPUTS, MAX_OBSERVATION_SIZE, MAX_PHYSICS_INPUTS, NARROW, Network, OUTPUT_BIAS,
    WIDTH,
};
use crate::qube::OBSERVATION_SIZE;

const POLICY: PolicyHead = PolicyHead { clip: 0.1, entropy_weight: 0.01, kl_weight: 0.3 };

/// Numbers of inputs: without last commands, with one command (with the constant 1, the rows fill
/// whole groups), with two (they do not), with the longest history, and with the most physics
/// inputs in addition.
const OBSERVATION_SIZES: [usize; 5] = [
    OBSERVATION_SIZE,
    OBSERVATION_SIZE + 1,
    OBSERVATION_SIZE + 2,
    MAX_OBSERVATION_SIZE,
    MAX_OBSERVATION_SIZE + MAX_PHYSICS_INPUTS,
];

fn example(observation_size: usize) -> (Network, Minibatch) {
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let mut network = Network::zero(observation_size);
    for slice in network.slices_mut() {
        slice.fill_with(|| rng.random_range(-0.3..0.3));
    }
    let used = network.inputs();
    network.first[used..].fill([0.0; WIDTH]);
    network.tail[2..].fill(0.0);
    let mut row = |low: f32, high: f32| std::array::from_fn(|_| rng.random_range(low..high));
    let mut inputs = [[0.0; WIDTH]; MAX_INPUTS];
    inputs[..observation_size].fill_with(|| row(-1.0, 1.0));
    inputs[observation_size] = [1.0; WIDTH];
    let minibatch = Minibatch {
        inputs,
        observation_size,
        action: row(-1.0, 1.0),
        log_probability: row(-1.5, -0.5),
        advantage: row(-2.0, 2.0),
        return_: row(0.0, 3.0),
    };
    (network, minibatch)
}

fn gradient_at<H: Head>(level: Level, size: usize, head: &H) -> (Network, H::Statistics) {
    let (network, minibatch) = example(size);
    let (mut gradient, mut workspace) = (Network::zero(size), Workspace::ZERO);
    let statistics = dispatch_at(
        level,
        Gradient {
            network: &network,
            minibatch: &minibatch,
            head,
            workspace: &mut workspace,
            gradient: &mut gradient,
        },
    );
    (gradient, statistics)
}

fn available() -> impl Iterator<Item = Level> {
    Level::ALL.into_iter().filter(|level| {
        if !level.is_available() {
            println!("{level:?} is not available here and was not checked");
        }
        level.is_available()
    })
}

/// The networks and losses in `f64`, as a textbook writes them.
mod textbook {
    use super::*;

    /// Outputs of the network whose parameters are `p`, in the order of [`Network::slices`].
    fn outputs(p: &[f64], minibatch: &Minibatch) -> Vec<f64> {
        let inputs = p.len() / WIDTH - (WIDTH + 3);
        let second = inputs * WIDTH;
        let second_bias = second + WIDTH * WIDTH;
        let last = second_bias + WIDTH;
        let tail = last + WIDTH;
        (0..WIDTH)
            .map(|sample| {
                let first: Vec<f64> = (0..WIDTH)
                    .map(|neuron| {
                        let products = (0..inputs).map(|input| {
                            p[input * WIDTH + neuron] * f64::from(minibatch.inputs[input][sample])
                        });
                        products.sum::<f64>().tanh()
                    })
                    .collect();
                let products = (0..WIDTH).map(|neuron| {
                    let row = &p[second + neuron * WIDTH..][..WIDTH];
                    let sum: f64 = row.iter().zip(&first).map(|(w, h)| w * h).sum();
                    p[last + neuron] * (sum + p[second_bias + neuron]).tanh()
                });
                products.sum::<f64>() + p[tail + OUTPUT_BIAS]
            })
            .collect()
    }

    pub fn value_loss(p: &[f64], minibatch: &Minibatch) -> f64 {
        let outputs = outputs(p, minibatch);
        let squares =
            outputs.iter().zip(minibatch.return_).map(|(v, r)| (v - f64::from(r)).powi(2));
        squares.sum::<f64>() / (2.0 * WIDTH as f64)
    }

    pub fn policy_loss(p: &[f64], minibatch: &Minibatch) -> f64 {
        let log_std = p[p.len() - WIDTH + LOG_STD];
        let clip = f64::from(POLICY.clip);
        let advantages = minibatch.advantage.map(f64::from);
        let average = advantages.iter().sum::<f64>() / WIDTH as f64;
        let squares = advantages.iter().map(|a| (a - average).powi(2)).sum::<f64>();
        let deviation = (squares / WIDTH as f64).sqrt();
        let mut sum = 0.0;
        for (i, mean) in outputs(p, minibatch).into_iter().enumerate() {
            let z = (f64::from(minibatch.action[i]) - mean) / log_std.exp();
            let log_probability = -0.5 * z * z - log_std - 0.5 * (2.0 * std::f64::consts::PI).ln();
            let log_ratio = log_probability - f64::from(minibatch.log_probability[i]);
            let ratio = log_ratio.exp();
            let advantage = (advantages[i] - average) / deviation;
            let clipped = ratio.clamp(1.0 - clip, 1.0 + clip);
            sum -= (ratio * advantage).min(clipped * advantage);
            sum += f64::from(POLICY.kl_weight) * (ratio - 1.0 - log_ratio);
        }
        sum / WIDTH as f64 - f64::from(POLICY.entropy_weight) * log_std
    }
}

/// Compares the gradients of every path with central differences in `f64`: for each 37th of the
/// second layer's weights, and for all parameters outside of these weights.
fn check_by_finite_differences(
    size: usize,
    gradients: &[(Level, Network)],
    loss: fn(&[f64], &Minibatch) -> f64,
) {
    let (network, minibatch) = example(size);
    let mut parameters: Vec<f64> =
        network.slices().into_iter().flatten().map(|&value| value.into()).collect();
    let gradients: Vec<(Level, Vec<f32>)> =
        gradients.iter().map(|(level, gradient)| (*level, gradient.slices().concat())).collect();
    for (level, gradient) in &gradients {
        let largest = gradient.iter().fold(0.0_f32, |largest, g| largest.max(g.abs()));
        assert!(largest > 1e-2, "{level:?}: the example has no gradient to check");
    }
    let inputs = network.padded_inputs();
    let big_layer = inputs * WIDTH..(inputs + WIDTH) * WIDTH;
    for index in (0..parameters.len()).filter(|i| !big_layer.contains(i) || i % 37 == 0) {
        let at = parameters[index];
        let mut loss_at = |value: f64| {
            parameters[index] = value;
            loss(&parameters, &minibatch)
        };
        const STEP: f64 = 1e-5;
        let difference = (loss_at(at + STEP) - loss_at(at - STEP)) / (2.0 * STEP);
        parameters[index] = at;
        for (level, gradient) in &gradients {
            let error = (f64::from(gradient[index]) - difference).abs();
            let found = gradient[index];
            assert!(error < 2e-5, "{level:?}, parameter {index}: {found} instead of {difference}");
        }
    }
}

#[test]
fn gradients_of_the_policy_equal_finite_differences_on_every_path() {
    for size in [OBSERVATION_SIZE, MAX_OBSERVATION_SIZE] {
        let mut gradients = Vec::new();
        for level in available() {
            let (gradient, statistics) = gradient_at(level, size, &POLICY);
            let clipped = statistics.clip_fraction;
            assert!((0.3..0.95).contains(&clipped), "{clipped} is not on both sides of the clip");
            assert!(statistics.approximate_kl > 0.0);
            gradients.push((level, gradient));
        }
        check_by_finite_differences(size, &gradients, textbook::policy_loss);
    }
}

#[test]
fn gradients_of_the_value_network_equal_finite_differences_on_every_path() {
    for size in [OBSERVATION_SIZE, MAX_OBSERVATION_SIZE] {
        let gradients: Vec<_> =
            available().map(|level| (level, gradient_at(level, size, &ValueHead).0)).collect();
        check_by_finite_differences(size, &gradients, textbook::value_loss);
    }
}

/// A network after 20 steps of Adam along real gradients, and the norm of each step's gradient.
fn trained_at(level: Level, size: usize) -> (Network, Vec<f32>) {
    let (mut network, minibatch) = example(size);
    let (mut gradient, mut moments) = (Network::zero(size), Moments::zero(size));
    let mut workspace = Workspace::ZERO;
    let norms = (0..20).map(|_| {
        dispatch_at(
            level,
            Gradient {
                network: &network,
                minibatch: &minibatch,
                head: &POLICY,
                workspace: &mut workspace,
                gradient: &mut gradient,
            },
        );
        let (network, moments) = (&mut network, &mut moments);
        dispatch_at(level, AdamStep { network, gradient: &gradient, moments, settings: &ADAM })
    });
    let norms = norms.collect();
    (network, norms)
}

const ADAM: AdamSettings = AdamSettings {
    learning_rate: 1e-3,
    beta_1: 0.9,
    beta_2: 0.999,
    epsilon: 1e-5,
    epsilon_beside_root: false,
    largest_norm: 0.5,
};

#[test]
fn avx512_and_avx2_give_the_same_bits() {
    if !(Level::Avx512.is_available() && Level::Avx2.is_available()) {
        println!("this processor lacks AVX-512 or AVX2: nothing was compared");
        return;
    }
    for size in OBSERVATION_SIZES {
        let (wide, narrow) = (trained_at(Level::Avx512, size), trained_at(Level::Avx2, size));
        assert_eq!(wide, narrow);
        assert_ne!(wide.0, example(size).0, "nothing was learned");
        assert_eq!(wide.0.first[1 + size..], Network::zero(size).first[1 + size..]);
    }
}

#[test]
fn the_plain_path_differs_by_rounding_only() {
    let at = |level| trained_at(level, OBSERVATION_SIZE).0;
    let (best, plain) = (at(Level::best()), at(Level::Plain));
    for (a, b) in best.slices().into_iter().zip(plain.slices()) {
        for (a, b) in a.iter().zip(b) {
            assert!((a - b).abs() < 1e-3, "{a} and {b}");
        }
    }
}

#[test]
fn adam_follows_its_formulas_after_shortening_the_gradient() {
    // Tests both places of epsilon, which only a large epsilon tells apart.
    for (epsilon, beside_root) in [(1e-5, false), (0.1, false), (1e-5, true), (0.1, true)] {
        adam_follows_its_formulas(epsilon, beside_root);
    }
}

fn adam_follows_its_formulas(epsilon: f32, epsilon_beside_root: bool) {
    let zero = Network::zero(OBSERVATION_SIZE);
    let (mut network, mut gradient) = (zero.clone(), zero);
    let mut moments = Moments::zero(OBSERVATION_SIZE);
    let (mut parameter, mut m, mut v) = (0.0_f64, 0.0_f64, 0.0_f64);
    for (step, (g, h)) in [(0.1, 0.0), (-0.3, 0.2), (3.0, 4.0), (0.0, 0.0)].into_iter().enumerate()
    {
        gradient.second[3][5] = g;
        gradient.tail[LOG_STD] = h;
        let step_of = AdamStep {
            network: &mut network,
            gradient: &gradient,
            moments: &mut moments,
            settings: &AdamSettings { epsilon, epsilon_beside_root, ..ADAM },
        };
        let norm = dispatch_at(Level::best(), step_of);
        let expected = f64::from(g * g + h * h).sqrt();
        assert!((f64::from(norm) - expected).abs() < 1e-6);
        let g = f64::from(g) * (0.5 / expected).min(1.0);
        m = 0.9 * m + 0.1 * g;
        v = 0.999 * v + 0.001 * g * g;
        let t = step as i32 + 1;
        let (m_hat, v_hat) = (m / (1.0 - 0.9_f64.powi(t)), v / (1.0 - 0.999_f64.powi(t)));
        let epsilon = f64::from(epsilon);
        let root = match epsilon_beside_root {
            true => v_hat.sqrt() + epsilon,
            false => (v_hat + epsilon.powi(2)).sqrt(),
        };
        parameter -= 1e-3 * m_hat / root;
        assert!((f64::from(network.second[3][5]) - parameter).abs() < 1e-6, "step {step}");
    }
    assert_eq!(network.second[3][6], 0.0);
}

#[test]
fn forward_and_gradient_compute_the_same_outputs() {
    for (level, size) in available().flat_map(|level| OBSERVATION_SIZES.map(|size| (level, size))) {
        let (network, minibatch) = example(size);
        let output = dispatch_at(level, Forward { network: &network, inputs: &minibatch.inputs });
        let narrow = minibatch.inputs.map(|row| *row.last_chunk::<NARROW>().unwrap());
        let of_narrow = dispatch_at(level, Forward { network: &network, inputs: &narrow });
        assert_eq!(output.last_chunk(), Some(&of_narrow), "{level:?}");
        let value_minibatch = Minibatch { return_: output, ..minibatch };
        let (mut gradient, mut workspace) = (Network::zero(size), Workspace::ZERO);
        dispatch_at(
            level,
            Gradient {
                network: &network,
                minibatch: &value_minibatch,
                head: &ValueHead,
                workspace: &mut workspace,
                gradient: &mut gradient,
            },
        );
        assert_eq!(
            gradient,
            Network::zero(size),
            "{level:?}: a network without error has a gradient"
        );
    }
}
