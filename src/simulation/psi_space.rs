use std::collections::BTreeMap;
use std::fmt;

use serde::de::{Error as _, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer, Serialize};

use super::psi_dimension::DimensionAfter;
use super::{Psi, PsiDimension, PsiError, PsiTarget};
use crate::qube::PlantModel;

/// The eight dimensions of Eilers 2019, table 5.2 (the thesis): mean and standard deviation of each
/// mass and length.
const THESIS: [&str; 8] =
    ["mean_M_p", "std_M_p", "mean_M_r", "std_M_r", "mean_L_p", "std_L_p", "mean_L_r", "std_L_r"];

/// The search space of psi. Each dimension is the range of one entry of psi. A point of the space
/// has one entry for each dimension, in the order of the dimensions and in the unit of the
/// dimension's target.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(into = "Vec<PsiDimension>")]
pub struct PsiSpace {
    dimensions: Vec<PsiDimension>,
}

impl PsiSpace {
    /// A space of these dimensions.
    ///
    /// # Errors
    /// The list is empty or names a dimension twice.
    pub fn new(dimensions: Vec<PsiDimension>) -> Result<Self, PsiError> {
        if dimensions.is_empty() {
            return Err(PsiError::NoDimensions);
        }
        let mut targets: Vec<PsiTarget> = dimensions.iter().map(|it| it.target).collect();
        targets.sort_unstable();
        match targets.windows(2).find(|pair| pair[0] == pair[1]) {
            Some(pair) => Err(PsiError::Twice { name: pair[0].to_string() }),
            None => Ok(Self { dimensions }),
        }
    }

    /// The dimensions with these names and their default ranges.
    ///
    /// # Errors
    /// The list is empty, or a name does not exist or occurs twice.
    pub fn named(names: &[&str]) -> Result<Self, PsiError> {
        let dimensions = names.iter().map(|name| PsiDimension::named(name));
        Self::new(dimensions.collect::<Result<_, _>>()?)
    }

    /// The space of Eilers 2019, table 5.2 (the thesis): mean and standard deviation of each mass
    /// and length, with the ranges of this table.
    ///
    /// # Panics
    /// Never panics.
    #[must_use]
    pub fn thesis() -> Self {
        Self::named(&THESIS).expect("the names exist and differ")
    }

    /// The search space around an identified Qube: the common width of all standard deviations,
    /// shifts of the means along the widest directions of the identification's errors, and mean and
    /// standard deviation of a lag that the identification may have missed. `directions` is the
    /// number of directions; at most [`PsiTarget::SHIFTS`] of them are searched.
    ///
    /// # Panics
    /// Never panics.
    #[must_use]
    pub fn of_posterior(directions: usize) -> Self {
        let shifts =
            (1..=directions.min(PsiTarget::SHIFTS)).map(|number| format!("shift_{number}"));
        let lag = ["mean_lag", "std_lag"].map(str::to_owned);
        let names: Vec<String> =
            std::iter::once("log_width".to_owned()).chain(shifts).chain(lag).collect();
        let names: Vec<&str> = names.iter().map(String::as_str).collect();
        Self::named(&names).expect("the names exist and differ")
    }

    /// The point at which psi changes nothing: all entries are 0. It is meaningful for a space of
    /// [`Self::of_posterior`], where the simulations at this point follow the identification.
    #[must_use]
    pub fn as_identified(&self) -> Vec<f64> {
        vec![0.0; self.dimensions.len()]
    }

    /// Converts this space, which describes Qubes, to another plant ([`PsiDimension::of_plant`]).
    #[must_use]
    pub fn of_plant(self, plant: &PlantModel) -> Self {
        let dimensions = self.dimensions.into_iter().map(|dimension| dimension.of_plant(plant));
        Self { dimensions: dimensions.collect() }
    }

    /// The dimensions, in the order of a point's entries.
    #[must_use]
    pub fn dimensions(&self) -> &[PsiDimension] {
        &self.dimensions
    }

    /// Names of the dimensions, in order.
    pub fn names(&self) -> impl Iterator<Item = String> {
        self.dimensions.iter().map(|dimension| dimension.target.to_string())
    }

