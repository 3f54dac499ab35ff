use std::ops::Range;

use crate::simulation::Evaluation;

/// Largest number of rounds of competing trainings. While no training has reached [`SUCCEEDED`] in
/// simulation, another round trains with other seeds; the best training of all rounds is kept.
pub const ROUNDS: u32 = 3;

/// Number of fresh simulations in which each of several trainings is evaluated to choose the best.
pub const CHOSEN_OF_STARTS: usize = 256;

/// Smallest [`tenth_percentile`] with which a training counts as successful. The largest possible
/// return is 600: a policy that swings up and balances earns more than 400, and a pendulum that
/// hangs or keeps turning earns less than 100.
pub const SUCCEEDED: f64 = 300.0;

/// Share of the simulations, the worst ones, that [`tenth_percentile`] leaves out. A mean over all
/// simulations would hide that a policy fails on some of the Qubes that the real Qube may be.
const WORST: f64 = 0.1;

/// The return that all but the worst tenth of an evaluation's trajectories reach, by which
/// competing trainings are compared; 0 without trajectories.
#[must_use]
pub fn tenth_percentile(evaluation: &Evaluation) -> f64 {
    let mut returns = evaluation.returns.clone();
    returns.sort_by(f64::total_cmp);
    returns.get((WORST * returns.len() as f64) as usize).copied().unwrap_or(0.0)
}

/// The worth of a training's policy: two [`tenth_percentile`]s in fresh simulations.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrainingScore {
    /// Tenth percentile in the simulations that decide whether the policy succeeds or another round
    /// is needed.
    pub scored: f64,
    /// Tenth percentile in the simulations by which policies are compared; often the same
    /// simulations.
    pub compared: f64,
}

impl TrainingScore {
    /// The score of a policy that has no competitor and is not evaluated.
    pub const UNCONTESTED: Self = Self { scored: SUCCEEDED, compared: SUCCEEDED };

    /// The score of a policy by one evaluation, which both decides and compares.
    #[must_use]
    pub fn of(evaluation: &Evaluation) -> Self {
        let tenth_percentile = tenth_percentile(evaluation);
        Self { scored: tenth_percentile, compared: tenth_percentile }
    }

    fn succeeds(&self) -> bool {
        self.scored >= SUCCEEDED
    }

    /// Returns whether this policy is kept instead of another: a policy that succeeds beats a
    /// policy that fails.
    #[must_use]
    pub fn is_better_than(&self, other: &Self) -> bool {
        (self.succeeds(), self.compared) > (other.succeeds(), other.compared)
    }
}

/// The trainings of one policy, equal but for their seeds or simulations, of which the best is
/// kept. They run in at most [`ROUNDS`] rounds, until one has succeeded in simulation.
#[derive(Debug)]
pub struct Competition<T> {
    trainings: u32,
    ended: u32,
    best: Option<Kept<T>>,
}

#[derive(Debug)]
struct Kept<T> {
    number: u32,
    score: TrainingScore,
    trained: T,
}

impl<T> Competition<T> {
    /// A competition with this number of trainings in each round, at least one.
    #[must_use]
    pub fn new(trainings: u32) -> Self {
        Self { trainings: trainings.max(1), ended: 0, best: None }
    }

    /// Numbers of the trainings of the round that has not begun or is under way.
    #[must_use]
    pub fn round(&self) -> Range<u32> {
        let first = self.ended - self.ended % self.trainings;
        first..first + self.trainings
    }

    /// Returns whether policies compete, so that each needs a score. A single training is kept as
    /// it is.
    #[must_use]
    pub fn is_contested(&self) -> bool {
        self.trainings > 1
    }

    /// Enters the result of the training with this number. The order in which the trainings of a
    /// round end does not matter: of equal scores, the lowest number wins.
    pub fn enter(&mut self, number: u32, score: TrainingScore, trained: T) {
        self.ended += 1;
        let beats = |best: &Kept<T>| {
            score.is_better_than(&best.score)
                || (number < best.number && !best.score.is_better_than(&score))
        };
        if self.best.as_ref().is_none_or(beats) {
            self.best = Some(Kept { number, score, trained });
        }
    }

    /// Takes the best result out once the competition is decided: a round is complete and no other
    /// round follows. Returns `None` before that, and after the result has been taken.
    pub fn take_winner(&mut self) -> Option<T> {
        let is_complete = self.ended.is_multiple_of(self.trainings);
        let is_last = self.ended >= ROUNDS * self.trainings;
        let wins = |best: &mut Kept<T>| is_complete && (best.score.succeeds() || is_last);
        self.best.take_if(wins).map(|best| best.trained)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A score whose policy succeeds from [`SUCCEEDED`] on.
    fn score(tenth_percentile: f64) -> TrainingScore {
        TrainingScore { scored: tenth_percentile, compared: tenth_percentile }
    }

    #[test]
    fn a_policy_that_falls_in_a_fifth_of_its_simulations_scores_by_its_falls() {
        let returns: Vec<f64> = (0..20).map(|it| if it % 5 == 0 { 90.0 } else { 540.0 }).collect();
        let evaluation = Evaluation { steps: vec![600; 20], returns };
        assert_eq!(tenth_percentile(&evaluation), 90.0);
        let returns = (0..20).map(|it| if it == 3 { 90.0 } else { 540.0 }).collect();
        assert_eq!(TrainingScore::of(&Evaluation { returns, ..evaluation }), score(540.0));
    }

    #[test]
    fn a_policy_that_succeeds_beats_one_that_fails_and_else_the_comparison_decides() {
        let fails = TrainingScore { scored: SUCCEEDED - 1.0, compared: 250.0 };
        let wide = TrainingScore { scored: 400.0, compared: 200.0 };
        let narrow = TrainingScore { scored: 500.0, compared: 100.0 };
        assert!(wide.is_better_than(&fails) && !fails.is_better_than(&wide));
        assert!(wide.is_better_than(&narrow) && !narrow.is_better_than(&wide));
    }

    #[test]
    fn a_round_that_fails_is_followed_by_others_and_the_best_of_all_rounds_is_kept() {
        let mut competition = Competition::new(2);
        let mut rounds = Vec::new();
        for returns in [[10.0, 200.0], [30.0, 40.0], [60.0, 50.0]] {
            assert_eq!(competition.take_winner(), None);
            rounds.push(competition.round());
            for (number, tenth_percentile) in competition.round().zip(returns) {
                competition.enter(number, score(tenth_percentile), number);
            }
        }
        assert_eq!(rounds, [0..2, 2..4, 4..6]);
        let winner = competition.take_winner();
        assert_eq!(winner, Some(1), "the second training of the first round wins");
    }

    #[test]
    fn a_round_with_a_success_is_the_last_once_all_of_its_trainings_have_ended() {
        let mut competition = Competition::new(3);
        for (number, tenth_percentile) in [(2, 400.0), (0, 400.0)] {
            competition.enter(number, score(tenth_percentile), number);
            assert_eq!(competition.take_winner(), None);
            assert_eq!(competition.round(), 0..3);
        }
        competition.enter(1, score(90.0), 1);
        // The order in which trainings end depends on the computer.
        assert_eq!(competition.take_winner(), Some(0));
    }

    #[test]
    fn a_single_training_needs_no_score() {
        let mut competition = Competition::new(1);
        assert!(!competition.is_contested());
        competition.enter(0, TrainingScore::UNCONTESTED, "policy");
        assert_eq!(competition.take_winner(), Some("policy"));
        assert_eq!(competition.take_winner(), None);
    }
}
