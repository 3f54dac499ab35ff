use serde::{Deserialize, Serialize};

use crate::learning::TrainSettings;
use crate::simulation::DomainDistribution;
use crate::storage::checksum_of;

/// A training as data: the same job gives the same policy and learning curve, bit for bit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainingJob {
    /// Distribution of the simulations.
    pub distribution: DomainDistribution,
    /// Settings of the training, with sensors, reward and box of the simulations.
    pub settings: TrainSettings,
    /// Seed of every random number.
    pub seed: u64,
}

impl TrainingJob {
    /// A checksum of everything that the policy depends on, as 16 hexadecimal digits.
    #[must_use]
    pub fn fingerprint(&self) -> String {
        let mut job = self.clone();
        // The number of threads does not change the result.
        job.settings.threads = 1;
        let json = serde_json::to_vec(&job);
        checksum_of(&json.expect("plain structs with text keys always become JSON"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn job() -> TrainingJob {
        TrainingJob {
            distribution: DomainDistribution::robust(),
            settings: TrainSettings::robust(),
            seed: u64::MAX - 1,
        }
    }

    #[test]
    fn a_job_reads_back_as_it_was_written() {
        let written = serde_json::to_string(&job()).unwrap();
        let read: TrainingJob = serde_json::from_str(&written).unwrap();
        assert_eq!(read, job());
        // An infinite limit on the gradient's norm reads back as well.
        let mut unlimited = job();
        unlimited.settings.largest_gradient_norm = f32::INFINITY;
        let read = serde_json::from_str(&serde_json::to_string(&unlimited).unwrap());
        assert_eq!(read.ok(), Some(unlimited));
        let negative = written.replacen("\"value\":9.81", "\"value\":-9.81", 1);
        assert_ne!(negative, written);
        let refused = serde_json::from_str::<TrainingJob>(&negative).unwrap_err();
        assert!(refused.to_string().contains('g'), "{refused}");
    }

    #[test]
    fn a_fingerprint_follows_the_settings_that_change_the_policy_and_no_others() {
        let first = job().fingerprint();
        let mut threads = job();
        threads.settings.threads = 2;
        assert_eq!(threads.fingerprint(), first);
        let mut others = [job(), job(), job()];
        others[0].seed += 1;
        others[1].settings.simulation.history += 1;
        others[2].distribution = DomainDistribution::nominal();
        for other in others {
            assert_ne!(other.fingerprint(), first);
        }
    }
}
