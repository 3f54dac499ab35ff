#![allow(
    clippy::needless_range_loop,
    reason = "a lane indexes many arrays at once, and plain index loops become vector code"
)]

use super::pendulums::Progress;
use crate::elementary::{InstructionSet, Kernel};
use crate::estimation::{FilterGains, VelocityFilter};
use crate::qube::{
    CONTROL_PERIOD_S, DomainParameters, Dynamics, MAX_HISTORY, MAX_STEPS, MAX_VOLTAGE_V,
    OBSERVATION_SIZE, RewardWeights, SUBSTEPS, State, observation, quantised, runge_kutta_4,
};
use crate::safety::SafetyBox;

/// Pendulums in a block: the widest vector's lanes.
pub(super) const BLOCK: usize = 16;

type Lanes = [f32; BLOCK];

/// Sixteen pendulums, each quantity of theirs beside that of the next: loops over a block's lanes
/// have a fixed length and nothing that could overlap, so that they become plain vector code.
#[derive(Clone, Debug)]
#[repr(align(64))]
pub(super) struct Block {
    state: State<Lanes>,
    /// What sensors and estimator make of it.
    seen: State<Lanes>,
    dynamics: Dynamics<Lanes>,
    /// The last commands as they were let through, V, newest first.
    commands_v: [Lanes; MAX_HISTORY],
    /// Steps since the start.
    steps: [u32; BLOCK],
}

impl Block {
    /// Nominal Qubes that hang at rest.
    pub(super) fn hanging() -> Self {
        let at_rest = State {
            theta: [0.0; BLOCK],
            alpha: [0.0; BLOCK],
            theta_dot: [0.0; BLOCK],
            alpha_dot: [0.0; BLOCK],
        };
        let nominal = Dynamics::<f32>::new(&DomainParameters::NOMINAL);
        Self {
            state: at_rest,
            seen: at_rest,
            dynamics: Dynamics {
                arm_inertia: [nominal.arm_inertia; BLOCK],
                quarter_inertia: [nominal.quarter_inertia; BLOCK],
                coupling: [nominal.coupling; BLOCK],
                pendulum_inertia: [nominal.pendulum_inertia; BLOCK],
                gravity_torque: [nominal.gravity_torque; BLOCK],
                torque_per_volt: [nominal.torque_per_volt; BLOCK],
                arm_damping: [nominal.arm_damping; BLOCK],
                pendulum_damping: [nominal.pendulum_damping; BLOCK],
            },
            commands_v: [[0.0; BLOCK]; MAX_HISTORY],
            steps: [0; BLOCK],
        }
    }

    pub(super) fn state(&self, lane: usize) -> State<f32> {
        lane_of(&self.state, lane)
    }

    pub(super) fn seen(&self, lane: usize) -> State<f32> {
        lane_of(&self.seen, lane)
    }

    /// What a policy sees of a lane with the longest history.
    pub(super) fn observed(&self, lane: usize) -> [f32; OBSERVATION_SIZE + MAX_HISTORY] {
        let mut observed = [0.0; OBSERVATION_SIZE + MAX_HISTORY];
        let (state, commands) = observed.split_at_mut(OBSERVATION_SIZE);
        state.copy_from_slice(&observation(&self.seen(lane)));
        for (observed, command_v) in commands.iter_mut().zip(&self.commands_v) {
            *observed = command_fraction(command_v[lane]);
        }
        observed
    }

    pub(super) fn restart(
        &mut self,
        lane: usize,
        dynamics: &Dynamics<f32>,
        state: &State<f32>,
        seen: &State<f32>,
    ) {
        set_lane(&mut self.state, lane, state);
        set_lane(&mut self.seen, lane, seen);
        self.dynamics.arm_inertia[lane] = dynamics.arm_inertia;
        self.dynamics.quarter_inertia[lane] = dynamics.quarter_inertia;
        self.dynamics.coupling[lane] = dynamics.coupling;
        self.dynamics.pendulum_inertia[lane] = dynamics.pendulum_inertia;
        self.dynamics.gravity_torque[lane] = dynamics.gravity_torque;
        self.dynamics.torque_per_volt[lane] = dynamics.torque_per_volt;
        self.dynamics.arm_damping[lane] = dynamics.arm_damping;
        self.dynamics.pendulum_damping[lane] = dynamics.pendulum_damping;
        for command_v in &mut self.commands_v {
            command_v[lane] = 0.0;
        }
        self.steps[lane] = 0;
    }
}

#[inline(always)]
fn lane_of(states: &State<Lanes>, lane: usize) -> State<f32> {
    State {
        theta: states.theta[lane],
        alpha: states.alpha[lane],
        theta_dot: states.theta_dot[lane],
        alpha_dot: states.alpha_dot[lane],
    }
}

#[inline(always)]
fn set_lane(states: &mut State<Lanes>, lane: usize, state: &State<f32>) {
    states.theta[lane] = state.theta;
    states.alpha[lane] = state.alpha;
    states.theta_dot[lane] = state.theta_dot;
    states.alpha_dot[lane] = state.alpha_dot;
}

/// What surrounds the physics, in the lanes' number type.
#[derive(Clone, Copy, Debug)]
pub(super) struct Surroundings {
    /// Gains of the velocity filter; none when the true state is seen.
    pub(super) filter: Option<FilterGains<f32>>,
    /// How many last commands are observed.
    pub(super) history: usize,
    pub(super) reward: RewardWeights<f32>,
    pub(super) safety_box: SafetyBox<f32>,
}

