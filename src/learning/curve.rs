use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::collect::Batch;
use super::transition::Transition;
use crate::qube::MAX_STEPS;

/// The statistics of one update: a point of the learning curve.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct TrainUpdate {
    /// Number of the update, from 0.
    pub update: u32,
    /// Mean return of the deterministic policy from the fixed starts, under the training's own
    /// distribution.
    pub mean_return: f64,
    /// Smallest return of the deterministic policy from the fixed starts.
    pub worst_return: f64,
    /// Mean reward in the batch times 600. The policy explores, and the reward includes the penalty
    /// on voltage changes.
    pub training_return: f64,
    /// Number of trajectories in the batch. It exceeds the number of pendulums if some left the
    /// safety box.
    pub trajectories: u32,
    /// Approximate KL divergence, the mean over minibatches: (r - 1) - ln r, where r is the ratio
    /// of new to old probability.
    pub approximate_kl: f64,
    /// Largest approximate KL divergence of a minibatch.
    pub largest_kl: f64,
    /// Share of samples whose ratio of new to old probability was outside the clip range.
    pub clip_fraction: f64,
    /// Explained variance of the value network before the update: 1 - variance of (return - value)
    /// / variance of return.
    pub explained_variance: f64,
    /// Logarithm of the policy's standard deviation, in units of its output.
    pub log_std: f64,
    /// Learning rate of Adam in the update.
    pub learning_rate: f64,
    /// Simulated control steps so far.
    pub steps: u64,
    /// Gradient steps of the policy so far.
    pub gradient_steps: u64,
}

impl TrainUpdate {
    /// The fields in the order of [`Self::CSV_HEADER`]; whole numbers are exact up to 2^53.
    pub(super) fn to_array(self) -> [f64; 13] {
        [
            self.update.into(),
            self.mean_return,
            self.worst_return,
            self.training_return,
            self.trajectories.into(),
            self.approximate_kl,
            self.largest_kl,
            self.clip_fraction,
            self.explained_variance,
            self.log_std,
            self.learning_rate,
            self.gradient_steps as f64,
            self.steps as f64,
        ]
    }

    /// Restores a point from the output of [`Self::to_array`].
    pub(super) fn from_array(fields: &[f64; 13]) -> Self {
        let [
            update,
            mean_return,
            worst_return,
            training_return,
            trajectories,
            approximate_kl,
            largest_kl,
            clip_fraction,
            explained_variance,
            log_std,
            learning_rate,
            gradient_steps,
            steps,
        ] = *fields;
        Self {
            update: update as u32,
            mean_return,
            worst_return,
            training_return,
            trajectories: trajectories as u32,
            approximate_kl,
            largest_kl,
            clip_fraction,
            explained_variance,
            log_std,
            learning_rate,
            gradient_steps: gradient_steps as u64,
            steps: steps as u64,
        }
    }

    /// Header line of the CSV table.
    pub const CSV_HEADER: &'static str = "update,mean_return,worst_return,training_return,trajectories,approximate_kl,largest_kl,clip_fraction,explained_variance,log_std,learning_rate,gradient_steps,steps";

    /// One line of the CSV table, without a line break.
    #[must_use]
    pub fn csv_line(&self) -> String {
        format!(
            "{},{:.3},{:.3},{:.3},{},{:.6},{:.6},{:.5},{:.5},{:.5},{:.3e},{},{}",
            self.update,
            self.mean_return,
            self.worst_return,
            self.training_return,
            self.trajectories,
            self.approximate_kl,
            self.largest_kl,
            self.clip_fraction,
            self.explained_variance,
            self.log_std,
            self.learning_rate,
            self.gradient_steps,
            self.steps,
        )
    }
}

/// The learning curve as CSV.
#[must_use]
pub fn curve_csv(curve: &[TrainUpdate]) -> String {
    std::iter::once(TrainUpdate::CSV_HEADER.to_owned())
        .chain(curve.iter().map(TrainUpdate::csv_line))
        .fold(String::new(), |text, line| text + &line + "\n")
}

/// Largest size of a file with a learning curve, bytes. The file of a long training has some 200
/// kB. The file of a million updates, the largest number that a training may have, has some 110 MB.
pub const CURVE_BYTES: u64 = 256 << 20;

