//! Training by PPO.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};

use pyo3::prelude::*;
use qube_hil::learning::{
    Origin, Preset, TrainError, TrainSettings, TrainUpdate, Trained, train as train_on, train_from,
};
use qube_hil::policy::Network;
use qube_hil::simulation::{DomainDistribution, Model, SimulationSettings};
use serde_json::{Map, Value};

use crate::POLL_INTERVAL;
use crate::distribution::{Around, Qubes, read_qubes};
use crate::errors::{TrainingError, bad_policy, bad_settings};
use crate::policy::Policy;
use crate::settings::read_settings;

/// Trains a policy and calls `on_update` with each update as JSON. Ctrl-C, or an exception in
/// `on_update`, ends the training.
///
/// `profile` is an identified Qube around which the simulated ones are drawn, in place of `model`;
/// `distributions` (JSON) replaces the distributions of single quantities. `simulation` is JSON, or
/// `None` for the preset's simulation, with the history of the model `robust` for this model and
/// for a profile; `changes` are settings of the training as JSON; `initial` is a policy to continue
/// from. Returns the policy, its best return, and the learning curve as JSON.
#[pyfunction]
#[allow(
    clippy::too_many_arguments,
    reason = "the arguments of a training, by name in the package's function"
)]
pub fn train(
    py: Python<'_>,
    model: Option<&str>,
    profile: Option<Around>,
    distributions: &str,
    preset: &str,
    simulation: Option<&str>,
    changes: &str,
    seed: u64,
    initial: Option<Bound<'_, Policy>>,
    on_update: &Bound<'_, PyAny>,
) -> PyResult<(Policy, f64, String)> {
    let named =
        Preset::NAMED.into_iter().find(|known| known.name() == preset).ok_or_else(|| {
            let names = Preset::NAMED.map(Preset::name).join(", ");
            bad_settings(format!("there is no preset {preset:?}: give one of {names}"))
        })?;
    let of_preset = named.settings_or(TrainSettings::default());
    let mut settings = changed(&of_preset, changes)?;
    settings.simulation = match simulation {
        Some(json) => read_settings("simulation", json)?,
        // As in the command `train`, a profile and the model `robust` set their own history of
        // commands, and the preset sets the rest.
        None if profile.is_some() || model == Some(Model::Robust.name()) => {
            let history = SimulationSettings::robust().history;
            SimulationSettings { history, ..of_preset.simulation }
        }
        None => of_preset.simulation,
    };
    let Qubes { distribution, origin } =
        read_qubes(model, profile.as_ref(), distributions, &settings.simulation)?;
    settings.check().map_err(|error| refused(&error))?;
    let without = || bad_policy("the policy to start from has no network");
    let initial =
        initial.map(|initial| initial.get().network(py).ok_or_else(without)).transpose()?;
    let from = if initial.is_some() { " from a policy" } else { "" };
    // Another weight of voltage changes does not change the recorded preset, as in the command
    // `train`, which has an option for it.
    let voltage_change_weight = of_preset.voltage_change_weight;
    let compared = TrainSettings { voltage_change_weight, ..settings.clone() };
    let origin =
        Origin { model: origin + from, psi: None, preset: Preset::of(&compared).name().to_owned() };
    let trained = supervised(py, initial.as_ref(), &distribution, &settings, seed, on_update)?;
    let best_return = trained.best_return;
    let curve = serde_json::to_string(&trained.curve).map_err(bad_settings)?;
    Ok((trained.into_policy(origin).into(), best_return, curve))
}

