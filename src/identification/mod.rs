//! Which Qube made these recordings?
//!
//! Parameters and gap of a machine from its recordings, by maximum likelihood, with what the
//! recordings cannot tell. Pure computation over motions that were read before.
//!
//! May import `qube` and `replay`.

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
