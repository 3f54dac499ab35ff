//! Policies: their files, and their voltages for observations.

use std::collections::BTreeMap;
use std::io::ErrorKind;
use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, PoisonError};

use numpy::{PyReadonlyArray1, PyReadonlyArray2, PyReadwriteArray2, PyUntypedArrayMethods};
use pyo3::prelude::*;
use pyo3::sync::MutexExt;
use pyo3::types::PyBytes;
use qube_hil::estimation::EstimatorSettings;
use qube_hil::experiment::is_irreplaceable;
use qube_hil::policy::onnx::{
    ForeignConventions, ImportError, Layers, MAX_FILE_BYTES, ObservationLayout, from_onnx, to_onnx,
};
use qube_hil::policy::{Activation, Controller, LayerWeights, Network, OutputKind, Policy as Kind};
use qube_hil::qube::{
    ALPHA_DOT_FACTOR, Distribution, MAX_HISTORY, MAX_VOLTAGE_V, OBSERVATION_SIZE, PlantModel,
    Quantity, State, THETA_DOT_FACTOR,
};
use qube_hil::storage::{MachineDisk, read_bounded, write_new, write_whole};

use crate::errors::{ActionError, bad_policy, shown};
use crate::settings::read_plant;
use crate::simulation::Simulation;

/// A policy: a network, the classical controller, an excitation, or the name of a controller
/// outside of this program.
#[pyclass(module = "qube_hil._core", frozen)]
pub struct Policy {
    /// Threads take turns, because a controller remembers the motion of a Qube.
    policy: Mutex<Kind>,
}

#[pymethods]
impl Policy {
    /// Reads a policy file.
    #[staticmethod]
    fn load(path: PathBuf) -> PyResult<Self> {
        Ok(Kind::load(&path).map_err(bad_policy)?.into())
    }

    /// Reads the bytes of a policy file.
    #[staticmethod]
    fn from_bytes(bytes: &[u8]) -> PyResult<Self> {
        let bad = |fault| bad_policy(format!("the policy {fault}"));
        Ok(Kind::from_bytes(bytes).map_err(bad)?.into())
    }

    /// Reads a policy from an ONNX file. A file of another program needs `action_scale_v`, the
    /// voltage of an output of 1, V; a file that this program wrote needs only its path, and no
    /// other argument goes without `action_scale_v`.
    #[staticmethod]
    fn from_onnx(
        path: PathBuf,
        action_scale_v: Option<f64>,
        observation: Option<&str>,
        history: Option<usize>,
        corner_rad_s: Option<f64>,
        clip_observation: Option<f32>,
        plant: Option<&str>,
    ) -> PyResult<Self> {
        let conventions = (observation, history, corner_rad_s, clip_observation, plant);
        let foreign = action_scale_v.map(|scale_v| foreign(scale_v, conventions)).transpose()?;
        let named = [
            ("observation", observation.is_some()),
            ("history", history.is_some()),
            ("filter_rad_s", corner_rad_s.is_some()),
            ("clip_observation", clip_observation.is_some()),
            ("plant", plant.is_some()),
        ];
        if let Some((name, _)) = named.into_iter().find(|(_, given)| *given && foreign.is_none()) {
            return Err(bad_policy(format!(
                "{name} without action_scale_v: name action_scale_v too, or leave both out for a file that this \
                 program exported, which names its conventions"
            )));
        }
        let located =
            |message: &dyn std::fmt::Display| bad_policy(format!("{}: {message}", path.display()));
        let bytes = read_bounded(&path, MAX_FILE_BYTES)
            .map_err(|error| located(&format!("cannot be read: {error}")))?;
        let policy = from_onnx(&bytes, foreign.as_ref()).map_err(|error| match error {
            ImportError::NoActionScale => located(&format!("{error} (action_scale_v)")),
            other => located(&other),
        })?;
        Ok(Kind::Network(policy).into())
    }

