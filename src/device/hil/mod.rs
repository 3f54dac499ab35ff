//! A Qube with the USB panel, through the vendor's HIL library, which is loaded at run time.
//!
//! The panel's own protocol is closed; the vendor's library has a C interface, of which this module uses a
//! dozen functions. They have no time limit, so one thread of their own calls them all and the tick waits for
//! it no longer than for a serial port. Without the library the program builds and runs as before.
//!
//! | file | holds |
//! | --- | --- |
//! | `address.rs` | the card's name, as users write it |
//! | `library.rs` | loading, and the signatures: the one file with calls of foreign code |
//! | `card.rs` | one card: typed calls, error codes as sentences |
//! | `panel.rs` | what an amplifier is taken through: greet, arm, sample, act, off |
//! | `thread.rs` | the one thread that calls |
//! | `worker.rs` | what that thread does for one card, and the exchange with it |
//! | `link.rs` | the [`Device`](super::Device) |

mod address;
mod card;
mod error;
mod library;
mod link;
mod panel;
mod thread;
mod worker;

pub use address::{HilAddress, NotAnAddress};
pub use error::HilError;
pub use link::HilLink;

/// The file name of the vendor's library that this computer would use, if it has every function.
///
/// # Errors
/// There is no such library, or it is of another version.
pub fn find_library() -> Result<String, HilError> {
    library::Library::load().map(|library| library.name)
}
