use nalgebra::DVector;

use super::log_sum_exp::log_sum_exp;
use super::{Acquisition, Computed};
use crate::surrogate::GaussianProcess;
use crate::surrogate::factor::dot;
use crate::surrogate::normal::{log_density, log_distribution, log_improvement};

/// The natural logarithm of the knowledge gradient: the expected rise of the largest posterior mean
/// after one more *noisy* observation at a point (Scott, Frazier and Powell 2011).
///
/// The largest posterior mean is taken over a set of alternatives: the observed points, further
/// points that the caller gives, and the point itself. The maximiser of the posterior mean should
/// be one of the further points, since it is the current recommendation.
///
/// The search is scored by its recommendation, which maximises the posterior mean. An acquisition
/// function of the posterior mean therefore does not reward a single lucky observation, and a
/// second observation of an uncertain point can be worth more than the observation of a new one.
/// Without noise and without further points, the knowledge gradient is the expected improvement
/// over the best posterior mean of the observed points, wherever that mean is above the point's own
/// mean.
///
/// After the observation the posterior mean of alternative `i` is `a_i + b_i Z` with a standard
/// normal `Z`. The expectation of the maximum of these lines is exact, from their upper envelope
/// (Frazier, Powell and Dayanik 2009).
pub struct LogKnowledgeGradient<'a> {
    process: &'a GaussianProcess,
    /// Posterior means at the n observed points and the further alternatives, standardised.
    means: Vec<f64>,
    /// The further alternatives `p`, each with `K^-1 k(X, p)`, n, for the observed points `X`.
    further: Vec<(Vec<f64>, DVector<f64>)>,
    /// Noise variances of the n observations, standardised.
    noise: DVector<f64>,
    /// Noise variance expected of the next observation, standardised.
    next_noise: f64,
}

/// One line `height + slope z`: the posterior mean of an alternative after the next observation,
/// standardised, as a function of `z`: the deviation of the observation from its prediction, in
/// standard deviations.
#[derive(Clone, Copy)]
struct Line {
    height: f64,
    slope: f64,
    /// Index of the line's point: observed points, then further alternatives, last the new point.
    index: usize,
}

impl<'a> LogKnowledgeGradient<'a> {
    /// A knowledge gradient on a process, with further alternatives in the box's own units. The
    /// next observation is assumed to have the median noise variance of the past observations,
    /// without fantasies. Costs O(n^2) for each further alternative, and O(n^2 d) for the observed
    /// points.
    #[must_use]
    pub fn new(process: &'a GaussianProcess, further: &[Vec<f64>]) -> Self {
        let data = process.data();
        let noise = process.noise_variances();
        let observed = (0..data.len()).map(|i| data.search_box().from_unit(&data.unit_point(i)));
        let means = observed
            .chain(further.iter().cloned())
            .map(|point| (process.mean(&point) - data.offset()) / data.scale())
            .collect();
        let further = further
            .iter()
            .map(|point| (point.clone(), process.solve(&process.cross(point).values)))
            .collect();
        // A fantasy has nearly no noise, but the next observation is a real one.
        let mut sorted: Vec<f64> = noise
            .iter()
            .zip(&data.own_noise)
            .filter(|(_, own)| **own >= 0.0)
            .map(|(noise, _)| *noise)
            .collect();
        sorted.sort_by(f64::total_cmp);
        Self { process, means, further, next_noise: sorted[sorted.len() / 2], noise }
    }

