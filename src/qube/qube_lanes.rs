#![allow(
    clippy::needless_range_loop,
    reason = "a lane indexes many arrays at once, and plain index loops become vector code"
)]

use super::delay_line::{DelayLine, STEP_S};
use super::{
    BLOCK, EquationsOfMotion as _, InLanes, Lanes, MAX_HISTORY, NonidealDynamics, QubeModel,
    SUBSTEPS, State, limited_to, runge_kutta_4,
};
use crate::elementary::{InstructionSet, VectorKernel};

/// Sixteen Qubes side by side in `f32`, each with its own parameters and nonidealities, stored as a
/// structure of arrays. Loops over the lanes have a fixed length and no aliasing, so that they
/// become plain vector code.
///
/// The numbers of a lane depend only on its own Qube, start and commands, and have the same bits on
/// every instruction set. The methods are fast only inside a [`VectorKernel`].
#[derive(Clone, Debug)]
#[repr(align(64))]
pub struct QubeLanes {
    /// True states of the Qubes.
    pub state: State<Lanes>,
    dynamics: NonidealDynamics<Lanes>,
    commands: DelayLine,
    /// True for each lane whose Qube has no Coulomb friction, dead zone, cable or delay, whatever
    /// its parameters are. If all lanes are ideal, [`Self::advance_ideal`] may integrate the block,
    /// on a shorter path with the same bits.
    ideal: [bool; BLOCK],
}

impl QubeLanes {
    /// Nominal Qubes that hang at rest.
    #[must_use]
    pub fn hanging() -> Self {
        let at_rest = State::default();
        Self {
            state: State::all(&at_rest),
            dynamics: NonidealDynamics::all(&NonidealDynamics::new(&QubeModel::NOMINAL)),
            commands: DelayLine::EMPTY,
            ideal: [true; BLOCK],
        }
    }

    /// Qubes like [`Self::hanging`] whose motors get at most this voltage, V.
    #[must_use]
    pub fn hanging_limited_to(largest_v: f32) -> Self {
        Self { commands: DelayLine::limited_to(largest_v), ..Self::hanging() }
    }

    /// Largest voltage that the motors get, V.
    #[must_use]
    #[inline(always)]
    pub fn largest_v(&self) -> f32 {
        self.commands.largest_v()
    }

    /// Puts another Qube into a lane, without any past commands.
    ///
    /// # Panics
    /// Panics if the lane does not exist, or if the delay of the Qube is negative, longer than
    /// [`MAX_HISTORY`] control periods, or NaN.
    pub fn restart(&mut self, lane: usize, model: &QubeModel, state: &State<f32>) {
        self.state.set_lane(lane, state);
        let nonidealities: NonidealDynamics<f32> = NonidealDynamics::new(model);
        self.dynamics.set_lane(lane, &nonidealities);
        self.commands.restart(lane, model.nonidealities.command_delay_s);
        let forces = [
            nonidealities.coulomb_torque,
            nonidealities.positive_dead_zone,
            nonidealities.negative_dead_zone,
            nonidealities.cable_stiffness,
        ];
        self.ideal[lane] = forces == [0.0; 4] && self.commands.is_immediate(lane);
    }

    /// Continues all lanes from these states. `sent_v` are the past commands, V, newest first.
    #[inline(always)]
    pub fn resume(&mut self, states: &State<Lanes>, sent_v: &[Lanes; MAX_HISTORY]) {
        self.state = *states;
        self.commands.resume(sent_v);
    }

    /// The equations of motion of all lanes.
    #[must_use]
    #[inline(always)]
    pub fn dynamics(&self) -> &NonidealDynamics<Lanes> {
        &self.dynamics
    }

    /// The last commands of all lanes, V, newest first.
    #[must_use]
    #[inline(always)]
    pub fn sent_v(&self) -> &[Lanes; MAX_HISTORY] {
        self.commands.all_sent_v()
    }

