#![allow(
    clippy::needless_range_loop,
    reason = "a lane indexes many arrays at once, and plain index loops become vector code"
)]

use super::lane_observer::ObserverLanes;
use super::lane_status::LaneStatus;
use super::sensors::{SeenLanes, Sensors};
use crate::elementary::{InstructionSet, VectorKernel};
use crate::qube::{
    BLOCK, InLanes, Lanes, MAX_HISTORY, MAX_STEPS, MAX_VOLTAGE_V, OBSERVATION_SIZE, QubeLanes,
    QubeModel, RewardWeights, SUBSTEPS, State, limited_to, observation,
};
use crate::safety::SafetyBox;

/// Sixteen simulated Qubes, and their states as sensors and estimators show them.
#[derive(Clone, Debug)]
#[repr(align(64))]
pub(super) struct Block {
    qubes: QubeLanes,
    /// States as sensors and estimators show them.
    lanes: SeenLanes,
    /// Steps since the start of the trajectory.
    steps: [u32; BLOCK],
}

impl Block {
    /// Sixteen nominal Qubes that hang at rest. `largest_v` is the largest voltage of their motors,
    /// V.
    pub(super) fn hanging(largest_v: f32) -> Self {
        let at_rest = State::default();
        Self {
            qubes: QubeLanes::hanging_limited_to(largest_v),
            lanes: SeenLanes::both(&at_rest),
            steps: [0; BLOCK],
        }
    }

    /// The true state of the Qube in a lane, rad and rad/s.
    pub(super) fn state(&self, lane: usize) -> State<f32> {
        self.qubes.state.lane(lane)
    }

    /// The state of the Qube in a lane as the policy sees it, rad and rad/s.
    pub(super) fn seen(&self, lane: usize) -> State<f32> {
        self.lanes.seen.lane(lane)
    }

    /// The state of the Qube in a lane as the guard sees it, rad and rad/s.
    pub(super) fn guarded(&self, lane: usize) -> State<f32> {
        self.lanes.guarded.lane(lane)
    }

    /// The longest possible observation of a lane: the features of the state, then all remembered
    /// commands, newest first.
    pub(super) fn observed(&self, lane: usize) -> [f32; OBSERVATION_SIZE + MAX_HISTORY] {
        let mut observed = [0.0; OBSERVATION_SIZE + MAX_HISTORY];
        let (state, commands) = observed.split_at_mut(OBSERVATION_SIZE);
        state.copy_from_slice(&observation(&self.seen(lane)));
        let sent_v = self.qubes.sent_v().map(|sent_v| sent_v[lane]);
        commands.copy_from_slice(&sent_v.map(command_fraction));
        observed
    }

    /// Puts another Qube into a lane, at step 0: its true state is `state`, and policy and guard
    /// see `seen`.
    pub(super) fn restart(
        &mut self,
        lane: usize,
        model: &QubeModel,
        state: &State<f32>,
        seen: &State<f32>,
    ) {
        self.qubes.restart(lane, model, state);
        self.lanes.restart(lane, seen);
        self.steps[lane] = 0;
    }
}

/// The parts of a simulation around the physics: sensors, observation, reward and box, in `f32`
/// like the lanes.
#[derive(Clone, Debug)]
pub(super) struct Environment {
    /// Sensors and estimators through which policy and guard see the states.
    pub(super) sensors: Sensors,
    /// Number of last commands in an observation.
    pub(super) history: usize,
    pub(super) reward: RewardWeights<f32>,
    pub(super) safety_box: SafetyBox<f32>,
}

/// Advances all blocks by one control period: writes rewards, integrates the motion, and updates
/// sensors, statuses and observations.
pub(super) struct Step<'a> {
    pub(super) blocks: &'a mut [Block],
    /// Memory of the observers that estimate the states for the policy, one entry for each block;
    /// empty if there are no observers.
    pub(super) observers: &'a mut [ObserverLanes],
    pub(super) environment: &'a Environment,
    pub(super) voltages_v: &'a [Lanes],
    pub(super) rewards: &'a mut [Lanes],
    pub(super) statuses: &'a mut [[LaneStatus; BLOCK]],
    /// Observations after the step, `[6 + history][blocks][16]`.
    pub(super) observations: &'a mut [Lanes],
}

