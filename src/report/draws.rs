//! Draws of a distribution of simulations, summed up for each quantity.

use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;

use crate::qube::Quantity;
use crate::simulation::{DomainDistribution, range_of_draws};

/// Largest standard deviation, in a quantity's SI unit, of a quantity that counts as constant;
/// nobody knows a quantity that precisely. Tables show smaller numbers as 0.
pub const NEGLIGIBLE: f64 = 1e-12;

/// Number of Qubes that are drawn. The mean of a quantity then errs by a three-hundredth of its
/// standard deviation.
const DRAWS: usize = 100_000;

/// [`DRAWS`] as text for pages.
pub const DRAWS_IN_WORDS: &str = "100 000";

/// Seed of the draws: the same distribution gives the same page.
const SEED: u64 = 0x6472_6177;

/// Number of cells into which the draws of a quantity are counted.
const CELLS: usize = 400;

/// Standard deviation of the smoothing kernel, in cells: narrow enough to move no draw visibly, and
/// wide enough for the number of draws.
const KERNEL_CELLS: f64 = 4.0;

/// Largest distance from an end of the range at which a draw may count as at this end, as a
/// fraction of the distance between the smallest and the largest draw.
const NEAR_END: f64 = 0.01;

/// Factor by which the draws within [`NEAR_END`] of an end must outnumber the draws in the same
/// distance beyond, so that they count as piled up at the end.
const PILED_UP: usize = 3;

/// The draws of one quantity, summed up.
#[derive(Clone, Debug, PartialEq)]
pub struct QuantityDraws {
    /// Mean of the draws, in the quantity's unit.
    pub mean: f64,
    /// Standard deviation of the draws, in the quantity's unit.
    pub standard_deviation: f64,
    /// The smallest and the largest value that a draw can have.
    pub range: (f64, f64),
    /// Shares of the draws that are piled up at the lower and at the upper end of the range. A
    /// joint deviation that would move a value out of its range puts it at the end, from where the
    /// other deviations may move it a little.
    pub at_ends: [f64; 2],
    /// Smallest and largest of the draws that are piled up at no end; equal if there are none.
    pub inner: (f64, f64),
    /// Density of the draws in cells of equal width from the smallest to the largest inner draw,
    /// smoothed; together with the shares at the ends it adds up to 1. Empty without spread.
    cells: Vec<f64>,
}

impl QuantityDraws {
    /// Draws Qubes from a distribution, and sums up every quantity, in the order of
    /// [`Quantity::all`].
    pub fn of(distribution: &DomainDistribution) -> Vec<Self> {
        let mut random = ChaCha8Rng::seed_from_u64(SEED);
        let mut values = vec![Vec::new(); Quantity::COUNT];
        for _ in 0..DRAWS {
            let model = distribution.sample(&mut random);
            for (quantity, values) in Quantity::all().zip(&mut values) {
                values.push(model.get(quantity));
            }
        }
        let summed = Quantity::all().zip(&values);
        summed
            .map(|(quantity, values)| {
                let mean = distribution.get(quantity).mean();
                Self::summed_up(values, range_of_draws(quantity, mean))
            })
            .collect()
    }

