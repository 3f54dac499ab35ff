//! Tests the import with models whose outputs onnxruntime computed (`tests/fixtures/onnx/make.py`),
//! and the import of what this program exports.

use serde_json::Value;

use super::message::Message;
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
        let layout = ObservationLayout::own(layers.inputs - 6);
        let mut network = layers.clone().network(&layout, 5.0).unwrap();
        let mut turned = layers.network(&layout, -5.0).unwrap();
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
fn a_graph_with_too_many_operators_is_refused_at_once() {
    let read = |operators: usize| {
        let node = |index: usize| {
            let [from, to] = [index, index + 1].map(|name| format!("v{name}"));
            Message::default().text(1, &from).text(2, &to).text(4, "Identity")
        };
        let nodes: Vec<Message> = (0..operators).map(node).collect();
        let end = |name: &str| Message::default().text(1, name);
        let graph = Message::default().messages(1, &nodes).message(11, &end("v0"));
        let graph = graph.message(12, &end(&format!("v{operators}")));
        Layers::from_onnx(&Message::default().message(7, &graph).into_bytes())
    };
    assert_eq!(read(MAX_OPERATORS).map(|layers| layers.layers.len()), Ok(0));
    assert_eq!(read(MAX_OPERATORS + 1), Err(ImportError::TooManyOperators));
    assert_eq!(read(100_000), Err(ImportError::TooManyOperators));
}

#[test]
fn an_observation_in_another_order_is_rearranged() {
    let (_, bytes) = MODELS[0];
    let own = [0.1, 0.9, -0.3, 0.5, 1.5, -0.7];
    let mut network =
        Layers::from_onnx(bytes).unwrap().network(&ObservationLayout::own(0), 5.0).unwrap();
    let expected = {
        // In the other order: alpha_dot in rad/s, the cosine from upright, and the arm's angle
        // last.
        let seen = [own[5] * 20.0, -own[3], own[2], own[4], own[0], own[1]];
        network.voltage_of_observation_v(&seen)
    };
    let layout = "alpha_dot, -1*cos_alpha, sin_alpha, 0.1*theta_dot, sin_theta, cos_theta";
    let layout = ObservationLayout::parse(layout).unwrap();
    let mut arranged = Layers::from_onnx(bytes).unwrap().network(&layout, 5.0).unwrap();
    let voltage_v = arranged.voltage_of_observation_v(&own);
    assert!((voltage_v - expected).abs() < 1e-4, "{voltage_v} {expected}");
}

fn foreign(action_scale_v: f32, clip_observation: Option<f32>) -> ForeignConventions {
    let (layout, corner_rad_s) = (ObservationLayout::own(0), 200.0);
    ForeignConventions { layout, action_scale_v, corner_rad_s, clip_observation }
}

/// Policies that cover each activation and output function, each number of last commands, bounds,
/// and a weight of -0.
fn policies() -> impl Iterator<Item = NetworkPolicy> {
    let functions = Activation::ALL.into_iter().flat_map(|activation| {
        [OutputKind::Linear, OutputKind::Tanh].map(|output| (activation, output))
    });
    functions.enumerate().map(|(index, (activation, output))| {
        let inputs = 6 + index % 5;
        let value = |i: usize| if i == 3 { -0.0 } else { (0.7 * (i + index) as f32).sin() };
        let layer = |inputs: usize, outputs: usize| LayerWeights {
            weight: (0..inputs * outputs).map(value).collect(),
            bias: vec![-0.0; outputs],
        };
        let layers = [layer(inputs, 9), layer(9, 4), layer(4, 1)];
        let pairs = [[-1.0, 2.0], [f32::NEG_INFINITY, 0.5], [f32::NEG_INFINITY, f32::INFINITY]];
        let bounds = if index % 2 == 0 { inputs } else { 0 };
        let network = Network::new(&[inputs, 9, 4, 1], &layers, 4.0 + index as f32).unwrap();
        let network = network.with_functions(activation, output);
        let bounds = (0..bounds).map(|entry| pairs[entry % 3]).collect();
        let training =
            TrainingRecord { best_return: Some(500.5), ..TrainingRecord::imported(97.0) };
        NetworkPolicy { network: network.with_bounds(bounds).unwrap(), training }
    })
}

#[test]
fn a_policy_that_is_exported_comes_back_as_it_was() {
    for policy in policies() {
        let model = to_onnx(&policy);
        assert_eq!(model, to_onnx(&policy));
        let again = from_onnx(&model, None).unwrap();
        let [before, after] =
            [policy, again].map(|it| crate::policy::Policy::Network(it).to_bytes());
        assert!(before == after);
        let refused = from_onnx(&model, Some(&foreign(5.0, None))).unwrap_err();
        assert_eq!(refused, ImportError::OwnConventions);
    }
}

#[test]
fn a_policy_whose_bounds_clip_nothing_comes_back() {
    let policy = policies().next().unwrap();
    let entries = policy.network.sizes()[0];
    // Programs write the largest finite numbers for the sides of a Clip that are open.
    for first in [[f32::MIN, f32::MAX], [-5.0, f32::MAX]] {
        let mut bounds = vec![[f32::MIN, f32::MAX]; entries];
        bounds[0] = first;
        let network = policy.network.clone().with_bounds(bounds).unwrap();
        let policy = NetworkPolicy { network, ..policy.clone() };
        assert_eq!(from_onnx(&to_onnx(&policy), None), Ok(policy.clone()));
        let file = crate::policy::Policy::Network(policy.clone()).to_bytes();
        match crate::policy::Policy::from_bytes(&file).unwrap() {
            crate::policy::Policy::Network(read) => {
                assert_eq!(from_onnx(&to_onnx(&read), None), Ok(policy));
            }
            other => panic!("{other:?} came back"),
        }
    }
}

