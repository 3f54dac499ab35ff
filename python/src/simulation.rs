//! Many simulated Qubes at once, for the environments of `qube_hil/envs.py`.

use numpy::{
    PyArray1, PyReadonlyArray1, PyReadonlyArray2, PyReadwriteArray1, PyReadwriteArray2,
    PyUntypedArrayMethods,
};
use pyo3::prelude::*;
use qube_hil::estimation::SettingsError as EstimatorError;
use qube_hil::qube::{Distribution, MAX_HISTORY, MAX_VOLTAGE_V, OBSERVATION_SIZE, Quantity};
use qube_hil::simulation::{
    DomainDistribution, Family, LaneStatus, Model, Pendulums, SensorModel, SimulationSettings,
    Trajectory,
};

use crate::errors::{ActionError, bad_settings};
use crate::guard::Guard;

/// Most Qubes that one simulation advances.
const MAX_ENVS: usize = 1 << 20;

/// Largest number of entries of an observation.
const LONGEST: usize = OBSERVATION_SIZE + MAX_HISTORY;

/// Simulated Qubes, each in an episode of its own. An episode is drawn from the seed and the
/// episode's number, so that the same seed gives the same episodes whatever the number of Qubes.
///
/// Observations are `float32` arrays `[num_envs, observation_size]`; actions are fractions of 5 V.
#[pyclass(module = "qube_hil._core")]
pub struct Simulation {
    lanes: Lanes,
    /// Foresight; `None` if the box alone guards the Qubes.
    guard: Option<Guard>,
    distribution: DomainDistribution,
    num_envs: usize,
    seed: u64,
    /// Number that the next episode gets.
    next: u64,
    /// Number of each Qube's episode.
    episodes: Vec<u64>,
}

/// The simulated pendulums, one a lane, and the arrays that they read and write.
struct Lanes {
    pendulums: Pendulums,
    voltages_v: Vec<f32>,
    rewards: Vec<f32>,
    statuses: Vec<LaneStatus>,
    /// Feature-major observations, `[observation_size][lanes]`.
    observations: Vec<f32>,
}

/// Observation, reward, terminated, truncated, and whether the guard took over.
type Stepped<'py> = (Bound<'py, PyArray1<f32>>, f64, bool, bool, bool);

#[pymethods]
impl Simulation {
    /// Makes a simulation of `num_envs` Qubes. `model` is the name of a distribution of Qubes, and
    /// `distributions`, JSON, replaces those of single quantities. `settings`, JSON too, are those
    /// of the simulation. `guard` is `box` or `foresight`.
    #[new]
    fn new(
        num_envs: usize,
        model: &str,
        distributions: &str,
        settings: &str,
        guard: &str,
    ) -> PyResult<Self> {
        if !(1..=MAX_ENVS).contains(&num_envs) {
            return Err(bad_settings(format!("num_envs = {num_envs}: give 1 to {MAX_ENVS}")));
        }
        let settings = read_settings(settings)?;
        let distribution = read_distribution(model, distributions, &settings)?;
        let guard = match guard {
            "box" => None,
            "foresight" => Some(Guard::new(num_envs, &settings)),
            other => {
                return Err(bad_settings(format!("guard = {other:?}: give box or foresight")));
            }
        };
        let pendulums = Pendulums::new(num_envs, &settings);
        let lanes = pendulums.lanes();
        Ok(Self {
            lanes: Lanes {
                voltages_v: vec![0.0; lanes],
                rewards: vec![0.0; lanes],
                statuses: vec![LaneStatus::Running; lanes],
                observations: vec![0.0; lanes * pendulums.observation_size()],
                pendulums,
            },
            guard,
            distribution,
            num_envs,
            seed: 0,
            next: 0,
            episodes: vec![0; num_envs],
        })
    }

    /// Length of an observation.
    #[getter]
    fn observation_size(&self) -> usize {
        self.lanes.pendulums.observation_size()
    }

    /// Numbers of the episodes, `uint64 [num_envs]`.
    #[getter]
    fn episodes<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<u64>> {
        PyArray1::from_slice(py, &self.episodes)
    }

    /// The distribution of the simulated Qubes, as JSON.
    #[getter]
    fn distribution(&self) -> PyResult<String> {
        serde_json::to_string(&self.distribution).map_err(bad_settings)
    }

