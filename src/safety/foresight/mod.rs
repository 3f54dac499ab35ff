//! Foresight: the brake, simulated in advance for many Qubes that this one may be (particles).
//!
//! Reading order: [`Foresight`] predicts whether the brake keeps the arm of every particle away
//! from its stops, `calm` finds the arms that stay away without further simulation, and
//! [`Prediction`] simulates the particles beside the Qube and compares the motions.

#![allow(
    clippy::needless_range_loop,
    reason = "a lane indexes many arrays at once, and plain index loops become vector code"
)]

mod calm;
mod prediction;
#[cfg(test)]
mod tests;
mod velocity_quality;

use calm::CalmLanes;
pub use prediction::Prediction;
use velocity_quality::VelocityQuality;

use super::{BrakeLaw, Particle};
use crate::elementary::{InstructionSet, Level, VectorKernel, dispatch_at};
use crate::estimation::{FilterGains, GUARD_CORNER_RAD_S, through_filters};
use crate::qube::{
    BLOCK, CONTROL_PERIOD_S, InLanes, Lanes, MAX_HISTORY, QubeLanes, SUBSTEPS, State, limited_to,
};

/// Number of blocks of sixteen particles that are simulated side by side. With four, the processor
/// always has another block to compute while the result of one is not ready yet.
const GROUP: usize = 4;

/// The simulation of the brake before it is needed, for every Qube that this one may be: a voltage
/// is held for some control periods, then the brake takes over. Each of these Qubes is a particle
/// with its own delay, and its brake acts on the velocities that the estimator would show.
///
/// The simulation ends at its horizon, and an arm may reach an end later. With a horizon of
/// 0.5 s this happens: of the arms of Qubes at +-30 % that are then neither calm (`calm.rs`) nor at
/// an end, one in forty reaches an end within 1.5 s, because a pendulum that comes to rest nearly
/// upright falls later.
///
/// A block of sixteen particles ends early once none of their arms can reach an end, and a group of
/// 64 particles ends with its last block. Nothing is allocated after [`Self::new`]. The outlook has
/// the same bits on every instruction set.
#[derive(Clone, Debug)]
pub struct Foresight<B> {
    brake: B,
    ends: Ends,
    horizon: PredictionHorizon,
    filter: FilterGains<f32>,
    velocity_quality: VelocityQuality,
    velocity_error_power: u32,
    /// Number of particles, without the copies that fill the last group.
    count: usize,
    particles: Vec<ParticleLanes>,
    qubes: Vec<QubeLanes>,
    /// The state of each Qube as the estimator would show it.
    seen: Vec<State<Lanes>>,
    level: Level,
}

/// The numbers of control periods of a prediction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PredictionHorizon {
    /// Control periods for which the voltage is held before the brake begins, at least 1.
    pub held_periods: u32,
    /// Largest number of control periods that are simulated, at least 1.
    pub horizon_periods: u32,
}

/// The angles that the arm must not reach, rad.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ends {
    /// The end below 0, rad.
    pub low_rad: f32,
    /// The end above 0, rad.
    pub high_rad: f32,
}

/// The result of simulating a voltage and the brake after it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Outlook {
    /// True if the brake keeps every particle's arm short of both ends.
    pub holds: bool,
    /// Smallest distance of any simulated arm from an end, rad: negative beyond the end, NaN if the
    /// simulation diverged or a voltage was NaN.
    pub clearance_rad: f32,
    /// Index of the particle whose arm came closest.
    pub particle: usize,
    /// Number of control periods that were simulated, summed over the groups of 64 particles.
    pub periods: u32,
}

/// The values of a block of sixteen particles that their [`QubeLanes`] do not hold.
#[derive(Clone, Debug)]
#[repr(align(64))]
struct ParticleLanes {
    error: State<Lanes>,
    positive_share: Lanes,
    negative_share: Lanes,
    calm: CalmLanes,
    /// Control periods after which only the brake's voltages act at the motors.
    settled: u32,
    /// Largest voltage of the plant, V.
    largest_v: f32,
}

