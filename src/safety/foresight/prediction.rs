#![allow(
    clippy::needless_range_loop,
    reason = "a lane indexes many arrays at once, and plain index loops become vector code"
)]

use super::super::{Contradiction, PredictedAngle};
use super::{Foresight, ParticleLanes, VelocityQuality, resume};
use crate::elementary::{InstructionSet, Level, VectorKernel, dispatch_at};
use crate::estimation::FilterGains;
use crate::qube::{BLOCK, CONTROL_PERIOD_S, MAX_HISTORY, QubeLanes, SUBSTEPS, State};

/// Control periods after which the prediction restarts from the estimate. They are enough for the
/// motions of two different Qubes to part, and few enough that a balancing pendulum stays
/// predictable.
const WINDOW_PERIODS: u32 = 10;

/// Difference between a sample's time and its expected time above which the prediction restarts, s.
const LATE_S: f64 = 0.002;

/// Allowed distance of a measured angle from the range of the particles' angles, rad: one degree of
/// play between motor and arm, plus two encoder counts.
const PLAY_RAD: f64 = 0.025;

/// Additional allowed distance for each rad/s of velocity, s: the error of a sample's time that is
/// allowed in addition to its measured lateness.
const JITTER_S: f64 = 0.0005;

/// The simulation of every particle beside the Qube, ten control periods at a time, and the
/// comparison of the Qube's motion with the particles' motions.
///
/// Nothing is allocated after [`Self::of`]. The result has the same bits on every instruction set.
#[derive(Clone, Debug)]
pub struct Prediction {
    particles: Vec<ParticleLanes>,
    qubes: Vec<QubeLanes>,
    filter: FilterGains<f32>,
    velocity_quality: VelocityQuality,
    velocity_error_power: u32,
    level: Level,
    /// The current run of the particles; `None` before the first sample, also after
    /// [`begin_anew`](Self::begin_anew).
    run: Option<Run>,
}

/// The last restart of the particles from the estimate: its time by the device's clock, us, and the
/// number of control periods since.
#[derive(Clone, Copy, Debug)]
struct Run {
    since_us: u64,
    periods: u32,
}

/// The smallest and the largest angle among all particles, rad.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Spread {
    theta: [f32; 2],
    alpha: [f32; 2],
}

impl Prediction {
    /// A prediction with the particles of a foresight.
    #[must_use]
    pub fn of<B>(foresight: &Foresight<B>) -> Self {
        Self {
            particles: foresight.particles.clone(),
            qubes: foresight.qubes.clone(),
            filter: foresight.filter,
            velocity_quality: foresight.velocity_quality,
            velocity_error_power: foresight.velocity_error_power,
            level: foresight.level,
            run: None,
        }
    }

    /// Uses this instruction set instead of the best one, for comparisons.
    #[must_use]
    pub(crate) fn at_level(mut self, level: Level) -> Self {
        self.level = level;
        self
    }

    /// Sets the number of control periods between the last two samples, as
    /// [`Foresight::sampled_after`] does.
    pub fn sampled_after(&mut self, periods: u32) {
        self.velocity_quality =
            VelocityQuality::after(periods, &self.filter, self.velocity_error_power);
    }

    /// Restarts the particles at the next sample, because its angles may be counted from another
    /// zero.
    pub fn begin_anew(&mut self) {
        self.run = None;
    }

