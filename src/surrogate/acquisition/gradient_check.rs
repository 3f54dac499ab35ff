//! An example of a Gaussian process for tests of acquisition functions that use the whole process,
//! and a check of their gradients.

use super::Acquisition;
use crate::surrogate::{Dataset, GaussianProcess, Hyperparameters, Kernel, SearchBox};

/// A Gaussian process over nine points in two dimensions. All points share `noise_variance`
/// (standardised); `own_variances` are added to it, one for each point, in squared units of the
/// values.
pub fn nine_points(noise_variance: f64, own_variances: Option<&[f64]>) -> GaussianProcess {
    let search_box = SearchBox::new(vec![-1.0, 10.0], vec![1.0, 30.0]).unwrap();
    let points: Vec<Vec<f64>> =
        (0..9).map(|i| vec![(i as f64).sin(), 20.0 + 10.0 * (i as f64 * 1.7).cos()]).collect();
    let values: Vec<f64> = points.iter().map(|p| 30.0 * (3.0 * p[0]).sin() + p[1]).collect();
    let data = Dataset::new(&search_box, &points, &values, own_variances).unwrap();
    let hyperparameters = Hyperparameters {
        mean: 0.1,
        lengthscales: vec![0.3, 0.5],
        signal_variance: 1.2,
        noise_variance,
    };
    GaussianProcess::new(data, Kernel::Matern52, hyperparameters).unwrap()
}

/// Checks the gradient of an acquisition function against finite differences at three points.
/// `search_box` is the box of [`nine_points`].
pub fn check_gradient(acquisition: &impl Acquisition, search_box: &SearchBox) {
    for point in [[0.7, 26.0], [0.1, 12.0], [-0.4, 19.0]] {
        let (value, gradient) = acquisition.value_and_gradient(&point);
        assert_eq!(value, acquisition.value(&point));
        for d in 0..2 {
            let h = 1e-6 * search_box.width(d);
            let shifted = |t: f64| {
                let mut shifted = point;
                shifted[d] += t;
                acquisition.value(&shifted)
            };
            let numeric = (shifted(h) - shifted(-h)) / (2.0 * h);
            let close = (gradient[d] - numeric).abs() < 1e-5 * (1.0 + numeric.abs());
            assert!(close, "{point:?} {d}: {} {numeric}", gradient[d]);
        }
    }
}
