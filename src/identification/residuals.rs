//! The distribution of the residuals of a fit: scale and correlation by regime, and robust weights.

use super::stretch::{Regime, Stretch};
use crate::qube::{Encoder, Encoders};

/// Residuals of one sample: theta and alpha, rad.
pub(super) type Residual = [f64; 2];

/// Root mean square of a stretch's residuals, in standard deviations of its regime, above which the
/// stretch loses weight (Huber's function, applied to whole stretches).
const BAD_STRETCH: f64 = 2.0;

/// Smallest scale with a Qube's encoders, rad: an encoder's resolution bounds the residuals from
/// below.
const SMALLEST_SCALE_RAD: f64 = 1e-3;

/// Standard deviations of the residuals of both angles, rad.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ResidualScale {
    /// Standard deviation of the arm's residuals, rad.
    pub theta_rad: f64,
    /// Standard deviation of the pendulum's residuals, rad.
    pub alpha_rad: f64,
}

impl ResidualScale {
    /// The smallest scale with these encoders.
    fn smallest(encoders: Encoders) -> Self {
        let of = |encoder: Encoder| SMALLEST_SCALE_RAD / encoder.counts_per_qube_count();
        Self { theta_rad: of(encoders.theta), alpha_rad: of(encoders.alpha) }
    }

    /// Returns whether both standard deviations are at most `limit_rad`. NaN exceeds every limit.
    pub(super) fn is_within(self, limit_rad: f64) -> bool {
        self.theta_rad <= limit_rad && self.alpha_rad <= limit_rad
    }
}

/// The distribution of the residuals of a regime.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Noise {
    /// Standard deviations of the residuals.
    pub scale: ResidualScale,
    /// Number of samples worth one independent sample: the integrated autocorrelation time.
    pub autocorrelation_samples: f64,
}

impl Default for Noise {
    fn default() -> Self {
        let scale = ResidualScale { theta_rad: 0.01, alpha_rad: 0.01 };
        Self { scale, autocorrelation_samples: 1.0 }
    }
}

impl Noise {
    /// Independent residuals of about the encoders' resolution.
    pub fn of_resolution(encoders: Encoders) -> Self {
        Self { scale: ResidualScale::smallest(encoders), autocorrelation_samples: 1.0 }
    }
}

/// The weight of a stretch with this mean squared residual, in squared standard deviations of its
/// regime: 1 as long as its root mean square is at most [`BAD_STRETCH`].
pub(super) fn robust_weight(mean_square: f64) -> f64 {
    (BAD_STRETCH / mean_square.sqrt()).min(1.0)
}

/// The cost of a stretch: Huber's function of its root mean square, times its number of independent
/// residuals.
pub(super) fn robust_cost(noise: &Noise, residuals: &[Residual]) -> f64 {
    let square = mean_square(noise, residuals);
    let bounded = if square <= BAD_STRETCH * BAD_STRETCH {
        square
    } else {
        2.0 * BAD_STRETCH * square.sqrt() - BAD_STRETCH * BAD_STRETCH
    };
    // 0 times an infinite square is NaN, by which the fit detects a motion that diverges.
    2.0 * residuals.len() as f64 * bounded / noise.autocorrelation_samples + 0.0 * square
}

/// The mean squared residual of both angles, in squared standard deviations of the regime.
pub(super) fn mean_square(noise: &Noise, residuals: &[Residual]) -> f64 {
    let scaled = |[theta, alpha]: &Residual| {
        (theta / noise.scale.theta_rad).powi(2) + (alpha / noise.scale.alpha_rad).powi(2)
    };
    residuals.iter().map(scaled).sum::<f64>() / (2.0 * residuals.len().max(1) as f64)
}

