//! Reports: a session, an experiment or recordings as one HTML page that loads nothing, with figures to zoom and
//! pendulums to play.
//!
//! [`SessionSource`] reads a session's folder, [`session_page`] writes the page; [`recordings_page`] writes that of
//! recordings, [`recipes_page`] and [`strategies_page`] those of experiments. A page is a pure function of what was read: the figures are data, which the page's own
//! script draws with uPlot. Every text from a file is escaped, and the page's content policy allows no other script
//! and no request.
//!
//! Only the feature `cli` builds this room. It may import `experiment`, `session`, `scoring`, `replay`, `identification`, `recording`,
//! `search`, `surrogate`, `learning`, `simulation`, `telemetry`, `storage` and `qube`.

mod chart;
mod densities;
mod error;
mod escape;
mod experiment;
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
pub use experiment::{NamedRollouts, recipes_page, strategies_page};
pub use recordings::recordings_page;
pub use rollout::RolloutView;
pub use session::{NoSurrogate, SessionSource, SessionSurrogate, session_page};