    /// The bytes of an ONNX model of the policy's network; an error if the policy has none.
    fn to_onnx<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyBytes>> {
        match &*self.turn(py) {
            Kind::Network(policy) => Ok(PyBytes::new(py, &to_onnx(policy))),
            other => Err(bad_policy(format!(
                "the policy is of the kind {} and has no network, which an ONNX model would contain",
                kind(other)
            ))),
        }
    }

    /// Makes a policy of layers: weights `[outputs][inputs]` row by row, and biases. `observation`
    /// names the entries of the observation; without `observation` they are the program's own, with
    /// the last `history` commands.
    #[staticmethod]
    #[allow(
        clippy::too_many_arguments,
        reason = "conventions that a file of weights does not contain"
    )]
    fn from_layers(
        layers: Vec<(PyReadonlyArray2<'_, f32>, PyReadonlyArray1<'_, f32>)>,
        activation: &str,
        output: &str,
        action_scale_v: f64,
        observation: Option<&str>,
        history: Option<usize>,
        corner_rad_s: Option<f64>,
        clip_observation: Option<f32>,
        plant: Option<&str>,
    ) -> PyResult<Self> {
        let activation = Activation::named(activation).ok_or_else(|| {
            let names = Activation::ALL.map(Activation::name).join(", ");
            bad_policy(format!("there is no activation {activation:?}: give one of {names}"))
        })?;
        let output = match output {
            "linear" => OutputKind::Linear,
            "tanh" => OutputKind::Tanh,
            other => {
                return Err(bad_policy(format!(
                    "there is no output {other:?}: give linear or tanh"
                )));
            }
        };
        let foreign =
            foreign(action_scale_v, (observation, history, corner_rad_s, clip_observation, plant))?;
        let inputs = layers.first().map_or(0, |(weight, _)| weight.shape()[1]);
        let layer = |(weight, bias): &(PyReadonlyArray2<'_, f32>, PyReadonlyArray1<'_, f32>)| {
            LayerWeights {
                weight: weight.as_array().iter().copied().collect(),
                bias: bias.as_array().iter().copied().collect(),
            }
        };
        let layers = layers.iter().map(layer).collect();
        let policy = Layers::plain(layers, inputs, activation, output)
            .policy(&foreign)
            .map_err(|error| bad_policy(format!("the policy {error}")))?;
        Ok(Kind::Network(policy).into())
    }

    /// The same policy, recorded as one that was trained with the sensors and on the plant of a
    /// simulation.
    fn seen_through(&self, py: Python<'_>, simulation: &Simulation) -> Self {
        let mut policy = self.turn(py).clone();
        if let Kind::Network(policy) = &mut policy {
            policy.training.sensors = simulation.sensors();
            policy.training.plant = *simulation.plant();
        }
        policy.into()
    }

    /// The bytes of the policy's file.
    fn to_bytes<'py>(&self, py: Python<'py>) -> Bound<'py, PyBytes> {
        PyBytes::new(py, &self.turn(py).to_bytes())
    }

    /// Writes the policy file, which appears whole or not at all. Only `force` replaces an existing
    /// file, and nothing replaces a folder, a pipe, a device, a recording, or the record of a
    /// session or an experiment.
    fn save(&self, py: Python<'_>, path: PathBuf, force: bool) -> PyResult<()> {
        let shown = path.display();
        let is_taken =
            || bad_policy(format!("{shown}: exists already: give another name, or force=True"));
        match path.symlink_metadata() {
            Ok(found) if !found.is_file() && !found.is_symlink() => {
                return Err(bad_policy(format!("{shown}: it is not a file: give a file")));
            }
            Ok(_) if !force => return Err(is_taken()),
            Ok(_) if is_irreplaceable(&path) => {
                return Err(bad_policy(format!(
                    "{shown} is a recording, or the record of a session or an experiment, which nothing replaces: \
                     give another name"
                )));
            }
            _ => {}
        }
        let bytes = self.turn(py).to_bytes();
        if force {
            return write_whole(&MachineDisk, &path, &bytes).map_err(bad_policy);
        }
        // Another program may have taken the name meanwhile.
        write_new(&MachineDisk, &path, &bytes).map_err(|error| match error.source.kind() {
            ErrorKind::AlreadyExists => is_taken(),
            _ => bad_policy(error),
        })
    }

    /// The kind: `network`, `classical`, `excitation` or `external`.
    #[getter]
    fn kind(&self, py: Python<'_>) -> &'static str {
        kind(&self.turn(py))
    }

    /// Number of entries of the observation.
    #[getter]
    fn observation_size(&self, py: Python<'_>) -> usize {
        observation_size(&self.turn(py))
    }

    /// Sizes of the network's layers from the observation to the output; `None` without a network.
    #[getter]
    fn sizes(&self, py: Python<'_>) -> Option<Vec<usize>> {
        match &*self.turn(py) {
            Kind::Network(policy) => Some(policy.network.sizes().to_vec()),
            Kind::Classical(_) | Kind::Excitation(_) | Kind::External(_) => None,
        }
    }

    /// The record of the training as JSON; `None` without a network.
    #[getter]
    fn training(&self, py: Python<'_>) -> PyResult<Option<String>> {
        let Kind::Network(policy) = &*self.turn(py) else { return Ok(None) };
        serde_json::to_string(&policy.training).map(Some).map_err(bad_policy)
    }

    /// The distribution of the draws of each quantity in training as JSON; `None` without a network
    /// or where the file does not name it.
    #[getter]
    fn randomisation(&self, py: Python<'_>) -> PyResult<Option<String>> {
        let Kind::Network(policy) = &*self.turn(py) else { return Ok(None) };
        let Some(known) = &policy.training.randomisation else { return Ok(None) };
        let of_draws = |(&quantity, drawn): (&Quantity, &Distribution)| {
            (quantity.name(), drawn.of_draws(quantity))
        };
        let named: BTreeMap<_, _> = known.distributions.iter().map(of_draws).collect();
        serde_json::to_string(&named).map(Some).map_err(bad_policy)
    }

    /// Starts a rollout: a controller with a memory forgets the last rollout.
    fn start(&self, py: Python<'_>) {
        self.turn(py).start();
    }

    /// Computes the voltage for each of the observations `[n, observation_size]` and writes it to
    /// `voltages_v`, `[n, 1]`, V, limited to the motor's range. A policy other than a network
    /// remembers the motion of one Qube, so that it takes one observation at a time.
    fn voltages(
        &self,
        py: Python<'_>,
        observations: PyReadonlyArray2<'_, f32>,
        mut voltages_v: PyReadwriteArray2<'_, f32>,
    ) -> PyResult<()> {
        let mut turn = self.turn(py);
        let policy = &mut *turn;
        if let Kind::External(external) = policy {
            return Err(bad_policy(format!(
                "the policy is the controller {:?} outside of this program, which is not in the file",
                external.name()
            )));
        }
        let size = observation_size(policy);
        let [count, given] = [observations.shape()[0], observations.shape()[1]];
        if given != size {
            return Err(ActionError::new_err(format!(
                "the observation has {given} entries: this policy sees {size}"
            )));
        }
        if count > 1 && !matches!(policy, Kind::Network(_)) {
            return Err(ActionError::new_err(format!(
                "there are {count} observations: a policy of the kind {} remembers the motion of one Qube, so give one \
                 observation at a time, and each Qube a policy of its own",
                kind(policy)
            )));
        }
        if voltages_v.shape() != [count, 1] {
            return Err(ActionError::new_err(format!("voltages_v: give [{count}, 1]")));
        }
        let observations = observations.as_array();
        let voltages_v = voltages_v.as_slice_mut().map_err(bad_policy)?;
        if !observations.iter().all(|entry| entry.is_finite()) {
            return Err(ActionError::new_err(
                "an observation has an entry that is not a finite number",
            ));
        }
        py.detach(|| {
            let mut observation = vec![0.0; size];
            for (row, voltage_v) in observations.outer_iter().zip(voltages_v) {
                observation.iter_mut().zip(row).for_each(|(entry, &seen)| *entry = seen);
                *voltage_v = match &mut *policy {
                    Kind::Network(policy) => policy.network.voltage_of_observation_v(&observation),
                    other => other.voltage_v(&state_of(&observation)) as f32,
                };
                *voltage_v = voltage_v.clamp(-MAX_VOLTAGE_V as f32, MAX_VOLTAGE_V as f32);
            }
        });
        Ok(())
    }
}