    fn summed_up(values: &[f64], range: (f64, f64)) -> Self {
        let count = values.len() as f64;
        let first = values.first().copied().unwrap_or(0.0);
        // Deviations from one of the values: the mean of equal values is then exact.
        let mean = first + values.iter().map(|value| value - first).sum::<f64>() / count;
        let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
        let standard_deviation = (squares / count).sqrt();
        let has_spread = standard_deviation > NEGLIGIBLE;
        let smallest = values.iter().copied().fold(f64::INFINITY, f64::min);
        let largest = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let near = NEAR_END * (largest - smallest);
        let piled_up = |is_within: &dyn Fn(f64, f64) -> bool| {
            let count = |distance| values.iter().filter(|it| is_within(**it, distance)).count();
            let (closest, close) = (count(near), count(2.0 * near));
            if has_spread && closest > PILED_UP * (close - closest) { closest } else { 0 }
        };
        let counts = [
            piled_up(&|value, distance| value <= range.0 + distance),
            piled_up(&|value, distance| value >= range.1 - distance),
        ];
        let at_ends = counts.map(|it| it as f64 / count);
        let [low, high] = [counts[0] > 0, counts[1] > 0];
        let is_inner =
            |value: f64| !(low && value <= range.0 + near || high && value >= range.1 - near);
        let inner = || values.iter().copied().filter(|it| is_inner(*it));
        let ends =
            (inner().fold(f64::INFINITY, f64::min), inner().fold(f64::NEG_INFINITY, f64::max));
        let ends = if ends.0 <= ends.1 { ends } else { (mean, mean) };
        let is_spread = has_spread && ends.1 - ends.0 > NEGLIGIBLE;
        let cells = if is_spread { density(inner(), ends, values.len()) } else { Vec::new() };
        Self { mean, standard_deviation, range, at_ends, inner: ends, cells }
    }

    /// Returns whether there is a density to draw. The limit is above 0 because of fits: for a
    /// quantity that no recording shows, such as the rest angle of a cable without stiffness,
    /// rounding alone may leave a deviation.
    pub fn has_spread(&self) -> bool {
        !self.cells.is_empty()
    }

    /// The smoothed density of the draws at a value, without those at the ends of the range; 0
    /// outside [`inner`](Self::inner).
    pub fn density(&self, value: f64) -> f64 {
        let (low, high) = self.inner;
        if self.cells.is_empty() || !(low..=high).contains(&value) {
            return 0.0;
        }
        let last = self.cells.len() - 1;
        // The density of a cell applies to the cell's middle.
        let place = ((value - low) / (high - low) * CELLS as f64 - 0.5).clamp(0.0, last as f64);
        let cell = (place as usize).min(last.saturating_sub(1));
        let part = place - cell as f64;
        self.cells[cell] * (1.0 - part) + self.cells[(cell + 1).min(last)] * part
    }
}

