//! Tests the import of models whose outputs onnxruntime computed (`tests/fixtures/onnx/make.py`),
//! of models that these tests assemble, and of models that this program exports.

use serde_json::Value;

use super::*;
use crate::policy::Policy;
use crate::qube::PlantModel;
use crate::storage::ProtobufMessage as Message;

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
                "{name}: {voltage_v} V for the action {action}"
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

/// ONNX's numbers for types: `float`, `int64`, `float16`.
const TYPES: [u64; 3] = [1, 7, 10];

fn node(operator: &str, inputs: &[&str], output: &str) -> Message {
    let node = inputs.iter().fold(Message::default(), |node, input| node.text(1, input));
    node.text(2, output).text(4, operator)
}

fn tensor(name: &str, kind: u64, shape: &[u64], raw: &[u8]) -> Message {
    let shaped = shape.iter().fold(Message::default(), |it, &size| it.integer(1, size));
    shaped.integer(2, kind).text(8, name).bytes(9, raw)
}

fn numbers_of(name: &str, shape: &[u64]) -> Message {
    let raw: Vec<u8> = (0..shape.iter().product()).flat_map(|_| 1.0_f32.to_le_bytes()).collect();
    tensor(name, TYPES[0], shape, &raw)
}

fn integers_of(name: &str, values: &[i64]) -> Message {
    let raw: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
    tensor(name, TYPES[1], &[values.len() as u64], &raw)
}

/// A model from `x` to `y`; `entries` is the number of entries of `x` that the model declares.
fn model(nodes: &[Message], constants: &[Message], entries: Option<u64>) -> Message {
    let rows = Message::default().text(2, "n");
    let columns = entries.map_or_else(Message::default, |it| Message::default().integer(1, it));
    let shape = Message::default().message(1, &rows).message(1, &columns);
    let kind = Message::default().integer(1, TYPES[0]).message(2, &shape);
    let end = |name: &str| Message::default().text(1, name);
    let graph = Message::default()
        .messages(1, nodes)
        .messages(5, constants)
        .message(11, &end("x").message(2, &Message::default().message(1, &kind)))
        .message(12, &end("y"));
    Message::default().message(7, &graph)
}

fn read(model: Message) -> Result<Layers, ImportError> {
    Layers::from_onnx(&model.into_bytes())
}

#[test]
fn a_bias_of_another_type_than_float_is_refused() {
    let with_bias = |kind: u64, raw: &[u8]| {
        let cast = node("Cast", &["b"], "bias");
        let to_float = Message::default().text(1, "to").integer(3, 1).integer(20, 2);
        let nodes = [
            cast.message(5, &to_float),
            node("Gemm", &["x", "w0", "bias"], "h"),
            node("Tanh", &["h"], "a"),
            node("MatMul", &["a", "w1"], "y"),
        ];
        let weights = [numbers_of("w0", &[6, 2]), numbers_of("w1", &[2, 1])];
        let constants: Vec<_> = weights.into_iter().chain([tensor("b", kind, &[2], raw)]).collect();
        read(model(&nodes, &constants, Some(6)))
    };
    let float: Vec<u8> = [0.5_f32, -2.0].iter().flat_map(|it| it.to_le_bytes()).collect();
    assert_eq!(with_bias(TYPES[0], &float).unwrap().layers[0].bias, [0.5, -2.0]);
    let refused = Err(ImportError::Type { name: "bias".into() });
    assert_eq!(with_bias(TYPES[2], &[0, 0x38, 0, 0xc0]), refused);
    assert_eq!(with_bias(TYPES[1], &[1; 16]), refused);
    // An integer constant must have as many values as its shape, too.
    assert_eq!(with_bias(TYPES[1], &[1; 8]), Err(ImportError::Values { name: "b".into() }));
}

#[test]
fn a_constant_of_several_rows_or_dimensions_is_refused_by_its_name() {
    let with = |shape: &[u64]| {
        let nodes = [
            node("Add", &["x", "c"], "s"),
            node("MatMul", &["s", "w0"], "h"),
            node("Tanh", &["h"], "a"),
            node("MatMul", &["a", "w1"], "y"),
        ];
        let constants =
            [numbers_of("c", shape), numbers_of("w0", &[6, 2]), numbers_of("w1", &[2, 1])];
        read(model(&nodes, &constants, Some(6)))
    };
    for shape in [&[][..], &[1], &[6], &[1, 6], &[1, 1]] {
        assert!(with(shape).is_ok(), "{shape:?}");
    }
    for shape in [&[6, 1][..], &[2, 3], &[6, 1, 1], &[1, 1, 6]] {
        assert_eq!(with(shape), Err(ImportError::Values { name: "c".into() }), "{shape:?}");
    }
}

