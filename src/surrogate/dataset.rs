use nalgebra::{DMatrix, DVector};

use super::{SearchBox, SurrogateError};

/// Checked observations, scaled as the priors of the hyperparameters assume: inputs on the unit
/// cube, outputs with mean 0 and sample standard deviation 1 (n - 1 in the denominator).
/// "Standardised" values are in these scaled units.
#[derive(Clone, Debug)]
pub struct Dataset {
    search_box: SearchBox,
    /// Inputs on the unit cube, n x d. Each column holds one dimension of all points, so that a
    /// loop over points reads contiguous memory.
    pub(super) inputs: DMatrix<f64>,
    /// Standardised outputs, n.
    pub(super) targets: DVector<f64>,
    /// Known noise variance of each point, standardised, n; the fitted noise variance is added to
    /// it. For a fantasy it is at most 0, so that the sum is the least noise variance.
    pub(super) own_noise: DVector<f64>,
    offset: f64,
    scale: f64,
}

impl Dataset {
    /// Checks and scales `n` observations.
    ///
    /// `points` are n x d, in the box's units; `values` are n. `noise_variances` are n known noise
    /// variances of the values, in squared units of the values, or `None` if they are unknown. In
    /// both cases the fit adds a noise variance that all points share.
    ///
    /// A single value, or values that are equal up to rounding, have no usable standard deviation:
    /// they are centred and keep scale 1.
    ///
    /// # Errors
    /// There is no data, the lists differ in length, a point has another dimension than the box or
    /// lies outside it, a value is not finite, or a variance is negative or not finite.
    pub fn new(
        search_box: &SearchBox,
        points: &[Vec<f64>],
        values: &[f64],
        noise_variances: Option<&[f64]>,
    ) -> Result<Self, SurrogateError> {
        let n = points.len();
        if n == 0 {
            return Err(SurrogateError::NoData);
        }
        let differ = |values, list| SurrogateError::LengthsDiffer { points: n, values, list };
        if values.len() != n {
            return Err(differ(values.len(), "values"));
        }
        for (index, point) in points.iter().enumerate() {
            search_box.check(index, point)?;
        }
        if let Some((index, &value)) = values.iter().enumerate().find(|(_, v)| !v.is_finite()) {
            return Err(SurrogateError::ValueNotFinite { index, value });
        }
        let noise = match noise_variances {
            None => DVector::zeros(n),
            Some(variances) if variances.len() != n => {
                return Err(differ(variances.len(), "noise variances"));
            }
            Some(variances) => DVector::from_column_slice(variances),
        };
        if let Some((index, &value)) =
            noise.iter().enumerate().find(|(_, v)| !v.is_finite() || **v < 0.0)
        {
            return Err(SurrogateError::BadNoise { index, value });
        }

        let (offset, scale) = mean_and_scale(values);
        let mut inputs = DMatrix::zeros(n, search_box.dimensions());
        for (i, point) in points.iter().enumerate() {
            for (d, u) in search_box.to_unit(point).into_iter().enumerate() {
                inputs[(i, d)] = u;
            }
        }
        Ok(Self {
            search_box: search_box.clone(),
            inputs,
            targets: DVector::from_iterator(n, values.iter().map(|y| (y - offset) / scale)),
            own_noise: noise / (scale * scale),
            offset,
            scale,
        })
    }

    /// Number of observations `n`.
    #[must_use]
    pub fn len(&self) -> usize {
        self.targets.len()
    }

