//! Gaussian-process regression and acquisition functions: a model of an expensive function, and the
//! choice of the next point to evaluate.
//!
//! The room works on vectors of `f64`, not on Qubes; it imports no other room and could be a crate
//! of its own. [`Dataset`] checks and scales observations in a [`SearchBox`].
//! [`GaussianProcess::fit`] finds the hyperparameters (maximum a posteriori) and conditions the
//! process on the data. An [`Acquisition`] scores points, and [`maximise()`] finds the point with
//! the highest score.
//!
//! ```
//! use qube_hil::surrogate::{Dataset, FitSettings, GaussianProcess, SearchBox};
//!
//! let search_box = SearchBox::unit(1)?;
//! let points = [vec![0.1], vec![0.5], vec![0.9]];
//! let data = Dataset::new(&search_box, &points, &[0.0, 1.0, 0.0], None)?;
//! let process = GaussianProcess::fit(data, &FitSettings::default())?;
//! assert!(process.mean(&[0.5]) > process.mean(&[0.1]));
//! # Ok::<(), qube_hil::surrogate::SurrogateError>(())
//! ```
//!
//! With n observations, one evaluation of the likelihood costs O(n^3) operations, and one
//! evaluation of a posterior O(n^2). Two calls with equal arguments give identical results on one
//! machine; another processor may round the last bits of its matrix products differently.

mod acquisition;
mod dataset;
mod error;
mod evidence;
mod factor;
mod fit;
mod gaussian_process;
mod hyperparameters;
mod kernel;
mod lbfgs;
mod maximise;
mod noise;
pub mod normal;
mod prior;
mod search_box;

pub use acquisition::{
    Acquisition, Criterion, CriterionValue, ExpectedImprovement, LogExpectedImprovement,
    LogKnowledgeGradient, LogNoisyExpectedImprovement, LogProbabilityOfImprovement, OnProcess,
    PosteriorMean, ProbabilityOfImprovement, UpperConfidenceBound,
};
pub use dataset::Dataset;
pub use error::SurrogateError;
pub use evidence::{LogMarginalLikelihood, log_marginal_likelihood};
pub use fit::{Fit, FitSettings, MeanFunction, fit};
pub use gaussian_process::{GaussianProcess, Posterior, PosteriorSlope};
pub use hyperparameters::Hyperparameters;
pub use kernel::Kernel;
pub use maximise::{MaximiserSettings, Maximum, maximise, sobol_point};
pub use noise::noise_of_means;
pub use prior::{Prior, PriorSet};
pub use search_box::SearchBox;