#[test]
fn an_exported_model_whose_graph_was_changed_is_refused() {
    let policy = policies().next().unwrap();
    let model = to_onnx(&policy);
    let weight = policy.network.layers()[1].weight[0].to_le_bytes();
    let scale = policy.network.action_scale_v().to_le_bytes();
    let place = |bytes: &[u8]| model.windows(4).rposition(|window| window == bytes).unwrap();
    let mut other_weight = model.clone();
    other_weight[place(&weight)] ^= 1;
    // A changed weight is accepted, as in a network that was trained further.
    assert!(from_onnx(&other_weight, None).unwrap() != policy);
    let mut other_scale = model.clone();
    other_scale[place(&scale)] ^= 1;
    assert_eq!(from_onnx(&other_scale, None), Err(ImportError::Changed));
    // The key of the metadata entry, and the tag of the value that follows it.
    let entry = b"qube_hil.policy\x12";
    let at = model.windows(entry.len()).position(|window| window == entry).unwrap();
    let mut other_entry = model.clone();
    other_entry[at] = b'Q';
    assert_eq!(from_onnx(&other_entry, None), Err(ImportError::NoActionScale));
    let read = from_onnx(&other_entry, Some(&foreign(1.0, None))).unwrap();
    assert_eq!(read.network, policy.network);
}

#[test]
fn a_clip_of_the_observation_is_kept_or_asked_for() {
    let (_, bytes) = MODELS[0];
    let plain = from_onnx(bytes, Some(&foreign(5.0, None))).unwrap().network;
    let clipped = from_onnx(bytes, Some(&foreign(5.0, Some(0.5)))).unwrap().network;
    assert!(plain.bounds().is_empty());
    assert_eq!(clipped.bounds(), [[-0.5, 0.5]; 6]);
    let (mut plain, mut clipped) = (plain, clipped);
    let (seen, counted) = ([0.4, -0.6, 3.0, 0.1, 0.0, -9.0], [0.4, -0.5, 0.5, 0.1, 0.0, -0.5]);
    let [seen, counted] = [seen.as_slice(), counted.as_slice()];
    assert_eq!(clipped.voltage_of_observation_v(seen), plain.voltage_of_observation_v(counted));
    for limit in [0.0, -1.0, f32::NAN, f32::INFINITY] {
        let refused = from_onnx(bytes, Some(&foreign(5.0, Some(limit))));
        assert!(matches!(refused, Err(ImportError::Clip { .. })));
    }
}

#[test]
fn a_limit_of_the_output_below_the_motors_is_refused() {
    let layers = Layers { limits: [-1.0, 1.0], ..Layers::from_onnx(MODELS[0].1).unwrap() };
    assert!(layers.clone().network(&ObservationLayout::own(0), 5.0).is_ok());
    assert!(layers.clone().network(&ObservationLayout::own(0), -5.0).is_ok());
    let refused = layers.network(&ObservationLayout::own(0), 3.0).unwrap_err();
    assert_eq!(refused, ImportError::OutputLimits { lower_v: -3.0, upper_v: 3.0 });
}

#[test]
fn what_this_program_does_not_know_is_refused_by_name() {
    for (bytes, message) in [
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
        assert!(refused.contains(message), "{refused}");
    }
    let layers = Layers::from_onnx(MODELS[0].1).unwrap();
    let refused = layers.network(&ObservationLayout::own(2), 5.0).unwrap_err();
    assert_eq!(refused, ImportError::Inputs { inputs: 6, named: 8 });
}

#[test]
fn a_known_operator_with_another_attribute_is_refused_by_its_attribute() {
    let (_, bytes) = MODELS[1];
    // The name of the attribute, and the tag of its value.
    let attribute = b"alpha\x15";
    let at = bytes.windows(attribute.len()).position(|window| window == attribute).unwrap();
    let value = at + attribute.len()..at + attribute.len() + 4;
    let mut changed = bytes.to_vec();
    assert_eq!(changed[value.clone()], 1.0_f32.to_le_bytes());
    changed[value].copy_from_slice(&2.0_f32.to_le_bytes());
    let refused = Layers::from_onnx(&changed).unwrap_err().to_string();
    assert_eq!(refused, "has the operator Elu with another alpha than 1");
}

#[test]
fn no_damage_of_a_file_panics() {
    let own = policies().nth(2).map(|policy| to_onnx(&policy)).unwrap();
    for bytes in MODELS.map(|(_, bytes)| bytes).into_iter().chain([own.as_slice()]) {
        for length in 0..bytes.len() {
            let _ = Layers::from_onnx(&bytes[..length]);
        }
        for index in 0..bytes.len() {
            let mut changed = bytes.to_vec();
            for flip in [0x01, 0x10, 0x80, 0xff] {
                changed[index] = bytes[index] ^ flip;
                let _ = from_onnx(&changed, None);
                if let Ok(layers) = Layers::from_onnx(&changed) {
                    let inputs = layers.inputs;
                    let _ = layers.network(&ObservationLayout::own(inputs.saturating_sub(6)), 5.0);
                }
            }
        }
    }
}
