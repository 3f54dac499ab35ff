use super::block::{Block, Environment, Observe, Step};
use super::lane_observer::ObserverLanes;
use super::sensors::Sensors;
use super::{LaneStatus, MAX_COMMAND_DELAY_S, SimulationSettings, Trajectory};
use crate::elementary::{Level, dispatch_at};
use crate::qube::{BLOCK, MAX_HISTORY, State};

/// Number of lanes in a block; the number of lanes of [`Pendulums`] is a multiple of it.
pub const LANES_MULTIPLE: usize = BLOCK;

/// Many simulated pendulums in `f32`, computed side by side in the lanes of vector instructions.
/// Each has its own parameters, nonidealities and trajectory; [`Self::step`] advances all of them
/// by one control period.
///
/// Slices with one entry for each lane have length [`Self::lanes`]. Observations are feature-major,
/// `[observation_size][lanes]`: feature `f` of lane `i` is entry `f * lanes + i`
/// ([`super::Observations`] reads them lane by lane). An observation contains the features of
/// [`crate::qube::observation`], then the last commands as fractions of 5 V, newest first; commands
/// before the start of a trajectory count as zero. The numbers of a lane depend on its own
/// trajectory and voltages alone, and have the same bits on every instruction set.
#[derive(Clone, Debug)]
pub struct Pendulums {
    blocks: Vec<Block>,
    /// Memory of the observers, one entry for each block; empty if there are no observers.
    observers: Vec<ObserverLanes>,
    environment: Environment,
    observation_size: usize,
    level: Level,
}

impl Pendulums {
    /// Creates at least `lanes` pendulums (rounded up to a multiple of [`LANES_MULTIPLE`]). They
    /// are nominal Qubes that hang at rest, until [`Self::restart`] gives them a trajectory.
    ///
    /// # Panics
    /// Panics if the history is longer than [`MAX_HISTORY`].
    #[must_use]
    pub fn new(lanes: usize, settings: &SimulationSettings) -> Self {
        assert!(settings.history <= MAX_HISTORY, "the history must be from 0 to {MAX_HISTORY}");
        let (blocks, sensors) =
            (lanes.div_ceil(BLOCK), Sensors::new(&settings.sensors, &settings.plant));
        let observers = if sensors.observe() { blocks } else { 0 };
        Self {
            blocks: vec![Block::hanging(settings.plant.limits.largest_voltage_v as f32); blocks],
            observers: vec![ObserverLanes::HANGING; observers],
            environment: Environment {
                sensors,
                history: settings.history,
                reward: settings.reward.cast(),
                safety_box: settings.safety_box.cast(),
            },
            observation_size: settings.observation_size(),
            level: Level::best(),
        }
    }

    /// Selects the instruction set, for comparisons (see [`crate::elementary::dispatch_at`]); the
    /// best available one is the default.
    #[must_use]
    pub fn at_level(mut self, level: Level) -> Self {
        self.level = level;
        self
    }

    /// Number of pendulums, a multiple of [`LANES_MULTIPLE`].
    #[must_use]
    pub fn lanes(&self) -> usize {
        self.blocks.len() * BLOCK
    }

    /// Length of an observation: the features of a state, then the last commands.
    #[must_use]
    pub fn observation_size(&self) -> usize {
        self.observation_size
    }

    /// Starts a new trajectory in a lane at step 0.
    ///
    /// The caller's array of observations keeps the lane's old entries until [`Self::observe_lane`]
    /// overwrites them.
    ///
    /// # Panics
    /// Panics if the lane does not exist, or if the Qube's command delay is not from 0 to
    /// [`super::MAX_COMMAND_DELAY_S`].
    pub fn restart(&mut self, lane: usize, trajectory: &Trajectory) {
        let Trajectory { model, start } = trajectory;
        let delays = 0.0..=MAX_COMMAND_DELAY_S;
        let delay_s = model.nonidealities.command_delay_s;
        assert!(delays.contains(&delay_s), "the command delay must be within {delays:?} s");
        let state = start.cast();
        let seen = self.environment.sensors.first(&state);
        self.blocks[lane / BLOCK].restart(lane % BLOCK, model, &state, &seen);
        if let Some(observers) = self.observers.get_mut(lane / BLOCK) {
            observers.restart(lane % BLOCK, &seen);
        }
    }