    /// Returns whether no lane has a Qube with Coulomb friction, dead zone, cable or delay, so that
    /// [`Self::advance_ideal`] may integrate the block.
    #[must_use]
    #[inline(always)]
    pub fn are_ideal(&self) -> bool {
        self.ideal == [true; BLOCK]
    }

    /// Integrates one of [`SUBSTEPS`] steps of a control period of Qubes that [are
    /// ideal](Self::are_ideal), whose voltages are constant over the period.
    #[inline(always)]
    pub fn advance_ideal(&mut self, commands_v: &Lanes) {
        let largest_v = self.commands.largest_v();
        let Self { state, dynamics, .. } = self;
        for lane in 0..BLOCK {
            let own = dynamics.ideal.lane(lane);
            let voltage_v = limited_to(commands_v[lane], largest_v);
            let next = runge_kutta_4(&own, state.lane(lane), voltage_v, STEP_S);
            state.set_lane(lane, &next);
        }
    }

    /// Begins a control period with these commands, for Qubes of any kind.
    #[inline(always)]
    pub fn begin_period(&mut self, commands_v: &Lanes) {
        self.commands.begin_period(commands_v);
    }

    /// The accelerations of arm and pendulum in the present states, rad/s^2, under the voltages at
    /// the motors just before the period that [`Self::begin_period`] has begun; in a lane with the
    /// longest delay, under the voltage of this period.
    #[must_use]
    #[inline(always)]
    pub fn accelerations_before(&self) -> (Lanes, Lanes) {
        let voltages_v = self.commands.before_v();
        let (mut theta_dot_dot, mut alpha_dot_dot) = ([0.0; BLOCK], [0.0; BLOCK]);
        for lane in 0..BLOCK {
            let own = self.dynamics.lane(lane);
            let acceleration = own.acceleration(&self.state.lane(lane), voltages_v[lane]);
            theta_dot_dot[lane] = acceleration.theta;
            alpha_dot_dot[lane] = acceleration.alpha;
        }
        (theta_dot_dot, alpha_dot_dot)
    }

    /// Integrates one of the `SUBSTEPS + 1` pieces of a control period, counted from 0, for Qubes
    /// of any kind.
    #[inline(always)]
    pub fn advance(&mut self, piece: usize) {
        let Self { state, dynamics, commands, .. } = self;
        // The lengths and voltages of the pieces are computed in a loop of their own. In one loop
        // with the integration the compiler emits scalar code, which is eight times slower.
        let (steps_s, voltages_v) = commands.pieces(piece);
        for lane in 0..BLOCK {
            let own = dynamics.lane(lane);
            let next = runge_kutta_4(&own, state.lane(lane), voltages_v[lane], steps_s[lane]);
            state.set_lane(lane, &next);
        }
    }

    /// Ends a control period: adds its commands to the past ones.
    #[inline(always)]
    pub fn end_period(&mut self, commands_v: &Lanes) {
        self.commands.end_period(commands_v);
    }
}

/// A kernel that integrates one control period of several blocks of Qubes.
pub struct ControlPeriod<'a> {
    /// Blocks to integrate.
    pub qubes: &'a mut [QubeLanes],
    /// Commands of each block, V.
    pub commands_v: &'a [Lanes],
}

impl VectorKernel for ControlPeriod<'_> {
    type Output = ();

    #[inline(always)]
    fn run<I: InstructionSet>(self) {
        let Self { qubes, commands_v } = self;
        for (qubes, commands_v) in qubes.iter_mut().zip(commands_v) {
            qubes.begin_period(commands_v);
        }
        // Each piece is computed for every block before the next piece begins. The blocks are
        // independent, so the processor works on several at once.
        for piece in 0..=SUBSTEPS {
            for qubes in qubes.iter_mut() {
                qubes.advance(piece);
            }
        }
        for (qubes, commands_v) in qubes.iter_mut().zip(commands_v) {
            qubes.end_period(commands_v);
        }
    }
}