    /// Begins an episode in every Qube and writes the first observations. With a seed the numbers
    /// of the episodes begin at 0; without a seed they continue.
    #[pyo3(signature = (seed, observations))]
    fn reset(
        &mut self,
        py: Python<'_>,
        seed: Option<u64>,
        mut observations: PyReadwriteArray2<'_, f32>,
    ) -> PyResult<()> {
        let shape = [self.num_envs, self.observation_size()];
        let observed = slice_of(&mut observations, shape)?;
        if let Some(seed) = seed {
            (self.seed, self.next) = (seed, 0);
        }
        py.detach(|| {
            for lane in 0..self.num_envs {
                self.begin(lane);
            }
            self.lanes.pendulums.observe(&mut self.lanes.observations);
            self.lanes.write_observations(observed);
        });
        Ok(())
    }

    /// Advances every Qube by one control period. A Qube whose episode ends begins the next one in
    /// the same step, and the last observation of the ended episode goes to `final_observations`.
    /// `took_over` is true where the guard ended the episode. Returns whether an episode has ended.
    #[allow(
        clippy::too_many_arguments,
        reason = "one array each, as the environment hands them out"
    )]
    fn step(
        &mut self,
        py: Python<'_>,
        actions: PyReadonlyArray2<'_, f32>,
        mut observations: PyReadwriteArray2<'_, f32>,
        mut rewards: PyReadwriteArray1<'_, f32>,
        mut terminated: PyReadwriteArray1<'_, bool>,
        mut truncated: PyReadwriteArray1<'_, bool>,
        mut took_over: PyReadwriteArray1<'_, bool>,
        mut final_observations: PyReadwriteArray2<'_, f32>,
    ) -> PyResult<bool> {
        let shape = [self.num_envs, self.observation_size()];
        if actions.shape() != [self.num_envs, 1] {
            return Err(ActionError::new_err(format!(
                "the actions have the shape {:?}: give {:?}",
                actions.shape(),
                [self.num_envs, 1]
            )));
        }
        let actions = actions.as_array();
        let observed = slice_of(&mut observations, shape)?;
        let last_observed = slice_of(&mut final_observations, shape)?;
        let rewards = rewards.as_slice_mut().map_err(bad_settings)?;
        let terminated = terminated.as_slice_mut().map_err(bad_settings)?;
        let truncated = truncated.as_slice_mut().map_err(bad_settings)?;
        let took_over = took_over.as_slice_mut().map_err(bad_settings)?;
        let lengths = [rewards.len(), terminated.len(), truncated.len(), took_over.len()];
        if lengths != [self.num_envs; 4] {
            return Err(bad_settings("rewards, terminated, truncated, took_over: give [num_envs]"));
        }
        py.detach(|| {
            self.lanes.take_actions(actions.iter().copied())?;
            self.advance();
            rewards.copy_from_slice(&self.lanes.rewards[..self.num_envs]);
            let mut ended = false;
            for (lane, status) in self.lanes.statuses[..self.num_envs].iter().enumerate() {
                terminated[lane] = *status == LaneStatus::LeftBox;
                truncated[lane] = *status == LaneStatus::TimeUp;
                took_over[lane] = self.guard.as_ref().is_some_and(|guard| guard.took_over(lane));
                ended |= *status != LaneStatus::Running;
            }
            if ended {
                self.begin_ended(last_observed);
            }
            self.lanes.write_observations(observed);
            Ok(ended)
        })
    }

    /// Advances a simulation of one Qube by one control period and begins no other episode. Returns
    /// observation (`float32 [observation_size]`), reward, terminated, truncated, and whether the
    /// guard took over.
    fn step_one<'py>(
        &mut self,
        py: Python<'py>,
        action: PyReadonlyArray1<'_, f32>,
    ) -> PyResult<Stepped<'py>> {
        let &[action] = action.as_slice().unwrap_or_default() else {
            let shape = action.shape();
            return Err(ActionError::new_err(format!(
                "the action has the shape {shape:?}: give [1]"
            )));
        };
        self.lanes.take_actions(std::iter::once(action))?;
        self.advance();
        let (mut observed, size) = ([0.0; LONGEST], self.observation_size());
        self.lanes.observation(0, &mut observed[..size]);
        let (reward, status) = (self.lanes.rewards[0], self.lanes.statuses[0]);
        let observed = PyArray1::from_slice(py, &observed[..size]);
        let [left, time_up] = [LaneStatus::LeftBox, LaneStatus::TimeUp].map(|end| status == end);
        let took_over = self.guard.as_ref().is_some_and(|guard| guard.took_over(0));
        Ok((observed, f64::from(reward), left, time_up, took_over))
    }

    /// The true state of a Qube: theta and alpha, rad, where alpha is 0 if the pendulum hangs;
    /// theta_dot and alpha_dot, rad/s.
    fn state(&self, index: usize) -> PyResult<[f32; 4]> {
        if index >= self.num_envs {
            let last = self.num_envs - 1;
            return Err(bad_settings(format!("there is no Qube {index}: give 0 to {last}")));
        }
        let state = self.lanes.pendulums.state(index);
        Ok([state.theta, state.alpha, state.theta_dot, state.alpha_dot])
    }

    /// The parameters of the Qube in this episode of the last seed, by name, in SI units.
    fn model<'py>(
        &self,
        py: Python<'py>,
        episode: u64,
    ) -> PyResult<Bound<'py, pyo3::types::PyDict>> {
        let model = Trajectory::draw(&self.distribution, self.seed, episode).model;
        let named = pyo3::types::PyDict::new(py);
        for quantity in Quantity::all() {
            named.set_item(quantity.name(), model.get(quantity))?;
        }
        Ok(named)
    }
}

