//! Many simulated Qubes at once, for the environments of `qube_hil/envs.py`.

use std::sync::{Mutex, MutexGuard, TryLockError};

use numpy::{
    BorrowError, Element, PyArray, PyArray1, PyArray2, PyArrayMethods, PyReadonlyArray1,
    PyReadwriteArray, PyReadwriteArray2, PyUntypedArrayMethods,
};
use pyo3::prelude::*;
use qube_hil::learning::simulated_sensors;
use qube_hil::policy::SimulatedSensors;
use qube_hil::qube::{MAX_HISTORY, MAX_VOLTAGE_V, OBSERVATION_SIZE, PlantModel, Quantity};
use qube_hil::simulation::{
    DomainDistribution, LANES_MULTIPLE, LaneStatus, Observations, Pendulums, SimulationSettings,
    Trajectory,
};

use crate::distribution::{Around, Qubes, read_qubes};
use crate::errors::{ActionError, BusyError, bad_settings};
use crate::guard::Guard;
use crate::settings::read_settings;

/// Most Qubes that one simulation advances.
const MAX_ENVS: usize = 1 << 20;

/// Largest number of entries of an observation.
const LONGEST: usize = OBSERVATION_SIZE + MAX_HISTORY;

/// Simulated Qubes, each in an episode of its own. An episode is drawn from the seed and the
/// episode's number, so that the same seed gives the same episodes whatever the number of Qubes.
///
/// Observations are `float32` arrays `[num_envs, observation_size]`; actions are fractions of 5 V.
/// While a call of one thread is under way, the calls of other threads are refused.
#[pyclass(module = "qube_hil._core", frozen)]
pub struct Simulation {
    num_envs: usize,
    observation_size: usize,
    /// Sensors through which policies see the state.
    sensors: SimulatedSensors,
    plant: PlantModel,
    episodes: Mutex<Episodes>,
}

/// The running episodes, one a Qube.
struct Episodes {
    lanes: Lanes,
    /// Foresight; `None` if the box alone guards the Qubes.
    guard: Option<Guard>,
    distribution: DomainDistribution,
    seed: u64,
    /// Number that the next episode gets.
    next: u64,
    /// Number of each Qube's episode.
    numbers: Vec<u64>,
}

/// The simulated pendulums, one a lane, and the arrays that they read and write.
pub struct Lanes {
    pub pendulums: Pendulums,
    pub voltages_v: Vec<f32>,
    rewards: Vec<f32>,
    statuses: Vec<LaneStatus>,
    /// Feature-major observations, `[observation_size][lanes]`.
    observations: Vec<f32>,
}

/// Observation, reward, terminated, truncated, and whether the guard took over.
type Stepped<'py> = (Bound<'py, PyArray1<f32>>, f64, bool, bool, bool);

#[pymethods]
impl Simulation {
    /// Makes a simulation of `num_envs` Qubes. They are drawn from the distribution with the name
    /// `model`, or around the identified Qube of `profile`; `distributions` (JSON) replaces the
    /// distributions of single quantities. `settings` (JSON) are the settings of the simulation.
    /// `guard` is `box` or `foresight`.
    #[new]
    fn new(
        num_envs: usize,
        model: Option<&str>,
        profile: Option<Around>,
        distributions: &str,
        settings: &str,
        guard: &str,
    ) -> PyResult<Self> {
        if !(1..=MAX_ENVS).contains(&num_envs) {
            return Err(bad_settings(format!("num_envs = {num_envs}: give 1 to {MAX_ENVS}")));
        }
        let settings = read_settings("settings", settings)?;
        let Qubes { distribution, .. } =
            read_qubes(model, profile.as_ref(), distributions, &settings)?;
        let guard = match guard {
            "box" => None,
            "foresight" => Some(Guard::new(num_envs, &settings)),
            other => {
                return Err(bad_settings(format!("guard = {other:?}: give box or foresight")));
            }
        };
        let lanes = Lanes::new(num_envs, &settings);
        let observation_size = lanes.pendulums.observation_size();
        let episodes =
            Episodes { lanes, guard, distribution, seed: 0, next: 0, numbers: vec![0; num_envs] };
        let sensors = simulated_sensors(&settings.sensors, &settings.plant);
        let plant = settings.plant;
        Ok(Self { num_envs, observation_size, sensors, plant, episodes: Mutex::new(episodes) })
    }