impl<B: BrakeLaw + Copy> Foresight<B> {
    /// Prepares the simulation of these particles, which should be sorted with the hardest to brake
    /// first. The simulated estimator is the guard's velocity filter with its smallest corner
    /// frequency.
    ///
    /// # Panics
    /// Panics if there is no particle, if the ends are not numbers below and above 0, if a number
    /// of the horizon is 0, if a share of the voltage is not a number from 0 to 1, or if a delay is
    /// not a number from 0 to [`MAX_HISTORY`] control periods.
    #[must_use]
    pub fn new(particles: &[Particle], brake: B, ends: Ends, horizon: PredictionHorizon) -> Self {
        assert!(!particles.is_empty(), "there is no particle");
        assert!(ends.low_rad < 0.0 && ends.high_rad > 0.0, "{ends:?}");
        assert!(horizon.held_periods > 0 && horizon.horizon_periods > 0, "{horizon:?}");
        let count = particles.len();
        let groups = count.div_ceil(GROUP * BLOCK);
        let largest_v = brake.largest_v() as f32;
        let mut qubes = vec![QubeLanes::hanging_limited_to(largest_v); groups * GROUP];
        let at_rest = State::default();
        // Copies of the last particle fill up the last group.
        let of_lane = |lane: usize| &particles[lane.min(particles.len() - 1)];
        for lane in 0..groups * GROUP * BLOCK {
            let Particle { model, positive_share, negative_share, .. } = of_lane(lane);
            let shares = [positive_share, negative_share];
            assert!(shares.iter().all(|share| (0.0..=1.0).contains(*share)), "{shares:?}");
            let delays = 0.0..=MAX_HISTORY as f64 * CONTROL_PERIOD_S;
            assert!(delays.contains(&model.nonidealities.command_delay_s), "delay: {delays:?} s");
            qubes[lane / BLOCK].restart(lane % BLOCK, model, &at_rest);
        }
        let lanes = qubes.iter().enumerate().map(|(block, qubes)| {
            let particles = std::array::from_fn(|lane| of_lane(block * BLOCK + lane));
            ParticleLanes::new(&particles, qubes, &brake, &ends)
        });
        let particles = lanes.map(|particles| particles.holding(horizon.held_periods)).collect();
        let seen = vec![State::all(&at_rest); qubes.len()];
        let filter = FilterGains::new(GUARD_CORNER_RAD_S, CONTROL_PERIOD_S).cast();
        let level = Level::best();
        let velocity_quality = VelocityQuality::after(1, &filter, 0);
        Self {
            brake,
            ends,
            horizon,
            filter,
            velocity_quality,
            velocity_error_power: 0,
            count,
            particles,
            qubes,
            seen,
            level,
        }
    }

    /// Lets the particles' velocity errors grow with this power of the number of control periods
    /// between the last two samples; without it they are the same after lost samples.
    #[must_use]
    pub fn with_velocity_error_power(self, power: u32) -> Self {
        Self { velocity_error_power: power, ..self }
    }

    /// Uses this instruction set instead of the best one, for comparisons.
    #[must_use]
    pub fn at_level(mut self, level: Level) -> Self {
        self.level = level;
        self
    }

    /// Sets the number of control periods between the last two samples, which is 1 unless samples
    /// were lost. Estimated velocities are differences of angles, so they lag more and are less
    /// exact after more lost samples.
    pub fn sampled_after(&mut self, periods: u32) {
        self.velocity_quality =
            VelocityQuality::after(periods, &self.filter, self.velocity_error_power);
    }

    /// Assumes that the velocities of the last sample are as exact as without lost samples, until
    /// the next [`Self::sampled_after`].
    pub fn trust_velocities(&mut self) {
        self.velocity_quality.error_factor = 1.0;
    }

    /// The nearer of the two ends, rad from the middle.
    pub(super) fn nearer_end_rad(&self) -> f32 {
        self.ends.high_rad.min(-self.ends.low_rad)
    }

    /// Switches off the early end of blocks, so that tests can compare it with a simulation to the
    /// horizon.
    #[cfg(test)]
    fn without_calm(mut self) -> Self {
        for particles in &mut self.particles {
            particles.settled = u32::MAX;
        }
        self
    }

    /// Simulates this voltage, V, and the brake after it, from the estimated state and with the
    /// last commands (V, newest first) still on their way. The simulation ends with the first group
    /// of particles in which an arm reaches an end. If a voltage is NaN, the outlook does not hold.
    #[must_use]
    pub fn predict(
        &mut self,
        state: &State<f32>,
        sent_v: &[f32; MAX_HISTORY],
        voltage_v: f32,
    ) -> Outlook {
        // The simulated motor reads NaN as 0 V; a guard must refuse it instead.
        if voltage_v.is_nan() || sent_v.iter().any(|sent_v| sent_v.is_nan()) {
            return Outlook { holds: false, clearance_rad: f32::NAN, particle: 0, periods: 0 };
        }
        let trial = Trial {
            brake: &self.brake,
            ends: self.ends,
            horizon: self.horizon,
            filter: &self.filter,
            velocity_quality: self.velocity_quality,
            count: self.count,
            particles: &self.particles,
            qubes: &mut self.qubes,
            seen: &mut self.seen,
            state: *state,
            sent_v: *sent_v,
            voltage_v,
        };
        dispatch_at(self.level, trial)
    }
}

