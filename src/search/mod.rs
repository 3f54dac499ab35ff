//! Strategies of the search for psi, behind the trait [`Strategy`]: each proposes points and
//! recommends one by the returns of the evaluated points.
//!
//! [`BayRn`] is the method of this program; the others are its baselines. A strategy keeps no state
//! between calls: its proposals follow from its settings, its seed, the data and the pending
//! points, so that a session can be resumed from its files alone. The room may import `surrogate`.
//!
//! ```
//! use qube_hil::search::{BayRnSettings, Observation, StrategyKind};
//! use qube_hil::surrogate::SearchBox;
//!
//! let search_box = SearchBox::new(vec![0.0], vec![2.0])?;
//! let search = StrategyKind::Random.build(&search_box, &BayRnSettings::default(), 1)?;
//! let mut data = Vec::new();
//! for _ in 0..8 {
//!     for point in search.propose(&data, &[], 1)? {
//!         let returns = vec![-(point[0] - 1.0).powi(2)];
//!         data.push(Observation { point, returns });
//!     }
//! }
//! assert!(search.recommend(&data)?.expected_return <= 0.0);
//! # Ok::<(), qube_hil::search::SearchError>(())
//! ```

mod bayrn;
mod bayrn_settings;
pub mod benchmark;
mod cmaes;
mod cross_entropy;
mod error;
mod observation;
mod random;
mod strategy;
mod strategy_kind;

use crate::surrogate::SearchBox;
pub use bayrn::BayRn;
pub use bayrn_settings::{
    AcquisitionKind, BayRnSettings, IncumbentRule, InitialDesign, NoiseModel,
};
pub use cmaes::CmaEs;
pub use cross_entropy::CrossEntropy;
pub use error::SearchError;
pub use observation::Observation;
pub use random::PointSequence;
pub use strategy::{Recommendation, Strategy};
pub use strategy_kind::StrategyKind;
