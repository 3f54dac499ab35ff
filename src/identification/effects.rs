//! Score tests of effects outside the equations: the part of the residuals that each of them would
//! explain.

use nalgebra::{DMatrix, DVector};

use super::fit::Fit;
use super::sensitivity::{STARTS, linearised};
use super::stretch::Stretch;
use super::weighing::prior_stds;
use crate::qube::{QubeModel, State};
use crate::replay::MotionSample;

/// Scale of the disturbances of the voltage by which the effects on a motion are computed as finite
/// differences, V.
const DISTURBANCE_V: f64 = 0.02;

/// Angles of the arm over which a torque builds up after a reversal, rad: the first for presliding
/// friction, the second for a cable with hysteresis.
const BUILD_UPS_RAD: [f64; 2] = [0.03, 0.2];

/// An effect outside the equations.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Effect {
    /// A torque that builds up while the arm moves on after a reversal.
    Reversals,
    /// A motor whose torque per volt changes in proportion to the time since the recording's start.
    Warming,
    /// An error of the arm's encoder that has one period in a turn of the arm.
    EncoderEccentricity,
    /// Damping that differs between the arm's two directions: a torque of one sign, in proportion
    /// to |theta_dot|.
    AsymmetricDamping,
    /// Play between motor and arm: where the torque between them changes its sign, the motor turns
    /// alone for a moment, and an encoder on its side is ahead of the arm by half the play.
    Play,
}

impl Effect {
    /// All effects in the order of their columns: `Play` is the last effect on the motor and the
    /// encoder's eccentricity the last of all, because [`columns_of`] writes the encoder columns of
    /// both after the columns of the disturbed voltages.
    pub const ALL: [Self; 5] = [
        Self::Reversals,
        Self::Warming,
        Self::AsymmetricDamping,
        Self::Play,
        Self::EncoderEccentricity,
    ];

    /// Number of columns that describe the effect in the linear regression of the residuals.
    fn columns(self) -> usize {
        match self {
            Self::Reversals | Self::EncoderEccentricity | Self::Play => 2,
            Self::Warming | Self::AsymmetricDamping => 1,
        }
    }

    /// The disturbances of a recording's voltages that act like the effect, in units of
    /// [`DISTURBANCE_V`]: one list for each column of the effect, except for columns that describe
    /// an error of the encoder, which have none.
    fn disturbances(self, samples: &[MotionSample], model: &QubeModel) -> Vec<Vec<f64>> {
        let delay_s = model.nonidealities.command_delay_s;
        match self {
            Self::EncoderEccentricity => Vec::new(),
            Self::Warming => {
                let start_s = samples[0].time_s;
                vec![samples.iter().map(|it| it.voltage_v * (it.time_s - start_s)).collect()]
            }
            Self::AsymmetricDamping => {
                let speeds: Vec<f64> = samples
                    .windows(2)
                    .map(|pair| {
                        let moved = pair[1].state.theta - pair[0].state.theta;
                        moved.abs() / (pair[1].time_s - pair[0].time_s)
                    })
                    .collect();
                vec![values_at_arrival(samples, &speeds, delay_s)]
            }
            Self::Play => {
                let pushes_v = pushes_v(samples, model);
                let lost = |pair: &[f64]| if pair[0] * pair[1] < 0.0 { -pair[1] } else { 0.0 };
                let lost_v: Vec<f64> =
                    std::iter::once(0.0).chain(pushes_v.windows(2).map(lost)).collect();
                vec![values_at_arrival(samples, &lost_v, delay_s)]
            }
            Self::Reversals => BUILD_UPS_RAD
                .map(|angle_rad| values_at_arrival(samples, &built_up(samples, angle_rad), delay_s))
                .to_vec(),
        }
    }
}

/// The entries of `values`, one for each sample, at the time at which the sample's command reaches
/// the motor. A disturbance that is added to the command then acts at that time.
fn values_at_arrival(samples: &[MotionSample], values: &[f64], delay_s: f64) -> Vec<f64> {
    let last = values.len().saturating_sub(1);
    let at = |sample: &MotionSample| {
        let acts = samples.partition_point(|later| later.time_s < sample.time_s + delay_s);
        values.get(acts.min(last)).copied().unwrap_or(0.0)
    };
    samples.iter().map(at).collect()
}

