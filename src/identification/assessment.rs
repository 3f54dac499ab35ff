use std::fmt;

use nalgebra::DVector;

use super::effects::{Effect, Trial, trials};
use super::fit::Fit;
use super::residuals::{Noise, Residual, noise_from_residuals, scale_of};
use super::stretch::{Regime, Stretch};
use super::{ResidualScale, Unknown};
use crate::qube::{PlantModel, QubeModel};

/// Largest [`Assessment::noise_ratio`] of a model that fits.
const LARGEST_NOISE_RATIO: f64 = 1.2;

/// Largest [`Assessment::whiteness`] of a model that fits, over long recordings. The fit of the
/// start states makes the correlation a little negative.
const LARGEST_WHITENESS: f64 = 0.02;

/// Largest [`Assessment::whiteness`] of a model that fits, times the root of the number of samples.
/// It replaces [`LARGEST_WHITENESS`] over recordings of fewer than 2025 samples, where chance
/// alone exceeds that limit: it is about two standard deviations of the mean over [`LAGS`] lags of
/// white residuals.
const LARGEST_CHANCE: f64 = 0.9;

/// Largest distance, in samples, of residuals whose correlation is tested.
const LAGS: usize = 5;

/// Largest [`Assessment::growth`] of a model that fits, with a Qube's encoders. Finer encoders
/// leave smaller residuals over short windows and allow more growth in proportion.
const LARGEST_GROWTH: f64 = 2.0;

/// Residual (root mean square, the larger of the two angles) over windows of half a second, or of a
/// quarter where the pendulum is upright, beyond which a model does not fit, rad.
const UNFIT_RAD: f64 = 0.03;

/// Largest noise ratio of held-out recordings with which the model describes them, as a multiple of
/// the fitted recordings' ratio or of 1, whichever is larger. The errors of a fit to one recording
/// show in others: after slow steps alone the ratio of a rollout of the same Qube reached 2.9.
const LARGEST_HELD_OUT_RATIO: f64 = 4.0;

/// Largest factor by which held-out recordings contradict the estimates more than noise and
/// standard errors predict, with which the model predicts them. For a right model the square of the
/// factor, times the number of directions that the recordings determine, is chi-squared: with eight
/// directions, chance alone makes the factor exceed 2 in one of 10 000 recordings.
const LARGEST_CONTRADICTION: f64 = 2.0;

/// Smallest score that counts as evidence for an effect outside the equations; if the model holds,
/// the score is chi-squared with one or two degrees of freedom.
const SIGNIFICANT: f64 = 20.0;

/// Share of the squared residuals beyond the encoders' rounding that an effect must explain to be
/// named.
const NAMED_SHARE: f64 = 0.2;

/// A verdict: whether the model describes the Qube that made the recordings.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ModelVerdict {
    /// The residuals are about as small and as uncorrelated as the encoders' rounding, and no test
    /// finds a sign of a missing effect.
    Fits,
    /// The model predicts windows of half a second, or of a quarter where the pendulum is upright,
    /// but the tests find signs of a missing effect.
    FitsBut,
    /// The model does not explain windows of half a second, or of a quarter where the pendulum is
    /// upright.
    DoesNotFit,
}

impl ModelVerdict {
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

/// An effect that the model may lack: a hint for the operator and no identification.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MissingEffect {
    /// The residuals are larger, more correlated or faster growing than the encoders' rounding
    /// explains.
    Unexplained,
    /// A torque builds up after the arm turns back: friction that yields before it slides, or a
    /// cable with hysteresis.
    Reversals,
    /// The motor changes in the course of each recording, as when it warms.
    Warming,
    /// The arm's measured angle has an error, or the arm feels a torque, that is periodic in the
    /// arm's angle.
    Angle,
    /// The arm's damping depends on its direction, or seems to, as with a cable that stiffens.
    Direction,
    /// The motor turns alone for a moment where its torque on the arm changes sign: play.
    Play,
    /// The model explains recordings that were held out much worse than the fitted recordings.
    HeldOut,
    /// Recordings that were held out contradict the estimates by more than noise and standard
    /// errors predict.
    Contradicted,
}

impl MissingEffect {
    /// All effects.
    pub const ALL: [Self; 8] = [
        Self::Unexplained,
        Self::Reversals,
        Self::Warming,
        Self::Angle,
        Self::Direction,
        Self::Play,
        Self::HeldOut,
        Self::Contradicted,
    ];

    /// The name in files.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Unexplained => "unexplained",
            Self::Reversals => "reversals",
            Self::Warming => "warming",
            Self::Angle => "angle",
            Self::Direction => "direction",
            Self::Play => "play",
            Self::HeldOut => "held_out",
            Self::Contradicted => "contradicted",
        }
    }
}

