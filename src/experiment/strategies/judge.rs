use crate::experiment::rollouts::all_of;
use crate::experiment::series::Series;
use crate::experiment::{Behaviour, ExperimentError, Plant, RolloutResult};

/// Smallest share of successful rollouts of a successful recommendation, over all its policies: the next
/// policy that somebody trains with it is a random one of them.
const SUCCESS_SHARE: f64 = 0.9;

/// The score of a recommendation, as far as it was needed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Judgement {
    /// Number of successful rollouts.
    pub stood: u32,
    /// Number of rollouts run.
    pub ran: u32,
}

impl Judgement {
    /// Whether the recommendation succeeds over `rollouts` rollouts; `None` while that is open.
    fn decided(self, rollouts: u32) -> Option<bool> {
        // Rounding must not turn nine of ten into ten of ten.
        let needed = (SUCCESS_SHARE * f64::from(rollouts) - 1e-9).ceil() as u32;
        let failed = self.ran - self.stood;
        if self.stood >= needed {
            Some(true)
        } else if failed > rollouts - needed {
            Some(false)
        } else {
            None
        }
    }

    fn add(&mut self, results: &[RolloutResult]) {
        let stood = results.iter().filter(|it| it.behaviour == Behaviour::Stood).count();
        self.stood += stood as u32;
        self.ran += results.len() as u32;
    }
}

/// Evaluates up to `policies` × `rollouts`; stops once the verdict cannot change. Without `works` the run
/// is read-only and returns `Ok(None)` where a result is missing.
///
/// # Errors
/// The work ends early, or a file cannot be read.
pub(super) fn judge(
    series: &Series,
    plant: &Plant,
    policies: u32,
    rollouts: u32,
    works: bool,
) -> Result<Option<(Judgement, bool)>, ExperimentError> {
    let mut judgement = Judgement::default();
    for policy in 0..policies {
        let results = if works {
            series.train(policy)?;
            series.run_in_virtual_time(policy, plant, rollouts)?
        } else {
            let folder = series.folders.rollouts(policy, &plant.name);
            match all_of(&folder, rollouts, series.recipe.settings.extent.repetitions)? {
                Some(results) => results,
                None => return Ok(None),
            }
        };
        judgement.add(&results);
        if let Some(succeeds) = judgement.decided(policies * rollouts) {
            return Ok(Some((judgement, succeeds)));
        }
    }
    Ok(None)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn decided(stood: u32, ran: u32, rollouts: u32) -> Option<bool> {
        Judgement { stood, ran }.decided(rollouts)
    }

    #[test]
    fn nine_of_ten_succeed_and_no_more_is_run_than_needed() {
        assert_eq!(decided(9, 10, 10), Some(true));
        assert_eq!(decided(9, 9, 10), Some(true));
        assert_eq!(decided(8, 9, 10), None);
        assert_eq!(decided(8, 10, 10), Some(false));
        assert_eq!(decided(0, 2, 10), Some(false));
        // 14 of 15 are 93 %, 13 are 87 %.
        assert_eq!(decided(14, 15, 15), Some(true));
        assert_eq!(decided(12, 14, 15), Some(false));
        assert_eq!(decided(0, 0, 1), None);
    }

    #[test]
    fn when_all_rollouts_are_run_it_is_decided() {
        for rollouts in 1..60 {
            for stood in 0..=rollouts {
                let succeeds = f64::from(stood) / f64::from(rollouts) > 0.9 - 1e-9;
                assert_eq!(
                    decided(stood, rollouts, rollouts),
                    Some(succeeds),
                    "{stood}/{rollouts}"
                );
            }
        }
    }
}
