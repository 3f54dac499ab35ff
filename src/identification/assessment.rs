use std::fmt;

use nalgebra::DVector;

use super::fit::Fit;
use super::residuals::{Noise, Residual, noise_of, scale_of};
use super::stretch::{Regime, Stretch};
use super::{ResidualScale, Unknown};
use crate::qube::{DomainParameter, Nonideality, RAD_PER_COUNT};

/// Largest residual over short windows of a model that fits, in standard deviations of the encoder's
/// quantisation.
const LARGEST_NOISE_RATIO: f64 = 1.5;

/// Largest correlation of successive residuals of a model that fits.
const LARGEST_WHITENESS: f64 = 0.5;

/// Largest residual over the fitted windows of a model that fits, in residuals over short windows.
const LARGEST_GROWTH: f64 = 2.0;

/// Residual over short windows beyond which a model does not fit, rad.
const UNFIT_RAD: f64 = 0.03;

/// Size of a test statistic, normal where the model holds, beyond which a dependence is reported.
const SIGNIFICANT: f64 = 4.0;

/// Time after a reversal of the arm in which play and hysteresis act, s.
const REVERSAL_S: f64 = 0.06;

/// Smallest ratio of the residuals' changes after reversals to those elsewhere that points at play.
const REVERSAL_RATIO: f64 = 1.5;

/// Whether the model describes the Qube that made the recordings.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// The residuals are those of the encoders.
    Fits,
    /// The model predicts, but something is missing.
    FitsBut,
    /// Windows of half a second are not explained.
    DoesNotFit,
}

impl Verdict {
    /// The name in files.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Fits => "fits",
            Self::FitsBut => "fits_but",
            Self::DoesNotFit => "does_not_fit",
        }
    }
}

/// A guess at what the model lacks. Each is a hint for the operator and no identification.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Doubt {
    /// The residuals exceed those of the encoders.
    Unexplained,
    /// The residuals change most where the arm has turned back: play, or friction that gives way.
    Reversals,
    /// The motor changes in the course of the recordings: it warms.
    Warming,
    /// What the arm resists depends on its angle otherwise than a spring does.
    Angle,
    /// What the arm resists depends on its direction.
    Direction,
}

impl Doubt {
    /// The name in files.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Unexplained => "unexplained",
            Self::Reversals => "reversals",
            Self::Warming => "warming",
            Self::Angle => "angle",
            Self::Direction => "direction",
        }
    }
}

impl fmt::Display for Doubt {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(match self {
            Self::Unexplained => "residuals larger than the encoders'",
            Self::Reversals => {
                "motion after the arm turns back (play between motor and arm, friction that gives way \
                 before it slides?)"
            }
            Self::Warming => "a motor that changes with time (does it warm?)",
            Self::Angle => {
                "a resistance that depends on the arm's angle (a cable with hysteresis, an encoder off \
                 its centre?)"
            }
            Self::Direction => "a resistance that depends on the arm's direction",
        })
    }
}

/// Tests of the residuals of a fit.
#[derive(Clone, Debug, PartialEq)]
pub struct Assessment {
    /// Result of the tests.
    pub verdict: Verdict,
    /// What the model lacks, where the tests say something.
    pub doubts: Vec<Doubt>,
    /// Residual over windows of half a second, in standard deviations of the encoder's quantisation.
    pub noise_ratio: f64,
    /// Correlation of successive residuals of an angle over half a second, the larger of both: 0 for white ones.
    pub whiteness: f64,
    /// Residual over the fitted windows of chirps, in residuals over half a second.
    pub growth: f64,
}

/// Tests the residuals of a fit over its own windows and over windows of half a second.
pub(super) fn assess(fit: &Fit<'_>, short: Vec<Stretch<'_>>) -> Assessment {
    let mut check = fit.with_unknowns(&[], short);
    check.noise = [Noise::of_resolution(); 3];
    check.minimise();
    let residuals = without_zero(&check.stretches, check.residuals_rad());
    let resolution_rad = RAD_PER_COUNT / 12.0_f64.sqrt();
    let ResidualScale { theta_rad, alpha_rad } = scale_of(&residuals);
    let short_rad = theta_rad.max(alpha_rad);
    let noise_ratio = short_rad / resolution_rad;
    let whiteness = correlation(&residuals, 0).max(correlation(&residuals, 1));
    let growth = growth(fit, &check, &residuals);
    let mut doubts = Vec::new();
    if noise_ratio > LARGEST_NOISE_RATIO || whiteness > LARGEST_WHITENESS || growth > LARGEST_GROWTH
    {
        doubts.push(Doubt::Unexplained);
        if after_reversals(&check, &residuals) > REVERSAL_RATIO {
            doubts.push(Doubt::Reversals);
        }
    }
    check.noise = noise_of(&check.stretches, &residuals, &check.noise);
    let check = Fit { unknowns: fit.unknowns, ..check };
    doubts.extend(dependences(&check));
    let verdict = if short_rad > UNFIT_RAD {
        Verdict::DoesNotFit
    } else if doubts.is_empty() {
        Verdict::Fits
    } else {
        Verdict::FitsBut
    };
    Assessment { verdict, doubts, noise_ratio, whiteness, growth }
}