impl Simulation {
    /// Begins the next episode in a lane.
    fn begin(&mut self, lane: usize) {
        let trajectory = Trajectory::draw(&self.distribution, self.seed, self.next);
        self.episodes[lane] = self.next;
        self.next += 1;
        self.lanes.pendulums.restart(lane, &trajectory);
        if let Some(guard) = &mut self.guard {
            guard.begin(lane, self.lanes.pendulums.guarded(lane));
        }
    }

    /// Advances every lane by one control period. A guard, if there is one, ends the episodes in
    /// which it takes over.
    fn advance(&mut self) {
        let Some(guard) = &mut self.guard else { return self.lanes.step() };
        for (lane, voltage_v) in self.lanes.voltages_v[..self.num_envs].iter_mut().enumerate() {
            *voltage_v = guard.permitted_v(lane, *voltage_v);
        }
        self.lanes.step();
        for (lane, status) in self.lanes.statuses[..self.num_envs].iter_mut().enumerate() {
            guard.observe(lane, self.lanes.pendulums.guarded(lane));
            if guard.took_over(lane) {
                *status = LaneStatus::LeftBox;
            }
        }
    }

    /// Writes the last observation of each ended episode and begins the next episode in its lane; a
    /// lane whose episode goes on gets zeros.
    fn begin_ended(&mut self, last_observed: &mut [f32]) {
        let size = self.observation_size();
        for (lane, row) in last_observed.chunks_exact_mut(size).enumerate() {
            if self.lanes.statuses[lane] == LaneStatus::Running {
                row.fill(0.0);
                continue;
            }
            self.lanes.observation(lane, row);
            self.begin(lane);
            self.lanes.pendulums.observe_lane(lane, &mut self.lanes.observations);
        }
    }
}

impl Lanes {
    /// Converts the actions to voltages, which are limited to the motor's range; an error if one is
    /// not a finite number.
    fn take_actions(&mut self, actions: impl Iterator<Item = f32> + Clone) -> PyResult<()> {
        let mut finite = true;
        for (voltage_v, action) in self.voltages_v.iter_mut().zip(actions.clone()) {
            finite &= action.is_finite();
            *voltage_v = MAX_VOLTAGE_V as f32 * action.clamp(-1.0, 1.0);
        }
        if finite { Ok(()) } else { Err(Self::not_finite(actions)) }
    }

    /// The error for actions that contain a number that is not finite. The simulation has not
    /// advanced.
    fn not_finite(mut actions: impl Iterator<Item = f32>) -> PyErr {
        let index = actions.position(|action| !action.is_finite());
        let place = index.map_or(String::new(), |index| format!(" of environment {index}"));
        ActionError::new_err(format!("the action{place} is not a finite number: give -1 to 1"))
    }

