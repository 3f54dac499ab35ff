//! Estimates from a push how far the pendulum's encoder follows the arm's motion: this shows the
//! encoder's sign, and whether the encoder works.
//!
//! Near the bottom the pendulum follows alpha'' = -k theta'' - w^2 (alpha - c), for every torque on
//! the arm, including friction, cable and play. Here k = 3 L_r / (2 L_p) is the lag, 0.99 on a
//! nominal Qube, with the lengths L_r of the arm and L_p of the pendulum; w is the angular
//! frequency of the pendulum's swing, and c the angle at which it hangs. Integrated twice, the
//! equation needs no derivatives of counts:
//!
//! ```text
//! alpha(t) = -k theta(t) - w^2 S(t) + a + b t + d t^2,    S = the double integral of alpha
//! ```
//!
//! This equation is linear in k, w^2, a, b and d. The terms with a, b and d absorb a pendulum that
//! already swings and an unknown hanging angle.

use nalgebra::{DMatrix, DVector};

use crate::control::ProbeSample;
use crate::qube::Encoders;

/// Standard deviation of the rounding to counts, 1/sqrt(12), counts.
const QUANTISATION_COUNTS: f64 = 0.3;

/// Terms of the fit: theta, S, 1, t, t^2.
const TERMS: usize = 5;

/// The result of the fit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct SwingFit {
    /// Estimate of k in the assumed signs, positive if they are right; `None` if the arm did not
    /// move, the terms are not independent, or there are too few samples to fit.
    pub(super) lag: Option<Lag>,
    /// Residual of alpha, counts, when the pendulum is fitted as on an arm at rest: large if the
    /// arm drove the pendulum. 0 if the terms are not independent, or there are too few samples.
    pub(super) driven_counts: f64,
}

/// An estimate of k.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Lag {
    /// Value of k, without a unit.
    pub(super) value: f64,
    /// Standard error of the value.
    pub(super) standard_error: f64,
}

/// Fits the pendulum's equation to the samples of a probe. An arm that moved by at most
/// `at_rest_counts` encoder counts is taken as at rest.
pub(super) fn fit(samples: &[ProbeSample], at_rest_counts: f64, encoders: Encoders) -> SwingFit {
    let [theta_rad, alpha_rad] = [encoders.theta, encoders.alpha].map(|own| own.rad_per_count());
    let Some(first) = samples.first() else {
        return SwingFit { lag: None, driven_counts: 0.0 };
    };
    let mut rows = Vec::with_capacity(samples.len());
    let (mut velocity, mut doubled) = (0.0, 0.0);
    let mut previous = (0.0, 0.0);
    let duration_s = samples.last().map_or(1.0, |last| last.time_s - first.time_s).max(1e-3);
    for sample in samples {
        let (time_s, alpha) = (sample.time_s - first.time_s, sample.alpha_rad - first.alpha_rad);
        let step_s = time_s - previous.0;
        let before = velocity;
        velocity += 0.5 * step_s * (alpha + previous.1);
        doubled += 0.5 * step_s * (velocity + before);
        previous = (time_s, alpha);
        let share = time_s / duration_s;
        let theta = sample.theta_rad - first.theta_rad;
        rows.push(([theta, doubled, 1.0, share, share * share], alpha));
    }
    let thetas = rows.iter().map(|(row, _)| row[0]);
    let (lowest, highest) =
        thetas.fold((0.0_f64, 0.0_f64), |(low, high), theta| (low.min(theta), high.max(theta)));
    let is_at_rest = highest - lowest <= (at_rest_counts + 0.5) * theta_rad;

    let free = least_squares(&rows, [false, true, true, true, true]);
    let driven_counts = free.map_or(0.0, |free| free.residual_rad / alpha_rad);
    let lag = if is_at_rest { None } else { least_squares(&rows, [true; TERMS]) };
    let lag = lag.map(|all| Lag {
        value: -all.coefficients[0],
        standard_error: all.first_variance.sqrt()
            * all.residual_rad.max(QUANTISATION_COUNTS * alpha_rad),
    });
    SwingFit { lag, driven_counts }
}

/// Least squared pivot of the normal matrix's Cholesky factor, divided by the number of rows; a
/// matrix with a smaller one is taken as singular.
const SINGULAR: f64 = 1e-9;

struct Solution {
    coefficients: [f64; TERMS],
    /// Variance of the coefficient of the first term in use, in units of the residuals' variance.
    first_variance: f64,
    /// Standard deviation of the residuals, rad, with one degree of freedom less for each term.
    residual_rad: f64,
}

