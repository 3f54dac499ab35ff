//! Benchmarks of the search strategies on functions whose maximum is known.

mod objective;
mod regret;
mod statistics;
mod two_humped;

pub use objective::Objective;
pub use regret::{RegretCurve, simple_regret};
pub use statistics::{MeanInterval, Quartiles};
pub use two_humped::{SearchVariant, TwoHumped, VariantResult};