/// A point of a learning curve that was read from a file.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CurvePoint {
    /// Simulated control steps so far.
    pub steps: f64,
    /// Mean return of the deterministic policy from the fixed starts.
    pub mean_return: f64,
}

/// The defect of a file that should have a learning curve.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
pub enum CurveError {
    /// The header line lacks the column of this name.
    #[error("there is no column {0}")]
    NoColumn(&'static str),
    /// A line has no number in one of the columns.
    #[error("this line has no number for steps or mean_return: {0}")]
    NoUpdate(String),
}

/// Reads a learning curve from the text that [`curve_csv`] made.
///
/// # Errors
/// A column is missing, or a line has no number in one of the columns.
pub fn parse_curve_csv(text: &str) -> Result<Vec<CurvePoint>, CurveError> {
    let mut lines = text.lines();
    let names: Vec<&str> = lines.next().unwrap_or_default().split(',').collect();
    let column = |name: &'static str| {
        names.iter().position(|it| *it == name).ok_or(CurveError::NoColumn(name))
    };
    let columns = [column("steps")?, column("mean_return")?];
    lines
        .map(|line| {
            let fields: Vec<&str> = line.split(',').collect();
            let number =
                |column: usize| fields.get(column).and_then(|field| field.parse::<f64>().ok());
            let [Some(steps), Some(mean_return)] = columns.map(number) else {
                return Err(CurveError::NoUpdate(line.to_owned()));
            };
            Ok(CurvePoint { steps, mean_return })
        })
        .collect()
}

/// The mean reward of a batch times 600.
pub(super) fn training_return(batch: &Batch) -> f64 {
    let rewards: f64 = batch.transitions.iter().map(|t| f64::from(t.reward)).sum();
    rewards / batch.transitions.len() as f64 * MAX_STEPS as f64
}

/// The explained variance of the values of these transitions: 1 - variance of (return - value) /
/// variance of return.
pub(super) fn explained_variance(transitions: &[Transition]) -> f64 {
    let variance = |of: fn(&Transition) -> f64| {
        let mean = transitions.iter().map(of).sum::<f64>() / transitions.len() as f64;
        transitions.iter().map(|t| (of(t) - mean) * (of(t) - mean)).sum::<f64>()
    };
    1.0 - variance(|t| f64::from(t.return_ - t.value)) / variance(|t| f64::from(t.return_))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_has_as_many_fields_as_the_header() {
        let csv =
            curve_csv(&[TrainUpdate { update: 3, mean_return: 541.5, ..TrainUpdate::default() }]);
        let lines: Vec<&str> = csv.lines().collect();
        assert_eq!(lines.len(), 2);
        assert_eq!(lines[0].split(',').count(), lines[1].split(',').count());
        assert!(lines[1].starts_with("3,541.500,"));
    }

    #[test]
    fn the_curve_of_the_longest_training_is_small_enough_to_be_read() {
        let last = TrainUpdate {
            update: 999_999,
            mean_return: 599.999,
            worst_return: 599.999,
            training_return: 599.999,
            trajectories: 4096 * 600,
            approximate_kl: 9_999.123_456,
            largest_kl: 9_999.123_456,
            clip_fraction: 0.123_45,
            explained_variance: -9_999.123_45,
            log_std: -10.123_45,
            learning_rate: 1e-4,
            steps: 1_000_000 * 4096 * 600,
            gradient_steps: 1_000_000 * 4096 * 600 / 64 * 1000,
        };
        assert!(1_000_000 * (last.csv_line().len() as u64 + 1) <= CURVE_BYTES);
    }

    #[test]
    fn a_curve_is_read_as_it_was_written() {
        let update = |update| TrainUpdate {
            update,
            mean_return: 10.0 * f64::from(update),
            steps: 9600 * u64::from(update + 1),
            ..TrainUpdate::default()
        };
        let text = curve_csv(&[update(0), update(1)]);
        let point = |steps, mean_return| CurvePoint { steps, mean_return };
        assert_eq!(parse_curve_csv(&text).unwrap(), [point(9600.0, 0.0), point(19_200.0, 10.0)]);
        assert_eq!(parse_curve_csv("update,steps\n"), Err(CurveError::NoColumn("mean_return")));
        let shortened = text.trim_end().rsplit_once(',').unwrap().0;
        assert!(matches!(parse_curve_csv(shortened), Err(CurveError::NoUpdate(_))));
    }
}
