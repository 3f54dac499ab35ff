use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::lbfgs::{Tolerances, minimise};
use super::{Acquisition, SearchBox};

/// The effort of a maximisation by [`maximise()`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MaximiserSettings {
    /// Number of quasi-random points at which the value alone is computed; 0 counts as 1.
    pub raw: usize,
    /// Number of the best points from which a local search follows the gradient; 0 counts as 1.
    pub starts: usize,
    /// Seed of the random points.
    pub seed: u64,
}

impl Default for MaximiserSettings {
    fn default() -> Self {
        Self { raw: 512, starts: 10, seed: 0 }
    }
}

/// A maximum over a box and its position.
#[derive(Clone, Debug, PartialEq)]
pub struct Maximum {
    /// Position in the box's own units.
    pub point: Vec<f64>,
    /// Value at that position.
    pub value: f64,
}

/// Half widths, on the unit cube, of the clouds of random points around each hint.
const CLOUDS: [f64; 3] = [0.2, 0.05, 0.01];
/// Number of random points in each cloud.
const CLOUD_POINTS: usize = 8;
/// Distance on the unit cube by which two starts differ in at least one coordinate. Closer points
/// become starts only if there are too few others.
const APART: f64 = 0.03;

/// Maximises an acquisition function over the box.
///
/// It is evaluated at Owen-scrambled Sobol points, at the `hints` and at clouds of points around
/// the hints; L-BFGS then follows its gradient within the box from the best of these points. Hints
/// are points in the box's own units near which a maximum is likely, such as the best observed
/// points. A value that is NaN counts as minus infinity.
#[must_use]
pub fn maximise(
    acquisition: &dyn Acquisition,
    search_box: &SearchBox,
    hints: &[Vec<f64>],
    settings: &MaximiserSettings,
) -> Maximum {
    let d = search_box.dimensions();
    let mut candidates: Vec<(f64, Vec<f64>)> = raw_points(search_box, hints, settings)
        .into_iter()
        .map(|unit| {
            let value = acquisition.value(&search_box.from_unit(&unit));
            (if value.is_nan() { f64::NEG_INFINITY } else { value }, unit)
        })
        .collect();
    candidates.sort_by(|a, b| b.0.total_cmp(&a.0));

    let tolerances = Tolerances { gradient: 1e-8, decrease: 1e-11, iterations: 100 };
    let negative = |unit: &[f64], gradient: &mut [f64]| {
        let (value, slopes) = acquisition.value_and_gradient(&search_box.from_unit(unit));
        for (i, (to, slope)) in gradient.iter_mut().zip(slopes).enumerate() {
            *to = -slope * search_box.width(i);
        }
        -value
    };
    let (lower, upper) = (vec![0.0; d], vec![1.0; d]);
    let mut best = candidates[0].clone();
    for start in spread_out(&candidates, settings.starts.max(1)) {
        let found = minimise(negative, start, &lower, &upper, tolerances);
        if -found.value > best.0 {
            best = (-found.value, found.point);
        }
    }
    Maximum { point: search_box.from_unit(&best.1), value: best.0 }
}

fn raw_points(
    search_box: &SearchBox,
    hints: &[Vec<f64>],
    settings: &MaximiserSettings,
) -> Vec<Vec<f64>> {
    let d = search_box.dimensions();
    let mut random = ChaCha8Rng::seed_from_u64(settings.seed);
    let scramble: u32 = random.random();
    let mut points: Vec<Vec<f64>> =
        (0..settings.raw.max(1)).map(|i| sobol_point(i, d, scramble)).collect();
    for hint in hints {
        let unit = search_box.to_unit(hint);
        for half_width in CLOUDS {
            for _ in 0..CLOUD_POINTS {
                let near = |u: &f64| {
                    (u + half_width * (2.0 * random.random::<f64>() - 1.0)).clamp(0.0, 1.0)
                };
                points.push(unit.iter().map(near).collect());
            }
        }
        points.push(unit);
    }
    points
}

