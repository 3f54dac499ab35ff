use nalgebra::{DMatrix, SymmetricEigen};

use super::{Direction, DomainDistribution};
use crate::qube::{PlantModel, Profile, Quantity};

/// Smallest width of a direction that [`Direction::of_errors`] keeps, in that function's units of
/// width; narrower directions are negligible.
const SMALLEST_WIDTH: f64 = 1e-6;

impl Direction {
    /// The principal directions of the errors of a profile's identification, the widest first.
    /// Together they have the covariance of these errors. The list is empty for a profile without
    /// standard errors.
    ///
    /// To compare quantities of different units, the width of a direction is measured in the
    /// standard deviations of the distribution `robust` for the profile's plant, the belief about a
    /// specimen before any data. For a quantity that `robust` holds constant, the unit of width is
    /// its nominal value; for any quantity whose nominal value is 0 in the plant, it is
    /// the standard error.
    #[must_use]
    pub fn of_errors(profile: &Profile, plant: &PlantModel) -> Vec<Self> {
        let quantities: Vec<Quantity> =
            Quantity::all().filter(|&quantity| profile.standard_error(quantity) > 0.0).collect();
        let before = DomainDistribution::robust();
        let scale = |quantity: Quantity| {
            let of_qube = match before.standard_deviation(quantity) {
                // `robust` holds the dampings constant, and before any data each of them is known to
                // about a factor of e.
                0.0 => before.get(quantity).mean().abs().max(f64::MIN_POSITIVE),
                deviation => deviation,
            };
            match plant.proportion(quantity) {
                // The plant's nominal value is 0 and gives no scale: the standard error is its own
                // scale.
                0.0 => profile.standard_error(quantity),
                proportion => proportion * of_qube,
            }
        };
        let scales: Vec<f64> = quantities.iter().map(|&quantity| scale(quantity)).collect();
        let scaled = DMatrix::from_fn(quantities.len(), quantities.len(), |row, column| {
            let covariance = profile.covariance(quantities[row], quantities[column]);
            covariance / (scales[row] * scales[column])
        });
        if quantities.is_empty() {
            return Vec::new();
        }
        let eigen = SymmetricEigen::new(scaled);
        let mut order: Vec<usize> = (0..quantities.len()).collect();
        order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
        let widths =
            order.into_iter().map(|index| (index, eigen.eigenvalues[index].max(0.0).sqrt()));
        widths
            .filter(|&(_, width)| width > SMALLEST_WIDTH)
            .map(|(index, width)| {
                let vector = eigen.eigenvectors.column(index);
                // The sign of an eigenvector is arbitrary: its largest entry is made positive.
                let sign = vector[vector.icamax()].signum();
                let entry = |(row, &quantity): (usize, &Quantity)| {
                    (quantity, sign * width * vector[row] * scales[row])
                };
                Self::new(&quantities.iter().enumerate().map(entry).collect::<Vec<_>>())
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::{Correlations, QubeModel};

    /// A profile in which the errors of resistance and back-EMF are correlated and the error of the
    /// delay is independent.
    fn profile() -> Profile {
        let mut profile = Profile::exact("one", &QubeModel::NOMINAL);
        let errors = [("R_m", 0.5), ("k_m", 0.002), ("command_delay_s", 0.001)];
        profile.standard_errors = errors.map(|(name, error)| (name.to_owned(), error)).into();
        let names = vec!["R_m".into(), "k_m".into(), "command_delay_s".into()];
        let matrix = [vec![1.0, 0.9, 0.0], vec![0.9, 1.0, 0.0], vec![0.0, 0.0, 1.0]];
        profile.correlations = Some(Correlations::new(names, &matrix));
        profile
    }

    #[test]
    fn the_directions_of_a_profile_have_its_covariance_and_the_widest_is_first() {
        let directions = Direction::of_errors(&profile(), &PlantModel::QUBE);
        assert_eq!(directions.len(), 3);
        for one in Quantity::all() {
            for other in Quantity::all() {
                let sum: f64 = directions.iter().map(|it| it.of(one) * it.of(other)).sum();
                let wanted = profile().covariance(one, other);
                let scale = profile().standard_error(one) * profile().standard_error(other);
                assert!((sum - wanted).abs() <= 1e-9 * scale, "{one:?} {other:?}: {sum} {wanted}");
            }
        }
        let robust = DomainDistribution::robust();
        let width = |direction: &Direction| {
            let share = |quantity: Quantity| {
                let deviation = direction.of(quantity);
                if deviation == 0.0 { 0.0 } else { deviation / robust.standard_deviation(quantity) }
            };
            Quantity::all().map(|quantity| share(quantity).powi(2)).sum::<f64>()
        };
        assert!(width(&directions[0]) > width(&directions[1]));
        assert!(width(&directions[1]) > width(&directions[2]));
    }

    #[test]
    fn a_profile_without_errors_has_no_direction() {
        let exact = Profile::exact("one", &QubeModel::NOMINAL);
        assert_eq!(Direction::of_errors(&exact, &PlantModel::QUBE), []);
    }
}