    /// Returns whether the data set is empty: always false, since [`Self::new`] refuses an empty
    /// one.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.targets.is_empty()
    }

    /// Number of dimensions `d`.
    #[must_use]
    pub fn dimensions(&self) -> usize {
        self.inputs.ncols()
    }

    /// The box that the points lie in.
    #[must_use]
    pub fn search_box(&self) -> &SearchBox {
        &self.search_box
    }

    /// Mean that was subtracted from the values, in their units.
    #[must_use]
    pub fn offset(&self) -> f64 {
        self.offset
    }

    /// Standard deviation by which the values were divided, in their units; 1 if they have no
    /// usable standard deviation.
    #[must_use]
    pub fn scale(&self) -> f64 {
        self.scale
    }

    /// Coordinates of one observation on the unit cube.
    #[must_use]
    pub fn unit_point(&self, index: usize) -> Vec<f64> {
        self.inputs.row(index).iter().copied().collect()
    }

    /// The value of one observation, in its own units.
    #[must_use]
    pub fn value(&self, index: usize) -> f64 {
        self.offset + self.scale * self.targets[index]
    }

    /// The largest value observed, in its own units.
    #[must_use]
    pub fn largest_value(&self) -> f64 {
        self.offset + self.scale * self.targets.max()
    }

    /// A subset of `size` observations, evenly spaced in the list, with unchanged scaling.
    pub(super) fn thinned(&self, size: usize) -> Self {
        let chosen: Vec<usize> = (0..size).map(|k| k * self.len() / size).collect();
        Self {
            inputs: self.inputs.select_rows(&chosen),
            targets: self.targets.select_rows(&chosen),
            own_noise: self.own_noise.select_rows(&chosen),
            ..self.clone()
        }
    }

    /// The data set without the known noise of its points.
    pub(super) fn without_own_noise(&self) -> Self {
        Self { own_noise: DVector::zeros(self.len()), ..self.clone() }
    }

    /// The data set with one more observation and unchanged scaling: `unit` on the unit cube,
    /// `target` and `own_noise` standardised.
    pub(super) fn extended(&self, unit: &[f64], target: f64, own_noise: f64) -> Self {
        let n = self.len();
        let mut inputs = self.inputs.clone().insert_row(n, 0.0);
        for (d, &u) in unit.iter().enumerate() {
            inputs[(n, d)] = u;
        }
        Self {
            inputs,
            targets: self.targets.clone().insert_row(n, target),
            own_noise: self.own_noise.clone().insert_row(n, own_noise),
            ..self.clone()
        }
    }
}

/// Sample mean and standard deviation (n - 1 in the denominator). A deviation that is undefined or
/// below rounding is replaced by 1.
fn mean_and_scale(values: &[f64]) -> (f64, f64) {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let squares: f64 = values.iter().map(|y| (y - mean) * (y - mean)).sum();
    let deviation = (squares / (n - 1.0)).sqrt();
    let largest = values.iter().fold(0.0_f64, |most, y| most.max(y.abs()));
    let resolvable = deviation.is_finite() && deviation > 1e-12 * largest && deviation > 0.0;
    (mean, if resolvable { deviation } else { 1.0 })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square() -> SearchBox {
        SearchBox::new(vec![0.0, 10.0], vec![2.0, 20.0]).unwrap()
    }

    #[test]
    fn inputs_and_outputs_are_scaled() {
        let points = vec![vec![0.0, 20.0], vec![1.0, 15.0], vec![2.0, 10.0]];
        let data =
            Dataset::new(&square(), &points, &[1.0, 3.0, 5.0], Some(&[4.0, 0.0, 1.0])).unwrap();
        assert_eq!(data.unit_point(0), [0.0, 1.0]);
        assert_eq!(data.targets.as_slice(), [-1.0, 0.0, 1.0]);
        assert_eq!(data.own_noise.as_slice(), [1.0, 0.0, 0.25]);
        assert_eq!((data.value(2), data.largest_value()), (5.0, 5.0));
    }

    #[test]
    fn one_point_or_equal_outputs_have_scale_one() {
        let points = vec![vec![1.0, 12.0]; 3];
        for n in [1, 3] {
            let data = Dataset::new(&square(), &points[..n], &[0.1; 3][..n], None).unwrap();
            assert_eq!(data.scale(), 1.0);
            assert!(data.targets.amax() < 1e-15);
        }
    }

    #[test]
    fn an_error_names_the_invalid_data() {
        let new = |points: &[Vec<f64>], values: &[f64], noise: Option<&[f64]>| {
            Dataset::new(&square(), points, values, noise).unwrap_err()
        };
        let inside = vec![1.0, 15.0];
        assert_eq!(new(&[], &[], None), SurrogateError::NoData);
        assert!(matches!(
            new(std::slice::from_ref(&inside), &[], None),
            SurrogateError::LengthsDiffer { .. }
        ));
        assert!(matches!(
            new(&[inside.clone(), vec![1.0, 9.0]], &[0.0, 0.0], None),
            SurrogateError::OutsideBox { index: 1, dimension: 1, .. }
        ));
        assert!(matches!(
            new(std::slice::from_ref(&inside), &[f64::NAN], None),
            SurrogateError::ValueNotFinite { index: 0, .. }
        ));
        assert!(matches!(
            new(&[inside], &[0.0], Some(&[-1.0])),
            SurrogateError::BadNoise { index: 0, .. }
        ));
    }
}