/// The torque that the motor passes on to the arm at each sample, as a voltage, V: the command that
/// acts, less dead zones, friction and the voltage that the arm's speed induces.
fn pushes_v(samples: &[MotionSample], model: &QubeModel) -> Vec<f64> {
    let (parameters, nonidealities) = (&model.parameters, &model.nonidealities);
    let friction_v = nonidealities.coulomb_torque_n_m * parameters.motor_resistance_ohm
        / parameters.motor_back_emf_v_s;
    let one = |sample: &MotionSample| {
        let acting_s = sample.time_s - nonidealities.command_delay_s;
        let sent = samples.partition_point(|it| it.time_s <= acting_s + 1e-9);
        let voltage_v = samples[sent.saturating_sub(1)].voltage_v;
        let above = (voltage_v - nonidealities.positive_dead_zone_v).max(0.0);
        let below = (voltage_v + nonidealities.negative_dead_zone_v).min(0.0);
        let speed_rad_s = sample.state.theta_dot;
        let induced_v = parameters.motor_back_emf_v_s * speed_rad_s;
        above + below - induced_v - friction_v * speed_rad_s.signum()
    };
    samples.iter().map(one).collect()
}

/// The torque at each sample, as a share of its largest, of an element that resists the arm
/// elastically until it slides (Dahl's friction).
fn built_up(samples: &[MotionSample], angle_rad: f64) -> Vec<f64> {
    let mut share = 0.0_f64;
    let mut last_rad = samples[0].state.theta;
    let mut one = |sample: &MotionSample| {
        let moved = (sample.state.theta - last_rad) / angle_rad;
        last_rad = sample.state.theta;
        // The solution of share' = v - |v| share over a movement in one direction.
        share = moved.signum() + (share - moved.signum()) * (-moved.abs()).exp();
        share
    };
    samples.iter().map(&mut one).collect()
}

/// The result of adding an effect to the model; unknowns and start states adapt to it.
pub(super) struct Trial {
    /// Effect that is added.
    pub effect: Effect,
    /// The reduction of the sum of squared residuals, in units of the residual variance. Where the
    /// model holds, it has a chi-squared distribution with as many degrees of freedom as the effect
    /// has columns.
    pub score: f64,
    /// The change of each unknown, in prior standard deviations.
    pub shift: DVector<f64>,
}

/// Adds each effect by itself to the model of a fit over short windows whose start states were
/// fitted anew.
pub(super) fn trials(fit: &Fit<'_>) -> Vec<Trial> {
    let size = columns(fit);
    let mut squares = DMatrix::<f64>::zeros(size, size);
    let simulated = simulated(fit);
    let mut disturbed: Vec<Option<Disturbed>> = vec![None; fit.offsets.len()];
    let mut count = 0.0;
    for (index, stretch) in fit.stretches.iter().enumerate() {
        let recording = fit.recording[index];
        let disturbed = disturbed[recording].get_or_insert_with(|| {
            let pairs = fit.stretches.iter().zip(&simulated);
            let own = pairs.filter(|(other, _)| other.is_of_same_recording(stretch));
            let model = fit.offsets[recording].applied(&fit.model);
            Disturbed::of(&with_simulated_states(stretch.recording, own), &model)
        });
        let all = columns_of(fit, index, &simulated[index], disturbed);
        squares += all.tr_mul(&all);
        count += (all.nrows() - STARTS.min(all.nrows())) as f64;
    }
    regressions(fit, &squares, count)
}

/// Number of columns of a fit: its unknowns, the effects in the order of [`Effect::ALL`], and the
/// residuals.
fn columns(fit: &Fit<'_>) -> usize {
    fit.unknowns.len() + Effect::ALL.iter().map(|effect| effect.columns()).sum::<usize>() + 1
}

/// The columns of the stretch with this index: unknowns, effects, residuals, each without the part
/// that a change of the start state explains. `simulated` contains the states of the stretch
/// without effects.
fn columns_of(
    fit: &Fit<'_>,
    index: usize,
    simulated: &[State],
    disturbed: &Disturbed,
) -> DMatrix<f64> {
    let (stretch, start) = (&fit.stretches[index], fit.starts[index]);
    let offset = &fit.offsets[fit.recording[index]];
    let model = offset.applied(&fit.model);
    let unknowns = fit.unknowns.len();
    let (mut residuals, slopes) =
        linearised(stretch, fit.unknowns, fit.plant, &model, start, [1.0, 1.0]);
    // The recorded angles of the pendulum contain the error of their zero.
    let zero_rad = offset.alpha_zero_rad;
    residuals.iter_mut().skip(1).step_by(2).for_each(|alpha| *alpha += zero_rad);
    let mut all = DMatrix::<f64>::zeros(residuals.len(), columns(fit));
    all.columns_mut(0, unknowns).copy_from(&slopes.columns(0, unknowns));
    let mut column = unknowns;
    for copy in &disturbed.copies {
        let states = Stretch { recording: copy, ..*stretch }.simulate(&model, start);
        for (row, (moved, unmoved)) in states.iter().zip(simulated).enumerate() {
            all[(2 * row, column)] = (moved.theta - unmoved.theta) / DISTURBANCE_V;
            all[(2 * row + 1, column)] = (moved.alpha - unmoved.alpha) / DISTURBANCE_V;
        }
        column += 1;
    }
    for (row, push_v) in disturbed.pushes_v[stretch.range()].iter().enumerate() {
        all[(2 * row, column)] = push_v.signum();
    }
    column += 1;
    // An error with one period in a turn is a combination of the angle's sine and cosine.
    for (row, state) in simulated.iter().enumerate() {
        let (sin, cos) = state.theta.sin_cos();
        (all[(2 * row, column)], all[(2 * row, column + 1)]) = (sin, cos);
    }
    all.set_column(column + 2, &residuals);
    let starts = slopes.columns(unknowns, STARTS).into_owned();
    if let Some(inverse) = starts.tr_mul(&starts).try_inverse() {
        all -= &starts * (inverse * starts.tr_mul(&all));
    }
    all
}

