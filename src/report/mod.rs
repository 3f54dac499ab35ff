//! Reports: one HTML page about a session, an experiment or recordings. The page loads nothing from
//! elsewhere; it has figures that zoom and pendulums that play recorded motions.
//!
//! [`SessionSource`] reads a session's folder and [`session_page`] writes its page;
//! [`recordings_page`] writes the page of recordings, [`recipes_page`] and [`methods_page`] write
//! the pages of experiments. A page depends only on the files that were read. Figures are data,
//! which the page's own script draws with uPlot. Every text from a file is escaped, and the page's
//! content security policy allows no other script and no request.
//!
//! Only the feature `cli` builds this room. It may import `charts`, `experiment`, `session`,
//! `scoring`, `replay`, `identification`, `recording`, `search`, `surrogate`, `learning`,
//! `simulation`, `telemetry`, `storage` and `qube`.

mod chart;
mod densities;
mod draws;
mod error;
mod escape;
mod experiment;
mod headline;
mod motion;
mod nearest;
mod page;
mod provenance;
mod recordings;
mod returns;
mod rollout;
mod session;
mod timing;

pub use error::ReportError;
pub use escape::is_obeyed;
pub use experiment::{NamedRollouts, methods_page, recipes_page};
pub use page::is_report;
pub use recordings::recordings_page;
pub use rollout::RolloutView;
pub use session::{NoSurrogate, SessionSource, SessionSurrogate, session_page};
