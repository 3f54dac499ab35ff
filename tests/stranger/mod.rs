//! An adversary by somebody who knows the promise of foresight and nothing of how it is kept.
//!
//! A scenario says which kind of attack a seed makes; an optimiser looks for the genes with which the arm
//! comes nearest to its stop, the true one. Every episode runs by the library's own `drive` and `Tick` in
//! virtual time, and comes out the same bit for bit whenever it is played again.

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

pub use beliefs::Known;
pub use optimiser::Method;
pub use report::{SearchRecord, summary};
pub use search::{Effort, Hunt};
