//! The report on a session.

mod distribution;
mod identified;
mod page;
mod posterior;
mod search;
mod source;
mod time_line;

pub use page::session_page;
pub use posterior::{NoSurrogate, SessionSurrogate};
pub use source::SessionSource;