impl VectorKernel for Step<'_> {
    type Output = ();

    #[inline(always)]
    fn run<I: InstructionSet>(self) {
        let Self { blocks, observers, environment, voltages_v, rewards, statuses, observations } =
            self;
        let earned = blocks.iter().zip(voltages_v).zip(rewards);
        for ((block, voltages_v), rewards) in earned {
            write_rewards(block, &environment.reward, voltages_v, rewards);
        }
        // Each substep is computed for every block before the next substep. Blocks do not depend on
        // each other, so the processor can work on several at once.
        if blocks.iter().all(|block| block.qubes.are_ideal()) {
            for _ in 0..SUBSTEPS {
                for (block, voltages_v) in blocks.iter_mut().zip(voltages_v) {
                    block.qubes.advance_ideal(voltages_v);
                }
            }
        } else {
            for (block, voltages_v) in blocks.iter_mut().zip(voltages_v) {
                block.qubes.begin_period(voltages_v);
            }
            for piece in 0..=SUBSTEPS {
                for block in blocks.iter_mut() {
                    block.qubes.advance(piece);
                }
            }
        }
        let count = blocks.len();
        for (index, (block, statuses)) in blocks.iter_mut().zip(statuses).enumerate() {
            let Block { qubes, lanes, .. } = block;
            let observers = observers.get_mut(index);
            environment.sensors.update(&qubes.state, lanes, observers, &voltages_v[index]);
            update_statuses(block, environment, statuses);
            if environment.history > 0 || !block.qubes.are_ideal() {
                block.qubes.end_period(&voltages_v[index]);
            }
            write_observations(block, index, count, environment.history, observations);
        }
    }
}

/// Writes the observations of all blocks: `[6 + history][blocks][16]`.
pub(super) struct Observe<'a> {
    pub(super) blocks: &'a [Block],
    pub(super) history: usize,
    pub(super) observations: &'a mut [Lanes],
}

impl VectorKernel for Observe<'_> {
    type Output = ();

    #[inline(always)]
    fn run<I: InstructionSet>(self) {
        let Self { blocks, history, observations } = self;
        for (index, block) in blocks.iter().enumerate() {
            write_observations(block, index, blocks.len(), history, observations);
        }
    }
}

#[inline(always)]
fn write_rewards(
    block: &Block,
    reward: &RewardWeights<f32>,
    voltages_v: &Lanes,
    rewards: &mut Lanes,
) {
    let largest_v = block.qubes.largest_v();
    for lane in 0..BLOCK {
        let voltage_v = limited_to(voltages_v[lane], largest_v);
        rewards[lane] = reward.reward(&block.lanes.seen.lane(lane), voltage_v);
    }
}

#[inline(always)]
fn update_statuses(
    block: &mut Block,
    environment: &Environment,
    statuses: &mut [LaneStatus; BLOCK],
) {
    let safety_box = &environment.safety_box;
    for lane in 0..BLOCK {
        block.steps[lane] += 1;
        let time_is_up = block.steps[lane] >= MAX_STEPS as u32;
        let inside = safety_box.contains(&block.lanes.guarded.lane(lane));
        let in_the_box = if time_is_up { LaneStatus::TimeUp } else { LaneStatus::Running };
        statuses[lane] = if inside { in_the_box } else { LaneStatus::LeftBox };
    }
}

#[inline(always)]
fn write_observations(
    block: &Block,
    index: usize,
    blocks: usize,
    history: usize,
    observations: &mut [Lanes],
) {
    let mut own = [[0.0; BLOCK]; OBSERVATION_SIZE];
    for lane in 0..BLOCK {
        let observed = observation(&block.lanes.seen.lane(lane));
        for (feature, value) in observed.into_iter().enumerate() {
            own[feature][lane] = value;
        }
    }
    for (feature, lanes) in own.into_iter().enumerate() {
        observations[feature * blocks + index] = lanes;
    }
    for (age, sent_v) in block.qubes.sent_v().iter().take(history).enumerate() {
        let observed = &mut observations[(OBSERVATION_SIZE + age) * blocks + index];
        for lane in 0..BLOCK {
            observed[lane] = command_fraction(sent_v[lane]);
        }
    }
}

/// A command as a fraction of 5 V, as a policy observes it.
#[inline(always)]
fn command_fraction(command_v: f32) -> f32 {
    command_v * (1.0 / MAX_VOLTAGE_V) as f32
}
