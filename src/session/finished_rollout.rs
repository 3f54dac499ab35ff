use std::path::Path;

use super::{Finished, PolicyPaths, RolloutAttempt, SessionError, SessionSettings};
use crate::policy::{MAX_FILE_BYTES as MAX_POLICY_BYTES, Policy};
use crate::recording::Recording;
use crate::scoring::{Verdict, read_finished};
use crate::storage::Disk;

/// Reads the recording of a candidate's finished rollout and computes the verdict; `paths` are the
/// paths of the candidate's files.
///
/// # Errors
/// The recording is missing, truncated or changed; it is the recording of another rollout; or the
/// candidate's policy file holds another policy than the policy that made the rollout.
pub fn finished_rollout(
    disk: &dyn Disk,
    paths: &PolicyPaths,
    candidate: u32,
    finished: &Finished,
) -> Result<(Recording, Verdict), SessionError> {
    let path = paths.rollout(finished.of_policy());
    let (recording, verdict) = read_finished(disk, &path)?;
    check_origin(&recording, &path, Some(candidate), finished.of_policy())?;
    check_policy(&recording, disk, &paths.policy())?;
    Ok((recording, verdict))
}

/// Checks that a recording names the session with these settings. Another session has rollouts of
/// the same numbers, on another Qube.
///
/// # Errors
/// It is the recording of another session.
pub fn check_session(
    recording: &Recording,
    path: &Path,
    settings: &SessionSettings,
) -> Result<(), SessionError> {
    let header = &recording.header;
    if header.session == settings.name && header.seed == settings.seed {
        return Ok(());
    }
    let found = format!("the session {} with seed {}", header.session, header.seed);
    Err(SessionError::RecordingMisplaced { path: path.to_owned(), found })
}

/// Checks that a recording is of this attempt at a rollout of the candidate with this number. If
/// `candidate` is `None`, the recording of any candidate passes.
///
/// # Errors
/// It is the recording of another rollout.
pub fn check_origin(
    recording: &Recording,
    path: &Path,
    candidate: Option<u32>,
    attempt: RolloutAttempt,
) -> Result<(), SessionError> {
    let header = &recording.header;
    let is_its_candidate = candidate.is_none() || header.candidate == candidate;
    let recorded = RolloutAttempt { rollout: header.rollout, attempt: header.attempt };
    if is_its_candidate && recorded == attempt {
        return Ok(());
    }
    let of_candidate = match header.candidate {
        Some(candidate) => format!("candidate {candidate}"),
        None => "no candidate".into(),
    };
    Err(SessionError::RecordingMisplaced {
        path: path.to_owned(),
        found: format!(
            "attempt {} of rollout {} of {of_candidate}",
            header.attempt, header.rollout
        ),
    })
}

/// Checks that a policy file holds the policy that made a recorded rollout. A file that is missing
/// or damaged passes: its error belongs to the step that needs the policy.
///
/// # Errors
/// The file holds another policy.
pub fn check_policy(
    recording: &Recording,
    disk: &dyn Disk,
    path: &Path,
) -> Result<(), SessionError> {
    match disk.read(path, MAX_POLICY_BYTES) {
        Ok(bytes) if are_different(&bytes, &recording.policy) => {
            Err(SessionError::PolicyChanged { path: path.to_owned() })
        }
        Ok(_) | Err(_) => Ok(()),
    }
}

/// Returns whether two policy files hold different policies; false if one is not a policy. Of
/// networks only the functions and weights are compared, because each version of the program may
/// write the record of the training in another way.
fn are_different(one: &[u8], other: &[u8]) -> bool {
    if one == other {
        return false;
    }
    match (Policy::from_bytes(one), Policy::from_bytes(other)) {
        (Ok(Policy::Network(one)), Ok(Policy::Network(other))) => one.network != other.network,
        (Ok(one), Ok(other)) => one.to_bytes() != other.to_bytes(),
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recording::{Completeness, samples};

    #[test]
    fn a_recording_of_another_session_is_refused() {
        let header = samples::header();
        let own = SessionSettings {
            name: header.session.clone(),
            seed: header.seed,
            ..SessionSettings::quick()
        };
        let recording = Recording {
            header,
            policy: samples::POLICY.to_vec(),
            ticks: Vec::new(),
            outcome: None,
            completeness: Completeness::Whole,
        };
        let path = Path::new("rollout-0-attempt-0.mcap");
        check_session(&recording, path, &own).unwrap();
        let of_other_name = SessionSettings { name: "other".into(), ..own.clone() };
        let of_other_seed = SessionSettings { seed: 7, ..own };
        for other in [of_other_name, of_other_seed] {
            let refused = check_session(&recording, path, &other).unwrap_err().to_string();
            assert!(refused.contains("which does not count here"), "{refused}");
        }
    }
}
