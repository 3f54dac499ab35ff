//! Identification of a Qube from its recordings.
//!
//! [`identify()`] estimates parameters and nonidealities by maximum likelihood, with standard errors and with
//! the combinations that the recordings do not determine; [`drift()`] estimates what changes from day to
//! day. The room is pure computation over motions that were read before, and may import `qube` and
//! `replay`.

#[cfg(test)]
mod delay_tests;
mod drift;
mod fit;
mod fitness;
mod identify;
mod prediction;
mod stretch;
#[cfg(test)]
mod tests;
mod uncertainty;
mod unknowns;

pub use drift::{DriftEstimate, drift};
pub use fit::ResidualScale;
pub use fitness::{Unfit, check_recording};
pub use identify::{Identified, IdentifyError, identify};
pub use prediction::{HorizonError, KNOWN_S, horizon_error, start_state};
pub use uncertainty::{Blind, Estimate};
pub use unknowns::{Prior, Unknown};
