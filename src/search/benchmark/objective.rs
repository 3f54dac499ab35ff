use std::f64::consts::PI;

use serde::Serialize;

use crate::search::SearchBox;
use crate::surrogate::SurrogateError;

/// A synthetic function with a known maximum.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Objective {
    /// Branin in 2 dimensions, with three equal maxima (negated).
    Branin,
    /// Logarithm of 1 plus Rosenbrock's bent valley in 4 dimensions (negated).
    Rosenbrock,
    /// Hartmann in 6 dimensions, with several peaks of which one is global.
    Hartmann,
    /// One hump in 8 dimensions of very unequal weight, as high as a good return (540): a model of
    /// the search over psi.
    Hump,
    /// Levy in 12 dimensions, a bowl with ripples (negated).
    Levy,
    /// Ackley in 16 dimensions, a rippled funnel off centre (negated).
    Ackley,
}

/// Weights of the hump's coordinates, some large, some negligible.
pub(super) const HUMP_WEIGHTS: [f64; 8] = [3.0, 2.0, 2.5, 0.5, 1.0, 1.5, 0.1, 0.05];
const HUMP_CENTRE: [f64; 8] = [0.3, 0.6, 0.5, 0.4, 0.7, 0.2, 0.5, 0.5];

impl Objective {
    /// Every objective, by rising dimension.
    pub const ALL: [Self; 6] =
        [Self::Branin, Self::Rosenbrock, Self::Hartmann, Self::Hump, Self::Levy, Self::Ackley];

    /// The objective's name.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Branin => "branin",
            Self::Rosenbrock => "rosenbrock",
            Self::Hartmann => "hartmann",
            Self::Hump => "hump",
            Self::Levy => "levy",
            Self::Ackley => "ackley",
        }
    }

    /// Number of dimensions.
    #[must_use]
    pub fn dimensions(self) -> usize {
        match self {
            Self::Branin => 2,
            Self::Rosenbrock => 4,
            Self::Hartmann => 6,
            Self::Hump => 8,
            Self::Levy => 12,
            Self::Ackley => 16,
        }
    }

    /// The box that is searched.
    ///
    /// # Errors
    /// Never fails: the bounds are constants.
    pub fn search_box(self) -> Result<SearchBox, SurrogateError> {
        let cube = |lower: f64, upper: f64| {
            SearchBox::new(vec![lower; self.dimensions()], vec![upper; self.dimensions()])
        };
        match self {
            Self::Branin => SearchBox::new(vec![-5.0, 0.0], vec![10.0, 15.0]),
            Self::Rosenbrock => cube(-2.0, 2.0),
            Self::Hartmann | Self::Hump => cube(0.0, 1.0),
            Self::Levy => cube(-10.0, 10.0),
            Self::Ackley => cube(-5.0, 10.0),
        }
    }

    /// The largest value in the box.
    #[must_use]
    pub fn maximum(self) -> f64 {
        match self {
            Self::Branin => -0.397_887_357_729_738_16,
            Self::Hartmann => 3.322_368_011_415_513,
            Self::Hump => 540.0,
            Self::Rosenbrock | Self::Levy | Self::Ackley => 0.0,
        }
    }

    /// The value at a point of the box, one coordinate for each dimension. Formulas: Surjanovic and
    /// Bingham, Virtual Library of Simulation Experiments.
    #[must_use]
    pub fn value(self, x: &[f64]) -> f64 {
        match self {
            Self::Branin => -branin(x),
            Self::Rosenbrock => -rosenbrock(x).ln_1p(),
            Self::Hartmann => hartmann(x),
            Self::Hump => 540.0 * (-bowl(x, &HUMP_CENTRE, &HUMP_WEIGHTS)).exp(),
            Self::Levy => -levy(x),
            Self::Ackley => -ackley(x),
        }
    }
}

/// Computes `sum_d w_d (x_d - c_d)^2`.
pub(super) fn bowl(x: &[f64], centre: &[f64], weights: &[f64]) -> f64 {
    x.iter().zip(centre).zip(weights).map(|((x, c), w)| w * (x - c) * (x - c)).sum()
}

