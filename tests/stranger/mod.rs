//! An adversary, written by a person who knew only the promise of foresight and the public
//! functions.
//!
//! Each seed gives a [`Scenario`], the kind of attack. An optimiser then searches the parameters of
//! this attack (its genes) that bring the arm closest to its true stop. Every episode uses the
//! library's `drive` and `Tick` in virtual time and can be repeated bit for bit.

mod attacker;
mod beliefs;
mod cma;
mod cross_entropy;
mod device;
mod episode;
mod genes;
mod mishap;
mod moves;
mod optimiser;
mod plant;
mod report;
mod scenario;
mod search;

pub use beliefs::BeliefKind;
#[allow(unused_imports, reason = "the test chooses no mishap")]
pub use mishap::MishapKind;
pub use optimiser::Method;
pub use report::{SearchRecord, summary};
#[allow(unused_imports, reason = "the example reads no scenario")]
pub use scenario::Scenario;
pub use search::{AdversarySearch, Effort};
