//! Tests that a policy comes back from its file as it was, and that damage and impossible values
//! are refused.

use std::collections::BTreeMap;

use proptest::prelude::*;

use super::*;
use crate::qube::{Distribution, DomainParameter, MAX_HISTORY, Nonideality, PlantModel, QubeModel};

fn network_policy() -> Policy {
    network_policy_with_history(0)
}

fn network_policy_with_history(history: usize) -> Policy {
    let value = |i: usize| (0.31 * i as f32).sin();
    let layer = |inputs: usize, outputs: usize| LayerWeights {
        weight: (0..inputs * outputs).map(value).collect(),
        bias: (0..outputs).map(value).collect(),
    };
    let inputs = 6 + history;
    let layers = [layer(inputs, 5), layer(5, 3), layer(3, 1)];
    Policy::Network(NetworkPolicy {
        network: Network::new(&[inputs, 5, 3, 1], &layers, 5.0).unwrap(),
        training: TrainingRecord {
            model: "opt-nominal".to_owned(),
            psi: Some(BTreeMap::from([("mean_M_p".to_owned(), 0.1 + 0.2)])),
            randomisation: None,
            seed: u64::MAX,
            preset: "quick".to_owned(),
            steps: 4_800_000,
            gradient_steps: 750_000,
            guard: SimulatedGuard::Envelope,
            voltage_change_weight: 0.02,
            plant: PlantModel::QUBE,
            sensors: SimulatedSensors::Encoders {
                corner_rad_s: 200.0,
                counts_per_revolution: 2048,
                observer: None,
            },
            best_return: Some(551.3),
            program_version: "0.1.0".to_owned(),
        },
    })
}

fn classical_policy() -> Policy {
    Policy::Classical(ClassicalController::new(ClassicalGains::default()))
}

/// The fault of these bytes; the test fails if they have none.
fn fault(bytes: &[u8]) -> String {
    Policy::from_bytes(bytes).expect_err("these bytes are no policy").to_string()
}

/// Replaces a text in the file's header by another of the same length.
fn with_header_text(bytes: &[u8], from: &str, to: &str) -> Vec<u8> {
    assert_eq!(from.len(), to.len());
    let at = bytes.windows(from.len()).position(|window| window == from.as_bytes());
    let at = at.unwrap_or_else(|| panic!("the header has no {from}"));
    let mut changed = bytes.to_vec();
    changed[at..at + to.len()].copy_from_slice(to.as_bytes());
    changed
}

#[test]
fn a_network_comes_back_bit_for_bit_and_so_do_its_bytes() {
    let policy = network_policy();
    let bytes = policy.to_bytes();
    let Policy::Network(original) = &policy else { unreachable!() };
    let read = Policy::from_bytes(&bytes).unwrap();
    assert_eq!(read.to_bytes(), bytes);
    let Policy::Network(read) = read else { panic!("a classical controller came back") };
    assert_eq!(&read, original);
}

#[test]
fn a_network_comes_back_with_its_history_and_its_file_names_the_observation() {
    for history in 0..=MAX_HISTORY {
        let bytes = network_policy_with_history(history).to_bytes();
        let Policy::Network(read) = Policy::from_bytes(&bytes).unwrap() else { unreachable!() };
        assert_eq!(read.network.history(), history);
        let text = String::from_utf8_lossy(&bytes);
        assert_eq!(text.contains("last command / 5 V"), history > 0);
    }
    let bytes = network_policy_with_history(1).to_bytes();
    let other = fault(&with_header_text(&bytes, "last command / 5 V", "last command / 9 V"));
    assert!(other.contains("last command / 9 V"), "{other}");
    let fewer = fault(&with_header_text(&bytes, "[7,5,3,1]", "[8,5,3,1]"));
    assert!(fewer.contains("7 entries") && fewer.contains("[8, 5, 3, 1]"), "{fewer}");
}

#[test]
fn a_classical_controller_comes_back() {
    let gains = ClassicalGains { balance: [1.0, 2.0, 3.0, 4.0], ..ClassicalGains::default() };
    let bytes = Policy::Classical(ClassicalController::new(gains)).to_bytes();
    match Policy::from_bytes(&bytes).unwrap() {
        Policy::Classical(controller) => assert_eq!(controller.gains(), &gains),
        other => panic!("{other:?} came back"),
    }
}