    /// Length of an observation.
    #[getter]
    fn observation_size(&self) -> usize {
        self.observation_size
    }

    /// Numbers of the episodes, `uint64 [num_envs]`.
    #[getter]
    fn episodes<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray1<u64>>> {
        Ok(PyArray1::from_slice(py, &self.turn()?.numbers))
    }

    /// The distribution of the simulated Qubes, as JSON.
    #[getter]
    fn distribution(&self) -> PyResult<String> {
        serde_json::to_string(&self.turn()?.distribution).map_err(bad_settings)
    }

    /// Begins an episode in every Qube and writes the first observations. With a seed the numbers
    /// of the episodes begin at 0; without a seed they continue.
    #[pyo3(signature = (seed, observations))]
    fn reset(
        &self,
        py: Python<'_>,
        seed: Option<u64>,
        observations: &Bound<'_, PyArray2<f32>>,
    ) -> PyResult<()> {
        let mut turn = self.turn()?;
        let episodes = &mut *turn;
        let mut observations = written(observations)?;
        let observed = slice_of(&mut observations, [self.num_envs, self.observation_size])?;
        if let Some(seed) = seed {
            (episodes.seed, episodes.next) = (seed, 0);
        }
        py.detach(|| {
            for lane in 0..self.num_envs {
                episodes.begin(lane);
            }
            let Lanes { pendulums, observations, .. } = &mut episodes.lanes;
            pendulums.observe(observations);
            episodes.lanes.write_observations(observed);
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
        &self,
        py: Python<'_>,
        actions: &Bound<'_, PyArray2<f32>>,
        observations: &Bound<'_, PyArray2<f32>>,
        rewards: &Bound<'_, PyArray1<f32>>,
        terminated: &Bound<'_, PyArray1<bool>>,
        truncated: &Bound<'_, PyArray1<bool>>,
        took_over: &Bound<'_, PyArray1<bool>>,
        final_observations: &Bound<'_, PyArray2<f32>>,
    ) -> PyResult<bool> {
        // The arrays of an environment are borrowed under the lock, so that another thread's call
        // does not find them borrowed.
        let mut turn = self.turn()?;
        let episodes = &mut *turn;
        let shape = [self.num_envs, self.observation_size];
        if actions.shape() != [self.num_envs, 1] {
            return Err(ActionError::new_err(format!(
                "the actions have the shape {:?}: give {:?}",
                actions.shape(),
                [self.num_envs, 1]
            )));
        }
        let actions = actions.try_readonly().map_err(|_| {
            ActionError::new_err("the actions share memory with an array in use: give a copy")
        })?;
        let actions = actions.as_array();
        let mut observations = written(observations)?;
        let observed = slice_of(&mut observations, shape)?;
        let mut final_observations = written(final_observations)?;
        let last_observed = slice_of(&mut final_observations, shape)?;
        let (mut rewards, mut terminated) = (written(rewards)?, written(terminated)?);
        let (mut truncated, mut took_over) = (written(truncated)?, written(took_over)?);
        let rewards = rewards.as_slice_mut().map_err(bad_settings)?;
        let terminated = terminated.as_slice_mut().map_err(bad_settings)?;
        let truncated = truncated.as_slice_mut().map_err(bad_settings)?;
        let took_over = took_over.as_slice_mut().map_err(bad_settings)?;
        let lengths = [rewards.len(), terminated.len(), truncated.len(), took_over.len()];
        if lengths != [self.num_envs; 4] {
            return Err(bad_settings("rewards, terminated, truncated, took_over: give [num_envs]"));
        }
        py.detach(|| {
            episodes.lanes.take_actions(actions.iter().copied())?;
            episodes.advance();
            episodes.check_simulated()?;
            rewards.copy_from_slice(&episodes.lanes.rewards[..self.num_envs]);
            let mut ended = false;
            for (lane, status) in episodes.lanes.statuses[..self.num_envs].iter().enumerate() {
                terminated[lane] = *status == LaneStatus::LeftBox;
                truncated[lane] = *status == LaneStatus::TimeUp;
                took_over[lane] =
                    episodes.guard.as_ref().is_some_and(|guard| guard.took_over(lane));
                ended |= *status != LaneStatus::Running;
            }
            if ended {
                episodes.begin_ended(last_observed);
            }
            episodes.lanes.write_observations(observed);
            Ok(ended)
        })
    }

    /// Advances a simulation of one Qube by one control period and begins no other episode. Returns
    /// observation (`float32 [observation_size]`), reward, terminated, truncated, and whether the
    /// guard took over.
    fn step_one<'py>(
        &self,
        py: Python<'py>,
        action: PyReadonlyArray1<'_, f32>,
    ) -> PyResult<Stepped<'py>> {
        let &[action] = action.as_slice().unwrap_or_default() else {
            let shape = action.shape();
            return Err(ActionError::new_err(format!(
                "the action has the shape {shape:?}: give [1]"
            )));
        };
        let mut episodes = self.turn()?;
        episodes.lanes.take_actions(std::iter::once(action))?;
        episodes.advance();
        episodes.check_simulated()?;
        let (mut observed, size) = ([0.0; LONGEST], self.observation_size);
        episodes.lanes.observation(0, &mut observed[..size]);
        let (reward, status) = (episodes.lanes.rewards[0], episodes.lanes.statuses[0]);
        let observed = PyArray1::from_slice(py, &observed[..size]);
        let [left, time_up] = [LaneStatus::LeftBox, LaneStatus::TimeUp].map(|end| status == end);
        let took_over = episodes.guard.as_ref().is_some_and(|guard| guard.took_over(0));
        Ok((observed, f64::from(reward), left, time_up, took_over))
    }

