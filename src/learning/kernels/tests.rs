use super::*;
use crate::elementary::dispatch_at;
use crate::learning::network::{CONSTANT, LOG_STD, Network, WIDTH};
use crate::qube::OBSERVATION_SIZE;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

fn example() -> (Network, Minibatch) {
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let mut network = Network::ZERO;
    for slice in network.slices_mut() {
        slice.fill_with(|| rng.random_range(-0.3..0.3));
    }
    let mut row = |low: f32, high: f32| std::array::from_fn(|_| rng.random_range(low..high));
    let mut inputs = [[0.0; WIDTH]; 8];
    inputs[..OBSERVATION_SIZE].fill_with(|| row(-1.0, 1.0));
    inputs[CONSTANT] = [1.0; WIDTH];
    let minibatch = Minibatch {
        inputs,
        action: row(-1.0, 1.0),
        log_probability: row(-1.3, -0.7),
        advantage: row(-2.0, 2.0),
        return_: row(0.0, 3.0),
    };
    (network, minibatch)
}
#[test]
fn timing() {
    let (mut network, minibatch) = example();
    let mut workspace = Box::new(Workspace::ZERO);
    let mut gradient = Box::new(Network::ZERO);
    let mut moments = Box::new(Moments::ZERO);
    for level in crate::elementary::Level::ALL {
        let mut time = |name: &str, f: &mut dyn FnMut()| {
            let mut best = f64::MAX;
            for _ in 0..20 {
                let start = std::time::Instant::now();
                for _ in 0..300 {
                    f();
                }
                best = best.min(start.elapsed().as_secs_f64() / 300.0);
            }
            println!("{level:?} {name} {:.2} us", best * 1e6);
        };
        time("policy gradient", &mut || {
            dispatch_at(
                level,
                Gradient {
                    network: &network,
                    minibatch: &minibatch,
                    head: &PolicyHead { dual: 3.0, clip: 0.1, entropy_weight: 0.0 },
                    workspace: &mut workspace,
                    gradient: &mut gradient,
                },
            );
        });
        time("value gradient", &mut || {
            dispatch_at(
                level,
                Gradient {
                    network: &network,
                    minibatch: &minibatch,
                    head: &ValueHead,
                    workspace: &mut workspace,
                    gradient: &mut gradient,
                },
            );
        });
        time("forward", &mut || {
            std::hint::black_box(dispatch_at(
                level,
                Forward { network: &network, inputs: &minibatch.inputs },
            ));
        });
        time("adam", &mut || {
            dispatch_at(
                level,
                AdamStep {
                    network: &mut network,
                    gradient: &gradient,
                    moments: &mut moments,
                    beta_1: 0.9,
                    beta_2: 0.999,
                    learning_rate: 1e-4,
                    epsilon: 1e-5,
                    largest_norm: 0.5,
                },
            );
        });
    }
}