fn branin(x: &[f64]) -> f64 {
    let bend = x[1] - 5.1 / (4.0 * PI * PI) * x[0] * x[0] + 5.0 / PI * x[0] - 6.0;
    bend * bend + 10.0 * (1.0 - 1.0 / (8.0 * PI)) * x[0].cos() + 10.0
}

fn rosenbrock(x: &[f64]) -> f64 {
    let term =
        |pair: &[f64]| 100.0 * (pair[1] - pair[0] * pair[0]).powi(2) + (1.0 - pair[0]).powi(2);
    x.windows(2).map(term).sum()
}

fn hartmann(x: &[f64]) -> f64 {
    const HEIGHTS: [f64; 4] = [1.0, 1.2, 3.0, 3.2];
    const WEIGHTS: [[f64; 6]; 4] = [
        [10.0, 3.0, 17.0, 3.5, 1.7, 8.0],
        [0.05, 10.0, 17.0, 0.1, 8.0, 14.0],
        [3.0, 3.5, 1.7, 10.0, 17.0, 8.0],
        [17.0, 8.0, 0.05, 10.0, 0.1, 14.0],
    ];
    const CENTRES: [[f64; 6]; 4] = [
        [0.1312, 0.1696, 0.5569, 0.0124, 0.8283, 0.5886],
        [0.2329, 0.4135, 0.8307, 0.3736, 0.1004, 0.9991],
        [0.2348, 0.1451, 0.3522, 0.2883, 0.3047, 0.6650],
        [0.4047, 0.8828, 0.8732, 0.5743, 0.1091, 0.0381],
    ];
    (0..4)
        .map(|i| {
            let inner: f64 = (0..6).map(|d| WEIGHTS[i][d] * (x[d] - CENTRES[i][d]).powi(2)).sum();
            HEIGHTS[i] * (-inner).exp()
        })
        .sum()
}

fn levy(x: &[f64]) -> f64 {
    let w = |x: f64| 1.0 + (x - 1.0) / 4.0;
    let (first, last) = (w(x[0]), w(x[x.len() - 1]));
    let middle: f64 = x[..x.len() - 1]
        .iter()
        .map(|&x| (w(x) - 1.0).powi(2) * (1.0 + 10.0 * (PI * w(x) + 1.0).sin().powi(2)))
        .sum();
    let end = (last - 1.0).powi(2) * (1.0 + (2.0 * PI * last).sin().powi(2));
    (PI * first).sin().powi(2) + middle + end
}

fn ackley(x: &[f64]) -> f64 {
    let d = x.len() as f64;
    let squares: f64 = x.iter().map(|x| x * x).sum();
    let waves: f64 = x.iter().map(|x| (2.0 * PI * x).cos()).sum();
    20.0 + 1f64.exp() - 20.0 * (-0.2 * (squares / d).sqrt()).exp() - (waves / d).exp()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surrogate::sobol_point;

    #[test]
    fn maxima_are_where_the_literature_has_them_and_nowhere_exceeded() {
        for (objective, at) in [
            (Objective::Branin, vec![PI, 2.275]),
            (Objective::Rosenbrock, vec![1.0; 4]),
            (Objective::Hartmann, vec![0.20169, 0.150011, 0.476874, 0.275332, 0.311652, 0.6573]),
            (Objective::Hump, HUMP_CENTRE.to_vec()),
            (Objective::Levy, vec![1.0; 12]),
            (Objective::Ackley, vec![0.0; 16]),
        ] {
            let search_box = objective.search_box().unwrap();
            assert_eq!(search_box.check(0, &at), Ok(()));
            assert!((objective.value(&at) - objective.maximum()).abs() < 1e-6, "{objective:?}");
            for i in 0..2000 {
                let unit = sobol_point(i, objective.dimensions(), 1);
                let value = objective.value(&search_box.from_unit(&unit));
                assert!(value <= objective.maximum() + 1e-9);
            }
        }
    }
}
