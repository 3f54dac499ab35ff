use nalgebra::DVector;
use rand_chacha::ChaCha8Rng;

use super::gaussian::standard_normal;
use crate::qube::{PlantModel, Quantity, QubeModel};
use crate::simulation::{DomainDistribution, range_of_draws};

/// Standard deviation of the logarithm of a damping before any data: published values differ by a
/// factor of 50.
const DAMPING_LOG_DEVIATION: f64 = 1.0;

/// Largest distance of a coordinate from 0 at which a Qube is simulated, in standard deviations of
/// the prior.
const FARTHEST: f64 = 4.0;

/// Largest number of draws for a point within the ranges. A distribution whose mean lies at several
/// ends of the ranges has about half of its draws beyond each.
const MOST_DRAWS: usize = 200;

/// The coordinates in which rivals learn about a Qube: one for each quantity that varies in the
/// distribution `robust`, and one for each damping, which `robust` does not vary. The prior of each
/// coordinate is the standard normal distribution, cut off at the values that can be simulated. Its
/// mean 0 and standard deviation 1 before the cut stand for the quantity's mean and standard
/// deviation in `robust`, in proportion to the plant; for a damping they stand for its nominal
/// value and a factor of e. Parameters count by their logarithms, so that none becomes negative. A
/// quantity that the plant lacks has no coordinate.
#[derive(Clone, Debug)]
pub struct Space {
    nominal: QubeModel,
    coordinates: Vec<Coordinate>,
}

#[derive(Clone, Copy, Debug)]
struct Coordinate {
    quantity: Quantity,
    centre: f64,
    deviation: f64,
}

impl Space {
    /// The space for a specimen of `plant` that nobody has identified.
    pub fn of_unknown(plant: &PlantModel) -> Self {
        let before = DomainDistribution::robust();
        let coordinate = |quantity: Quantity| {
            let (own, proportion) = (before.get(quantity), plant.proportion(quantity));
            let (mean, deviation) =
                (proportion * own.mean(), proportion * own.standard_deviation());
            let deviation = match quantity {
                // A quantity that the plant does not have stays 0.
                Quantity::Parameter(_) if mean == 0.0 => 0.0,
                Quantity::Parameter(parameter) if parameter.is_damping() => DAMPING_LOG_DEVIATION,
                Quantity::Parameter(_) => deviation / mean,
                Quantity::Nonideality(_) => deviation,
            };
            (deviation > 0.0).then_some(Coordinate { quantity, centre: mean, deviation })
        };
        let coordinates = Quantity::all().filter_map(coordinate).collect();
        Self { nominal: plant.nominal(), coordinates }
    }

    /// Number of coordinates.
    pub fn dimensions(&self) -> usize {
        self.coordinates.len()
    }

    /// The nearest point whose Qube can be simulated: an entry beyond its range becomes the end of
    /// the range.
    pub fn clamped(&self, point: &DVector<f64>) -> DVector<f64> {
        DVector::from_iterator(
            point.len(),
            self.coordinates.iter().zip(point.iter()).map(|(coordinate, entry)| {
                let (lower, upper) = coordinate.range();
                entry.clamp(lower, upper)
            }),
        )
    }

    /// A point that `draw` draws and whose Qube can be simulated. A draw beyond the ranges is drawn
    /// again: clamping would break the correlations of its entries, and gather the entries at the
    /// ends. If all of [`MOST_DRAWS`] draws lie beyond the ranges, the last one is clamped.
    pub fn drawn_within(&self, draw: &mut dyn FnMut() -> DVector<f64>) -> DVector<f64> {
        let mut point = draw();
        for _ in 1..MOST_DRAWS {
            if self.contains(&point) {
                break;
            }
            point = draw();
        }
        self.clamped(&point)
    }

    /// Points that `draw` draws and whose Qubes can be simulated, as [`Self::drawn_within`].
    pub fn draws_within(
        &self,
        count: usize,
        mut draw: impl FnMut() -> DVector<f64>,
    ) -> Vec<DVector<f64>> {
        (0..count).map(|_| self.drawn_within(&mut draw)).collect()
    }

    /// The Qube at a point, or at the nearest point that can be simulated.
    pub fn model(&self, point: &DVector<f64>) -> QubeModel {
        let mut model = self.nominal;
        for (coordinate, entry) in self.coordinates.iter().zip(self.clamped(point).iter()) {
            model.set(coordinate.quantity, coordinate.value(*entry));
        }
        model
    }

    /// The point of a Qube.
    pub fn point(&self, model: &QubeModel) -> DVector<f64> {
        let entry = |it: &Coordinate| {
            let value = model.get(it.quantity);
            match it.quantity {
                Quantity::Parameter(_) => (value / it.centre).ln() / it.deviation,
                Quantity::Nonideality(_) => (value - it.centre) / it.deviation,
            }
        };
        DVector::from_iterator(self.dimensions(), self.coordinates.iter().map(entry))
    }

    /// Returns whether the Qube at a point can be simulated as it is.
    pub fn contains(&self, point: &DVector<f64>) -> bool {
        let mut entries = self.coordinates.iter().zip(point.iter());
        entries.all(|(coordinate, entry)| {
            let (lower, upper) = coordinate.range();
            (lower..=upper).contains(entry)
        })
    }

    /// The probability that a point of the prior, before it is cut off at the ranges, lies within
    /// them.
    pub fn prior_probability(&self) -> f64 {
        let within = |(lower, upper): (f64, f64)| {
            let below = |entry: f64| 0.5 * libm::erfc(-entry * std::f64::consts::FRAC_1_SQRT_2);
            below(upper) - below(lower)
        };
        self.coordinates.iter().map(|coordinate| within(coordinate.range())).product()
    }