    /// Lower ends of the ranges, in order.
    #[must_use]
    pub fn lower(&self) -> Vec<f64> {
        self.dimensions.iter().map(|dimension| dimension.lower).collect()
    }

    /// Upper ends of the ranges, in order.
    #[must_use]
    pub fn upper(&self) -> Vec<f64> {
        self.dimensions.iter().map(|dimension| dimension.upper).collect()
    }

    /// Returns whether the space has a dimension with this target.
    #[must_use]
    pub fn has(&self, target: PsiTarget) -> bool {
        self.dimensions.iter().any(|dimension| dimension.target == target)
    }

    /// The entries of a point by name.
    #[must_use]
    pub fn by_name(&self, point: &[f64]) -> BTreeMap<String, f64> {
        self.names().zip(point.iter().copied()).collect()
    }

    /// The psi at a point.
    ///
    /// # Errors
    /// The number of the point's entries is not the number of dimensions, or a value lies outside
    /// its dimension's range or is not physical.
    pub fn psi(&self, point: &[f64]) -> Result<Psi, PsiError> {
        if point.len() != self.dimensions.len() {
            return Err(PsiError::WrongLength {
                entries: point.len(),
                expected: self.names().collect::<Vec<_>>().join(", "),
            });
        }
        for (&PsiDimension { target, lower, upper }, &value) in self.dimensions.iter().zip(point) {
            if !(lower..=upper).contains(&value) {
                let name = target.to_string();
                return Err(PsiError::OutOfRange { name, value, lower, upper });
            }
        }
        let targets = self.dimensions.iter().map(|dimension| dimension.target);
        Psi::new(targets.zip(point.iter().copied()).collect())
    }
}

impl Default for PsiSpace {
    fn default() -> Self {
        Self::thesis()
    }
}

impl<'de> Deserialize<'de> for PsiSpace {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_seq(SpaceVisitor)
    }
}

struct SpaceVisitor;

impl<'de> Visitor<'de> for SpaceVisitor {
    type Value = PsiSpace;

    fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("a list of tables, each with the name and range of one entry of psi")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut entries: A) -> Result<PsiSpace, A::Error> {
        let mut dimensions = Vec::new();
        while let Some(dimension) = entries.next_element_seed(DimensionAfter(&dimensions))? {
            dimensions.push(dimension);
        }
        PsiSpace::new(dimensions).map_err(A::Error::custom)
    }
}

impl From<PsiSpace> for Vec<PsiDimension> {
    fn from(space: PsiSpace) -> Self {
        space.dimensions
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_ends_of_a_range_are_accepted_and_a_value_outside_is_refused_with_its_name() {
        let space = PsiSpace::thesis();
        assert!(space.psi(&space.lower()).is_ok());
        assert!(space.psi(&space.upper()).is_ok());
        for (index, dimension) in space.dimensions().iter().enumerate() {
            for value in [dimension.lower * 0.999, dimension.upper * 1.001, f64::NAN] {
                let mut values = space.lower();
                values[index] = value;
                let message = space.psi(&values).unwrap_err().to_string();
                assert!(message.contains(&dimension.target.to_string()), "{message}");
            }
        }
        let short = space.psi(&[0.02]).unwrap_err().to_string();
        assert!(short.contains("mean_M_p") && short.contains('1'), "{short}");
    }

    #[test]
    fn a_list_of_names_makes_a_space_unless_it_is_empty_or_has_a_name_twice() {
        let space = PsiSpace::named(&["mean_delay", "filter", "std_coulomb"]).unwrap();
        assert!(space.has(PsiTarget::Filter));
        let point = [0.01, 50.0, 1e-4];
        assert_eq!(space.psi(&point).unwrap().filter_corner_rad_s(), Some(50.0));
        assert_eq!(space.by_name(&point)["mean_delay"], 0.01);
        assert!(matches!(PsiSpace::named(&[]), Err(PsiError::NoDimensions)));
        let twice = PsiSpace::named(&["filter", "mean_delay", "filter"]).unwrap_err().to_string();
        assert!(twice.contains("filter"), "{twice}");
    }
}