    /// The true state of a Qube: theta and alpha, rad, where alpha is 0 if the pendulum hangs;
    /// theta_dot and alpha_dot, rad/s.
    fn state(&self, index: usize) -> PyResult<[f32; 4]> {
        if index >= self.num_envs {
            let last = self.num_envs - 1;
            return Err(bad_settings(format!("there is no Qube {index}: give 0 to {last}")));
        }
        let state = self.turn()?.lanes.pendulums.state(index);
        Ok([state.theta, state.alpha, state.theta_dot, state.alpha_dot])
    }

    /// The parameters of the Qube in this episode of the last seed, by name, in SI units.
    fn model<'py>(
        &self,
        py: Python<'py>,
        episode: u64,
    ) -> PyResult<Bound<'py, pyo3::types::PyDict>> {
        let model = self.turn()?.drawn(episode).model;
        let named = pyo3::types::PyDict::new(py);
        for quantity in Quantity::all() {
            named.set_item(quantity.name(), model.get(quantity))?;
        }
        Ok(named)
    }
}

impl Simulation {
    /// Sensors through which policies see the state, as policy files record them.
    pub(crate) fn sensors(&self) -> SimulatedSensors {
        self.sensors
    }

    /// The plant of the simulated specimens.
    pub(crate) fn plant(&self) -> &PlantModel {
        &self.plant
    }

    /// Locks the episodes for one call; an error while another call is under way.
    fn turn(&self) -> PyResult<MutexGuard<'_, Episodes>> {
        match self.episodes.try_lock() {
            Ok(episodes) => Ok(episodes),
            Err(TryLockError::Poisoned(poisoned)) => Ok(poisoned.into_inner()),
            Err(TryLockError::WouldBlock) => Err(BusyError::new_err(
                "another thread is inside a call of this environment, and this call has had no effect: give each \
                 thread an environment of its own",
            )),
        }
    }
}

impl Episodes {
    /// The Qube and the start of the episode with this number under the seed.
    fn drawn(&self, number: u64) -> Trajectory {
        Trajectory::draw(&self.distribution, self.seed, number)
    }

