//! Gaussian-process regression and acquisition functions: what is known of an expensive function,
//! and where to look next.
//!
//! Knows vectors of `f64` and nothing of Qubes; imports no other room, and would serve as a crate
//! of its own. The way through it: a [`SearchBox`] and observations make a [`Dataset`] (checked and
//! scaled), [`GaussianProcess::fit`] finds the hyperparameters (maximum a posteriori) and
//! conditions on the data, an [`Acquisition`] scores points, [`maximise`] finds the best one.
//!
//! What it costs: with n observations in d dimensions, one evaluation of the likelihood O(n^3),
//! of a posterior O(n^2). The same call gives the same bytes on the same machine; another
//! processor may round its matrix products differently in the last bits.

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
    Acquisition, Criterion, ExpectedImprovement, LogExpectedImprovement, LogKnowledgeGradient,
    LogNoisyExpectedImprovement, LogProbabilityOfImprovement, OnProcess, PosteriorMean,
    ProbabilityOfImprovement, Score, UpperConfidenceBound,
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