impl Policy {
    /// Waits for this thread's turn. Other threads of Python go on meanwhile.
    fn turn(&self, py: Python<'_>) -> MutexGuard<'_, Kind> {
        self.policy.lock_py_attached(py).unwrap_or_else(PoisonError::into_inner)
    }

    /// A copy of the policy's network; `None` without one.
    pub(crate) fn network(&self, py: Python<'_>) -> Option<Network> {
        match &*self.turn(py) {
            Kind::Network(policy) => Some(policy.network.clone()),
            Kind::Classical(_) | Kind::Excitation(_) | Kind::External(_) => None,
        }
    }
}

impl From<Kind> for Policy {
    fn from(policy: Kind) -> Self {
        Self { policy: Mutex::new(policy) }
    }
}

/// The kind of a policy by name.
fn kind(policy: &Kind) -> &'static str {
    match policy {
        Kind::Network(_) => "network",
        Kind::Classical(_) => "classical",
        Kind::Excitation(_) => "excitation",
        Kind::External(_) => "external",
    }
}

/// Number of entries of the observation that a policy sees.
fn observation_size(policy: &Kind) -> usize {
    match policy {
        Kind::Network(policy) => policy.network.sizes()[0],
        Kind::Classical(_) | Kind::Excitation(_) | Kind::External(_) => OBSERVATION_SIZE,
    }
}