/// Estimates scale and correlation of each regime, with weights of the stretches that follow from
/// the noise `before`. A regime without stretches keeps that noise.
pub(super) fn updated_noise(
    stretches: &[Stretch<'_>],
    residuals: &[Vec<Residual>],
    before: &[Noise; 3],
    encoders: Encoders,
) -> [Noise; 3] {
    let smallest = ResidualScale::smallest(encoders);
    let mut noise = *before;
    for regime in Regime::ALL {
        let own_residuals: Vec<&Vec<Residual>> = stretches
            .iter()
            .zip(residuals)
            .filter(|(stretch, _)| stretch.regime == regime)
            .map(|(_, residuals)| residuals)
            .collect();
        if own_residuals.is_empty() {
            continue;
        }
        let own = &mut noise[regime as usize];
        let rms = |angle: usize| {
            let (mut squares, mut count) = (0.0, 0.0);
            for residuals in &own_residuals {
                let weight = robust_weight(mean_square(own, residuals));
                squares += weight * residuals.iter().map(|it| it[angle].powi(2)).sum::<f64>();
                count += weight * residuals.len() as f64;
            }
            (squares / count).sqrt()
        };
        let scale = ResidualScale {
            theta_rad: rms(0).max(smallest.theta_rad),
            alpha_rad: rms(1).max(smallest.alpha_rad),
        };
        *own = Noise { scale, autocorrelation_samples: autocorrelation_samples(&own_residuals) };
    }
    noise
}

/// Number of rounds in which [`noise_from_residuals`] estimates scales and the weights that depend
/// on them in turn.
const ROUNDS: usize = 4;

/// Estimates scale and correlation of each regime from these residuals alone. A regime without
/// stretches gets the noise of the quietest other regime: its own residuals are unknown, and a
/// model that holds leaves residuals of about the encoders' rounding in every regime. Without any
/// stretch, all regimes get [`Noise::of_resolution`].
pub(super) fn noise_from_residuals(
    stretches: &[Stretch<'_>],
    residuals: &[Vec<Residual>],
    encoders: Encoders,
) -> [Noise; 3] {
    let mut noise = [Noise { scale: scale_of(residuals), autocorrelation_samples: 1.0 }; 3];
    for _ in 0..ROUNDS {
        noise = updated_noise(stretches, residuals, &noise, encoders);
    }
    let is_seen = |regime: &Regime| stretches.iter().any(|stretch| stretch.regime == *regime);
    let size = |noise: &Noise| noise.scale.theta_rad * noise.scale.alpha_rad;
    let seen = Regime::ALL.into_iter().filter(is_seen).map(|regime| noise[regime as usize]);
    let quietest = seen
        .min_by(|one, other| size(one).total_cmp(&size(other)))
        .unwrap_or(Noise::of_resolution(encoders));
    for regime in Regime::ALL.into_iter().filter(|regime| !is_seen(regime)) {
        noise[regime as usize] = quietest;
    }
    noise
}

/// Root mean square of residuals, rad.
pub(super) fn scale_of(residuals: &[Vec<Residual>]) -> ResidualScale {
    let count = residuals.iter().map(Vec::len).sum::<usize>().max(1) as f64;
    let rms = |angle: usize| {
        let squares: f64 = residuals.iter().flatten().map(|it| it[angle].powi(2)).sum();
        (squares / count).sqrt()
    };
    ResidualScale { theta_rad: rms(0), alpha_rad: rms(1) }
}

/// Integrated autocorrelation time in samples: 1 + 2 (r1 + r2 + ...) up to the first r that is not
/// above 0, averaged over both angles and all stretches.
///
/// The two angles share one time, although the arm's residuals of a real Qube change more slowly
/// than the pendulum's. With a separate time for each angle, a fit gives up the angle that the
/// model describes worse: its residuals grow, are correlated for longer, and so count for less.
fn autocorrelation_samples(residuals: &[&Vec<Residual>]) -> f64 {
    let of_angle = |angle: usize| {
        let (mut total, mut weight) = (0.0, 0.0);
        for stretch in residuals {
            let values: Vec<f64> = stretch.iter().map(|residual| residual[angle]).collect();
            let power: f64 = values.iter().map(|value| value * value).sum();
            if power == 0.0 {
                continue;
            }
            let mut time = 1.0;
            for lag in 1..values.len() {
                let products = values.iter().zip(&values[lag..]);
                let correlation = products.map(|(one, other)| one * other).sum::<f64>() / power;
                if correlation <= 0.0 {
                    break;
                }
                time += 2.0 * correlation;
            }
            total += time * values.len() as f64;
            weight += values.len() as f64;
        }
        if weight == 0.0 { 1.0 } else { total / weight }
    };
    0.5 * (of_angle(0) + of_angle(1))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::{PlantModel, State};
    use crate::replay::MotionSample;

    #[test]
    fn a_regime_that_was_not_recorded_has_the_noise_of_the_quietest_regime() {
        let sample = MotionSample { time_s: 0.0, state: State::default(), voltage_v: 0.0 };
        let samples = [sample; 4];
        let stretch = |regime| Stretch { regime, recording: &samples, first: 0, end: 4 };
        let residuals = |rad: f64| vec![[rad, -rad], [-rad, rad], [rad, -rad], [-rad, rad]];
        let encoders = PlantModel::QUBE.encoders;
        let noise = noise_from_residuals(
            &[stretch(Regime::Swinging), stretch(Regime::Hanging)],
            &[residuals(0.02), residuals(0.004)],
            encoders,
        );
        let scale = |regime: Regime| noise[regime as usize].scale;
        assert!((scale(Regime::Swinging).theta_rad - 0.02).abs() < 1e-12, "{noise:?}");
        assert!((scale(Regime::Hanging).alpha_rad - 0.004).abs() < 1e-12, "{noise:?}");
        assert_eq!(noise[Regime::Upright as usize], noise[Regime::Hanging as usize]);
        assert_eq!(noise_from_residuals(&[], &[], encoders), [Noise::of_resolution(encoders); 3]);
    }

    #[test]
    fn residuals_that_are_not_finite_exceed_every_limit() {
        let scale = |residual: Residual| scale_of(&[vec![[0.01, 0.02], residual]]);
        assert!(scale([0.01, 0.02]).is_within(0.02 + 1e-12));
        assert!(!scale([0.01, 0.02]).is_within(0.015));
        for residual in [[f64::NAN, 0.0], [0.0, f64::NAN], [f64::INFINITY, 0.0]] {
            assert!(!scale(residual).is_within(1.0), "{residual:?}");
        }
    }
}
