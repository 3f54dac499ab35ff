//! Derives seeds from the seed of a session or experiment and the purpose of the draws, never from
//! earlier draws. A resumed session therefore draws the same numbers. The plan of a rollout derives
//! the start angle of the arm in the same way.

use rand::{RngExt as _, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// The purpose of a random stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SeedFor {
    /// Training of a policy.
    Training {
        /// Number of the candidate, or of the policy in an experiment.
        candidate: u32,
        /// Number of the training among the trainings of this candidate or policy.
        training: u32,
    },
    /// Simulations that score the policies of a candidate.
    Evaluation {
        /// Number of the candidate, or of the policy in an experiment.
        candidate: u32,
    },
    /// Belief that a method of an experiment learns from recordings. It has the streams of
    /// [`Self::Evaluation`]: a method that learns a belief evaluates nothing under the same seed.
    Belief {
        /// Number of recordings from which the belief is learnt.
        recordings: u32,
    },
    /// Simulations that estimate the return of a candidate's policy, other than those in which the
    /// policy was chosen.
    Estimate {
        /// Number of the candidate.
        candidate: u32,
    },
    /// Emulated Qube of one attempt at one rollout, under virtual time.
    Emulator {
        /// Number of the candidate, or of the policy in an experiment.
        candidate: u32,
        /// Number of the rollout.
        rollout: u32,
        /// Number of the attempt.
        attempt: u32,
    },
    /// Part of an experiment with a seed of its own, such as a session, recordings or a belief. It
    /// shares no random numbers with the trainings and rollouts of the experiment's policies.
    ExperimentPart,
    /// Factors that scale a plant to the Qube of one policy or repetition, where each has a Qube of
    /// its own.
    Qube {
        /// Number of the policy or repetition.
        policy: u32,
        /// Number of the stream of factors; plants with the same stream are scaled alike.
        plant: u32,
    },
    /// One of several repetitions of a method on one of several plants.
    Repetition {
        /// Number of the plant, from 0; 0 for every plant if the plants share their seeds.
        plant: u32,
        /// Number of the repetition.
        repetition: u32,
    },
    /// Session of one of several Qubes, each of which has a session of its own.
    RigSession {
        /// Number of the rig, from 1.
        rig: u32,
    },
    /// One of several emulated Qubes: its properties, or its emulator with the board's serial
    /// number.
    RigQube {
        /// Number of the rig, from 1.
        rig: u32,
    },
}

/// The number of the random stream of a purpose. From the highest bits to the lowest, it contains:
///
/// - 8 bits: the kind of the purpose. The start angles of rollouts have a kind of their own, 1
///   ([`crate::rig::RolloutPlan::seed`]).
/// - 24 bits: the number of the candidate, policy, repetition or rig.
/// - 16 bits: the lowest bits of the number of the rollout, training or plant.
/// - 16 bits: the lowest bits of the number of the attempt.
fn stream(purpose: SeedFor) -> u64 {
    let number = |kind: u64, candidate: u32, rollout: u32, attempt: u32| {
        kind << 56
            | u64::from(candidate) << 32
            | u64::from(rollout & 0xffff) << 16
            | u64::from(attempt & 0xffff)
    };
    match purpose {
        SeedFor::Training { candidate, training } => number(2, candidate, training, 0),
        SeedFor::Evaluation { candidate } => number(7, candidate, 0, 0),
        SeedFor::Belief { recordings } => number(7, recordings, 0, 0),
        SeedFor::Estimate { candidate } => number(10, candidate, 0, 0),
        SeedFor::Emulator { candidate, rollout, attempt } => number(3, candidate, rollout, attempt),
        SeedFor::ExperimentPart => number(4, 0, 0, 0),
        SeedFor::Qube { policy, plant } => number(5, policy, plant, 0),
        SeedFor::Repetition { plant, repetition } => number(6, repetition, plant, 0),
        SeedFor::RigSession { rig } => number(8, rig, 0, 0),
        SeedFor::RigQube { rig } => number(9, rig, 0, 0),
    }
}

/// Derives a separate seed for a purpose.
#[must_use]
pub fn derived_seed(session_seed: u64, purpose: SeedFor) -> u64 {
    let mut random = ChaCha8Rng::seed_from_u64(session_seed);
    random.set_stream(stream(purpose));
    random.random()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rig::START_STREAMS;

    #[test]
    fn purposes_do_not_share_a_stream() {
        let mut purposes = vec![SeedFor::ExperimentPart];
        for candidate in 0..4 {
            purposes.push(SeedFor::Evaluation { candidate });
            purposes.push(SeedFor::Estimate { candidate });
            for training in 0..3 {
                purposes.push(SeedFor::Training { candidate, training });
            }
            purposes.push(SeedFor::Qube { policy: candidate, plant: 0 });
            purposes.push(SeedFor::Qube { policy: candidate, plant: 1 });
            for plant in 0..4 {
                purposes.push(SeedFor::Repetition { plant, repetition: candidate });
            }
            purposes.push(SeedFor::RigSession { rig: candidate });
            purposes.push(SeedFor::RigQube { rig: candidate });
            for rollout in 0..4 {
                for attempt in 0..4 {
                    purposes.push(SeedFor::Emulator { candidate, rollout, attempt });
                }
            }
        }
        assert!(purposes.iter().all(|&it| stream(it) >> 56 != START_STREAMS));
        let mut seeds: Vec<u64> = purposes.iter().map(|&it| derived_seed(7, it)).collect();
        seeds.sort_unstable();
        seeds.dedup();
        assert_eq!(seeds.len(), purposes.len());
    }
}
