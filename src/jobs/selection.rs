use crate::simulation::Evaluation;

/// Largest number of rounds of competing trainings. While no training has reached [`SUCCEEDED`] in
/// simulation, another round trains with other seeds; the best training of all rounds is kept.
pub const ROUNDS: u32 = 3;

/// Number of fresh simulations in which each of several trainings is evaluated to choose the best.
pub const CHOSEN_OF_STARTS: usize = 256;

/// Smallest [`worst_return`] with which a training counts as successful. The largest possible
/// return is 600: a policy that swings up and balances earns more than 400, and a pendulum that
/// hangs or keeps turning earns less than 100.
pub const SUCCEEDED: f64 = 300.0;

/// Share of the simulations, the worst ones, that [`worst_return`] leaves out. A mean over all
/// simulations would hide that a policy fails on some of the Qubes that the real one may be.
const WORST: f64 = 0.1;

/// The return that all but the worst tenth of an evaluation's trajectories reach, by which
/// competing trainings are compared; 0 without trajectories.
#[must_use]
pub fn worst_return(evaluation: &Evaluation) -> f64 {
    let mut returns = evaluation.returns.clone();
    returns.sort_by(f64::total_cmp);
    returns.get((WORST * returns.len() as f64) as usize).copied().unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_policy_that_falls_in_a_fifth_of_its_simulations_scores_by_its_falls() {
        let returns: Vec<f64> = (0..20).map(|it| if it % 5 == 0 { 90.0 } else { 540.0 }).collect();
        let evaluation = Evaluation { steps: vec![600; 20], returns };
        assert_eq!(worst_return(&evaluation), 90.0);
        let returns = (0..20).map(|it| if it == 3 { 90.0 } else { 540.0 }).collect();
        assert_eq!(worst_return(&Evaluation { returns, ..evaluation }), 540.0);
    }
}