    fn step(&mut self) {
        let Self { pendulums, voltages_v, rewards, statuses, observations } = self;
        pendulums.step(voltages_v, rewards, statuses, observations);
    }

    /// Copies the observation in a lane to `row`.
    fn observation(&self, lane: usize, row: &mut [f32]) {
        let lanes = self.pendulums.lanes();
        for (feature, value) in row.iter_mut().enumerate() {
            *value = self.observations[feature * lanes + lane];
        }
    }

    /// Copies the observations of the first lanes to `rows`, lane by lane.
    fn write_observations(&self, rows: &mut [f32]) {
        let (lanes, size) = (self.pendulums.lanes(), self.pendulums.observation_size());
        let features: Vec<&[f32]> = self.observations.chunks_exact(lanes).collect();
        for (lane, row) in rows.chunks_exact_mut(size).enumerate() {
            for (value, feature) in row.iter_mut().zip(&features) {
                *value = feature[lane];
            }
        }
    }
}

/// A caller's array as a slice; an error unless it has this shape and is contiguous.
fn slice_of<'a>(
    array: &'a mut PyReadwriteArray2<'_, f32>,
    shape: [usize; 2],
) -> PyResult<&'a mut [f32]> {
    if array.shape() != shape {
        let given = array.shape();
        return Err(bad_settings(format!("an array of observations is {given:?}: give {shape:?}")));
    }
    array.as_slice_mut().map_err(bad_settings)
}

/// Settings of simulations by name, in the order in which messages list them.
fn named_settings() -> [(&'static str, SimulationSettings); 3] {
    [
        ("thesis", SimulationSettings::default()),
        ("machine", SimulationSettings::machine()),
        ("robust", SimulationSettings::robust()),
    ]
}

/// Parses the settings of a simulation from JSON, either a name or an object, and checks them. A
/// setting that the object leaves out has its default.
pub fn read_settings(json: &str) -> PyResult<SimulationSettings> {
    if let Ok(name) = serde_json::from_str::<String>(json) {
        let known = named_settings().into_iter().find(|(known, _)| *known == name);
        return known.map(|(_, settings)| settings).ok_or_else(|| {
            let names = named_settings().map(|(known, _)| known).join(", ");
            bad_settings(format!(
                "there are no settings {name:?}: give a mapping or one of {names}"
            ))
        });
    }
    let settings: SimulationSettings = serde_json::from_str(json)
        .map_err(|error| bad_settings(format!("the simulation's settings: {error}")))?;
    if settings.history > MAX_HISTORY {
        let history = settings.history;
        return Err(bad_settings(format!("history = {history}: give 0 to {MAX_HISTORY}")));
    }
    if let SensorModel::Encoders { estimator } = &settings.sensors {
        let named = |error: EstimatorError| bad_settings(format!("sensors.estimator: {error}"));
        estimator.check().map_err(named)?;
    }
    Ok(settings)
}

/// A model's distribution with some quantities' distributions replaced by those in JSON.
pub fn read_distribution(
    model: &str,
    replaced: &str,
    settings: &SimulationSettings,
) -> PyResult<DomainDistribution> {
    let plain = [Model::Nominal, Model::Handcrafted, Model::NominalHandcrafted, Model::Robust];
    let known = plain.into_iter().find(|known| known.name() == model).ok_or_else(|| {
        let names = plain.map(Model::name).join(", ");
        bad_settings(format!("there is no model {model:?}: give one of {names}"))
    })?;
    let mut distribution =
        known.distribution(&settings.plant, Family::Normal, None, None).map_err(bad_settings)?;
    let replaced: std::collections::BTreeMap<String, Distribution> = serde_json::from_str(replaced)
        .map_err(|error| bad_settings(format!("the distributions: {error}")))?;
    for (name, own) in replaced {
        let quantity = Quantity::from_name(&name).ok_or_else(|| {
            let names: Vec<_> = Quantity::all().map(Quantity::name).collect();
            bad_settings(format!("there is no quantity {name:?}: give one of {}", names.join(", ")))
        })?;
        distribution = distribution.with(quantity, own).map_err(bad_settings)?;
    }
    Ok(distribution)
}
