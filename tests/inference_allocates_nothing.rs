//! A policy decides inside the tick, where nothing may allocate.

use assert_no_alloc::{AllocDisabler, assert_no_alloc};
use qube_hil::policy::{
    ClassicalController, ClassicalGains, LayerWeights, Network, NetworkPolicy, Policy,
    SimulatedSensors, TrainingRecord,
};
use qube_hil::qube::State;

#[global_allocator]
static ALLOCATOR: AllocDisabler = AllocDisabler;

fn network() -> Policy {
    let layer = |inputs: usize, outputs: usize| LayerWeights {
        weight: vec![0.1; inputs * outputs],
        bias: vec![0.1; outputs],
    };
    let layers = [layer(6, 64), layer(64, 64), layer(64, 1)];
    let training = TrainingRecord {
        model: "nominal".to_owned(),
        psi: None,
        seed: 1,
        preset: "quick".to_owned(),
        steps: 0,
        gradient_steps: 0,
        sensors: SimulatedSensors::TrueState,
        best_return: None,
        program_version: "0.1.0".to_owned(),
    };
    let network = Network::new(&[6, 64, 64, 1], &layers, 5.0).unwrap();
    Policy::Network(NetworkPolicy { network, training })
}

#[test]
fn a_rollout_of_either_kind_of_policy_allocates_nothing() {
    let classical = Policy::Classical(ClassicalController::new(ClassicalGains::default()));
    for mut policy in [network(), classical] {
        let mut sum = 0.0;
        assert_no_alloc(|| {
            policy.reset();
            for step in 0..600 {
                let alpha = 0.01 * f64::from(step);
                sum += policy.voltage_v(&State { alpha, alpha_dot: 1.0, ..State::default() });
            }
        });
        assert!(sum.is_finite());
    }
}
