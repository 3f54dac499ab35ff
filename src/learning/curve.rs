use serde::{Deserialize, Serialize};

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
    /// Mean reward in the batch times 600. The policy explores, and the reward includes the penalty on
    /// voltage changes.
    pub training_return: f64,
    /// Trajectories in the batch; more than the number of pendulums when some left the safety box.
    pub trajectories: u32,
    /// Approximate KL divergence, the mean over minibatches: (r - 1) - ln r, where r is the ratio of new to old
    /// probability.
    pub approximate_kl: f64,
    /// Largest approximate KL divergence of a minibatch.
    pub largest_kl: f64,
    /// Share of samples whose ratio of new to old probability was outside the clip range.
    pub clip_fraction: f64,
    /// Explained variance of the value network before the update: 1 - variance of (return - value) /
    /// variance of return.
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
    /// The fields in order; whole numbers are exact up to 2^53.
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

    /// One line of the CSV table, without a line end.
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
}
