use serde::{Deserialize, Serialize};

/// A decision or a finished piece of work of a session. Returns are not entered: they are computed
/// from the recordings.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "event", deny_unknown_fields)]
pub enum Entry {
    /// The session began with these settings: the first line. Ledgers of older programs lack it;
    /// such a session can be read, and cannot be continued.
    Begun {
        /// The checksum of `session.toml`, as [`crate::storage::checksum_of`] computes it.
        settings: String,
        /// True if the checksum of each later line includes the checksum of the line before it, so
        /// that no line can be removed unnoticed. Ledgers of older programs are not chained.
        #[serde(default, skip_serializing_if = "std::ops::Not::not")]
        chained: bool,
    },
    /// A candidate was proposed. Candidates are numbered from 0 in the order of these entries.
    Proposed {
        /// Number of the candidate.
        candidate: u32,
        /// Reason of the proposal.
        purpose: Purpose,
        /// Point of the search space: one value for each entry of psi, in the order and units of
        /// the space; empty for an excitation and the baseline.
        #[serde(rename = "psi")]
        point: Vec<f64>,
        /// Numbers of the candidates whose returns were still unknown to the search when it chose
        /// this point.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        pending: Vec<u32>,
        /// Number of the searched candidate whose policy this one runs again, to verify it; `None`
        /// for a candidate with a policy of its own, and in ledgers of older programs.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        policy_of: Option<u32>,
    },
    /// The candidate's policy is complete on disk.
    Trained {
        /// Number of the candidate.
        candidate: u32,
        /// The checksum of the policy's file, as [`crate::storage::checksum_of`] computes it; `None`
        /// in ledgers of older programs. Before the first rollout no recording shows that the file
        /// was exchanged.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        checksum: Option<String>,
    },
    /// A rollout has a result, and its recording is complete on disk.
    RolloutFinished {
        /// Number of the candidate.
        candidate: u32,
        /// Number of the rollout for this candidate, from 0.
        rollout: u32,
        /// Number of the attempt, from 0.
        attempt: u32,
        /// Number of the rig that made the rollout, from 1, where several rigs share the session.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        rig: Option<u32>,
    },
    /// The Qube was identified, and its profile is complete on disk.
    Identified {
        /// Number of recordings that the profile was fitted to; the name of its file contains this
        /// number. Recordings that cannot be fitted do not count.
        recordings: u32,
        /// The fit's verdict by its name: `fits` or `fits_but`.
        verdict: String,
        /// Names of the effects that are missing according to the verdict.
        #[serde(rename = "doubts")]
        missing_effects: Vec<String>,
        /// The checksum of the profile, as [`crate::storage::checksum_of`] computes it. It protects
        /// the file, which determines the guard.
        checksum: String,
    },
    /// The Qube could not be identified from its recordings; the search continues as for an unknown
    /// Qube.
    NotIdentified {
        /// Reason, as a text for the operator.
        reason: String,
    },
    /// Further recordings, of the verification or of the search, left the profile as it was.
    NotUpdated {
        /// Number of recordings, of the search and before it, from which a fit gave no new profile;
        /// `None` for the recordings of the verification.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        recordings: Option<u32>,
        /// Reason, as a text for the operator.
        reason: String,
    },
    /// The search around an identified Qube ended.
    #[serde(rename = "settled")]
    SearchEnded {
        /// Return that one more candidate was estimated to gain over the verified policy.
        expected_gain: f64,
    },
    /// A rig was taken out after a fault; the other rigs make its rollouts.
    RigTakenOut {
        /// Number of the rig, from 1.
        rig: u32,
        /// Reason, as a text for the operator.
        reason: String,
    },
    /// A rollout is void: a fault ended it, or its recording lacks ticks. The recording is kept.
    RolloutVoid {
        /// Number of the candidate.
        candidate: u32,
        /// Number of the rollout for this candidate, from 0.
        rollout: u32,
        /// Number of the attempt, from 0.
        attempt: u32,
        /// Number of the rig that made the rollout, from 1, where several rigs share the session.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        rig: Option<u32>,
    },
}

/// The reason of a candidate's proposal.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Purpose {
    /// A recording that identifies the Qube: its policy is an excitation.
    Excitation,
    /// An initial point of the search.
    Initial,
    /// A proposal of the search.
    Search,
    /// The search's recommendation, trained and run to verify it.
    Verification,
    /// The best searched candidate, whose existing policy is verified. A search around an
    /// identified Qube verifies this policy alone. Other searches verify the recommendation's
    /// policy too: all rollouts of a policy share the luck of its training, and the training for
    /// the recommendation may have turned out worse.
    Incumbent,
    /// A policy that was trained on the nominal Qube, for comparison.
    Baseline,
}

impl Entry {
    /// Number of the rig that the entry names, from 1; `None` if it names none.
    #[must_use]
    pub fn rig(&self) -> Option<u32> {
        match self {
            Self::RolloutFinished { rig, .. } | Self::RolloutVoid { rig, .. } => *rig,
            Self::RigTakenOut { rig, .. } => Some(*rig),
            _ => None,
        }
    }
}

impl Purpose {
    /// Returns whether the candidate belongs to the search and has a psi to be evaluated.
    #[must_use]
    pub fn is_searched(self) -> bool {
        matches!(self, Self::Initial | Self::Search)
    }

    /// Returns whether the candidate's rollouts inform the method: they identify the Qube or
    /// evaluate a psi.
    #[must_use]
    pub fn informs(self) -> bool {
        self == Self::Excitation || self.is_searched()
    }

    /// Returns whether the candidate's rollouts verify the result.
    #[must_use]
    pub fn verifies(self) -> bool {
        matches!(self, Self::Verification | Self::Incumbent)
    }
}