    /// Writes the current observations of all lanes to `observations`, `[observation_size][lanes]`.
    ///
    /// # Panics
    /// Panics if the slice has another length.
    pub fn observe(&self, observations: &mut [f32]) {
        self.check_length_of(observations);
        let (observations, _) = observations.as_chunks_mut();
        let history = self.environment.history;
        dispatch_at(self.level, Observe { blocks: &self.blocks, history, observations });
    }

    /// Writes the current observation of one lane, for instance after a restart, to its entries of
    /// `observations`, `[observation_size][lanes]`.
    ///
    /// # Panics
    /// Panics if the lane does not exist or the slice has another length.
    pub fn observe_lane(&self, lane: usize, observations: &mut [f32]) {
        self.check_length_of(observations);
        let observed = self.blocks[lane / BLOCK].observed(lane % BLOCK);
        for (feature, value) in observed.into_iter().take(self.observation_size).enumerate() {
            observations[feature * self.lanes() + lane] = value;
        }
    }

    /// Advances all lanes by one control period.
    ///
    /// `voltages_v` are clipped to the largest voltage of the plant, ±5 V for a Qube. The call
    /// writes the `rewards` for the clipped voltages and the states that the policies saw before
    /// the step, the `statuses` of the trajectories after the step, and the `observations` after
    /// the step, `[observation_size][lanes]`, also of trajectories that end with this step.
    ///
    /// A lane whose trajectory has ended continues with meaningless numbers until it is restarted;
    /// they do not affect other lanes. A state that is not a number counts as outside the box.
    ///
    /// # Panics
    /// Panics if a slice has another length.
    pub fn step(
        &mut self,
        voltages_v: &[f32],
        rewards: &mut [f32],
        statuses: &mut [LaneStatus],
        observations: &mut [f32],
    ) {
        let lanes = self.lanes();
        assert_eq!(voltages_v.len(), lanes, "voltages_v must have one entry for each lane");
        assert_eq!(rewards.len(), lanes, "rewards must have one entry for each lane");
        assert_eq!(statuses.len(), lanes, "statuses must have one entry for each lane");
        self.check_length_of(observations);
        let (voltages_v, _) = voltages_v.as_chunks();
        let (rewards, _) = rewards.as_chunks_mut();
        let (statuses, _) = statuses.as_chunks_mut();
        let (observations, _) = observations.as_chunks_mut();
        let step = Step {
            blocks: &mut self.blocks,
            observers: &mut self.observers,
            environment: &self.environment,
            voltages_v,
            rewards,
            statuses,
            observations,
        };
        dispatch_at(self.level, step);
    }

    fn check_length_of(&self, observations: &[f32]) {
        let expected = self.observation_size * self.lanes();
        assert_eq!(
            observations.len(),
            expected,
            "observations must have the shape [observation_size][lanes]"
        );
    }

    /// The true state of the Qube in a lane, rad and rad/s.
    ///
    /// # Panics
    /// Panics if the lane does not exist.
    #[must_use]
    pub fn state(&self, lane: usize) -> State<f32> {
        self.blocks[lane / BLOCK].state(lane % BLOCK)
    }

    /// The state of the Qube in a lane as sensors and estimator show it to the policy, rad and
    /// rad/s.
    ///
    /// # Panics
    /// Panics if the lane does not exist.
    #[must_use]
    pub fn seen(&self, lane: usize) -> State<f32> {
        self.blocks[lane / BLOCK].seen(lane % BLOCK)
    }

    /// The state of the Qube in a lane as sensors and filter show it to the guard, rad and rad/s;
    /// with true states, the true state.
    ///
    /// # Panics
    /// Panics if the lane does not exist.
    #[must_use]
    pub fn guarded(&self, lane: usize) -> State<f32> {
        self.blocks[lane / BLOCK].guarded(lane % BLOCK)
    }
}
