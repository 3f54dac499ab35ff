//! Tests the import with models whose outputs onnxruntime computed (`tests/fixtures/onnx/make.py`).

use serde_json::Value;

use super::*;

const MODELS: [(&str, &[u8]); 4] = [
    ("tanh", include_bytes!("../../../tests/fixtures/onnx/tanh.onnx")),
    ("elu-normalised", include_bytes!("../../../tests/fixtures/onnx/elu-normalised.onnx")),
    ("silu-wrapped", include_bytes!("../../../tests/fixtures/onnx/silu-wrapped.onnx")),
    ("relu", include_bytes!("../../../tests/fixtures/onnx/relu.onnx")),
];

const OUTPUTS: &str = include_str!("../../../tests/fixtures/onnx/outputs.json");

fn numbers(values: &Value) -> Vec<f32> {
    values.as_array().unwrap().iter().map(|value| value.as_f64().unwrap() as f32).collect()
}

#[test]
fn imported_networks_give_the_outputs_of_onnxruntime() {
    let outputs: Value = serde_json::from_str(OUTPUTS).unwrap();
    for (name, bytes) in MODELS {
        let layers = Layers::from_onnx(bytes).unwrap();
        let sight = Sight::own(layers.inputs - 6);
        let mut network = layers.clone().network(&sight, 5.0).unwrap();
        let mut turned = layers.network(&sight, -5.0).unwrap();
        let observations = outputs[name]["observations"].as_array().unwrap();
        let actions = numbers(&outputs[name]["actions"]);
        assert_eq!(observations.len(), actions.len());
        for (observation, action) in observations.iter().zip(actions) {
            let observation = numbers(observation);
            let voltage_v = network.voltage_of_observation_v(&observation);
            let scale = 1.0_f32.max(action.abs());
            assert!(
                (voltage_v / 5.0 - action).abs() < 2e-6 * scale,
                "{name}: {voltage_v} {action}"
            );
            assert_eq!(turned.voltage_of_observation_v(&observation), -voltage_v);
        }
    }
}

#[test]
fn the_functions_of_a_network_are_recognised() {
    let functions = MODELS.map(|(_, bytes)| {
        let Layers { activation, output, .. } = Layers::from_onnx(bytes).unwrap();
        (activation, output)
    });
    let linear = |activation| (activation, OutputKind::Linear);
    let expected = [
        linear(Activation::Tanh),
        linear(Activation::Elu),
        (Activation::Silu, OutputKind::Tanh),
        linear(Activation::Relu),
    ];
    assert_eq!(functions, expected);
}

#[test]
fn an_observation_in_another_order_is_rearranged() {
    let (_, bytes) = MODELS[0];
    let own = [0.1, 0.9, -0.3, 0.5, 1.5, -0.7];
    let mut network = Layers::from_onnx(bytes).unwrap().network(&Sight::own(0), 5.0).unwrap();
    let expected = {
        // The model sees alpha_dot in rad/s, the cosine from upright, and the arm's angle last.
        let seen = [own[5] * 20.0, -own[3], own[2], own[4], own[0], own[1]];
        network.voltage_of_observation_v(&seen)
    };
    let sight = "alpha_dot, -1*cos_alpha, sin_alpha, 0.1*theta_dot, sin_theta, cos_theta";
    let sight = Sight::parse(sight).unwrap();
    let mut arranged = Layers::from_onnx(bytes).unwrap().network(&sight, 5.0).unwrap();
    let voltage_v = arranged.voltage_of_observation_v(&own);
    assert!((voltage_v - expected).abs() < 1e-4, "{voltage_v} {expected}");
}

#[test]
fn what_this_program_does_not_know_is_refused_by_name() {
    for (bytes, told) in [
        (&include_bytes!("../../../tests/fixtures/onnx/refused-softmax.onnx")[..], "Softmax"),
        (include_bytes!("../../../tests/fixtures/onnx/refused-leakyrelu.onnx"), "LeakyRelu"),
        (
            include_bytes!("../../../tests/fixtures/onnx/refused-outside.onnx"),
            "external_data=False",
        ),
        (b"", "not an ONNX model"),
        (b"no model at all", "not an ONNX model"),
    ] {
        let refused = Layers::from_onnx(bytes).unwrap_err().to_string();
        assert!(refused.contains(told), "{refused}");
    }
    let layers = Layers::from_onnx(MODELS[0].1).unwrap();
    let refused = layers.network(&Sight::own(2), 5.0).unwrap_err();
    assert_eq!(refused, ImportError::Inputs { inputs: 6, named: 8 });
}

#[test]
fn no_damage_of_a_file_panics() {
    for (_, bytes) in MODELS {
        for length in 0..bytes.len() {
            let _ = Layers::from_onnx(&bytes[..length]);
        }
        for index in 0..bytes.len() {
            let mut changed = bytes.to_vec();
            for flip in [0x01, 0x10, 0x80, 0xff] {
                changed[index] = bytes[index] ^ flip;
                if let Ok(layers) = Layers::from_onnx(&changed) {
                    let inputs = layers.inputs;
                    let _ = layers.network(&Sight::own(inputs.saturating_sub(6)), 5.0);
                }
            }
        }
    }
}