/// The states of each stretch, simulated from its start state.
fn simulated(fit: &Fit<'_>) -> Vec<Vec<State>> {
    let pieces = fit.stretches.iter().zip(&fit.starts).zip(&fit.recording);
    let one = |((stretch, &start), &recording): ((&Stretch<'_>, &State), &usize)| {
        stretch.simulate(&fit.offsets[recording].applied(&fit.model), start)
    };
    pieces.map(one).collect()
}

/// A recording with the simulated states of its stretches in place of the recorded states. Samples
/// outside the stretches, such as the samples of the first 0.04 s, keep their recorded states. The
/// effects depend on the arm's angle, and the simulated angle is free of the encoder's rounding,
/// which is part of the residual. Where two stretches meet, the states jump by about that rounding.
fn with_simulated_states<'a>(
    recording: &[MotionSample],
    stretches: impl Iterator<Item = (&'a Stretch<'a>, &'a Vec<State>)>,
) -> Vec<MotionSample> {
    let mut samples = recording.to_vec();
    for (stretch, states) in stretches {
        for (sample, state) in samples[stretch.range()].iter_mut().zip(states) {
            sample.state = *state;
        }
    }
    samples
}

/// A recording under the effects.
#[derive(Clone)]
struct Disturbed {
    /// Copies of the recording with disturbed voltages, one for each list of
    /// [`Effect::disturbances`].
    copies: Vec<Vec<MotionSample>>,
    /// The result of [`pushes_v`]: its sign is the side of the play on which the motor is.
    pushes_v: Vec<f64>,
}

impl Disturbed {
    fn of(samples: &[MotionSample], model: &QubeModel) -> Self {
        let one = |by: Vec<f64>| {
            let add = |(sample, by): (&MotionSample, f64)| MotionSample {
                voltage_v: sample.voltage_v + DISTURBANCE_V * by,
                ..*sample
            };
            samples.iter().zip(by).map(add).collect()
        };
        let effects = Effect::ALL.iter().flat_map(|effect| effect.disturbances(samples, model));
        Self { copies: effects.map(one).collect(), pushes_v: pushes_v(samples, model) }
    }
}

/// The regression of the residuals on the unknowns with each effect. `squares` contains the
/// products with each other of all columns: the columns of the unknowns, of the effects, and of the
/// residuals. `count` is the number of residuals minus the number of entries of the start states.
fn regressions(fit: &Fit<'_>, squares: &DMatrix<f64>, count: f64) -> Vec<Trial> {
    let unknowns = fit.unknowns.len();
    let size = squares.nrows();
    let variance = squares[(size - 1, size - 1)] / count.max(1.0);
    let stds = prior_stds(fit.unknowns, fit.plant);
    // The change of the model's numbers, and the squares that it removes.
    let regression = |kept: &[usize]| {
        let mut matrix = DMatrix::from_fn(kept.len(), kept.len(), |row, column| {
            squares[(kept[row], kept[column])]
        });
        // The prior of each unknown counts like one more residual.
        for (index, std) in stds.iter().enumerate() {
            matrix[(index, index)] += variance / std.powi(2);
        }
        let right = DVector::from_fn(kept.len(), |row, _| squares[(kept[row], size - 1)]);
        let change = matrix
            .cholesky()
            .map_or_else(|| DVector::zeros(kept.len()), |matrix| matrix.solve(&right));
        (right.dot(&change), change)
    };
    let own: Vec<usize> = (0..unknowns).collect();
    let (without, alone) = regression(&own);
    let mut first = unknowns;
    let trial = |effect: Effect| {
        let columns = first..first + effect.columns();
        first = columns.end;
        let kept: Vec<usize> = (0..unknowns).chain(columns).collect();
        let (with, joint) = regression(&kept);
        let score = if variance > 0.0 { (with - without) / variance } else { 0.0 };
        let shift = (joint.rows(0, unknowns) - &alone).component_div(&stds);
        Trial { effect, score, shift }
    };
    Effect::ALL.into_iter().map(trial).collect()
}