#[test]
fn a_network_with_other_functions_comes_back_in_version_2_with_its_conventions() {
    let Policy::Network(plain) = network_policy() else { unreachable!() };
    let first = Policy::Network(plain.clone()).to_bytes();
    let has = |bytes: &[u8], text: &str| String::from_utf8_lossy(bytes).contains(text);
    assert!(has(&first, r#"format_version\":1,"#) && !has(&first, "conventions"));
    for activation in Activation::ALL {
        for output in [OutputKind::Linear, OutputKind::Tanh] {
            let network = plain.network.clone().with_functions(activation, output);
            let policy = Policy::Network(NetworkPolicy { network, ..plain.clone() });
            let bytes = policy.to_bytes();
            let is_first = (activation, output) == (Activation::Tanh, OutputKind::Linear);
            assert_eq!(has(&bytes, "conventions"), !is_first);
            match Policy::from_bytes(&bytes).unwrap() {
                Policy::Network(read) => {
                    assert_eq!(
                        (read.network.activation(), read.network.output()),
                        (activation, output)
                    );
                    assert_eq!(Policy::Network(read).to_bytes(), bytes);
                }
                other => panic!("{other:?} came back"),
            }
        }
    }
}

#[test]
fn a_randomisation_comes_back_in_version_2_and_files_without_stay_as_they_are() {
    let Policy::Network(plain) = network_policy() else { unreachable!() };
    let shipped = include_bytes!("../../policies/nominal.safetensors");
    let first = Policy::from_bytes(shipped).unwrap();
    assert_eq!(first.to_bytes(), shipped);
    let randomisation = Randomisation {
        distributions: BTreeMap::from([
            (
                DomainParameter::PendulumMass.into(),
                Distribution::Normal { mean: 0.024, standard_deviation: 0.1 + 0.2 },
            ),
            (
                Nonideality::CommandDelay.into(),
                Distribution::Uniform { mean: 0.008, standard_deviation: 0.004 },
            ),
            (DomainParameter::Gravity.into(), Distribution::Constant { value: 9.81 }),
        ]),
        directions: vec![BTreeMap::from([(DomainParameter::MotorBackEmf.into(), -0.002)])],
        specimens: vec![QubeModel::NOMINAL],
    };
    let training = TrainingRecord { randomisation: Some(randomisation.clone()), ..plain.training };
    let bytes = Policy::Network(NetworkPolicy { training, ..plain }).to_bytes();
    let text = String::from_utf8_lossy(&bytes);
    assert!(text.contains(r#"format_version\":2,"#) && text.contains("conventions"), "{text}");
    match Policy::from_bytes(&bytes).unwrap() {
        Policy::Network(read) => {
            assert_eq!(read.training.randomisation, Some(randomisation));
            assert_eq!(Policy::Network(read).to_bytes(), bytes);
        }
        other => panic!("{other:?} came back"),
    }
    let nameless = fault(&with_header_text(&bytes, r#"\"M_p\""#, r#"\"M_q\""#));
    assert!(nameless.contains("M_q"), "{nameless}");
}

#[test]
fn a_clipped_observation_comes_back_in_version_2() {
    let Policy::Network(plain) = network_policy() else { unreachable!() };
    let mut bounds = vec![[f32::NEG_INFINITY, f32::INFINITY]; plain.network.sizes()[0]];
    bounds[4] = [-0.5, 0.3];
    let network = plain.network.clone().with_bounds(bounds.clone()).unwrap();
    let bytes = Policy::Network(NetworkPolicy { network, ..plain }).to_bytes();
    let named = r#"observation_bounds\":[null,null,null,null,[-0.5,0.3]"#;
    assert!(String::from_utf8_lossy(&bytes).contains(named));
    match Policy::from_bytes(&bytes).unwrap() {
        Policy::Network(read) => {
            assert_eq!(read.network.bounds(), bounds);
            assert_eq!(Policy::Network(read).to_bytes(), bytes);
        }
        other => panic!("{other:?} came back"),
    }
}

#[test]
fn another_convention_is_refused() {
    let Policy::Network(plain) = network_policy() else { unreachable!() };
    let network = plain.network.clone().with_functions(Activation::Relu, OutputKind::Linear);
    let bytes = Policy::Network(NetworkPolicy { network, ..plain }).to_bytes();
    let text = b"+-pi upright";
    let place = bytes.windows(text.len()).position(|window| window == text).unwrap();
    let mut changed = bytes.clone();
    changed[place] = b'-';
    let refused = Policy::from_bytes(&changed).unwrap_err();
    assert!(matches!(refused, PolicyFault::Conventions { version: 2 }), "{refused}");
}

#[test]
fn an_external_controller_comes_back_as_a_name() {
    let answering = External::new("mine").answering(vec![1.0]);
    match Policy::from_bytes(&Policy::External(answering).to_bytes()).unwrap() {
        Policy::External(read) => assert_eq!(read, External::new("mine")),
        other => panic!("{other:?} came back"),
    }
}

#[test]
fn an_excitation_comes_back_and_one_beyond_the_motor_is_refused() {
    for shape in ExcitationShape::ALL {
        let bytes = Policy::Excitation(Excitation::new(shape, -1.25)).to_bytes();
        match Policy::from_bytes(&bytes).unwrap() {
            Policy::Excitation(read) => assert_eq!(read, Excitation::new(shape, -1.25)),
            other => panic!("{other:?} came back"),
        }
    }
    let bytes = Policy::Excitation(Excitation::new(ExcitationShape::Steps, 5.5)).to_bytes();
    assert!(fault(&bytes).contains("5.5 V"), "{}", fault(&bytes));
}

#[test]
fn a_policy_is_loaded_and_errors_name_the_file() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("policy.safetensors");
    std::fs::write(&path, network_policy().to_bytes()).unwrap();
    assert_eq!(Policy::load(&path).unwrap().to_bytes(), network_policy().to_bytes());

    std::fs::write(&path, "no policy").unwrap();
    let message = Policy::load(&path).unwrap_err().to_string();
    assert!(message.contains("policy.safetensors: is not a safetensors file"), "{message}");
    let nowhere = directory.path().join("nowhere").join("policy.safetensors");
    let message = Policy::load(&nowhere).unwrap_err().to_string();
    assert!(message.contains("nowhere") && message.contains("cannot be read"), "{message}");
}

#[test]
fn each_kind_of_damage_is_named() {
    let bytes = network_policy().to_bytes();
    let classical = classical_policy().to_bytes();
    let damaged = |from, to| fault(&with_header_text(&bytes, from, to));
    for (message, expected) in [
        (fault(&vec![0; MAX_FILE_BYTES as usize + 1]), "larger than"),
        (fault(&[]), "not a safetensors file"),
        (fault(&bytes[..bytes.len() - 1]), "not a safetensors file"),
        (fault(&[bytes.as_slice(), &[0]].concat()), "not a safetensors file"),
        (damaged("\"policy\"", "\"polizy\""), "no metadata `policy`"),
        (damaged("format_version\\\":1", "format_version\\\":7"), "format version 7"),
        (damaged("0.05 alpha_dot", "0.50 alpha_dot"), "0.50 alpha_dot"),
        (damaged("\\\"tanh\\\"", "\\\"relu\\\""), "activation `relu`"),
        (damaged("[6,5,3,1]", "[6,5,3,2]"), "[6, 5, 3, 2]"),
        (damaged("[6,5,3,1]", "[6,5,2,1]"), "`layers.1.weight` as F32 [3, 5]"),
        (damaged("[6,5,3,1]", "[6,5,1]  "), "`layers.1.weight` as F32 [3, 5]"),
        (damaged("layers.1.bias", "layers.1.mass"), "no tensor `layers.1.bias`"),
        (damaged("\"F32\"", "\"I32\""), "I32"),
        (damaged("\\\"network\\\"", "\\\"netwerk\\\""), "netwerk"),
        (damaged("action_scale_v\\\":5.0", "action_scale_v\\\":0.0"), "action scale"),
        (damaged("\\\"seed\\\"", "\\\"sead\\\""), "sead"),
        (fault(&with_header_text(&classical, "\"balance\"", "\"balanse\"")), "`balance`"),
    ] {
        assert!(message.contains(expected), "expected {expected:?} in: {message}");
    }
}

#[test]
fn nan_and_infinity_are_refused() {
    let mut bytes = network_policy().to_bytes();
    let end = bytes.len();
    bytes[end - 4..].copy_from_slice(&f32::NAN.to_le_bytes());
    assert!(fault(&bytes).contains("holds NaN"), "{}", fault(&bytes));
    let mut bytes = classical_policy().to_bytes();
    let end = bytes.len();
    bytes[end - 8..].copy_from_slice(&f64::INFINITY.to_le_bytes());
    assert!(fault(&bytes).contains("holds inf for the gain"), "{}", fault(&bytes));
}

#[test]
fn an_impossible_training_record_is_refused() {
    let Policy::Network(policy) = network_policy() else { panic!("the policy is no network") };
    let observer = SimulatedObserver {
        model: QubeModel::NOMINAL,
        theta_noise_rad_s2: 30.0,
        alpha_noise_rad_s2: 30.0,
        reset_error_rad: 0.1,
    };
    let sensors = |corner_rad_s, counts_per_revolution, observer| SimulatedSensors::Encoders {
        corner_rad_s,
        counts_per_revolution,
        observer,
    };
    let fine = TrainingRecord {
        sensors: sensors(200.0, 2048, Some(observer)),
        best_return: Some(540.0),
        ..policy.training.clone()
    };
    let read_back = |training: TrainingRecord| {
        let network = policy.network.clone();
        let policy = Policy::Network(NetworkPolicy { network, training });
        Policy::from_bytes(&policy.to_bytes()).map_err(|fault| fault.to_string())
    };
    assert!(read_back(fine.clone()).is_ok());
    let noise = SimulatedObserver { theta_noise_rad_s2: 0.0, ..observer };
    let mut massless = observer;
    massless.model.parameters.pendulum_mass_kg = 0.0;
    let randomised = |distribution: Distribution, joint: f64| {
        let mass = DomainParameter::PendulumMass.into();
        let randomisation = Randomisation {
            distributions: BTreeMap::from([(mass, distribution)]),
            directions: vec![BTreeMap::from([(mass, joint)])],
            specimens: vec![QubeModel::NOMINAL],
        };
        TrainingRecord { randomisation: Some(randomisation), ..fine.clone() }
    };
    let normal = |mean, standard_deviation| Distribution::Normal { mean, standard_deviation };
    assert!(read_back(randomised(normal(0.024, 0.0), -0.001)).is_ok());
    for (training, words) in [
        (randomised(normal(0.024, -0.1), 0.0), "a standard_deviation of randomisation = -0.1"),
        (randomised(normal(1e308, 0.1), 0.0), "a mean or value of randomisation = 1"),
        (randomised(normal(0.024, 0.1), 1e300), "an entry of randomisation.directions = 1"),
        (
            TrainingRecord { sensors: sensors(-1.0, 2048, None), ..fine.clone() },
            "corner_rad_s = -1",
        ),
        (TrainingRecord { sensors: sensors(200.0, 0, None), ..fine.clone() }, "revolution = 0"),
        (TrainingRecord { sensors: sensors(9.0, 9, Some(noise)), ..fine.clone() }, "theta_noise"),
        (
            TrainingRecord { sensors: sensors(9.0, 9, Some(massless)), ..fine.clone() },
            "names an observer model that describes no Qube: model.parameters.M_p = 0",
        ),
        (TrainingRecord { best_return: Some(1e308), ..fine.clone() }, "best_return"),
        (TrainingRecord { voltage_change_weight: -1.0, ..fine }, "voltage_change_weight = -1"),
    ] {
        let message = read_back(training).unwrap_err();
        assert!(message.contains(words), "{words:?} is missing in: {message}");
    }
}

#[test]
fn an_unexpected_tensor_is_refused() {
    // The file has a tensor `layers.9.weight` in place of `layers.2.weight`.
    let bytes = network_policy().to_bytes();
    let fewer = with_header_text(&bytes, "layers.2.weight", "layers.9.weight");
    assert!(fault(&fewer).contains("no tensor `layers.2.weight`"));
    let classical = classical_policy().to_bytes();
    let text = "{\"__metadata__\"";
    let added =
        "{\"x\":{\"dtype\":\"F64\",\"shape\":[0],\"data_offsets\":[80,80]},\"__metadata__\"";
    let header_length = u64::from_le_bytes(classical[..8].try_into().unwrap()) as usize;
    let header = std::str::from_utf8(&classical[8..8 + header_length]).unwrap();
    let header = header.replacen(text, added, 1);
    let mut longer = (header.len() as u64).to_le_bytes().to_vec();
    longer.extend(header.as_bytes());
    longer.extend(&classical[8 + header_length..]);
    assert!(fault(&longer).contains("unexpected tensor `x`"), "{}", fault(&longer));
}

proptest! {
    #[test]
    fn no_bytes_make_the_reader_panic(bytes in proptest::collection::vec(any::<u8>(), 0..400)) {
        let _ = Policy::from_bytes(&bytes);
    }

    #[test]
    fn no_damage_makes_the_reader_panic_or_accept_a_broken_network(
        changes in proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..6),
        classical in any::<bool>(),
    ) {
        let mut bytes = if classical { classical_policy() } else { network_policy() }.to_bytes();
        for (index, byte) in changes {
            let at = index.index(bytes.len());
            bytes[at] = byte;
        }
        if let Ok(Policy::Network(mut policy)) = Policy::from_bytes(&bytes) {
            // Finite weights may still be large: the output may be infinite, but nothing panics.
            let _ = policy.network.voltage_v(&State::default());
            for layer in policy.network.layers() {
                prop_assert!(layer.weight.iter().chain(&layer.bias).all(|value| value.is_finite()));
            }
        }
    }
}
