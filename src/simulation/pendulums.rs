use super::block::{Block, Observe, Step, Surroundings};
use super::lane_observer::ObserverLanes;
use super::sensors::Sensors;
use super::{MAX_COMMAND_DELAY_S, SimulationSettings, Trajectory};
use crate::elementary::{Level, Scalar, dispatch_at};
use crate::qube::{BLOCK, MAX_HISTORY, State};

/// The number of lanes is a multiple of this.
pub const LANES_MULTIPLE: usize = BLOCK;

/// How a lane's trajectory stands after a step.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(u8)]
pub enum Progress {
    /// It goes on.
    #[default]
    Running,
    /// It has left the safety box: it earns nothing more, and its value is 0.
    LeftBox,
    /// Its 600 steps are over: whoever learns from it bootstraps its value.
    TimeUp,
}

/// Many pendulums at once, in lanes, in `f32`: each with its own parameters, gap and trajectory, all
/// of them advancing one control period with each [`Self::step`].
///
/// Slices over lanes have length [`Self::lanes`]; observations are feature-major,
/// `[observation_size][lanes]`: feature `f` of lane `i` is entry `f * lanes + i`. The features are
/// those of [`crate::qube::observation`], then the last commands as fractions of 5 V, newest first,
/// zeros at the start of a trajectory. A lane's numbers depend on its own trajectory and voltages
/// alone, and are the same bits on every instruction set.
#[derive(Clone, Debug)]
pub struct Pendulums {
    blocks: Vec<Block>,
    /// As many as blocks, or none.
    observers: Vec<ObserverLanes>,
    surroundings: Surroundings,
    observation_size: usize,
    level: Level,
}

impl Pendulums {
    /// At least `lanes` pendulums (rounded up to a multiple of [`LANES_MULTIPLE`]), nominal and
    /// hanging at rest until they are [`restarted`](Self::restart).
    ///
    /// # Panics
    /// If the history is longer than [`MAX_HISTORY`].
    #[must_use]
    pub fn new(lanes: usize, settings: &SimulationSettings) -> Self {
        assert!(settings.history <= MAX_HISTORY, "history: 0 to {MAX_HISTORY}");
        let (blocks, sensors) = (lanes.div_ceil(BLOCK), Sensors::new(&settings.sensors));
        let observers = if sensors.observe() { blocks } else { 0 };
        Self {
            blocks: vec![Block::hanging(); blocks],
            observers: vec![ObserverLanes::HANGING; observers],
            surroundings: Surroundings {
                sensors,
                history: settings.history,
                reward: settings.reward.cast(),
                safety_box: settings.safety_box.cast(),
            },
            observation_size: settings.observation_size(),
            level: Level::best(),
        }
    }

    /// The same, computed with this instruction set (for comparisons; see
    /// [`crate::elementary::dispatch_at`]).
    #[must_use]
    pub fn at_level(mut self, level: Level) -> Self {
        self.level = level;
        self
    }

    /// How many pendulums there are.
    #[must_use]
    pub fn lanes(&self) -> usize {
        self.blocks.len() * BLOCK
    }

    /// Numbers in an observation: those of a state, then the last commands.
    #[must_use]
    pub fn observation_size(&self) -> usize {
        self.observation_size
    }

    /// Puts a new trajectory into a lane, at its step 0.
    ///
    /// The lane's entries in an array of observations are as they were; see [`Self::observe_lane`].
    ///
    /// A command may be delayed by [`super::MAX_COMMAND_DELAY_S`] at most.
    ///
    /// # Panics
    /// If there is no such lane, or the delay is longer.
    pub fn restart(&mut self, lane: usize, trajectory: &Trajectory) {
        let Trajectory { model, start } = trajectory;
        let delays = 0.0..=MAX_COMMAND_DELAY_S;
        assert!(delays.contains(&model.gap.command_delay_s), "delay: {delays:?} s");
        let state: State<f32> = State {
            theta: f32::from_f64(start.theta),
            alpha: f32::from_f64(start.alpha),
            theta_dot: f32::from_f64(start.theta_dot),
            alpha_dot: f32::from_f64(start.alpha_dot),
        };
        let seen = self.surroundings.sensors.first(&state);
        self.blocks[lane / BLOCK].restart(lane % BLOCK, model, &state, &seen);
        if let Some(observers) = self.observers.get_mut(lane / BLOCK) {
            observers.restart(lane % BLOCK, &seen);
        }
    }

    /// Writes what is observed now in all lanes to `observations`, `[observation_size][lanes]`.
    ///
    /// # Panics
    /// If the length is another.
    pub fn observe(&self, observations: &mut [f32]) {
        self.check_length_of(observations);
        let (observations, _) = observations.as_chunks_mut();
        let history = self.surroundings.history;
        dispatch_at(self.level, Observe { blocks: &self.blocks, history, observations });
    }

    /// Writes what is observed now in one lane to its entries of `observations`,
    /// `[observation_size][lanes]`: after a restart.
    ///
    /// # Panics
    /// If there is no such lane or the length is another.
    pub fn observe_lane(&self, lane: usize, observations: &mut [f32]) {
        self.check_length_of(observations);
        let observed = self.blocks[lane / BLOCK].observed(lane % BLOCK);
        for (feature, value) in observed.into_iter().take(self.observation_size).enumerate() {
            observations[feature * self.lanes() + lane] = value;
        }
    }

    /// One control period of all lanes.
    ///
    /// `voltages_v` is limited to the motor's +-5 V. Written are: the `rewards` of the states before
    /// the step with these voltages; how each trajectory stands now; and the `observations`,
    /// `[observation_size][lanes]`, after the step, also of those that end with it.
    ///
    /// A lane that has ended runs on into the meaningless until it is restarted; nothing of it
    /// reaches other lanes. A state that is not a number counts as outside of the box.
    ///
    /// # Panics
    /// If a slice has another length.
    pub fn step(
        &mut self,
        voltages_v: &[f32],
        rewards: &mut [f32],
        progress: &mut [Progress],
        observations: &mut [f32],
    ) {
        let lanes = self.lanes();
        assert_eq!(voltages_v.len(), lanes, "voltages_v: [lanes]");
        assert_eq!(rewards.len(), lanes, "rewards: [lanes]");
        assert_eq!(progress.len(), lanes, "progress: [lanes]");
        self.check_length_of(observations);
        let (voltages_v, _) = voltages_v.as_chunks();
        let (rewards, _) = rewards.as_chunks_mut();
        let (progress, _) = progress.as_chunks_mut();
        let (observations, _) = observations.as_chunks_mut();
        let step = Step {
            blocks: &mut self.blocks,
            observers: &mut self.observers,
            surroundings: &self.surroundings,
            voltages_v,
            rewards,
            progress,
            observations,
        };
        dispatch_at(self.level, step);
    }

    fn check_length_of(&self, observations: &[f32]) {
        let expected = self.observation_size * self.lanes();
        assert_eq!(observations.len(), expected, "observations: [observation_size][lanes]");
    }

    /// The true state in a lane.
    ///
    /// # Panics
    /// If there is no such lane.
    #[must_use]
    pub fn state(&self, lane: usize) -> State<f32> {
        self.blocks[lane / BLOCK].state(lane % BLOCK)
    }

    /// What sensors and estimator make of the state in a lane.
    ///
    /// # Panics
    /// If there is no such lane.
    #[must_use]
    pub fn seen(&self, lane: usize) -> State<f32> {
        self.blocks[lane / BLOCK].seen(lane % BLOCK)
    }
}