impl fmt::Display for MissingEffect {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(match self {
            Self::Unexplained => "residuals that the encoders' rounding does not explain",
            Self::Reversals => {
                "a torque that builds up after the arm turns back (friction that gives way before it \
                 slides, a cable with hysteresis?)"
            }
            Self::Warming => "a motor that changes with time (does it warm?)",
            Self::Angle => {
                "an error that depends on the arm's angle (an encoder off its centre, a base that is not level?)"
            }
            Self::Direction => {
                "damping that depends on the arm's direction (or a cable that stiffens as it is bent?)"
            }
            Self::Play => {
                "a motor that turns alone where its torque changes sign (play between motor and arm?)"
            }
            Self::HeldOut => {
                "the recordings that were held out (are they of another Qube, or was it changed in between?)"
            }
            Self::Contradicted => {
                "the recordings that were held out: they lead to other values, beyond the standard errors"
            }
        })
    }
}

/// Tests of the residuals of a fit.
#[derive(Clone, Debug, PartialEq)]
pub struct Assessment {
    /// Result of the tests.
    pub verdict: ModelVerdict,
    /// Effects that the model may lack; empty if the tests find no sign of any.
    pub missing_effects: Vec<MissingEffect>,
    /// Residual (root mean square) over windows of half a second, or of a quarter where the
    /// pendulum is upright, in standard deviations of the encoder's quantisation; the larger value
    /// of the two angles.
    pub noise_ratio: f64,
    /// Mean correlation of residuals of one angle that are one to five samples apart, in the same
    /// windows; the larger value of the two angles. White noise has about 0.
    pub whiteness: f64,
    /// Residual over the fitted windows of chirps and steps, divided by the residual over their
    /// windows of half a second; the larger value of the two angles, and 1 without such recordings.
    pub growth: f64,
}

/// Tests the residuals of a fit over its own windows and, with start states fitted anew, over the
/// windows `short` of half a second, or of a quarter where the pendulum is upright. Also returns
/// scale and correlation of the residuals over these short windows, and, if the tests doubt the
/// model, the [`Trial::shift`] of the effect that explains the residuals best.
pub(super) fn assess(
    fit: &Fit<'_>,
    short: Vec<Stretch<'_>>,
) -> (Assessment, [Noise; 3], Option<DVector<f64>>) {
    let mut check = fit.with_unknowns(&[], short);
    check.noise = [Noise::of_resolution(fit.plant.encoders); 3];
    check.minimise();
    let residuals = check.residuals_rad();
    let scale = scale_of(&residuals);
    let noise_ratio = noise_ratio(fit, scale);
    let correlation = |angle| correlation(&check, &residuals, angle);
    let whiteness = correlation(0).max(correlation(1));
    let samples = residuals.iter().map(Vec::len).sum::<usize>().max(1) as f64;
    let largest_whiteness = LARGEST_WHITENESS.max(LARGEST_CHANCE / samples.sqrt());
    let growth = growth(fit, &check, &residuals);
    let encoders = fit.plant.encoders;
    let finer =
        encoders.theta.counts_per_qube_count().max(encoders.alpha.counts_per_qube_count()).max(1.0);
    let mut missing_effects = Vec::new();
    if noise_ratio > LARGEST_NOISE_RATIO
        || whiteness > largest_whiteness
        || growth > LARGEST_GROWTH * finer
    {
        missing_effects.push(MissingEffect::Unexplained);
    }
    let noise = noise_from_residuals(&check.stretches, &residuals, encoders);
    let check = Fit { unknowns: fit.unknowns, ..check };
    let best = trials(&check)
        .into_iter()
        .filter(|trial| trial.score > SIGNIFICANT)
        .max_by(|a, b| a.score.total_cmp(&b.score));
    missing_effects
        .extend(best.as_ref().and_then(|trial| named(trial, 2.0 * samples, noise_ratio)));
    let shift = best.filter(|_| !missing_effects.is_empty()).map(|trial| trial.shift);
    let verdict = if !scale.is_within(UNFIT_RAD) {
        ModelVerdict::DoesNotFit
    } else if missing_effects.is_empty() {
        ModelVerdict::Fits
    } else {
        ModelVerdict::FitsBut
    };
    (Assessment { verdict, missing_effects, noise_ratio, whiteness, growth }, noise, shift)
}

