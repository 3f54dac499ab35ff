//! Methods from the literature, here called rivals, that learn a distribution of simulations from
//! real rollouts, or without any: methods of the thesis's chapter 2, and later methods.
//! docs/rivals.md has a paragraph about each.
//!
//! A `rival` turns recordings into a `belief` about the Qube, in the coordinates of a `space`;
//! `learned` turns beliefs into recommendations. Three rivals leave the belief as it is: `adr` and
//! `fpo` train policies of their own, in the stages of
//! [`StagedTraining`](crate::learning::StagedTraining), and `history` only gives its policies a
//! longer observation. `universal` is no rival of this form: it searches for the inputs of a
//! policy. The statistics of the rivals are in files of their own, which do not depend on a Qube:
//! `gaussian`, `relative_entropy`, `mixture_density`, `offline_likelihood`, `tempering`,
//! `entropy_trade_off`, `stein`, `discriminator`, `evolution`. `simulator` simulates rollouts again
//! in other Qubes; `summary` and `discrepancy` compare motions, and `transitions` short stretches
//! of motions.

mod adr;
mod bayessim;
mod belief;
mod discrepancy;
mod discriminator;
mod dropo;
mod entropy_trade_off;
mod epopt;
mod evolution;
mod fpo;
mod gaussian;
mod history;
mod kind;
mod learned;
mod lsdr;
mod mixture_density;
mod npdr;
mod offline_likelihood;
mod relative_entropy;
mod rival;
mod scored;
mod settings;
mod simopt;
mod simulator;
mod space;
mod stein;
mod summary;
mod tempering;
#[cfg(test)]
mod tests;
mod transitions;
mod universal;

pub use kind::RivalKind;
pub(super) use learned::FromRival;
pub use settings::RivalSettings;
pub(super) use universal::FromUniversalPolicy;
