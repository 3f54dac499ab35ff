use std::ops::Range;

use serde::{Deserialize, Serialize};

use super::{SearchBox, SearchError};

/// A candidate and its returns.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Observation {
    /// Coordinates of the point, in the box's units.
    pub point: Vec<f64>,
    /// Return of each rollout: at least one, all finite.
    pub returns: Vec<f64>,
}

impl Observation {
    /// The mean of the returns.
    #[must_use]
    pub fn mean_return(&self) -> f64 {
        self.returns.iter().sum::<f64>() / self.returns.len() as f64
    }

    /// Standard error of the mean return, estimated from the spread of the returns; `None` for a
    /// single return.
    #[must_use]
    pub fn standard_error(&self) -> Option<f64> {
        let n = self.returns.len() as f64;
        let mean = self.mean_return();
        let squares: f64 = self.returns.iter().map(|r| (r - mean) * (r - mean)).sum();
        (self.returns.len() > 1).then(|| (squares / (n - 1.0) / n).sqrt())
    }
}

/// Checks that every candidate lies in the box and has at least one return, all finite.
pub(super) fn check(search_box: &SearchBox, data: &[Observation]) -> Result<(), SearchError> {
    for (index, observation) in data.iter().enumerate() {
        search_box.check(index, &observation.point)?;
        if observation.returns.is_empty() {
            return Err(SearchError::NoReturns { index });
        }
        let bad = observation.returns.iter().enumerate().find(|(_, r)| !r.is_finite());
        if let Some((rollout, &value)) = bad {
            return Err(SearchError::ReturnNotFinite { index, rollout, value });
        }
    }
    Ok(())
}

/// Checks the data like [`check`], and that every pending point lies in the box. Returns the
/// indices of the next `count` points of the search, counted from 0 over all its points.
pub(super) fn next_indices(
    search_box: &SearchBox,
    data: &[Observation],
    pending: &[Vec<f64>],
    count: usize,
) -> Result<Range<usize>, SearchError> {
    check(search_box, data)?;
    for (index, point) in (data.len()..).zip(pending) {
        search_box.check(index, point)?;
    }
    let first = data.len() + pending.len();
    Ok(first..first + count)
}

/// The index of the evaluated candidate with the highest mean return; in a tie, the earliest.
pub(super) fn highest_mean_return(data: &[Observation]) -> Result<usize, SearchError> {
    let means: Vec<f64> = data.iter().map(Observation::mean_return).collect();
    (0..data.len())
        .max_by(|&a, &b| means[a].total_cmp(&means[b]).then(b.cmp(&a)))
        .ok_or(SearchError::NothingEvaluated)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bad_observations_are_refused() {
        let search_box = SearchBox::unit(1).unwrap();
        let good = Observation { point: vec![0.5], returns: vec![1.0, 3.0] };
        let check_second = |second: Observation| check(&search_box, &[good.clone(), second]);
        assert_eq!(check_second(good.clone()), Ok(()));
        assert_eq!(
            check_second(Observation { returns: vec![], ..good.clone() }),
            Err(SearchError::NoReturns { index: 1 })
        );
        let nan = check_second(Observation { returns: vec![2.0, f64::NAN], ..good.clone() });
        assert!(matches!(nan, Err(SearchError::ReturnNotFinite { index: 1, rollout: 1, .. })));
        let outside = check_second(Observation { point: vec![1.5], ..good.clone() });
        assert!(outside.unwrap_err().to_string().contains("point 1 lies outside"));
    }

    #[test]
    fn the_mean_the_error_and_the_best_of_known_returns_are_exact() {
        let of = |returns: &[f64]| Observation { point: vec![0.5], returns: returns.to_vec() };
        assert_eq!(of(&[1.0, 3.0]).mean_return(), 2.0);
        assert_eq!(of(&[1.0, 3.0]).standard_error(), Some(1.0));
        assert_eq!(of(&[1.0]).standard_error(), None);
        assert_eq!(highest_mean_return(&[of(&[1.0]), of(&[2.0]), of(&[2.0])]), Ok(1));
        assert_eq!(highest_mean_return(&[]), Err(SearchError::NothingEvaluated));
    }
}
