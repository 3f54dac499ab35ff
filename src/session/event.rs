use super::{CandidateCounts, GainSource, Purpose, SessionError};
use crate::identification::{Drift, Unfit};
use crate::learning::TrainUpdate;
use crate::rig::Rig;
use crate::scoring::{QuietnessFigures, Verdict};

/// An event of a running session.
pub enum SessionEvent<'a> {
    /// A candidate was proposed.
    Proposed {
        /// Number of the candidate.
        candidate: u32,
        /// Reason of the proposal.
        purpose: Purpose,
        /// Numbers of candidates, this one included.
        counts: CandidateCounts,
    },
    /// The Qube was identified from recordings.
    Identified {
        /// Number of recordings.
        recordings: u32,
        /// Names of the effects that are missing according to the verdict.
        missing_effects: &'a [String],
    },
    /// The fit of a profile leaves a recording out, because it cannot be fitted. A session reports
    /// each such recording once.
    RecordingLeftOut {
        /// Number of the candidate.
        candidate: u32,
        /// Number of the rollout.
        rollout: u32,
        /// Reason, as a text for the operator.
        reason: &'a str,
    },
    /// Another excitation follows, for this reason: no recording can be fitted yet, or the Qube has
    /// contradicted its profile.
    ExcitationRepeated(&'a str),
    /// The Qube could not be identified from its recordings, for this reason; the search continues
    /// as for an unknown Qube.
    NotIdentified(&'a str),
    /// A fit to the recordings so far gave no new profile during the search, for this reason. The
    /// latest profile stays and is questionable.
    RefitFailed {
        /// Number of recordings.
        recordings: u32,
        /// Reason, as a text for the operator.
        reason: &'a str,
    },
    /// The recordings of the verification left the profile as it was, for this reason.
    NotUpdated(&'a str),
    /// The search around the identified Qube ended, because one more candidate was estimated to
    /// gain too little, or because the largest number of candidates was reached.
    SearchEnded {
        /// Return that one more candidate was estimated to gain.
        expected_gain: f64,
        /// Source of this estimate.
        source: GainSource,
    },
    /// The search continues after a verified policy, because one more candidate is estimated to
    /// gain this return.
    SearchContinues {
        /// Return that one more candidate is estimated to gain.
        expected_gain: f64,
        /// Source of this estimate.
        source: GainSource,
        /// Gain in return below which the search ends.
        smallest_gain: f64,
    },
    /// The search continues after a verified policy, because the policy balances loudly.
    TooLoud(QuietnessFigures),
    /// A candidate's training has completed one more update.
    Training {
        /// Number of the candidate.
        candidate: u32,
        /// Number of the training for this candidate.
        training: u32,
        /// Statistics of the update.
        update: &'a TrainUpdate,
    },
    /// A candidate's policy was trained in this run and is on disk.
    Trained {
        /// Number of the candidate.
        candidate: u32,
        /// Mean return of the policy in the simulations of its training.
        best_return: f64,
    },
    /// The device is open, its board and doubt are accepted, and the arm is about to move for the
    /// first time.
    FirstMotion {
        /// Number of the rig, from 1, where several rigs share the session.
        rig: Option<u32>,
        /// True if the Qube is examined before it is homed.
        is_examined: bool,
        /// True if the operator has acknowledged a doubt, so that no setting skips the examination.
        is_acknowledged: bool,
    },
    /// The device is open and homed.
    Connected {
        /// Number of the rig, from 1, where several rigs share the session.
        rig: Option<u32>,
        /// The rig.
        opened: &'a Rig,
    },
    /// A rollout begins. Rollouts of several rigs that share the session begin together.
    RolloutBegins {
        /// Number of the candidate.
        candidate: u32,
        /// Number of the rollout.
        rollout: u32,
        /// Number of the rig that makes it, from 1, where several rigs share the session.
        rig: Option<u32>,
    },
    /// A rollout has ended.
    Rollout {
        /// Number of the candidate.
        candidate: u32,
        /// Purpose of the candidate.
        purpose: Purpose,
        /// Number of the rollout.
        rollout: u32,
        /// Number of the attempt, from 0.
        attempt: u32,
        /// Number of the rig that made it, from 1, where several rigs share the session.
        rig: Option<u32>,
        /// Verdict on the rollout.
        verdict: &'a Verdict,
    },
    /// Drift of a rig from its profile.
    Drift {
        /// Number of the rig, from 1, where several rigs share the session.
        rig: Option<u32>,
        /// The drift, or the reason why it cannot be estimated.
        drift: &'a Result<Drift, Unfit>,
    },
    /// A rig of several that share the session was taken out; the other rigs make its rollouts.
    RigTakenOut {
        /// Number of the rig, from 1.
        rig: u32,
        /// Reason, as a text for the operator.
        reason: &'a str,
    },
    /// One session of several that run side by side has ended early; the others continue.
    EndedEarly(&'a SessionError),
}
