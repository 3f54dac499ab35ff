use serde::{Deserialize, Serialize};

use super::{PriorSet, SurrogateError};

/// The hyperparameters of a Gaussian process, for inputs on the unit cube and standardised outputs.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Hyperparameters {
    /// The constant prior mean of the standardised outputs.
    pub mean: f64,
    /// One lengthscale per dimension, in widths of the box.
    pub lengthscales: Vec<f64>,
    /// The signal's variance (not its square root).
    pub signal_variance: f64,
    /// Variance of the noise that all observations share. The noise variance of a single
    /// observation is added to it.
    pub noise_variance: f64,
}

impl Hyperparameters {
    /// Checks that there are `dimensions` positive lengthscales and that variances and mean are
    /// valid.
    ///
    /// # Errors
    /// A value is invalid; the error names the first one.
    pub fn check(&self, dimensions: usize) -> Result<(), SurrogateError> {
        let bad = |reason: String| Err(SurrogateError::BadHyperparameters { reason });
        if self.lengthscales.len() != dimensions {
            let got = self.lengthscales.len();
            return bad(format!(
                "{got} lengthscales for {dimensions} dimensions: give one per dimension"
            ));
        }
        if let Some(l) = self.lengthscales.iter().find(|l| !(l.is_finite() && **l > 0.0)) {
            return bad(format!("a lengthscale of {l}: it must be finite and positive"));
        }
        if !(self.signal_variance.is_finite() && self.signal_variance > 0.0) {
            return bad(format!(
                "a signal variance of {}: it must be finite and positive",
                self.signal_variance
            ));
        }
        if !(self.noise_variance.is_finite() && self.noise_variance >= 0.0) {
            return bad(format!(
                "a noise variance of {}: it must be finite and not negative",
                self.noise_variance
            ));
        }
        if !self.mean.is_finite() {
            return bad(format!("a mean of {}: it must be finite", self.mean));
        }
        Ok(())
    }

    /// Sum of the log densities of the hyperparameters under a set of priors. The mean has no
    /// prior.
    #[must_use]
    pub fn log_prior(&self, priors: PriorSet) -> f64 {
        let lengthscale = priors.lengthscale(self.lengthscales.len());
        let lengthscales: f64 =
            self.lengthscales.iter().map(|&l| lengthscale.log_density(l).0).sum();
        let signal =
            priors.signal_variance().map_or(0.0, |p| p.log_density(self.signal_variance).0);
        lengthscales + signal + priors.noise_variance().log_density(self.noise_variance).0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn invalid_hyperparameters_are_refused() {
        let good = Hyperparameters {
            mean: 0.0,
            lengthscales: vec![0.5, 0.5],
            signal_variance: 1.0,
            noise_variance: 0.0,
        };
        assert_eq!(good.check(2), Ok(()));
        assert!(good.check(3).is_err());
        for bad in [
            Hyperparameters { lengthscales: vec![0.5, 0.0], ..good.clone() },
            Hyperparameters { signal_variance: f64::NAN, ..good.clone() },
            Hyperparameters { noise_variance: -1e-9, ..good.clone() },
            Hyperparameters { mean: f64::INFINITY, ..good },
        ] {
            assert!(matches!(bad.check(2), Err(SurrogateError::BadHyperparameters { .. })));
        }
    }
}