    /// Begins the next episode in a lane.
    fn begin(&mut self, lane: usize) {
        let trajectory = self.drawn(self.next);
        self.numbers[lane] = self.next;
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
        let num_envs = self.numbers.len();
        for (lane, voltage_v) in self.lanes.voltages_v[..num_envs].iter_mut().enumerate() {
            *voltage_v = guard.permitted_v(lane, *voltage_v);
        }
        self.lanes.step();
        for (lane, status) in self.lanes.statuses[..num_envs].iter_mut().enumerate() {
            guard.observe(lane, self.lanes.pendulums.guarded(lane));
            if guard.took_over(lane) {
                *status = LaneStatus::LeftBox;
            }
        }
    }

    /// Checks that the observation of every Qube is finite; it is not where the motion of a Qube
    /// diverges.
    fn check_simulated(&self) -> PyResult<()> {
        match self.lanes.first_not_finite(self.numbers.len()) {
            None => Ok(()),
            Some(lane) => Err(bad_settings(format!(
                "the Qube of episode {} cannot be simulated, its motion is not a finite number: narrow the distributions, \
                 and reset the environment",
                self.numbers[lane]
            ))),
        }
    }

    /// Writes the last observation of each ended episode and begins the next episode in its lane; a
    /// lane whose episode goes on gets zeros.
    fn begin_ended(&mut self, last_observed: &mut [f32]) {
        let size = self.lanes.pendulums.observation_size();
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
    /// Pendulums in this many lanes or a few more, at 0 V.
    pub fn new(num_envs: usize, settings: &SimulationSettings) -> Self {
        let pendulums = Pendulums::new(num_envs, settings);
        let lanes = pendulums.lanes();
        Self {
            voltages_v: vec![0.0; lanes],
            rewards: vec![0.0; lanes],
            statuses: vec![LaneStatus::Running; lanes],
            observations: vec![0.0; lanes * pendulums.observation_size()],
            pendulums,
        }
    }

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
    fn not_finite(mut actions: impl Iterator<Item = f32> + Clone) -> PyErr {
        let is_alone = actions.clone().nth(1).is_none();
        let index = actions.position(|action| !action.is_finite()).filter(|_| !is_alone);
        let place = index.map_or(String::new(), |index| format!(" of environment {index}"));
        ActionError::new_err(format!("the action{place} is not a finite number: give -1 to 1"))
    }

    /// Advances the pendulums by one control period under `voltages_v`.
    pub fn step(&mut self) {
        let Self { pendulums, voltages_v, rewards, statuses, observations } = self;
        pendulums.step(voltages_v, rewards, statuses, observations);
    }

    /// The first of the first `count` lanes with an observation that is not a finite number.
    pub fn first_not_finite(&self, count: usize) -> Option<usize> {
        // Zero times a finite number is zero, zero times any other is NaN. Sums in lanes are faster
        // than a test of each number.
        let (blocks, _) = self.observations.as_chunks::<LANES_MULTIPLE>();
        let mut sums = [0.0; LANES_MULTIPLE];
        for block in blocks {
            sums.iter_mut().zip(block).for_each(|(sum, entry)| *sum += 0.0 * entry);
        }
        if sums == [0.0; LANES_MULTIPLE] {
            return None;
        }
        let observations = self.observations_by_lane();
        (0..count).find(|lane| !observations.of_lane(*lane).all(f32::is_finite))
    }

    /// Copies the observation in a lane to `row`.
    fn observation(&self, lane: usize, row: &mut [f32]) {
        self.observations_by_lane().copy_lane(lane, row);
    }

    /// Copies the observations of the first lanes to `rows`, lane by lane.
    fn write_observations(&self, rows: &mut [f32]) {
        let observations = self.observations_by_lane();
        for (lane, row) in rows.chunks_exact_mut(self.pendulums.observation_size()).enumerate() {
            observations.copy_lane(lane, row);
        }
    }

    fn observations_by_lane(&self) -> Observations<'_> {
        Observations::new(&self.observations, self.pendulums.lanes())
    }
}

/// A caller's array, to be written; an error if it shares memory with an array in use.
fn written<'py, T: Element, D: numpy::ndarray::Dimension>(
    array: &Bound<'py, PyArray<T, D>>,
) -> PyResult<PyReadwriteArray<'py, T, D>> {
    array.try_readwrite().map_err(|error: BorrowError| bad_settings(format!("an array: {error}")))
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