/// Trains in another thread, while this one calls `on_update` and checks for Ctrl-C.
fn supervised(
    py: Python<'_>,
    initial: Option<&Network>,
    distribution: &DomainDistribution,
    settings: &TrainSettings,
    seed: u64,
    on_update: &Bound<'_, PyAny>,
) -> PyResult<Trained> {
    let stop = AtomicBool::new(false);
    let (updates, events) = channel();
    std::thread::scope(|scope| {
        let stop = &stop;
        let training = scope.spawn(move || {
            // The receiver is gone only after an error, upon which the training is stopped.
            let on_update = |update: &TrainUpdate| {
                let _ = updates.send(*update);
            };
            match initial {
                Some(initial) => train_from(initial, distribution, settings, seed, stop, on_update),
                None => train_on(distribution, settings, seed, None, stop, on_update),
            }
        });
        let followed = follow(py, events, on_update);
        if followed.is_err() {
            stop.store(true, Ordering::Relaxed);
        }
        let joined = py.detach(|| training.join());
        followed?;
        match joined {
            Ok(trained) => trained.map_err(|error| match error {
                TrainError::Start { .. } => bad_policy(error),
                other => TrainingError::new_err(other.to_string()),
            }),
            Err(panic) => std::panic::resume_unwind(panic),
        }
    })
}

/// Calls `on_update` with each update until the training ends.
fn follow(
    py: Python<'_>,
    events: Receiver<TrainUpdate>,
    on_update: &Bound<'_, PyAny>,
) -> PyResult<()> {
    let mut events = std::sync::Mutex::new(events);
    loop {
        py.check_signals()?;
        let receiver = &mut events;
        let next = py.detach(|| match receiver.get_mut() {
            Ok(receiver) => receiver.recv_timeout(POLL_INTERVAL),
            Err(_) => Err(RecvTimeoutError::Disconnected),
        });
        match next {
            Ok(update) => {
                on_update.call1((serde_json::to_string(&update).map_err(bad_settings)?,))?;
            }
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => return Ok(()),
        }
    }
}

/// Replaces the settings that `changes`, a JSON object, names. Each is read alone, so that an error
/// names it.
fn changed(settings: &TrainSettings, changes: &str) -> PyResult<TrainSettings> {
    let changes: Map<String, Value> = serde_json::from_str(changes).map_err(bad_settings)?;
    let known = every_setting();
    let mut settings = settings.clone();
    for (name, value) in changes {
        let Some(example) = known.get(&name) else {
            let names = known.keys().cloned().collect::<Vec<_>>().join(", ");
            return Err(bad_settings(format!(
                "a training has no setting {name:?}: give some of {names}"
            )));
        };
        let given = if value.is_null() { "None".to_owned() } else { value.to_string() };
        settings = with(&settings, &name, value).map_err(|_| {
            bad_settings(format!("{name} = {given}: give {}", wanted(&name, example)))
        })?;
    }
    Ok(settings)
}

/// The settings, with another value of the one with this name.
fn with(
    settings: &TrainSettings,
    name: &str,
    value: Value,
) -> Result<TrainSettings, serde_json::Error> {
    let mut all = serde_json::to_value(settings)?;
    all[name] = value;
    serde_json::from_value(all)
}

/// The settings of a training with a value for each, without the simulation, which is an argument
/// of its own.
fn every_setting() -> Map<String, Value> {
    let settings = TrainSettings {
        adam_epsilon_beside_root: true,
        target_return: Some(0.0),
        worst_share: 0.5,
        ..TrainSettings::default()
    };
    let Ok(Value::Object(mut all)) = serde_json::to_value(settings) else { return Map::new() };
    all.remove("simulation");
    all
}

/// The values that a setting accepts, in words. `example` is one of its type.
fn wanted(name: &str, example: &Value) -> String {
    let (kind, refused) = match example {
        Value::Bool(_) => return "True or False".into(),
        Value::Number(number) if number.is_u64() => ("a whole number", Value::from(0)),
        _ => ("a number", Value::from(-1e3)),
    };
    // No setting accepts this value, so that the library's check tells the range.
    let checked = with(&TrainSettings::default(), name, refused).map(|settings| settings.check());
    match checked {
        Ok(Err(TrainError::Setting { bound, .. })) => format!("{kind}, {bound}"),
        _ => kind.into(),
    }
}

/// The refusal of a setting of a training.
fn refused(error: &TrainError) -> PyErr {
    bad_settings(match error {
        TrainError::Setting { name, value, bound } => format!("{name} = {value}: give {bound}"),
        other => other.to_string(),
    })
}
