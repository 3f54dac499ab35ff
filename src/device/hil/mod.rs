//! A Qube with the USB panel, through the vendor's HIL library, which is loaded at run time.
//!
//! The panel's own protocol is closed; the vendor's library has a C interface, of which this module
//! uses sixteen functions. These functions have no time limit. So one thread makes all calls, and
//! the tick waits for that thread no longer than for a serial port. Without the library the program
//! builds, and runs with every other device.
//!
//! | file | holds |
//! | --- | --- |
//! | `address.rs` | the card's address, as users write it |
//! | `error.rs` | the failures, as messages, with a remedy where there is one |
//! | `library.rs` | loading, and the signatures: the one file that calls the vendor's code |
//! | `card.rs` | one card: typed calls, error codes as sentences |
//! | `panel.rs` | the operations on one card: hello, arm, sample, act, off, close |
//! | `thread.rs` | the one thread that calls the library |
//! | `card_service.rs` | the service of one card, and its exchange of requests and replies |
//! | `link.rs` | the implementation of [`Device`](super::Device) |

mod address;
mod card;
mod card_service;
mod error;
mod library;
mod link;
mod panel;
mod thread;

pub use address::{HilAddress, NotAnAddress};
pub use error::HilError;
pub use link::HilLink;

/// Loads the vendor's library and returns the name under which it was found, if it has every
/// function that the program needs.
///
/// # Errors
/// The library is not found, cannot be loaded, or lacks a function and so is of another version.
pub fn find_library() -> Result<String, HilError> {
    library::Library::load().map(|library| library.name)
}