impl ParticleLanes {
    fn new(
        particles: &[&Particle; BLOCK],
        qubes: &QubeLanes,
        brake: &impl BrakeLaw,
        ends: &Ends,
    ) -> Self {
        let column =
            |number: fn(&Particle) -> f64| particles.map(|particle| number(particle) as f32);
        let error = State {
            theta: column(|particle| particle.error.theta),
            alpha: column(|particle| particle.error.alpha),
            theta_dot: column(|particle| particle.error.theta_dot),
            alpha_dot: column(|particle| particle.error.alpha_dot),
        };
        let periods = |particle: &&Particle| {
            (particle.model.nonidealities.command_delay_s / CONTROL_PERIOD_S).ceil() as u32 + 1
        };
        Self {
            error,
            positive_share: column(|particle| particle.positive_share),
            negative_share: column(|particle| particle.negative_share),
            calm: CalmLanes::new(particles, qubes, brake, ends),
            settled: particles.iter().map(periods).max().unwrap_or(0),
            largest_v: brake.largest_v() as f32,
        }
    }

    /// Lengthens `settled` by the periods after the first for which the voltage is held.
    fn holding(self, held: u32) -> Self {
        Self { settled: self.settled + held - 1, ..self }
    }

    /// The voltages that arrive at the motors after these commands, V.
    #[inline(always)]
    fn arriving(&self, commands_v: &Lanes) -> Lanes {
        let mut arriving_v = [0.0; BLOCK];
        let largest_v = self.largest_v;
        for lane in 0..BLOCK {
            let command_v = limited_to(commands_v[lane], largest_v);
            let share =
                if command_v > 0.0 { self.positive_share[lane] } else { self.negative_share[lane] };
            arriving_v[lane] = share * command_v;
        }
        arriving_v
    }
}

/// One prediction: its inputs, and the lanes in which it is computed.
struct Trial<'a, B> {
    brake: &'a B,
    ends: Ends,
    horizon: PredictionHorizon,
    filter: &'a FilterGains<f32>,
    velocity_quality: VelocityQuality,
    count: usize,
    particles: &'a [ParticleLanes],
    qubes: &'a mut [QubeLanes],
    seen: &'a mut [State<Lanes>],
    state: State<f32>,
    sent_v: [f32; MAX_HISTORY],
    voltage_v: f32,
}

impl<B: BrakeLaw> VectorKernel for Trial<'_, B> {
    type Output = Outlook;

    #[inline(always)]
    fn run<I: InstructionSet>(self) -> Outlook {
        let Self { brake, ends, horizon, filter, count, particles, qubes, seen, .. } = self;
        let Self { velocity_quality, state, sent_v, voltage_v, .. } = self;
        let (groups, _) = qubes.as_chunks_mut::<GROUP>();
        let (seen_groups, _) = seen.as_chunks_mut::<GROUP>();
        let (particle_groups, _) = particles.as_chunks::<GROUP>();
        let mut outlook =
            Outlook { holds: true, clearance_rad: f32::INFINITY, particle: 0, periods: 0 };
        let all = groups.iter_mut().zip(seen_groups).zip(particle_groups);
        for (group, ((qubes, seen), particles)) in all.enumerate() {
            let mut clearances = [[f32::INFINITY; BLOCK]; GROUP];
            for block in 0..GROUP {
                let first_v = particles[block].arriving(&[voltage_v; BLOCK]);
                seen[block] = State::all(&state);
                resume(
                    &mut qubes[block],
                    &particles[block],
                    &state,
                    &sent_v,
                    &first_v,
                    velocity_quality,
                );
                narrow(&mut clearances[block], &qubes[block], &ends);
            }
            let mut over = [false; GROUP];
            let mut holds = true;
            for period in 0..horizon.horizon_periods {
                outlook.periods += 1;
                let mut commands_v = [[voltage_v; BLOCK]; GROUP];
                for block in 0..GROUP {
                    if !over[block] {
                        if period >= horizon.held_periods {
                            commands_v[block] = brakes(brake, &seen[block]);
                        }
                        commands_v[block] = particles[block].arriving(&commands_v[block]);
                        qubes[block].begin_period(&commands_v[block]);
                    }
                }
                for piece in 0..=SUBSTEPS {
                    for block in 0..GROUP {
                        if !over[block] {
                            qubes[block].advance(piece);
                            narrow(&mut clearances[block], &qubes[block], &ends);
                        }
                    }
                }
                for block in 0..GROUP {
                    if !over[block] {
                        qubes[block].end_period(&commands_v[block]);
                        observe(&mut seen[block], &qubes[block], &particles[block], filter);
                        holds &= all_positive(&clearances[block]);
                        over[block] = period >= particles[block].settled
                            && particles[block].calm.holds(&qubes[block], brake);
                    }
                }
                if !holds || over == [true; GROUP] {
                    break;
                }
            }
            for (index, &clearance_rad) in clearances.as_flattened().iter().enumerate() {
                // NaN counts as the smallest distance.
                if clearance_rad < outlook.clearance_rad || clearance_rad.is_nan() {
                    let particle = group * GROUP * BLOCK + index;
                    (outlook.clearance_rad, outlook.particle) =
                        (clearance_rad, particle.min(count - 1));
                }
            }
            if !holds {
                outlook.holds = false;
                break;
            }
        }
        outlook
    }
}

