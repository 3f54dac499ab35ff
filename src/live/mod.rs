//! The live view, which shows rollouts while they are recorded.
//!
//! [`LiveView::serve`] listens on one address. There, the viewers Foxglove and Lichtblick get the
//! channels of a recording by Foxglove's WebSocket protocol, and a browser gets the program's own
//! page. The page's only command is to stop; a client can change nothing else.
//!
//! The recorder's thread hands each record to a bounded queue, or drops the record if the queue is
//! full; it drops the start and the end of a rollout only after 50 ms without room. The view's
//! thread encodes the records of the queue into a ring, and the thread of each connection sends
//! from the ring as much as its client takes. A client that reads slowly, or not at all, loses
//! messages and delays nobody. The view refuses requests that name this computer by a foreign name,
//! come from foreign web pages, exceed small sizes or take more than a few seconds.
//!
//! The room may import `recording` and `telemetry`.

mod connection;
mod feed;
mod foxglove;
mod origin;
mod page;
mod request;
mod server;
mod status;
#[cfg(test)]
mod tests;
mod view;

pub use server::LiveError;
pub use status::LiveStatus;
pub use view::{LiveSettings, LiveView};