/// Residuals without the error of each recording's zero of the pendulum, which is unknown by up to a count.
fn without_zero(
    stretches: &[Stretch<'_>],
    mut residuals: Vec<Vec<Residual>>,
) -> Vec<Vec<Residual>> {
    let recording = |index: usize| stretches[index].recording.as_ptr();
    let mut first = 0;
    while first < stretches.len() {
        let end = (first..stretches.len())
            .find(|&index| recording(index) != recording(first))
            .unwrap_or(stretches.len());
        let own = &mut residuals[first..end];
        let count = own.iter().map(Vec::len).sum::<usize>().max(1) as f64;
        let mean = own.iter().flatten().map(|residual| residual[1]).sum::<f64>() / count;
        let zero_rad = mean.clamp(-RAD_PER_COUNT, RAD_PER_COUNT);
        own.iter_mut().flatten().for_each(|residual| residual[1] -= zero_rad);
        first = end;
    }
    residuals
}

/// Residuals of the fitted windows of chirps in those of short windows; 1 without chirps.
fn growth(fit: &Fit<'_>, check: &Fit<'_>, short: &[Vec<Residual>]) -> f64 {
    let of = |fit: &Fit<'_>, residuals: &[Vec<Residual>]| {
        let hanging = fit.stretches.iter().zip(residuals);
        let kept: Vec<_> = hanging
            .filter(|(stretch, _)| stretch.regime == Regime::Hanging)
            .map(|(_, residuals)| residuals.clone())
            .collect();
        (!kept.is_empty()).then(|| scale_of(&kept))
    };
    match (of(fit, &without_zero(&fit.stretches, fit.residuals_rad())), of(check, short)) {
        (Some(long), Some(short)) => {
            (long.theta_rad / short.theta_rad).max(long.alpha_rad / short.alpha_rad)
        }
        _ => 1.0,
    }
}

/// Correlation of successive residuals of an angle within windows.
fn correlation(residuals: &[Vec<Residual>], angle: usize) -> f64 {
    let (mut products, mut squares) = (0.0, 0.0);
    for residuals in residuals {
        products += residuals.windows(2).map(|pair| pair[0][angle] * pair[1][angle]).sum::<f64>();
        squares += residuals.iter().map(|residual| residual[angle].powi(2)).sum::<f64>();
    }
    if squares > 0.0 { products / squares } else { 0.0 }
}

/// Root mean square change of the arm's residual per time within 60 ms of a reversal of the arm, relative to
/// that at other times.
fn after_reversals(check: &Fit<'_>, residuals: &[Vec<Residual>]) -> f64 {
    let (mut near, mut far) = ([0.0; 2], [0.0; 2]);
    for (stretch, residuals) in check.stretches.iter().zip(residuals) {
        let samples = stretch.samples();
        let mut turned_s = f64::NEG_INFINITY;
        let mut direction = 0.0;
        for (pair, residual) in samples.windows(2).zip(residuals.windows(2)) {
            let moved = pair[1].state.theta - pair[0].state.theta;
            if moved.abs() > 1.5 * RAD_PER_COUNT {
                if moved * direction < 0.0 {
                    turned_s = pair[0].time_s;
                }
                direction = moved.signum();
            }
            let change = (residual[1][0] - residual[0][0]).powi(2);
            let sums = if pair[1].time_s - turned_s < REVERSAL_S { &mut near } else { &mut far };
            sums[0] += change;
            sums[1] += 1.0;
        }
    }
    if near[1] == 0.0 || far[0] == 0.0 {
        1.0
    } else {
        (near[0] / near[1] / (far[0] / far[1])).sqrt()
    }
}

/// Dependences of the windows' gradients on time, angle and direction. Where the model holds, the gradient of a
/// window with respect to an unknown has mean 0 whatever the window's time, angle or direction.
fn dependences(check: &Fit<'_>) -> Vec<Doubt> {
    let windows = check.reduced();
    let samples = |index: usize| check.stretches[index].samples();
    let time = |index: usize| samples(index)[0].time_s - check.stretches[index].recording[0].time_s;
    let mean_angle = |index: usize| {
        let samples = samples(index);
        samples.iter().map(|sample| sample.state.theta).sum::<f64>() / samples.len() as f64
    };
    let moved = |index: usize| {
        let samples = samples(index);
        samples[samples.len() - 1].state.theta - samples[0].state.theta
    };
    let gradients: Vec<&DVector<f64>> = windows.iter().map(|(_, gradient)| gradient).collect();
    let depends = |unknown: Unknown, covariate: &dyn Fn(usize) -> f64| {
        let column = check.unknowns.iter().position(|&own| own == unknown);
        column.is_some_and(|column| statistic(&gradients, column, covariate).abs() > SIGNIFICANT)
    };
    let motor = Unknown::from(DomainParameter::MotorResistance);
    let friction = Unknown::from(Nonideality::CoulombTorque);
    let rest = Unknown::from(Nonideality::CableRest);
    let mut doubts = Vec::new();
    if depends(motor, &time) {
        doubts.push(Doubt::Warming);
    }
    if depends(rest, &|index| mean_angle(index).powi(2)) || depends(friction, &mean_angle) {
        doubts.push(Doubt::Angle);
    }
    if depends(friction, &moved) || depends(rest, &|index| moved(index).abs()) {
        doubts.push(Doubt::Direction);
    }
    doubts
}

/// The correlation of a gradient's entry with a covariate over the windows, in its standard deviations.
fn statistic(gradients: &[&DVector<f64>], column: usize, covariate: &dyn Fn(usize) -> f64) -> f64 {
    let count = gradients.len().max(1) as f64;
    let mean = (0..gradients.len()).map(covariate).sum::<f64>() / count;
    let centre = gradients.iter().map(|gradient| gradient[column]).sum::<f64>() / count;
    let (mut sum, mut squares) = (0.0, 0.0);
    for (index, gradient) in gradients.iter().enumerate() {
        let product = (covariate(index) - mean) * (gradient[column] - centre);
        sum += product;
        squares += product * product;
    }
    if squares > 0.0 { sum / squares.sqrt() } else { 0.0 }
}
