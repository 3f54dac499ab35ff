use std::io::ErrorKind;

use super::{FolderError, SessionError, SessionPaths, StoredProfile};
use crate::qube::Profile;
use crate::storage::{Disk, SETTINGS_BYTES, checksum_of};

/// Reads, from a session's folder, a profile that the session identified.
///
/// # Errors
/// The file cannot be read, does not have this checksum, or is not a valid profile.
pub fn identified_profile(
    disk: &dyn Disk,
    paths: &SessionPaths,
    StoredProfile { recordings, checksum }: &StoredProfile,
) -> Result<Profile, SessionError> {
    let path = paths.profile(*recordings);
    let lost = |reason: String| SessionError::ProfileLost { path: path.clone(), reason };
    let bytes = disk.read(&path, SETTINGS_BYTES).map_err(|source| match source.kind() {
        ErrorKind::NotFound => lost("the file is missing".into()),
        ErrorKind::FileTooLarge => lost(source.to_string()),
        _ => FolderError::Io { path: path.clone(), source }.into(),
    })?;
    if checksum_of(&bytes) != *checksum {
        return Err(lost("it was changed".into()));
    }
    let text = String::from_utf8(bytes).map_err(|error| lost(error.to_string()))?;
    Profile::parse(&text).map_err(|error| lost(error.to_string()))
}