/// One control period of all blocks.
pub(super) struct Step<'a> {
    pub(super) blocks: &'a mut [Block],
    pub(super) surroundings: &'a Surroundings,
    pub(super) voltages_v: &'a [Lanes],
    pub(super) rewards: &'a mut [Lanes],
    pub(super) progress: &'a mut [[Progress; BLOCK]],
    /// [6 + history][blocks][16].
    pub(super) observations: &'a mut [Lanes],
}

impl Kernel for Step<'_> {
    type Output = ();

    #[inline(always)]
    fn run<I: InstructionSet>(self) {
        let Self { blocks, surroundings, voltages_v, rewards, progress, observations } = self;
        let earned = blocks.iter().zip(voltages_v).zip(rewards);
        for ((block, voltages_v), rewards) in earned {
            earn(block, &surroundings.reward, voltages_v, rewards);
        }
        // One substep of every block before the next of any: neighbours do not wait for each other,
        // so that the processor works on several at once.
        for _ in 0..SUBSTEPS {
            for (block, voltages_v) in blocks.iter_mut().zip(voltages_v) {
                advance(block, voltages_v);
            }
        }
        let count = blocks.len();
        for (index, (block, progress)) in blocks.iter_mut().zip(progress).enumerate() {
            match &surroundings.filter {
                Some(gains) => look_through_encoders(block, gains),
                None => block.seen = block.state,
            }
            judge(block, &surroundings.safety_box, progress);
            if surroundings.history > 0 {
                remember(block, &voltages_v[index]);
            }
            write_observations(block, index, count, surroundings.history, observations);
        }
    }
}

/// Writes the observations of all blocks: [6 + history][blocks][16].
pub(super) struct Observe<'a> {
    pub(super) blocks: &'a [Block],
    pub(super) history: usize,
    pub(super) observations: &'a mut [Lanes],
}

impl Kernel for Observe<'_> {
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
fn earn(block: &Block, reward: &RewardWeights<f32>, voltages_v: &Lanes, rewards: &mut Lanes) {
    for lane in 0..BLOCK {
        rewards[lane] = reward.reward(&lane_of(&block.seen, lane), limited(voltages_v[lane]));
    }
}

#[inline(always)]
fn advance(block: &mut Block, voltages_v: &Lanes) {
    const STEP_S: f32 = (CONTROL_PERIOD_S / SUBSTEPS as f64) as f32;
    let Block { state, dynamics, .. } = block;
    for lane in 0..BLOCK {
        let own = Dynamics {
            arm_inertia: dynamics.arm_inertia[lane],
            quarter_inertia: dynamics.quarter_inertia[lane],
            coupling: dynamics.coupling[lane],
            pendulum_inertia: dynamics.pendulum_inertia[lane],
            gravity_torque: dynamics.gravity_torque[lane],
            torque_per_volt: dynamics.torque_per_volt[lane],
            arm_damping: dynamics.arm_damping[lane],
            pendulum_damping: dynamics.pendulum_damping[lane],
        };
        let next = runge_kutta_4(&own, lane_of(state, lane), limited(voltages_v[lane]), STEP_S);
        set_lane(state, lane, &next);
    }
}

#[inline(always)]
fn look_through_encoders(block: &mut Block, gains: &FilterGains<f32>) {
    let Block { state, seen, .. } = block;
    for lane in 0..BLOCK {
        let before = lane_of(seen, lane);
        let (theta, alpha) = (quantised(state.theta[lane]), quantised(state.alpha[lane]));
        let now = State {
            theta,
            alpha,
            theta_dot: VelocityFilter::at(before.theta, before.theta_dot).update(theta, gains),
            alpha_dot: VelocityFilter::at(before.alpha, before.alpha_dot).update(alpha, gains),
        };
        set_lane(seen, lane, &now);
    }
}

#[inline(always)]
fn judge(block: &mut Block, safety_box: &SafetyBox<f32>, progress: &mut [Progress; BLOCK]) {
    for lane in 0..BLOCK {
        block.steps[lane] += 1;
        let time_is_up = block.steps[lane] >= MAX_STEPS as u32;
        let inside = safety_box.contains(&lane_of(&block.seen, lane));
        let in_the_box = if time_is_up { Progress::TimeUp } else { Progress::Running };
        progress[lane] = if inside { in_the_box } else { Progress::LeftBox };
    }
}

/// Puts this period's commands before those of the periods before it.
#[inline(always)]
fn remember(block: &mut Block, voltages_v: &Lanes) {
    block.commands_v.rotate_right(1);
    for lane in 0..BLOCK {
        block.commands_v[0][lane] = limited(voltages_v[lane]);
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
        let observed = observation(&lane_of(&block.seen, lane));
        for (feature, value) in observed.into_iter().enumerate() {
            own[feature][lane] = value;
        }
    }
    for (feature, lanes) in own.into_iter().enumerate() {
        observations[feature * blocks + index] = lanes;
    }
    for (age, commands_v) in block.commands_v.iter().take(history).enumerate() {
        let observed = &mut observations[(OBSERVATION_SIZE + age) * blocks + index];
        for lane in 0..BLOCK {
            observed[lane] = command_fraction(commands_v[lane]);
        }
    }
}

/// A command as a policy sees it.
#[inline(always)]
fn command_fraction(command_v: f32) -> f32 {
    command_v * (1.0 / MAX_VOLTAGE_V) as f32
}

#[inline(always)]
fn limited(voltage_v: f32) -> f32 {
    voltage_v.clamp(-MAX_VOLTAGE_V as f32, MAX_VOLTAGE_V as f32)
}