/// The smoothed density in each cell between `low` and `high`: counts, spread by a normal kernel
/// and reflected at both ends, so that no draw is moved out of the range.
fn density(values: impl Iterator<Item = f64>, (low, high): (f64, f64), all: usize) -> Vec<f64> {
    let width = (high - low) / CELLS as f64;
    let mut counts = [0.0; CELLS];
    for value in values {
        counts[(((value - low) / width) as usize).min(CELLS - 1)] += 1.0;
    }
    let reach = (4.0 * KERNEL_CELLS) as isize;
    let weights: Vec<f64> = (-reach..=reach)
        .map(|distance| (-0.5 * (distance as f64 / KERNEL_CELLS).powi(2)).exp())
        .collect();
    let total: f64 = weights.iter().sum();
    let mut smooth = vec![0.0; CELLS];
    for (cell, count) in counts.into_iter().enumerate() {
        for (distance, weight) in (-reach..=reach).zip(&weights) {
            let mut to = cell as isize + distance;
            if to < 0 {
                to = -1 - to;
            }
            if to >= CELLS as isize {
                to = 2 * CELLS as isize - 1 - to;
            }
            if let Some(cell) = smooth.get_mut(to as usize) {
                *cell += count * weight / (total * all as f64 * width);
            }
        }
    }
    smooth
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::{Distribution, DomainParameter, Nonideality, PlantModel};
    use crate::simulation::{Direction, Family};

    fn draws_of(distribution: &DomainDistribution, quantity: impl Into<Quantity>) -> QuantityDraws {
        QuantityDraws::of(distribution)[quantity.into().index()].clone()
    }

    /// The integral of the density over the range.
    fn integral(draws: &QuantityDraws) -> f64 {
        let (low, high) = draws.inner;
        let places = (0..4000).map(|it| low + (high - low) * (f64::from(it) + 0.5) / 4000.0);
        places.map(|it| draws.density(it)).sum::<f64>() * (high - low) / 4000.0
    }

    #[test]
    fn a_damping_that_is_nearly_unknown_is_not_drawn_below_its_range() {
        let damping = Quantity::Parameter(DomainParameter::RotaryDamping);
        let nominal = PlantModel::QUBE.nominal().get(damping);
        // The deviation is twice the value, as after an identification that does not determine it.
        let error = Direction::new(&[(damping, 2.0 * nominal)]);
        let draws = draws_of(&DomainDistribution::nominal().along(&[error]), damping);
        let (low, high) = (0.1 * nominal, 1.9 * nominal);
        assert!(draws.inner.0 > low && draws.inner.1 < high, "{:?}", draws.inner);
        assert!((draws.mean / nominal - 1.0).abs() < 0.01, "{}", draws.mean);
        assert!(draws.standard_deviation < 0.9 * nominal, "{}", draws.standard_deviation);
        for share in draws.at_ends {
            // 32.6 % of a normal distribution lie beyond 0.45 standard deviations.
            assert!((share - 0.33).abs() < 0.015, "{share}");
        }
        let inner = integral(&draws);
        assert!((inner + draws.at_ends[0] + draws.at_ends[1] - 1.0).abs() < 0.01, "{inner}");
        assert_eq!((draws.density(0.0), draws.density(2.0 * nominal)), (0.0, 0.0));
    }

    #[test]
    fn draws_that_other_deviations_move_slightly_off_an_end_count_as_at_the_end() {
        let damping = Quantity::Parameter(DomainParameter::RotaryDamping);
        let nominal = PlantModel::QUBE.nominal().get(damping);
        let errors = [2.0, 0.002].map(|size| Direction::new(&[(damping, size * nominal)]));
        let draws = draws_of(&DomainDistribution::nominal().along(&errors), damping);
        assert!(draws.at_ends.iter().all(|share| (share - 0.33).abs() < 0.015), "{draws:?}");
        let highest = draws.cells.iter().fold(0.0_f64, |one, other| one.max(*other));
        assert!(highest < 1.3 * draws.density(nominal), "{highest}");
    }

    #[test]
    fn the_density_of_draws_follows_their_distribution_up_to_its_ends() {
        let mass = Quantity::Parameter(DomainParameter::PendulumMass);
        let handcrafted = DomainDistribution::handcrafted(Family::Normal);
        let (draws, normal) = (draws_of(&handcrafted, mass), handcrafted.get(mass));
        for place in [-2.0, -1.0, 0.0, 0.5, 1.5] {
            let at = normal.mean() + place * normal.standard_deviation();
            let ratio = draws.density(at) / normal.density(at);
            assert!((ratio - 1.0).abs() < 0.06, "{place}: {ratio}");
        }
        let dead_zone = Quantity::Nonideality(Nonideality::PositiveDeadZone);
        let uniform = DomainDistribution::nominal()
            .with(dead_zone, Distribution::between(0.0, 0.35))
            .unwrap();
        let draws = draws_of(&uniform, dead_zone);
        for at in [0.001, 0.1, 0.349] {
            assert!((draws.density(at) * 0.35 - 1.0).abs() < 0.1, "{at}: {}", draws.density(at));
        }
        assert_eq!(draws.density(-0.001), 0.0);
    }

    #[test]
    fn a_constant_quantity_has_no_spread_and_its_exact_mean() {
        let mass = Quantity::Parameter(DomainParameter::PendulumMass);
        let draws = draws_of(&DomainDistribution::nominal(), mass);
        assert_eq!(
            (draws.mean, draws.standard_deviation),
            (PlantModel::QUBE.nominal().get(mass), 0.0)
        );
        assert!(!draws.has_spread());
        assert_eq!(draws.at_ends, [0.0; 2]);
    }
}