#[test]
fn weights_that_are_no_matrix_and_an_output_times_0_are_refused_by_their_operator() {
    let with = |shape: &[u64], factor: f32| {
        let nodes = [
            node("MatMul", &["x", "w0"], "h"),
            node("Tanh", &["h"], "a"),
            node("MatMul", &["a", "w1"], "z"),
            node("Mul", &["z", "factor"], "y"),
        ];
        let factor = tensor("factor", TYPES[0], &[1], &factor.to_le_bytes());
        read(model(&nodes, &[numbers_of("w0", shape), numbers_of("w1", &[2, 1]), factor], Some(6)))
    };
    assert!(with(&[6, 2], 0.5).is_ok());
    let place =
        |operator: &str, place| Err(ImportError::Place { operator: operator.to_owned(), place });
    let no_matrix = "whose weights are not a matrix of two dimensions";
    assert_eq!(with(&[1, 6, 2], 0.5), place("MatMul", no_matrix));
    assert_eq!(with(&[6, 2], 0.0), place("Mul", "by 0 at the end, which leaves no voltage"));
}

#[test]
fn a_shape_that_contradicts_the_layers_is_refused() {
    let read = |shaped: Message, more: Option<Message>, target: &[i64], entries: Option<u64>| {
        let nodes: Vec<Message> = more
            .into_iter()
            .chain([
                shaped,
                node("MatMul", &["s", "w0"], "h"),
                node("Tanh", &["h"], "a"),
                node("MatMul", &["a", "w1"], "y"),
            ])
            .collect();
        let weights = [numbers_of("w0", &[6, 2]), numbers_of("w1", &[2, 1])];
        let constants: Vec<_> = weights.into_iter().chain([integers_of("to", target)]).collect();
        read(model(&nodes, &constants, entries)).map(|layers| layers.inputs)
    };
    let changed = |operator: &str, target: &[i64], entries| {
        read(node(operator, &["x", "to"], "s"), None, target, entries)
    };
    for (operator, target) in [
        ("Reshape", &[-1, 6][..]),
        ("Reshape", &[0, -1]),
        ("Reshape", &[1, 0]),
        ("Expand", &[1, 1]),
        ("Expand", &[4, 6]),
    ] {
        assert_eq!(changed(operator, target, Some(6)), Ok(6), "{operator} {target:?}");
        assert_eq!(changed(operator, target, None), Ok(6), "{operator} {target:?}");
    }
    let declared = |declared| Err(ImportError::Declared { declared, inputs: 6 });
    assert_eq!(changed("Expand", &[1, 6], Some(1)), declared(1));
    assert_eq!(changed("Reshape", &[-1, 6], Some(12)), declared(12));
    for (operator, target) in [("Reshape", [-1, 3]), ("Reshape", [6, 1]), ("Expand", [1, 12])] {
        let refused = changed(operator, &target, Some(6)).unwrap_err().to_string();
        let reason = "to a shape with another number of entries in a row";
        assert_eq!(refused, format!("has the operator {operator} {reason}"));
    }
    // Two computed shapes are accepted: the shape of x itself, and a shape whose last part is
    // constant.
    let own = |operator: &str| {
        let shape = node("Shape", &["x"], "own");
        read(node(operator, &["x", "own"], "s"), Some(shape), &[6], Some(6))
    };
    assert_eq!((own("Expand"), own("Reshape")), (Ok(6), Ok(6)));
    let joined = |last: i64| {
        let joined = node("Concat", &["rows", "to"], "joined");
        read(node("Reshape", &["x", "joined"], "s"), Some(joined), &[last], Some(6))
    };
    assert_eq!(joined(-1), Ok(6));
    assert!(joined(2).is_err());
    let computed = node("Add", &["to", "to"], "computed");
    let computed = read(node("Expand", &["x", "computed"], "s"), Some(computed), &[3], None);
    assert!(computed.unwrap_err().to_string().contains("that is not constant"));
}