/// Starts a block from the estimated state plus each particle's error, with the last commands still
/// on their way.
///
/// An estimated velocity lags behind its angle. The acceleration of each particle under the
/// voltage that was at its motor brings the velocity up to date.
#[inline(always)]
fn resume(
    qubes: &mut QubeLanes,
    particles: &ParticleLanes,
    state: &State<f32>,
    sent_v: &[f32; MAX_HISTORY],
    first_v: &Lanes,
    VelocityQuality { lag_s, error_factor }: VelocityQuality,
) {
    let mut states = particles.error;
    for lane in 0..BLOCK {
        states.theta[lane] += state.theta;
        states.alpha[lane] += state.alpha;
        states.theta_dot[lane] = state.theta_dot + error_factor * states.theta_dot[lane];
        states.alpha_dot[lane] = state.alpha_dot + error_factor * states.alpha_dot[lane];
    }
    let arrived_v = sent_v.map(|sent_v| particles.arriving(&[sent_v; BLOCK]));
    qubes.resume(&states, &arrived_v);
    qubes.begin_period(first_v);
    let (theta_dot_dot, alpha_dot_dot) = qubes.accelerations_before();
    for lane in 0..BLOCK {
        qubes.state.theta_dot[lane] += lag_s * theta_dot_dot[lane];
        qubes.state.alpha_dot[lane] += lag_s * alpha_dot_dot[lane];
    }
}

/// Updates the estimated states of a block after a control period.
#[inline(always)]
fn observe(
    seen: &mut State<Lanes>,
    qubes: &QubeLanes,
    particles: &ParticleLanes,
    filter: &FilterGains<f32>,
) {
    for lane in 0..BLOCK {
        let theta = qubes.state.theta[lane] - particles.error.theta[lane];
        let alpha = qubes.state.alpha[lane] - particles.error.alpha[lane];
        let next = through_filters(&seen.lane(lane), theta, alpha, filter);
        seen.set_lane(lane, &next);
    }
}

/// The voltages that the brake requests in a block, V.
#[inline(always)]
fn brakes(brake: &impl BrakeLaw, seen: &State<Lanes>) -> Lanes {
    let mut commands_v = [0.0; BLOCK];
    for lane in 0..BLOCK {
        commands_v[lane] = brake.voltage_v(&seen.lane(lane));
    }
    commands_v
}

/// Updates the smallest distance of each arm from an end.
#[inline(always)]
fn narrow(clearances: &mut Lanes, qubes: &QubeLanes, ends: &Ends) {
    for lane in 0..BLOCK {
        let theta = qubes.state.theta[lane];
        let (above, below) = (ends.high_rad - theta, theta - ends.low_rad);
        let room = if above < below { above } else { below };
        // A distance that is NaN stays NaN, because the state that caused it stays NaN.
        clearances[lane] = if room >= clearances[lane] { clearances[lane] } else { room };
    }
}

#[inline(always)]
fn all_positive(clearances: &Lanes) -> bool {
    let mut short = 0;
    for lane in 0..BLOCK {
        short += u32::from(clearances[lane] > 0.0);
    }
    short == BLOCK as u32
}