/// Observation, history, corner of the filter, rad/s, bound of the observation, and plant (JSON) of
/// another program's policy, as Python gives them.
type Conventions<'a> = (Option<&'a str>, Option<usize>, Option<f64>, Option<f32>, Option<&'a str>);

/// Checks and collects the conventions of another program's policy. Without `observation` and
/// `history` the policy sees the program's own observation without commands; the default of
/// `corner_rad_s` is that of the program's filter, and the default plant the Qube.
fn foreign(
    action_scale_v: f64,
    (observation, history, corner_rad_s, clip_observation, plant): Conventions<'_>,
) -> PyResult<ForeignConventions> {
    let plant = plant.map(read_plant).transpose()?.unwrap_or(PlantModel::QUBE);
    if let (Some(_), Some(history)) = (observation, history) {
        return Err(bad_policy(format!(
            "history = {history} beside observation: name the last commands in observation (command_1 ...), or give \
             history alone"
        )));
    }
    let history = history.unwrap_or_default();
    let corner_rad_s = corner_rad_s.unwrap_or(EstimatorSettings::default().corner_rad_s);
    if !(action_scale_v.abs() > 0.0 && action_scale_v.abs() <= 100.0) {
        return Err(bad_policy(format!(
            "action_scale_v = {}: give a voltage from -100 to 100 that is not 0",
            shown(action_scale_v)
        )));
    }
    if !(1.0..=10_000.0).contains(&corner_rad_s) {
        return Err(bad_policy(format!("filter_rad_s = {}: give 1 to 10000", shown(corner_rad_s))));
    }
    if history > MAX_HISTORY {
        return Err(bad_policy(format!("history = {history}: give 0 to {MAX_HISTORY}")));
    }
    let layout = match observation {
        Some(names) => ObservationLayout::parse(names).map_err(bad_policy)?,
        None => ObservationLayout::own(history),
    };
    let action_scale_v = action_scale_v as f32;
    Ok(ForeignConventions { layout, action_scale_v, corner_rad_s, clip_observation, plant })
}

/// The state of an observation, rad and rad/s, with both angles within half a turn of 0.
fn state_of(observation: &[f32]) -> State {
    let entry = |index: usize| f64::from(observation[index]);
    State {
        theta: entry(0).atan2(entry(1)),
        alpha: entry(2).atan2(entry(3)),
        theta_dot: entry(4) / THETA_DOT_FACTOR,
        alpha_dot: entry(5) / ALPHA_DOT_FACTOR,
    }
}
