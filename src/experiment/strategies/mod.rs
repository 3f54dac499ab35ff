//! How many real rollouts until a search's answer succeeds? Strategies × repetitions, to a table.
//!
//! A [`Contender`] is a strategy that looks for psi, or `identify`, which takes recordings instead
//! and trains around the Qube that they show. After each candidate, or recording, it has an answer:
//! what it would say if it were stopped there. Answers are judged apart from the search, by policies
//! of their own whose rollouts count for nothing, until one succeeds.
//!
//! Reading order: [`StrategySettings`], `follow` goes through one [`Repetition`], `search` and
//! `identified` give its answers, `judge` judges them, [`StrategyResults`] sums up.

mod contender;
mod figure;
mod follow;
mod identified;
mod judge;
mod results;
mod search;
mod settings;

pub use contender::Contender;
pub use figure::strategies_svg;
pub use follow::{AnswerResult, Repetition};
pub use judge::Judgement;
pub use results::{StrategyResult, StrategyResults};
pub use settings::StrategySettings;