    /// Returns the contradiction, if an angle lies farther outside the range of the particles'
    /// angles than allowed; if both angles do, the contradiction of the angle that lies farther
    /// outside. Takes the estimated state of the next sample, its time by the device's clock, us,
    /// and the commands before it (V, newest first).
    ///
    /// The first sample and a sample at an unexpected time are not compared: the result is `None`.
    /// The particles restart after such a sample, after a sample that contradicts them, and after
    /// ten periods.
    #[must_use]
    pub fn contradiction(
        &mut self,
        state: &State,
        device_time_us: u64,
        sent_v: &[f32; MAX_HISTORY],
    ) -> Option<Contradiction> {
        let contradiction = self.run.and_then(|run| {
            let periods = run.periods + 1;
            let elapsed_s = device_time_us.saturating_sub(run.since_us) as f64 * 1e-6;
            let late_s = (elapsed_s - f64::from(periods) * CONTROL_PERIOD_S).abs();
            self.run = Some(Run { periods, ..run });
            if late_s > LATE_S {
                self.run = None;
                return None;
            }
            let spread = dispatch_at(
                self.level,
                Period { particles: &self.particles, qubes: &mut self.qubes, command_v: sent_v[0] },
            );
            let beyond = |angle: PredictedAngle, [least, most]: [f32; 2]| {
                let (measured, velocity) = match angle {
                    PredictedAngle::Theta => (state.theta, state.theta_dot),
                    PredictedAngle::Alpha => (state.alpha, state.alpha_dot),
                };
                let allowed_rad = PLAY_RAD + (JITTER_S + late_s) * velocity.abs();
                let is_kept = measured >= f64::from(least) - allowed_rad
                    && measured <= f64::from(most) + allowed_rad;
                let beyond_rad = (f64::from(least) - measured).max(measured - f64::from(most));
                let beyond_rad = Some(beyond_rad as f32).filter(|beyond| beyond.is_finite());
                (!is_kept).then_some(Contradiction { angle, beyond_rad, periods })
            };
            let both = [
                beyond(PredictedAngle::Theta, spread.theta),
                beyond(PredictedAngle::Alpha, spread.alpha),
            ];
            // A distance that is not finite counts as the largest.
            let distance = |it: &Contradiction| it.beyond_rad.unwrap_or(f32::INFINITY);
            both.into_iter().flatten().max_by(|a, b| distance(a).total_cmp(&distance(b)))
        });
        if contradiction.is_some() || self.run.is_none_or(|run| run.periods >= WINDOW_PERIODS) {
            let Self { particles, qubes, velocity_quality, level, .. } = &mut *self;
            let (velocity_quality, state) = (*velocity_quality, state.cast());
            dispatch_at(*level, Begin { particles, qubes, velocity_quality, state, sent_v });
            self.run = Some(Run { since_us: device_time_us, periods: 0 });
        }
        contradiction
    }
}

/// The restart of all particles from an estimate.
struct Begin<'a> {
    particles: &'a [ParticleLanes],
    qubes: &'a mut [QubeLanes],
    velocity_quality: VelocityQuality,
    state: State<f32>,
    sent_v: &'a [f32; MAX_HISTORY],
}

impl VectorKernel for Begin<'_> {
    type Output = ();

    #[inline(always)]
    fn run<I: InstructionSet>(self) {
        let Self { particles, qubes, velocity_quality, state, sent_v } = self;
        for (qubes, particles) in qubes.iter_mut().zip(particles) {
            let first_v = particles.arriving(&[sent_v[0]; BLOCK]);
            resume(qubes, particles, &state, sent_v, &first_v, velocity_quality);
        }
    }
}

/// One control period of all particles under one command.
struct Period<'a> {
    particles: &'a [ParticleLanes],
    qubes: &'a mut [QubeLanes],
    command_v: f32,
}

impl VectorKernel for Period<'_> {
    type Output = Spread;

    #[inline(always)]
    fn run<I: InstructionSet>(self) -> Spread {
        let Self { particles, qubes, command_v } = self;
        let none = [f32::INFINITY, f32::NEG_INFINITY];
        let mut spread = Spread { theta: none, alpha: none };
        for (qubes, particles) in qubes.iter_mut().zip(particles) {
            let commands_v = particles.arriving(&[command_v; BLOCK]);
            qubes.begin_period(&commands_v);
            for piece in 0..=SUBSTEPS {
                qubes.advance(piece);
            }
            qubes.end_period(&commands_v);
            for lane in 0..BLOCK {
                widen(&mut spread.theta, qubes.state.theta[lane] - particles.error.theta[lane]);
                widen(&mut spread.alpha, qubes.state.alpha[lane] - particles.error.alpha[lane]);
            }
        }
        spread
    }
}

#[inline(always)]
fn widen(spread: &mut [f32; 2], angle: f32) {
    *spread = [spread[0].min(angle), spread[1].max(angle)];
}