    fn evaluate(&self, point: &[f64], computed: Computed) -> (f64, Vec<f64>) {
        let data = self.process.data();
        let (n, scale) = (data.len(), data.scale());
        let cross = self.process.cross(point);
        let (posterior, d_mean, d_variance, solved) = self.process.slope_of(&cross);
        let variance = posterior.variance / (scale * scale);
        let spread = (variance + self.next_noise).sqrt();

        // Posterior covariances of the function's value at the point with its values at the
        // alternatives; for the i-th observed point noise_i (K^-1 k)_i, since K = k(X, X) + noise.
        let observed = (0..n).map(|i| self.noise[i] * solved[i]);
        let between: Vec<(f64, Vec<f64>)> = self
            .further
            .iter()
            .map(|(alternative, _)| self.process.prior_covariance(alternative, point))
            .collect();
        let elsewhere = self
            .further
            .iter()
            .zip(&between)
            .map(|((_, weights), (prior, _))| prior - dot(weights.as_slice(), &cross.values));
        let mut lines: Vec<Line> = observed
            .chain(elsewhere)
            .enumerate()
            .map(|(index, covariance)| Line {
                height: self.means[index],
                slope: covariance / spread,
                index,
            })
            .collect();
        let new = lines.len();
        let height = (posterior.mean - data.offset()) / scale;
        lines.push(Line { height, slope: variance / spread, index: new });
        let envelope = upper_envelope(lines);

        // The expected rise is the sum over neighbouring lines of (b' - b) h(-|c|), where b and b'
        // are their slopes, c is the z at which they cross, and `log_improvement` is ln h.
        let crossing = |pair: &[Line]| {
            let rise = pair[1].slope - pair[0].slope;
            (rise, (pair[0].height - pair[1].height) / rise)
        };
        let terms: Vec<f64> = envelope
            .windows(2)
            .map(|pair| {
                let (rise, at) = crossing(pair);
                rise.ln() + log_improvement(-at.abs())
            })
            .collect();
        let log_sum = log_sum_exp(&terms);
        if computed == Computed::Value || !log_sum.is_finite() {
            return (log_sum + scale.ln(), vec![0.0; d_mean.len()]);
        }

        let mut by_slope = vec![0.0; new + 1];
        let mut by_height = 0.0;
        for pair in envelope.windows(2) {
            let (_, at) = crossing(pair);
            let slope_weight = (log_density(at) - log_sum).exp();
            by_slope[pair[1].index] += slope_weight;
            by_slope[pair[0].index] -= slope_weight;
            // The expected rise grows with the height of the line that is lower at z = 0, and falls
            // with the height of the other line.
            let height_weight = (log_distribution(-at.abs()) - log_sum).exp() * at.signum();
            if pair[1].index == new {
                by_height += height_weight;
            } else if pair[0].index == new {
                by_height -= height_weight;
            }
        }
        let total: f64 = envelope.iter().map(|line| by_slope[line.index] * line.slope).sum();
        let by_variance = by_slope[new] / spread - total / (2.0 * spread * spread);
        let mut gradient: Vec<f64> = d_mean
            .iter()
            .zip(&d_variance)
            .map(|(m, v)| by_height * m / scale + by_variance * v / (scale * scale))
            .collect();
        // The gradients of the covariances. All parts that depend on k(X, x) share one call of
        // `pull_back`.
        if by_slope[..new].iter().any(|g| *g != 0.0) {
            let pulled: Vec<f64> = by_slope.iter().zip(&self.noise).map(|(g, s)| g * s).collect();
            let mut through = self.process.solve(&pulled);
            for (i, (_, weights)) in self.further.iter().enumerate() {
                through.axpy(-by_slope[n + i], weights, 1.0);
            }
            let slopes = self.process.pull_back(&cross, through.as_slice(), 1.0 / spread);
            gradient.iter_mut().zip(slopes).for_each(|(g, s)| *g += s);
            for (i, (_, slopes)) in between.iter().enumerate() {
                let weight = by_slope[n + i] / spread;
                gradient.iter_mut().zip(slopes).for_each(|(g, s)| *g += weight * s);
            }
        }
        (log_sum + scale.ln(), gradient)
    }
}

impl Acquisition for LogKnowledgeGradient<'_> {
    fn value(&self, point: &[f64]) -> f64 {
        self.evaluate(point, Computed::Value).0
    }

    fn value_and_gradient(&self, point: &[f64]) -> (f64, Vec<f64>) {
        self.evaluate(point, Computed::ValueAndGradient)
    }
}