    /// Smallest and largest entry of each coordinate that can be simulated.
    pub fn ranges(&self) -> (Vec<f64>, Vec<f64>) {
        self.coordinates.iter().map(Coordinate::range).unzip()
    }

    /// Draws points from the prior, within the ranges that can be simulated.
    pub fn draws(&self, count: usize, random: &mut ChaCha8Rng) -> Vec<DVector<f64>> {
        (0..count)
            .map(|_| {
                let mut point = standard_normal(self.dimensions(), random);
                // An entry beyond its range is drawn again, because clamping would gather all such
                // entries at the end of the range.
                while !self.contains(&point) {
                    let again = standard_normal(self.dimensions(), random);
                    for (index, coordinate) in self.coordinates.iter().enumerate() {
                        let (lower, upper) = coordinate.range();
                        if !(lower..=upper).contains(&point[index]) {
                            point[index] = again[index];
                        }
                    }
                }
                point
            })
            .collect()
    }
}

impl Coordinate {
    fn value(&self, entry: f64) -> f64 {
        match self.quantity {
            Quantity::Parameter(_) => self.centre * (self.deviation * entry).exp(),
            Quantity::Nonideality(_) => self.centre + self.deviation * entry,
        }
    }

    /// Smallest and largest entry of the coordinate that can be simulated, both within
    /// [`FARTHEST`] of 0.
    fn range(&self) -> (f64, f64) {
        let Quantity::Nonideality(_) = self.quantity else { return (-FARTHEST, FARTHEST) };
        let (smallest, largest) = range_of_draws(self.quantity, self.centre);
        // A rounding error must not leave the range.
        let entry = |value: f64| (value - self.centre) / self.deviation;
        let inside = 1e-9;
        (entry(smallest).max(-FARTHEST) + inside, entry(largest).min(FARTHEST) - inside)
    }
}

/// The distribution of simulations that draws one of the Qubes at these points, or without points
/// the nominal Qube; `None` if a Qube cannot be simulated.
pub fn distribution_of(space: &Space, points: &[DVector<f64>]) -> Option<DomainDistribution> {
    let models = points.iter().map(|point| space.model(point)).collect();
    DomainDistribution::of_specimens(models).ok()
}

/// Mean and standard deviation of the simulations of a quantity.
#[cfg(test)]
pub fn moments(distribution: &DomainDistribution, quantity: Quantity) -> [f64; 2] {
    let own = distribution.get(quantity);
    [own.mean(), own.standard_deviation()]
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng as _;

    use super::*;

    #[test]
    fn every_point_is_a_qube_that_can_be_simulated() {
        let space = Space::of_unknown(&PlantModel::QUBE);
        assert_eq!(space.dimensions(), 14);
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let far_points: Vec<DVector<f64>> =
            (0..200).map(|_| 9.0 * standard_normal(14, &mut random)).collect();
        assert!(distribution_of(&space, &far_points).is_some());
        for point in &far_points {
            let there = space.point(&space.model(point));
            assert!((there - space.clamped(point)).norm() < 1e-9);
        }
    }

    /// Mean and standard deviation of the standard normal distribution between two ends.
    fn truncated((lower, upper): (f64, f64)) -> [f64; 2] {
        let density = |entry: f64| (-0.5 * entry * entry).exp() / std::f64::consts::TAU.sqrt();
        let below = |entry: f64| 0.5 * libm::erfc(-entry / 2.0_f64.sqrt());
        let within = below(upper) - below(lower);
        let mean = (density(lower) - density(upper)) / within;
        let square = 1.0 + (lower * density(lower) - upper * density(upper)) / within;
        [mean, (square - mean * mean).sqrt()]
    }

    #[test]
    fn draws_have_the_moments_of_an_unknown_qube() {
        let space = Space::of_unknown(&PlantModel::QUBE);
        let points = space.draws(4000, &mut ChaCha8Rng::seed_from_u64(2));
        let drawn = distribution_of(&space, &points).unwrap();
        let before = DomainDistribution::robust();
        for coordinate in &space.coordinates {
            let quantity = coordinate.quantity;
            let own = before.get(quantity);
            if own.standard_deviation() == 0.0 {
                continue;
            }
            let [mean, deviation] = moments(&drawn, quantity);
            let expected = match quantity {
                // The logarithm is normal, and its ends are far away.
                Quantity::Parameter(_) => {
                    let variance = (own.standard_deviation() / own.mean()).powi(2);
                    let mean = own.mean() * (0.5 * variance).exp();
                    [mean, mean * variance.exp_m1().sqrt()]
                }
                Quantity::Nonideality(_) => {
                    let [mean, deviation] = truncated(coordinate.range());
                    let scale = own.standard_deviation();
                    [own.mean() + scale * mean, scale * deviation]
                }
            };
            let off = (mean - expected[0]).abs() / own.standard_deviation();
            assert!(off < 0.06, "{quantity:?}: {off}");
            let part = deviation / expected[1];
            assert!((0.95..1.05).contains(&part), "{quantity:?}: {part}");
        }
    }

    #[test]
    fn the_prior_has_its_probability_within_the_ranges() {
        let space = Space::of_unknown(&PlantModel::QUBE);
        let mut random = ChaCha8Rng::seed_from_u64(5);
        let count = 20_000;
        let within = (0..count)
            .filter(|_| space.contains(&standard_normal(space.dimensions(), &mut random)))
            .count();
        let share = within as f64 / f64::from(count);
        assert!((share - space.prior_probability()).abs() < 0.015, "{share}");
    }
}
