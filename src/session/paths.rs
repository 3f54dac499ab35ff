use std::path::{Path, PathBuf};

use super::RolloutAttempt;

/// The paths of a session's files.
///
/// ```text
/// session.toml                            all settings, the defaults included
/// ledger.jsonl                            decisions and finished work
/// profile-1.toml                          the Qube's profile, fitted to 1 recording
/// candidates/000/                         the files of candidate 0's policy
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SessionPaths {
    root: PathBuf,
}

impl SessionPaths {
    /// Name of the file with all settings.
    pub(crate) const CONFIGURATION: &str = "session.toml";

    /// Name of the ledger.
    pub(crate) const LEDGER: &str = "ledger.jsonl";

    /// The paths of a session in this folder.
    #[must_use]
    pub fn new(root: &Path) -> Self {
        Self { root: root.to_owned() }
    }

    /// Path of the folder.
    #[must_use]
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Path of the file with all settings, the defaults included.
    #[must_use]
    pub fn configuration(&self) -> PathBuf {
        self.root.join(Self::CONFIGURATION)
    }

    /// Path of the ledger.
    #[must_use]
    pub fn ledger(&self) -> PathBuf {
        self.root.join(Self::LEDGER)
    }

    /// Name of the file with the profile that was fitted to this number of recordings.
    #[must_use]
    pub fn profile_name(recordings: u32) -> String {
        format!("profile-{recordings}.toml")
    }

    /// Path of the profile that was fitted to this number of recordings.
    #[must_use]
    pub fn profile(&self, recordings: u32) -> PathBuf {
        self.root.join(Self::profile_name(recordings))
    }

    /// Folder of the candidates.
    #[must_use]
    pub fn candidates(&self) -> PathBuf {
        self.root.join("candidates")
    }

    /// Paths of a candidate's policy.
    #[must_use]
    pub fn candidate(&self, candidate: u32) -> PolicyPaths {
        PolicyPaths::numbered(&self.candidates(), candidate)
    }
}

/// The paths of the files of one policy. The curve and the times exist only if it was trained.
///
/// ```text
/// policy.safetensors                      the policy
/// curve.csv                               the learning curve of its training
/// training-times.json                     times of its trainings; not written in virtual time
/// rollout-0-attempt-0.mcap                the recording of one of its rollouts
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PolicyPaths {
    folder: PathBuf,
}

impl PolicyPaths {
    /// The paths of the policy with this number among the policies in a folder.
    #[must_use]
    pub fn numbered(policies: &Path, number: u32) -> Self {
        Self { folder: policies.join(format!("{number:03}")) }
    }

    /// The paths of the policy in this folder.
    #[must_use]
    pub fn in_folder(folder: &Path) -> Self {
        Self { folder: folder.to_owned() }
    }

    /// Path of the folder.
    #[must_use]
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Path of the policy file.
    #[must_use]
    pub fn policy(&self) -> PathBuf {
        self.folder.join("policy.safetensors")
    }

    /// Path of the training curve.
    #[must_use]
    pub fn curve(&self) -> PathBuf {
        self.folder.join("curve.csv")
    }

    /// Path of the file with the times at which the policy's trainings ran.
    #[must_use]
    pub fn training_times(&self) -> PathBuf {
        self.folder.join("training-times.json")
    }

    /// Path of the recording of an attempt at a rollout.
    #[must_use]
    pub fn rollout(&self, attempt: RolloutAttempt) -> PathBuf {
        recording_in(&self.folder, attempt)
    }
}

/// Path, in a folder of recordings, of the recording of an attempt at a rollout.
#[must_use]
pub fn recording_in(folder: &Path, RolloutAttempt { rollout, attempt }: RolloutAttempt) -> PathBuf {
    folder.join(format!("rollout-{rollout}-attempt-{attempt}.mcap"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::session::AttemptId;

    #[test]
    fn the_rollout_precedes_the_attempt_in_the_name_of_a_recording() {
        let third = AttemptId { candidate: 7, rollout: 1, attempt: 2 };
        let paths = SessionPaths::new(Path::new("session")).candidate(third.candidate);
        let recording = Path::new("session/candidates/007/rollout-1-attempt-2.mcap");
        assert_eq!(paths.rollout(third.of_policy()), recording);
    }
}
