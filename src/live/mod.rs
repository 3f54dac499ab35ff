//! The live view: what is recorded, shown while it happens.
//!
//! [`LiveView::serve`] listens on one address. Foxglove and Lichtblick get the channels of a recording there by
//! Foxglove's WebSocket protocol; a browser gets a page of the program's own, whose only command is to stop. Nothing
//! else can be changed from there.
//!
//! The view hangs on the recorder's thread, which hands each record to a bounded queue and drops it where the queue is
//! full. A thread of its own encodes them into a ring, and each connection's thread takes from the ring what its client
//! can bear. A client that reads slowly, or not at all, loses messages and delays nobody. Requests under a foreign name
//! of this computer, from foreign web pages, beyond small sizes, or later than a few seconds are refused.
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
pub use status::Status;
pub use view::{LiveSettings, LiveView};