/// The upper envelope of lines: the lines that are the highest at some z, sorted by rising slope.
fn upper_envelope(mut lines: Vec<Line>) -> Vec<Line> {
    lines.sort_by(|a, b| a.slope.total_cmp(&b.slope).then(a.height.total_cmp(&b.height)));
    let mut kept: Vec<Line> = Vec::with_capacity(lines.len());
    let crossing = |a: &Line, b: &Line| (a.height - b.height) / (b.slope - a.slope);
    for line in lines {
        while let Some(top) = kept.last() {
            let hidden = top.slope == line.slope
                || (kept.len() > 1 && crossing(top, &line) <= crossing(&kept[kept.len() - 2], top));
            if !hidden {
                break;
            }
            kept.pop();
        }
        kept.push(line);
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::super::gradient_check::{check_gradient, nine_points};
    use super::*;
    use crate::surrogate::{Criterion, Kernel, LogExpectedImprovement};

    /// A process whose points have their own noise.
    fn process(noise_variance: f64) -> GaussianProcess {
        let own: Vec<f64> = (0..9).map(|i| 20.0 * f64::from(i % 3) * noise_variance).collect();
        nine_points(noise_variance, Some(&own))
    }

    #[test]
    fn the_value_is_the_mean_gain_over_the_possible_next_observations() {
        let process = process(0.3);
        let data = process.data();
        let further = [vec![0.9, 15.0], vec![0.45, 28.0]];
        let acquisition = LogKnowledgeGradient::new(&process, &further);
        for point in [[0.7, 26.0], [0.1, 12.0]] {
            let unit = data.search_box().to_unit(&point);
            let now = process.posterior(&point);
            let candidates: Vec<Vec<f64>> = (0..data.len())
                .map(|i| data.search_box().from_unit(&data.unit_point(i)))
                .chain(further.iter().cloned())
                .chain([point.to_vec()])
                .collect();
            let best = |process: &GaussianProcess| {
                candidates.iter().map(|c| process.mean(c)).fold(f64::NEG_INFINITY, f64::max)
            };
            // The integral over the next value, by the midpoint rule in z.
            let spread = (now.variance / data.scale().powi(2) + acquisition.next_noise).sqrt();
            let h = 0.005;
            let mut gain = 0.0;
            for k in -1200..1200 {
                let z = (f64::from(k) + 0.5) * h;
                let value = (now.mean - data.offset()) / data.scale() + spread * z;
                let own = acquisition.next_noise - process.hyperparameters().noise_variance;
                let next = data.extended(&unit, value, own);
                let after =
                    GaussianProcess::new(next, Kernel::Matern52, process.hyperparameters().clone())
                        .unwrap();
                gain += h * log_density(z).exp() * (best(&after) - best(&process));
            }
            let ours = acquisition.value(&point).exp();
            assert!((ours / gain - 1.0).abs() < 2e-4, "{ours} {gain}");
        }
    }

    #[test]
    fn fantasies_do_not_make_the_next_observation_exact() {
        let observed = process(0.3);
        let mut with_fantasies = observed.clone();
        for k in 0..10 {
            let point = [0.05 + 0.09 * f64::from(k), 29.0 - 1.5 * f64::from(k)];
            let value = observed.mean(&point);
            with_fantasies = with_fantasies.conditioned_on_fantasy(&point, value).unwrap();
        }
        let next_noise = |process| LogKnowledgeGradient::new(process, &[]).next_noise;
        assert_eq!(next_noise(&with_fantasies), next_noise(&observed));
    }

    #[test]
    fn the_gradient_equals_finite_differences() {
        for noise_variance in [1e-4, 0.05, 0.8] {
            let process = process(noise_variance);
            let acquisition = LogKnowledgeGradient::new(&process, &[vec![0.5, 25.0]]);
            check_gradient(&acquisition, process.data().search_box());
        }
    }

    #[test]
    fn without_noise_the_value_is_the_expected_improvement_of_the_mean() {
        let process = process(1e-9);
        let acquisition = LogKnowledgeGradient::new(&process, &[]);
        let data = process.data();
        let point = [0.7, 26.0];
        let posterior = process.posterior(&point);
        let incumbent = data.offset()
            + data.scale() * acquisition.means.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let expected =
            LogExpectedImprovement { incumbent }.score(posterior.mean, posterior.deviation());
        assert!((acquisition.value(&point) - expected.value).abs() < 1e-4);
    }
}