#[test]
fn an_operator_that_is_not_onnxs_own_is_refused_by_its_whole_name() {
    let read = |relu: Message, function: Option<Message>| {
        let nodes = [node("MatMul", &["x", "w0"], "h"), relu, node("MatMul", &["a", "w1"], "y")];
        let weights = [numbers_of("w0", &[6, 2]), numbers_of("w1", &[2, 1])];
        let model = model(&nodes, &weights, None);
        read(model.messages(25, &Vec::from_iter(function))).map_err(|error| error.to_string())
    };
    let relu = || node("Relu", &["h"], "a");
    let function = |domain: &str| Some(Message::default().text(1, "Relu").text(10, domain));
    let refused = |name: &str| format!("has the operator {name}, which this program does not know");
    assert!(read(relu(), None).is_ok());
    assert!(read(relu().text(7, "ai.onnx"), None).is_ok());
    assert!(read(relu(), function("mine")).is_ok());
    let of_another = read(relu().text(7, "mine"), function("mine")).unwrap_err();
    assert!(of_another.starts_with(&refused("mine::Relu")), "{of_another}");
    for domain in ["", "ai.onnx"] {
        let of_its_own = read(relu(), function(domain)).unwrap_err();
        assert!(of_its_own.starts_with(&refused("Relu as a function of its own")), "{of_its_own}");
    }
}

#[test]
fn a_constant_operator_gives_its_value_in_each_of_its_attributes() {
    let scaled = |value: Message| {
        let nodes = [
            node("Constant", &[], "factor").message(5, &value),
            node("Mul", &["x", "factor"], "scaled"),
            node("MatMul", &["scaled", "w0"], "h"),
            node("Tanh", &["h"], "a"),
            node("MatMul", &["a", "w1"], "y"),
        ];
        let weights = [numbers_of("w0", &[6, 2]), numbers_of("w1", &[2, 1])];
        read(model(&nodes, &weights, Some(6))).map(|layers| layers.layers[0].weight.clone())
    };
    let value = |name: &str| Message::default().text(1, name);
    assert_eq!(scaled(value("value_float").number(2, 0.5)), Ok(vec![0.5; 12]));
    let several = (0..6).fold(value("value_floats"), |it, _| it.number(7, 0.5));
    assert_eq!(scaled(several), Ok(vec![0.5; 12]));
    let refused = Err(ImportError::Type { name: "factor".into() });
    assert_eq!(scaled(value("value_int").integer(3, 2)), refused);
}

#[test]
fn an_observation_in_another_order_is_rearranged() {
    let (_, bytes) = MODELS[0];
    let own = [0.1, 0.9, -0.3, 0.5, 1.5, -0.7];
    let mut network =
        Layers::from_onnx(bytes).unwrap().network(&ObservationLayout::own(0), 5.0).unwrap();
    let expected = {
        // The other order has alpha_dot in rad/s, the cosine from upright, and the arm's angle
        // last.
        let seen = [own[5] * 20.0, -own[3], own[2], own[4], own[0], own[1]];
        network.voltage_of_observation_v(&seen)
    };
    let layout = "alpha_dot, -1*cos_alpha, sin_alpha, 0.1*theta_dot, sin_theta, cos_theta";
    let layout = ObservationLayout::parse(layout).unwrap();
    let mut arranged = Layers::from_onnx(bytes).unwrap().network(&layout, 5.0).unwrap();
    let voltage_v = arranged.voltage_of_observation_v(&own);
    assert!((voltage_v - expected).abs() < 1e-4, "{voltage_v} V instead of {expected} V");
}

fn foreign(action_scale_v: f32, clip_observation: Option<f32>) -> ForeignConventions {
    let (layout, corner_rad_s) = (ObservationLayout::own(0), 200.0);
    let plant = PlantModel::QUBE;
    ForeignConventions { layout, action_scale_v, corner_rad_s, clip_observation, plant }
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
        let training = TrainingRecord {
            best_return: Some(500.5),
            ..TrainingRecord::imported(97.0, &PlantModel::QUBE)
        };
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
fn the_observation_is_clipped_at_the_limit_that_the_caller_gives() {
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
fn a_velocity_filter_that_no_policy_file_can_hold_is_refused() {
    let (_, bytes) = MODELS[0];
    for corner_rad_s in [0.0, -1.0, 1e7, f64::NAN, f64::INFINITY] {
        let conventions = ForeignConventions { corner_rad_s, ..foreign(5.0, None) };
        let refused = from_onnx(bytes, Some(&conventions));
        assert!(matches!(refused, Err(ImportError::Corner { .. })), "{corner_rad_s}");
    }
    let conventions = ForeignConventions { corner_rad_s: 1e6, ..foreign(5.0, None) };
    let policy = Policy::Network(from_onnx(bytes, Some(&conventions)).unwrap());
    assert!(Policy::from_bytes(&policy.to_bytes()).is_ok());
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
fn unknown_operators_and_other_files_are_refused_by_name() {
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
fn no_damage_of_a_file_makes_the_reader_panic() {
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
