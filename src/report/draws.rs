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

/// The draws of one quantity, summed up.
#[derive(Clone, Debug, PartialEq)]
pub struct QuantityDraws {
    /// Mean of the draws, in the quantity's unit.
    pub mean: f64,
    /// Standard deviation of the draws, in the quantity's unit.
    pub standard_deviation: f64,
    /// The smallest and the largest value that a draw can have.
    pub range: (f64, f64),
    /// Smallest and largest of the draws.
    pub drawn: (f64, f64),
    /// Density of the draws in cells of equal width from the smallest to the largest draw, smoothed;
    /// it adds up to 1. Empty without spread.
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
        let smallest = values.iter().copied().fold(f64::INFINITY, f64::min);
        let largest = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let is_spread = standard_deviation > NEGLIGIBLE && largest - smallest > NEGLIGIBLE;
        let drawn = (smallest, largest);
        let cells = if is_spread { density(values, drawn) } else { Vec::new() };
        Self { mean, standard_deviation, range, drawn, cells }
    }

    /// Returns whether there is a density to draw. The limit is above 0 because of fits: for a
    /// quantity that no recording shows, such as the rest angle of a cable without stiffness,
    /// rounding alone may leave a deviation.
    pub fn has_spread(&self) -> bool {
        !self.cells.is_empty()
    }

    /// The smoothed density of the draws at a value; 0 outside [`drawn`](Self::drawn).
    pub fn density(&self, value: f64) -> f64 {
        let (low, high) = self.drawn;
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
fn density(values: &[f64], (low, high): (f64, f64)) -> Vec<f64> {
    let width = (high - low) / CELLS as f64;
    let mut counts = [0.0; CELLS];
    for &value in values {
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
                *cell += count * weight / (total * values.len() as f64 * width);
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

    #[test]
    fn a_damping_that_is_nearly_unknown_is_drawn_within_its_range() {
        let damping = Quantity::Parameter(DomainParameter::RotaryDamping);
        let nominal = PlantModel::QUBE.nominal().get(damping);
        // The deviation is twice the value, as after an identification that does not determine it.
        let error = Direction::new(&[(damping, 2.0 * nominal)]);
        let draws = draws_of(&DomainDistribution::nominal().along(&[error]), damping);
        let (low, high) = draws.drawn;
        assert!(low >= 0.0 && high <= 10.0 * nominal, "{:?}", draws.drawn);
        // Mean of a normal number above -0.5.
        assert!((draws.mean / nominal - (1.0 + 2.0 * 0.509)).abs() < 0.03, "{}", draws.mean);
        let places = (0..4000).map(|it| low + (high - low) * (f64::from(it) + 0.5) / 4000.0);
        let integral = places.map(|it| draws.density(it)).sum::<f64>() * (high - low) / 4000.0;
        assert!((integral - 1.0).abs() < 0.01, "{integral}");
        assert_eq!(draws.density(-nominal), 0.0);
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
    }
}
