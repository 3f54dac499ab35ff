//! Time in which a deployed policy computes one voltage, which is the policy's part of a tick: a
//! network, and the classical controller.
//!
//! `cargo bench --bench inference`; pin it to one core for comparable figures.

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use qube_hil::policy::{ClassicalController, ClassicalGains, LayerWeights, Network};
use qube_hil::qube::State;

fn inference(criterion: &mut Criterion) {
    let value = |i: usize| (0.31 * i as f32).sin() * 0.3;
    let layer = |inputs: usize, outputs: usize| LayerWeights {
        weight: (0..inputs * outputs).map(value).collect(),
        bias: (0..outputs).map(value).collect(),
    };
    let layers = [layer(6, 64), layer(64, 64), layer(64, 1)];
    let mut network =
        Network::new(&[6, 64, 64, 1], &layers, 5.0).expect("sizes and weights fit together");
    let mut controller = ClassicalController::new(ClassicalGains::default());
    let state = State { theta: 0.3, alpha: 3.0, theta_dot: -1.0, alpha_dot: 2.0 };
    criterion.bench_function("inference/network_6_64_64_1", |bencher| {
        bencher.iter(|| network.voltage_v(black_box(&state)));
    });
    criterion.bench_function("inference/classical", |bencher| {
        bencher.iter(|| controller.voltage_v(black_box(&state)));
    });
}

criterion_group!(benches, inference);
criterion_main!(benches);
