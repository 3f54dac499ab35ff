use std::fs::TryLockError;
use std::path::{Path, PathBuf};

use super::seal::Seal;
use super::{ExperimentError, ExperimentSettingError};
use crate::session::{FolderError, PolicyPaths};
use crate::storage::{
    Disk, FolderLock, MachineDisk, file_exists, is_unfinished_of, remove_unfinished, write_whole,
};

/// The folder of an experiment; one process at a time holds it. The files in the folder are the
/// only record of finished work.
///
/// ```text
/// experiment.toml                                 the resolved settings
/// searches/RECIPE/                                the session that looks for a recipe's psi
/// policies/RECIPE/000/policy.safetensors          a trained policy
/// policies/RECIPE/000/curve.csv                   its learning curve
/// policies/RECIPE/000/PLANT/rollout-0-attempt-0.mcap   its rollouts
/// strategies/METHOD/000/search/                   the session of one repetition
/// strategies/identify/000/recordings/             the recordings of a repetition without a session
/// strategies/identify/000/identified-1.toml       the Qube identified from the first recording,
/// strategies/identify/000/refused-1.txt           or the reason why it identifies none
/// strategies/identify/000/left-out-2.txt          recordings that the fit to the first 2 ignores
/// strategies/METHOD/000/judged/003/000/           a policy that scores the recommendation after
///                                                 3 candidates or recordings
/// strategies/simopt/000/belief-1.json             a rival's belief after the first recording
/// budgets/PLANT/METHOD/000/                       a repetition at fixed budgets, with the files of
///                                                 strategies/METHOD/000/
/// ```
#[derive(Debug)]
pub struct ExperimentFolder {
    root: PathBuf,
    _lock: FolderLock,
}

impl ExperimentFolder {
    /// Name of the file with the settings.
    pub(crate) const SETTINGS: &str = "experiment.toml";

    /// Returns whether a folder is an experiment that has begun.
    #[must_use]
    pub fn is_in(root: &Path) -> bool {
        MachineDisk.exists(&settings_in(root))
    }

    /// Creates a new folder, or takes an empty one, and writes the experiment's settings into it.
    /// The partial settings of an experiment that was killed at its start are replaced.
    ///
    /// # Errors
    /// The folder has other content, cannot be created or written, or another process holds it.
    pub fn create(root: &Path, settings: &str) -> Result<Self, ExperimentError> {
        let exists = || FolderError::Exists { path: root.to_owned() };
        let settings_path = settings_in(root);
        let holds_only_leftovers = || {
            let names = MachineDisk.names(root);
            let is_partial = |path: PathBuf| is_unfinished_of(&MachineDisk, &path, &settings_path);
            names.is_ok_and(|names| names.iter().all(|name| is_partial(root.join(name))))
        };
        if MachineDisk.exists(root) && !holds_only_leftovers() {
            return Err(exists().into());
        }
        make(root)?;
        let folder = Self::lock(root)?;
        // Another process may have begun an experiment there before this process held the folder.
        let io = |source| FolderError::Io { path: folder.settings_path(), source };
        if file_exists(&MachineDisk, &folder.settings_path()).map_err(io)? {
            return Err(exists().into());
        }
        remove_unfinished(&MachineDisk, &settings_path);
        let sealed = Seal::EXPERIMENT.sealed(settings);
        write_whole(&MachineDisk, &folder.settings_path(), sealed.as_bytes())?;
        Ok(folder)
    }

    /// Opens the folder of an experiment that has begun.
    ///
    /// # Errors
    /// The folder is not an experiment, cannot be locked, or another process holds it.
    pub fn open(root: &Path) -> Result<Self, ExperimentError> {
        if !Self::is_in(root) {
            let (path, missing) = (root.to_owned(), Self::SETTINGS);
            return Err(ExperimentError::NotAnExperiment { path, missing });
        }
        Self::lock(root)
    }

    fn lock(root: &Path) -> Result<Self, ExperimentError> {
        let path = root.to_owned();
        match MachineDisk.lock_folder(root) {
            Ok(lock) => Ok(Self { root: path, _lock: lock }),
            Err(TryLockError::WouldBlock) => Err(FolderError::InUse { path }.into()),
            Err(TryLockError::Error(source)) => Err(FolderError::Io { path, source }.into()),
        }
    }