/// Solves the least squares problem over the terms in use; `None` if these terms are not
/// independent or the rows are too few.
fn least_squares(rows: &[([f64; TERMS], f64)], used: [bool; TERMS]) -> Option<Solution> {
    // Each column is scaled by its largest magnitude, so that one threshold detects a singular
    // matrix.
    let mut size = [0.0_f64; TERMS];
    for (row, _) in rows {
        for (size, value) in size.iter_mut().zip(row) {
            *size = size.max(value.abs());
        }
    }
    let active: Vec<usize> = (0..TERMS).filter(|term| used[*term] && size[*term] > 0.0).collect();
    let count = active.len();
    if rows.len() <= count {
        return None;
    }
    let design = DMatrix::from_fn(rows.len(), count, |row, column| {
        rows[row].0[active[column]] / size[active[column]]
    });
    let observed = DVector::from_iterator(rows.len(), rows.iter().map(|(_, value)| *value));
    let factor = design.tr_mul(&design).cholesky()?;
    if factor.l_dirty().diagonal().min().powi(2) < SINGULAR * rows.len() as f64 {
        return None;
    }
    let scaled = factor.solve(&design.tr_mul(&observed));
    let mut coefficients = [0.0; TERMS];
    for (coefficient, &term) in scaled.iter().zip(&active) {
        coefficients[term] = coefficient / size[term];
    }
    let first_variance =
        active.first().map_or(0.0, |&term| factor.inverse()[(0, 0)] / (size[term] * size[term]));
    let squares = (observed - design * scaled).norm_squared();
    let residual_rad = (squares / (rows.len() - count) as f64).sqrt();
    Some(Solution { coefficients, first_variance, residual_rad })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::AT_REST_COUNTS;
    use crate::qube::RAD_PER_COUNT;
    use crate::qube::counts;

    /// The samples of a pendulum on an arm that moves as `theta(t)`, seen through encoders. The
    /// pendulum starts with the velocity `alpha_dot`, rad/s.
    fn samples(
        theta: impl Fn(f64) -> f64,
        alpha_dot: f64,
        (lag, square_rad_s2): (f64, f64),
    ) -> Vec<ProbeSample> {
        let (mut alpha, mut velocity) = (0.02, alpha_dot);
        let step_s = 1e-4;
        let mut samples = Vec::new();
        for step in 0..7500 {
            let time_s = f64::from(step) * step_s;
            if step % 100 == 0 {
                samples.push(ProbeSample {
                    time_s,
                    theta_rad: f64::from(counts(theta(time_s))) * RAD_PER_COUNT,
                    alpha_rad: f64::from(counts(alpha)) * RAD_PER_COUNT,
                    ..ProbeSample::default()
                });
            }
            let bend = (theta(time_s + step_s) - 2.0 * theta(time_s) + theta(time_s - step_s))
                / (step_s * step_s);
            velocity += step_s * (-lag * bend - square_rad_s2 * (alpha - 0.01));
            alpha += step_s * velocity;
        }
        samples
    }

    /// A smooth push from 0 to `reach` between 0.2 s and 0.3 s.
    fn pushed(reach: f64) -> impl Fn(f64) -> f64 {
        move |time_s: f64| {
            let x = ((time_s - 0.2) / 0.1).clamp(0.0, 1.0);
            reach * x * x * (3.0 - 2.0 * x)
        }
    }

    #[test]
    fn the_lag_of_a_pendulum_is_found_at_rest_and_swinging() {
        for lag in [0.9, 1.0, 1.1, -1.0] {
            for square_rad_s2 in [100.0, 117.0, 135.0] {
                for alpha_dot in [0.0, 0.5, -1.0] {
                    let seen = samples(pushed(0.05), alpha_dot, (lag, square_rad_s2));
                    let found = fit(&seen, AT_REST_COUNTS, Encoders::QUBE).lag.unwrap();
                    assert!((found.value - lag).abs() < 0.15, "{found:?} of {lag}");
                    assert!(found.standard_error < 0.1, "{found:?}");
                }
            }
        }
    }

    #[test]
    fn a_count_that_stays_has_no_lag() {
        let mut seen = samples(pushed(0.05), 0.0, (1.0, 117.0));
        seen.iter_mut().for_each(|sample| sample.alpha_rad = 0.3);
        let found = fit(&seen, AT_REST_COUNTS, Encoders::QUBE).lag.unwrap();
        assert!(found.value.abs() < 1e-9 && found.standard_error < 0.1, "{found:?}");
    }

    #[test]
    fn a_swing_counts_as_driven_by_an_arm_with_a_dead_encoder_and_not_by_an_arm_at_rest() {
        for alpha_dot in [0.0, 0.3, 1.0] {
            let still =
                fit(&samples(|_| 0.0, alpha_dot, (1.0, 117.0)), AT_REST_COUNTS, Encoders::QUBE);
            assert!(still.lag.is_none() && still.driven_counts < 0.7, "{still:?}");
            let mut seen = samples(pushed(0.05), alpha_dot, (1.0, 117.0));
            seen.iter_mut().for_each(|sample| sample.theta_rad = 1.0);
            let driven = fit(&seen, AT_REST_COUNTS, Encoders::QUBE);
            assert!(driven.lag.is_none() && driven.driven_counts > 1.5, "{driven:?}");
        }
    }

    #[test]
    fn too_few_samples_give_no_lag() {
        assert_eq!(
            fit(&[], AT_REST_COUNTS, Encoders::QUBE),
            SwingFit { lag: None, driven_counts: 0.0 }
        );
        let one = [ProbeSample::default()];
        assert_eq!(fit(&one, AT_REST_COUNTS, Encoders::QUBE).lag, None);
    }
}