impl Assessment {
    /// Doubts the model if it predicts held-out recordings badly: their `noise_ratio` is much
    /// larger than the fitted recordings', or they contradict the estimates by more than noise and
    /// standard errors predict, by the factor `contradiction` (a posterior predictive check).
    pub(super) fn compare(&mut self, noise_ratio: f64, contradiction: f64) {
        if noise_ratio > LARGEST_HELD_OUT_RATIO * self.noise_ratio.max(1.0) {
            self.missing_effects.push(MissingEffect::HeldOut);
        } else if contradiction > LARGEST_CONTRADICTION {
            self.missing_effects.push(MissingEffect::Contradicted);
        }
        if self.verdict == ModelVerdict::Fits && !self.missing_effects.is_empty() {
            self.verdict = ModelVerdict::FitsBut;
        }
    }
}

/// The [`Assessment::noise_ratio`] of a model over recordings to which it was not fitted. Start
/// states, the zero of the pendulum's angle and, if it is one of `homed`, the rest angle of the
/// cable are estimated anew, because homing sets them anew.
pub(super) fn noise_ratio_of(
    model: QubeModel,
    homed: &[Unknown],
    plant: &PlantModel,
    windows: Vec<Stretch<'_>>,
) -> f64 {
    let mut fit = Fit::new(homed, plant, model, windows).with_offsets();
    fit.noise = [Noise::of_resolution(plant.encoders); 3];
    fit.minimise();
    noise_ratio(&fit, scale_of(&fit.residuals_rad()))
}

/// The larger of the two angles' residuals, in standard deviations of its encoder's quantisation.
fn noise_ratio(fit: &Fit<'_>, scale: ResidualScale) -> f64 {
    let [theta_count_rad, alpha_count_rad] = counts_rad(fit);
    let in_noise = |residual_rad: f64, count_rad: f64| residual_rad / (count_rad / 12.0_f64.sqrt());
    in_noise(scale.theta_rad, theta_count_rad).max(in_noise(scale.alpha_rad, alpha_count_rad))
}

/// The angles of one count of the arm's encoder and of the pendulum's, rad.
fn counts_rad(fit: &Fit<'_>) -> [f64; 2] {
    let encoders = fit.plant.encoders;
    [encoders.theta.rad_per_count(), encoders.alpha.rad_per_count()]
}

/// The [`Assessment::growth`] of a fit; `check` is its model over the windows of half a second, and
/// `short` has the residuals of `check`.
fn growth(fit: &Fit<'_>, check: &Fit<'_>, short: &[Vec<Residual>]) -> f64 {
    let of = |fit: &Fit<'_>, residuals: &[Vec<Residual>]| {
        let hanging = fit.stretches.iter().zip(residuals);
        let kept: Vec<_> = hanging
            .filter(|(stretch, _)| stretch.regime == Regime::Hanging)
            .map(|(_, residuals)| residuals.clone())
            .collect();
        (!kept.is_empty()).then(|| scale_of(&kept))
    };
    match (of(fit, &fit.residuals_rad()), of(check, short)) {
        (Some(long), Some(short)) => {
            (long.theta_rad / short.theta_rad).max(long.alpha_rad / short.alpha_rad)
        }
        _ => 1.0,
    }
}

/// Mean correlation of residuals of an angle that are one to five samples apart.
///
/// Pairs between which the angle moves by at most two counts are left out, because the encoder
/// rounds both alike.
fn correlation(fit: &Fit<'_>, residuals: &[Vec<Residual>], angle: usize) -> f64 {
    let count_rad = counts_rad(fit)[angle];
    let (mut products, mut squares, mut pairs) = (0.0, 0.0, 0.0_f64);
    for (stretch, residuals) in fit.stretches.iter().zip(residuals) {
        let samples = stretch.samples();
        let measured = |index: usize| {
            let state = &samples[index].state;
            [state.theta, state.alpha][angle]
        };
        for lag in 1..=LAGS.min(residuals.len() - 1) {
            for first in 0..residuals.len() - lag {
                let second = first + lag;
                if (measured(second) - measured(first)).abs() > 2.0 * count_rad {
                    let (one, other) = (residuals[first][angle], residuals[second][angle]);
                    products += one * other;
                    squares += 0.5 * (one * one + other * other);
                    pairs += 1.0;
                }
            }
        }
    }
    if pairs > 0.0 && squares > 0.0 { products / squares } else { 0.0 }
}

/// The name of a significant effect if it explains a good part of the residuals beyond the
/// encoders' rounding. `residuals` is the number of residuals, two for each sample.
fn named(trial: &Trial, residuals: f64, noise_ratio: f64) -> Option<MissingEffect> {
    let excess = residuals * (1.0 - noise_ratio.max(1.0).powi(-2));
    (trial.score > NAMED_SHARE * excess).then_some(match trial.effect {
        Effect::Reversals => MissingEffect::Reversals,
        Effect::Warming => MissingEffect::Warming,
        Effect::EncoderEccentricity => MissingEffect::Angle,
        Effect::AsymmetricDamping => MissingEffect::Direction,
        Effect::Play => MissingEffect::Play,
    })
}