    /// Path of the folder.
    #[must_use]
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Path of the resolved settings.
    #[must_use]
    pub fn settings_path(&self) -> PathBuf {
        settings_in(&self.root)
    }

    /// Folder of the searches.
    #[must_use]
    pub fn searches(&self) -> PathBuf {
        self.root.join("searches")
    }

    /// Folder of the session that searches for a recipe's psi.
    #[must_use]
    pub fn search(&self, recipe: &str) -> PathBuf {
        self.searches().join(recipe)
    }

    /// Folders of a recipe's policies.
    #[must_use]
    pub fn policies(&self, recipe: &str) -> PolicyFolders {
        PolicyFolders(self.root.join("policies").join(recipe))
    }

    /// Folder of one repetition of a method on a plant, in a comparison at fixed budgets.
    #[must_use]
    pub fn repetition_on(&self, plant: &str, method: &str, repetition: u32) -> PathBuf {
        self.root.join("budgets").join(plant).join(method).join(format!("{repetition:03}"))
    }

    /// Folder of one repetition of a method in a comparison up to the first success.
    #[must_use]
    pub fn repetition(&self, method: &str, repetition: u32) -> PathBuf {
        self.root.join("strategies").join(method).join(format!("{repetition:03}"))
    }
}

/// Path of the resolved settings of an experiment in this folder.
fn settings_in(root: &Path) -> PathBuf {
    root.join(ExperimentFolder::SETTINGS)
}

/// The folders of the policies of one recipe or one recommendation, by policy number.
#[derive(Clone, Debug)]
pub struct PolicyFolders(PathBuf);

impl PolicyFolders {
    /// Folders of the policies that score the recommendation after `number` candidates or
    /// recordings, in a repetition's folder.
    #[must_use]
    pub fn of_recommendation(repetition: &Path, number: u32) -> Self {
        Self(repetition.join("judged").join(format!("{number:03}")))
    }

    /// Paths of a policy.
    #[must_use]
    pub fn policy(&self, policy: u32) -> PolicyPaths {
        PolicyPaths::numbered(&self.0, policy)
    }

    /// Folder of a policy's recordings on a plant.
    #[must_use]
    pub fn rollouts(&self, policy: u32, plant: &str) -> PathBuf {
        self.policy(policy).folder().join(plant)
    }
}

/// Creates a folder if it does not exist.
pub(super) fn make(path: &Path) -> Result<(), FolderError> {
    let io = |source| FolderError::Io { path: path.to_owned(), source };
    MachineDisk.create_folder(path).map_err(io)
}

/// Checks a name that also becomes the name of a folder; `kind` names the setting in the error.
pub(super) fn check_name(kind: &'static str, name: &str) -> Result<(), ExperimentSettingError> {
    let allowed = |letter: char| letter.is_ascii_alphanumeric() || "-_.+%".contains(letter);
    if !name.is_empty() && name.len() <= 60 && !name.starts_with('.') && name.chars().all(allowed) {
        return Ok(());
    }
    Err(ExperimentSettingError::Name { kind, name: name.to_owned() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_is_taken_if_it_is_empty_or_its_experiment_was_killed_at_its_start() {
        let directory = tempfile::tempdir().unwrap();
        let root = directory.path().join("one");
        let create = || ExperimentFolder::create(&root, "seed = 1\n").map(drop);
        std::fs::create_dir(&root).unwrap();
        let partial = root.join("experiment.toml.4711-0.unfinished");
        std::fs::write(&partial, "se").unwrap();
        assert!(create().is_ok());
        let written = std::fs::read_to_string(settings_in(&root)).unwrap();
        assert!(written.starts_with("seed = 1\n"), "{written}");
        assert!(!partial.exists());
        assert!(create().is_err());
        std::fs::remove_file(settings_in(&root)).unwrap();
        assert!(create().is_ok());
        std::fs::rename(settings_in(&root), root.join("notes")).unwrap();
        assert!(create().is_err());
    }
}
