use serde::{Deserialize, Serialize};

use super::SurrogateError;

/// The search space: a box with one finite, non-empty interval for each of its `d` dimensions.
///
/// A point has `d` coordinates in the box's own units; the surrogate converts it to the unit cube.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Bounds", into = "Bounds")]
pub struct SearchBox {
    lower: Vec<f64>,
    upper: Vec<f64>,
}

/// The bounds as a file contains them, before they are checked.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Bounds {
    lower: Vec<f64>,
    upper: Vec<f64>,
}

impl SearchBox {
    /// A box from its `d` lower and `d` upper bounds.
    ///
    /// # Errors
    /// There is no dimension, the lists differ in length, a bound or an interval's width is not
    /// finite, or a lower bound is not below the upper one.
    pub fn new(lower: Vec<f64>, upper: Vec<f64>) -> Result<Self, SurrogateError> {
        if lower.len() != upper.len() {
            return Err(SurrogateError::BoundsDiffer { lower: lower.len(), upper: upper.len() });
        }
        if lower.is_empty() {
            return Err(SurrogateError::NoDimensions);
        }
        for (dimension, (&lower, &upper)) in lower.iter().zip(&upper).enumerate() {
            if !lower.is_finite() || !upper.is_finite() || !(upper - lower).is_finite() {
                return Err(SurrogateError::BoundNotFinite { dimension, lower, upper });
            }
            if lower >= upper {
                return Err(SurrogateError::LowerNotBelowUpper { dimension, lower, upper });
            }
        }
        Ok(Self { lower, upper })
    }

    /// The unit cube of `dimensions` dimensions.
    ///
    /// # Errors
    /// `dimensions` is 0.
    pub fn unit(dimensions: usize) -> Result<Self, SurrogateError> {
        Self::new(vec![0.0; dimensions], vec![1.0; dimensions])
    }

    /// Number of dimensions `d`.
    #[must_use]
    pub fn dimensions(&self) -> usize {
        self.lower.len()
    }

    /// The `d` lower bounds.
    #[must_use]
    pub fn lower(&self) -> &[f64] {
        &self.lower
    }

    /// The `d` upper bounds.
    #[must_use]
    pub fn upper(&self) -> &[f64] {
        &self.upper
    }

    /// Width of the interval of one dimension, in the box's own units.
    #[must_use]
    pub fn width(&self, dimension: usize) -> f64 {
        self.upper[dimension] - self.lower[dimension]
    }

    /// The `d` coordinates on the unit cube of a point that is given in the box's own units.
    #[must_use]
    pub fn to_unit(&self, point: &[f64]) -> Vec<f64> {
        point.iter().enumerate().map(|(d, &x)| (x - self.lower[d]) / self.width(d)).collect()
    }

    /// The point in the box's own units that has these coordinates on the unit cube. Coordinates
    /// beyond the cube, for example through rounding, are put on the border of the box.
    #[must_use]
    pub fn from_unit(&self, unit: &[f64]) -> Vec<f64> {
        unit.iter()
            .enumerate()
            .map(|(d, &u)| (self.lower[d] + u * self.width(d)).clamp(self.lower[d], self.upper[d]))
            .collect()
    }

    /// Checks that a point has `d` coordinates and lies in the box, bounds included.
    ///
    /// # Errors
    /// The number of coordinates is not `d`, or a coordinate is NaN or outside its interval. The
    /// error names the point by `index`.
    pub fn check(&self, index: usize, point: &[f64]) -> Result<(), SurrogateError> {
        let expected = self.dimensions();
        if point.len() != expected {
            return Err(SurrogateError::WrongDimension { index, expected, got: point.len() });
        }
        for (dimension, &value) in point.iter().enumerate() {
            let (lower, upper) = (self.lower[dimension], self.upper[dimension]);
            if !(lower..=upper).contains(&value) {
                return Err(SurrogateError::OutsideBox { index, dimension, value, lower, upper });
            }
        }
        Ok(())
    }
}

impl TryFrom<Bounds> for SearchBox {
    type Error = SurrogateError;

    fn try_from(bounds: Bounds) -> Result<Self, SurrogateError> {
        Self::new(bounds.lower, bounds.upper)
    }
}

impl From<SearchBox> for Bounds {
    fn from(search_box: SearchBox) -> Self {
        Self { lower: search_box.lower, upper: search_box.upper }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_names_the_invalid_bounds() {
        assert_eq!(SearchBox::new(vec![], vec![]), Err(SurrogateError::NoDimensions));
        assert_eq!(
            SearchBox::new(vec![0.0], vec![1.0, 2.0]),
            Err(SurrogateError::BoundsDiffer { lower: 1, upper: 2 })
        );
        for (lower, upper) in [(1.0, 1.0), (2.0, 1.0)] {
            assert_eq!(
                SearchBox::new(vec![0.0, lower], vec![1.0, upper]),
                Err(SurrogateError::LowerNotBelowUpper { dimension: 1, lower, upper })
            );
        }
        for bad in [f64::NAN, f64::INFINITY, f64::MAX] {
            let found = SearchBox::new(vec![-bad], vec![bad]);
            assert!(matches!(found, Err(SurrogateError::BoundNotFinite { dimension: 0, .. })));
        }
        let read = toml::from_str::<SearchBox>("lower = [1.0]\nupper = [0.0]");
        assert!(read.unwrap_err().to_string().contains("lower bound 1 >= upper bound 0"));
    }

    #[test]
    fn a_point_converts_to_the_unit_cube_and_back_and_stays_inside() {
        let search_box = SearchBox::new(vec![0.019, -3.0], vec![0.029, 7.0]).unwrap();
        let point = search_box.from_unit(&[0.25, 1.0]);
        assert_eq!(point[1], 7.0);
        let unit = search_box.to_unit(&point);
        assert!((unit[0] - 0.25).abs() < 1e-12 && (unit[1] - 1.0).abs() < 1e-12);
        assert_eq!(search_box.check(0, &search_box.from_unit(&[1.0 + 1e-12, -1e-12])), Ok(()));
        assert!(search_box.check(3, &[0.02, 8.0]).unwrap_err().to_string().contains("point 3"));
        assert!(search_box.check(0, &[f64::NAN, 0.0]).is_err());
        assert!(search_box.check(0, &[0.02]).is_err());
    }
}