/// The `index`-th point of an Owen-scrambled Sobol sequence on the unit cube (Burley 2020). The
/// sequence has 65 536 points; larger indices take its points again with another scrambling.
#[must_use]
pub fn sobol_point(index: usize, dimensions: usize, seed: u32) -> Vec<f64> {
    let (round, index) = (index >> 16, index & 0xffff);
    let seed = seed.wrapping_add((round as u32).wrapping_mul(0x9e37_79b9));
    (0..dimensions)
        .map(|d| {
            // The crate has direction numbers for 256 dimensions; further dimensions use the same
            // ones with another seed.
            let (block, d) =
                (d as u32 / sobol_burley::NUM_DIMENSIONS, d as u32 % sobol_burley::NUM_DIMENSIONS);
            f64::from(sobol_burley::sample(index as u32, d, seed.wrapping_add(block)))
        })
        .collect()
}

/// Chooses at most `count` points of a list that is sorted from best to worst: the best points that
/// are farther apart than [`APART`], and, if these are too few, the best of the others.
fn spread_out(sorted: &[(f64, Vec<f64>)], count: usize) -> Vec<&[f64]> {
    let mut chosen: Vec<&[f64]> = Vec::with_capacity(count);
    let mut left = Vec::new();
    for (_, point) in sorted {
        let apart = |other: &&[f64]| point.iter().zip(*other).any(|(a, b)| (a - b).abs() > APART);
        if chosen.len() == count {
            break;
        }
        if chosen.iter().all(apart) {
            chosen.push(point);
        } else {
            left.push(point.as_slice());
        }
    }
    let missing = count - chosen.len();
    chosen.extend(left.into_iter().take(missing));
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A function with many humps; the highest, at (0.2, 3.0), is one unit above the others.
    struct Humps;

    impl Acquisition for Humps {
        fn value(&self, point: &[f64]) -> f64 {
            self.value_and_gradient(point).0
        }

        fn value_and_gradient(&self, point: &[f64]) -> (f64, Vec<f64>) {
            let mut value = 0.0;
            let mut gradient = vec![0.0; 2];
            for (center, height) in
                [([0.2, 3.0], 3.0), ([0.8, 1.0], 2.0), ([0.7, 4.0], 2.0), ([0.1, 0.3], 2.0)]
            {
                let offset = [(point[0] - center[0]) / 0.1, (point[1] - center[1]) / 0.5];
                let hump = height * (-0.5 * (offset[0] * offset[0] + offset[1] * offset[1])).exp();
                value += hump;
                gradient[0] -= hump * offset[0] / 0.1;
                gradient[1] -= hump * offset[1] / 0.5;
            }
            (value, gradient)
        }
    }

    #[test]
    fn the_highest_hump_is_found_with_every_seed() {
        let search_box = SearchBox::new(vec![0.0, 0.0], vec![1.0, 5.0]).unwrap();
        for seed in 0..20 {
            let settings = MaximiserSettings { raw: 64, starts: 4, seed };
            let found = maximise(&Humps, &search_box, &[], &settings);
            assert!(
                (found.point[0] - 0.2).abs() < 1e-3 && (found.point[1] - 3.0).abs() < 1e-2,
                "{found:?}"
            );
            assert_eq!(found, maximise(&Humps, &search_box, &[], &settings));
        }
    }

    /// A plane that rises towards one corner of the box.
    struct Corner;

    impl Acquisition for Corner {
        fn value(&self, point: &[f64]) -> f64 {
            point[0] - point[1]
        }

        fn value_and_gradient(&self, point: &[f64]) -> (f64, Vec<f64>) {
            (self.value(point), vec![1.0, -1.0])
        }
    }

    #[test]
    fn a_maximum_at_a_corner_of_the_box_is_found_exactly() {
        let search_box = SearchBox::new(vec![-3.0, 2.0], vec![-1.0, 9.0]).unwrap();
        let found =
            maximise(&Corner, &search_box, &[vec![-2.0, 3.0]], &MaximiserSettings::default());
        assert_eq!(found.point, [-1.0, 2.0]);
    }

    #[test]
    fn sobol_points_go_on_beyond_their_tables() {
        for (index, dimensions) in [(0, 1), (65_535, 3), (65_536, 3), (7, 300)] {
            let point = sobol_point(index, dimensions, 1);
            assert!(point.len() == dimensions && point.iter().all(|u| (0.0..1.0).contains(u)));
        }
        assert_ne!(sobol_point(0, 3, 1), sobol_point(65_536, 3, 1));
    }
}
