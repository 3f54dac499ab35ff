//! The normalisation and the bounds between a model's input and its first layer.

use super::ImportError;
use crate::policy::LayerWeights;

/// Largest sum of the magnitudes of weight times offset that is folded into the bias of one neuron
/// of the first layer. Single precision rounds it by at most 2.4e-4, which changes the voltage by
/// about 1 mV.
const LARGEST_OFFSET: f64 = 4096.0;

/// The preparation of each entry x of the input for the first layer: factor · clip(x, bounds) +
/// offset.
#[derive(Debug)]
pub struct Input {
    factors: Vec<f64>,
    offsets: Vec<f64>,
    bounds: Vec<[f64; 2]>,
}

impl Input {
    /// An input that reaches the first layer unchanged.
    pub fn plain(entries: usize) -> Self {
        Self {
            factors: vec![1.0; entries],
            offsets: vec![0.0; entries],
            bounds: vec![[f64::NEG_INFINITY, f64::INFINITY]; entries],
        }
    }

    /// Adds constants to the entries: one for each entry, or one for all.
    pub fn add(&mut self, values: &[f32]) -> Result<(), ImportError> {
        let values = spread(values, self.factors.len())?;
        self.offsets.iter_mut().zip(values).for_each(|(offset, value)| *offset += f64::from(value));
        Ok(())
    }

    /// Multiplies the entries by constants: one for each entry, or one for all.
    pub fn multiply(&mut self, values: &[f32]) -> Result<(), ImportError> {
        for (index, value) in spread(values, self.factors.len())?.into_iter().enumerate() {
            self.factors[index] *= f64::from(value);
            self.offsets[index] *= f64::from(value);
        }
        Ok(())
    }

    /// Clips the entries, as they are after the factors and offsets so far, between constants: one
    /// for each entry, or one for all. Stores the constants as bounds of the original entries x.
    ///
    /// # Errors
    /// The number of constants is wrong, the factor of an entry is 0, or a bound is not a number.
    pub fn clip(&mut self, lower: &[f32], upper: &[f32]) -> Result<(), ImportError> {
        let entries = self.factors.len();
        let pairs = spread(lower, entries)?.into_iter().zip(spread(upper, entries)?);
        for (index, (lower, upper)) in pairs.enumerate() {
            let (factor, offset) = (self.factors[index], self.offsets[index]);
            let [one, other] = [lower, upper].map(|bound| (f64::from(bound) - offset) / factor);
            if factor == 0.0 || one.is_nan() || other.is_nan() {
                return Err(ImportError::Values { name: "among the observation's bounds".into() });
            }
            let (lower, upper) = if factor < 0.0 { (other, one) } else { (one, other) };
            let bounds = &mut self.bounds[index];
            *bounds = [bounds[0].max(lower), bounds[1].min(upper)];
        }
        Ok(())
    }

    /// Folds the factors a and offsets b of the entries x into the weights W and biases c of the
    /// first layer: W (a x + b) + c = (W a) x + (W b + c).
    ///
    /// # Errors
    /// The magnitudes of the products in W b add up to more than 4096 for a neuron, so that single
    /// precision could round W b by more than 2.4e-4.
    pub fn fold(&self, layer: &mut LayerWeights) -> Result<(), ImportError> {
        if self.factors.iter().all(|it| *it == 1.0) && self.offsets.iter().all(|it| *it == 0.0) {
            return Ok(());
        }
        let entries = self.factors.len();
        for row in layer.weight.chunks_exact(entries) {
            let magnitude = |(weight, offset): (&f32, &f64)| (f64::from(*weight) * offset).abs();
            let largest: f64 = row.iter().zip(&self.offsets).map(magnitude).sum();
            // A NaN is refused later, with the network.
            if largest > LARGEST_OFFSET {
                let deviations = self.offsets.iter().fold(0.0, |most, it| it.abs().max(most));
                return Err(ImportError::Normalisation { deviations });
            }
        }
        for (row, bias) in layer.weight.chunks_exact_mut(entries).zip(&mut layer.bias) {
            let products = row.iter().zip(&self.offsets);
            let shift: f64 = products.map(|(weight, offset)| f64::from(*weight) * offset).sum();
            *bias = (f64::from(*bias) + shift) as f32;
            for (weight, factor) in row.iter_mut().zip(&self.factors) {
                *weight = (f64::from(*weight) * factor) as f32;
            }
        }
        Ok(())
    }

    /// Least and largest value of each original entry x; empty if no entry is clipped.
    pub fn into_bounds(self) -> Vec<[f32; 2]> {
        let open = [f64::NEG_INFINITY, f64::INFINITY];
        if self.bounds.iter().all(|bounds| *bounds == open) {
            return Vec::new();
        }
        self.bounds.into_iter().map(|bounds| bounds.map(|bound| bound as f32)).collect()
    }
}

/// Spreads a constant, of one value or of `count` values, to one value for each of `count` entries.
pub fn spread(values: &[f32], count: usize) -> Result<Vec<f32>, ImportError> {
    match values {
        [one] => Ok(vec![*one; count]),
        values if values.len() == count => Ok(values.to_vec()),
        _ => Err(ImportError::Values { name: "beside a layer".to_owned() }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bounds_after_other_operators_hold_for_the_original_input() {
        let mut input = Input::plain(2);
        input.add(&[1.0]).unwrap();
        input.multiply(&[2.0, -4.0]).unwrap();
        input.clip(&[-2.0], &[4.0, 8.0]).unwrap();
        input.multiply(&[3.0]).unwrap();
        input.clip(&[-f32::INFINITY], &[3.0]).unwrap();
        let mut layer = LayerWeights { weight: vec![1.0, 10.0], bias: vec![0.5] };
        input.fold(&mut layer).unwrap();
        assert_eq!((layer.weight, layer.bias), (vec![6.0, -120.0], vec![6.0 - 120.0 + 0.5]));
        // The first clip keeps 2 (x + 1) between -2 and 4 and -4 (x + 1) between -2 and 8. The
        // second keeps 6 (x + 1) and -12 (x + 1) at 3 or below.
        assert_eq!(input.into_bounds(), [[-2.0, -0.5], [-1.25, -0.5]]);
        assert!(Input::plain(3).into_bounds().is_empty());
        assert!(Input::plain(3).add(&[1.0, 2.0]).is_err());
    }

    #[test]
    fn a_normalisation_that_single_precision_cannot_hold_is_refused() {
        let folded = |mean: f32, deviation: f32| {
            let mut input = Input::plain(2);
            input.add(&[-mean, 0.0]).unwrap();
            input.multiply(&[1.0 / deviation, 1.0]).unwrap();
            let mut layer = LayerWeights { weight: vec![0.6, 1.0], bias: vec![0.0] };
            input.fold(&mut layer).map(|()| layer)
        };
        for (mean, deviation) in [(0.7, 1e-3), (0.0, 1e-8), (1.0, 0.01), (-0.7, -1e-3)] {
            assert!(folded(mean, deviation).is_ok(), "mean {mean}, deviation {deviation}");
        }
        for (mean, deviation) in [(0.7, 1e-5), (0.7, -1e-5), (-1.0, 1e-8), (1e6, 1.0)] {
            let refused = folded(mean, deviation).unwrap_err();
            assert!(refused.to_string().contains("times its standard deviation"), "{refused}");
        }
    }
}
