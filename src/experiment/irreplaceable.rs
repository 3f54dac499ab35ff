use std::path::Path;

use super::ExperimentFolder;
use crate::recording::is_recording;
use crate::session::{PolicyPaths, RigSessions, SessionPaths};

/// Returns whether a file is a recording, or belongs to the record of a session or an experiment:
/// by its name the ledger or the settings, or the list of the devices of several sessions, or a
/// policy, a profile or a belief in the folder of a session or an experiment. Without such a file
/// the work cannot be resumed, so no command replaces it, not even by force.
#[must_use]
pub fn is_irreplaceable(path: &Path) -> bool {
    const NAMES: [&str; 4] = [
        SessionPaths::LEDGER,
        SessionPaths::CONFIGURATION,
        ExperimentFolder::SETTINGS,
        RigSessions::FILE,
    ];
    path.file_name().is_some_and(|name| NAMES.iter().any(|record| name == *record))
        || is_part_of_results(path)
        || is_recording(path).unwrap_or(false)
}

/// Returns whether a file has the name of a part of a session or an experiment and lies in the
/// folder of one. A user's own folder may hold files of these names, and settings of a session.
fn is_part_of_results(path: &Path) -> bool {
    const FITTED: [(&str, &str); 3] =
        [("profile-", ".toml"), ("identified-", ".toml"), ("belief-", ".json")];
    let Some(name) = path.file_name().map(|name| name.to_string_lossy()) else { return false };
    let paths = PolicyPaths::in_folder(Path::new(""));
    let of_policy = [paths.policy(), paths.curve(), paths.training_times()];
    let is_part = of_policy.iter().any(|own| own.as_os_str() == &*name)
        || FITTED.iter().any(|(first, last)| name.starts_with(first) && name.ends_with(last));
    let Ok(absolute) = std::path::absolute(path) else { return is_part };
    let is_root = |folder: &Path| {
        [SessionPaths::LEDGER, ExperimentFolder::SETTINGS]
            .iter()
            .any(|record| folder.join(record).exists())
    };
    is_part && absolute.ancestors().skip(1).any(is_root)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_of_a_session_or_an_experiment_are_irreplaceable_and_files_of_their_names_are_not() {
        for record in [SessionPaths::LEDGER, ExperimentFolder::SETTINGS] {
            let directory = tempfile::tempdir().unwrap();
            let inside = directory.path().join("candidates/001");
            std::fs::create_dir_all(&inside).unwrap();
            let parts = ["policy.safetensors", "curve.csv", "profile-1.toml", "belief-2.json"];
            let others = ["report.html", "mine.safetensors", "table.csv"];
            let check = |name: &str, expected: bool| {
                let path = inside.join(name);
                std::fs::write(&path, "x").unwrap();
                assert_eq!(is_irreplaceable(&path), expected, "{record}: {name}");
            };
            parts.iter().chain(&others).for_each(|name| check(name, false));
            std::fs::write(directory.path().join(record), "").unwrap();
            parts.iter().for_each(|name| check(name, true));
            others.iter().for_each(|name| check(name, false));
        }
    }
}
