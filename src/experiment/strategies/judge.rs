use crate::experiment::rollouts::all_of;
use crate::experiment::series::Series;
use crate::experiment::{Behaviour, ExperimentError, Plant, RolloutResult};

/// An answer succeeds when at least this share of its judges' rollouts do: of all of them, whichever
/// policy they are of, as nobody who trains one more policy knows which it will be.
const SUCCESS_SHARE: f64 = 0.9;

/// What came of judging an answer, as far as it had to go.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Judgement {
    /// Rollouts that succeeded.
    pub stood: u32,
    /// Rollouts that were run.
    pub ran: u32,
}

impl Judgement {
    /// Whether the answer succeeds that is to have `rollouts` rollouts; none while that is open.
    fn decided(self, rollouts: u32) -> Option<bool> {
        // Rounding must not make ten of ten out of nine of ten.
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

/// Judges an answer by so many policies that are trained by it and run so many times each; no more of
/// them than it takes to know. With `works` what is missing is done, else none is returned where
/// something is.
///
/// # Errors
/// Whatever ends it early; what is there cannot be read.
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
