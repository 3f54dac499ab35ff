//! Recognition of a file that was given to the wrong option.

use std::path::Path;

use super::exit::Failure;
use crate::storage::{SETTINGS_BYTES, read_text};

/// A kind of TOML file that an operator writes or keeps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FileKind {
    /// The numbers of one specimen, as `identify` writes them.
    Profile,
    /// The description of another plant than the Qube.
    Plant,
    /// The rig's own file, as `check --write` writes it.
    Qube,
    /// The emulated specimens of an experiment.
    Plants,
    /// One recipe of an experiment.
    Recipe,
    /// The settings of a session.
    Session,
}

/// Each kind, with the entries that files of the other kinds do not have at their top. The kinds
/// with the plainest entries come first, because a session's settings also name a profile.
const KINDS: [(FileKind, &[&str]); 6] = [
    (FileKind::Plants, &["plants"]),
    (FileKind::Recipe, &["settings"]),
    (FileKind::Plant, &["encoders"]),
    (FileKind::Profile, &["gap", "standard_errors", "correlations", "provenance"]),
    (FileKind::Qube, &["port", "board", "signs", "power", "watchdog"]),
    (FileKind::Session, &["extent", "psi", "training", "bayrn", "estimator", "identification"]),
];

impl FileKind {
    /// Recognises the kind of a file by the entries at its top; `None` if it is not TOML or has
    /// none that only one kind has.
    fn of(text: &str) -> Option<Self> {
        let table: toml::Table = toml::from_str(text).ok()?;
        let has = |names: &[&str]| names.iter().any(|name| table.contains_key(*name));
        KINDS.iter().find(|(_, names)| has(names)).map(|(kind, _)| *kind)
    }

    /// Sentence that says what a file of this kind is and how it is given.
    const fn sentence(self) -> &'static str {
        match self {
            Self::Profile => "The file is a profile, the numbers of one Qube: --profile takes it",
            Self::Plant => "The file describes a plant: --plant takes it",
            Self::Qube => "The file describes the board and the signs of a rig: --qube takes it",
            Self::Plants => {
                "The file lists the Qubes of an experiment: `experiment --plants` takes it"
            }
            Self::Recipe => "The file is a recipe: `experiment --recipe` takes it",
            Self::Session => "The file has the settings of a session: `session --config` takes it",
        }
    }

    /// Returns the failure of reading a file as one of this kind. If the file is of another kind,
    /// the failure says so.
    pub fn refused(self, path: &Path, error: impl ToString) -> Failure {
        let failure = Failure::usage(error);
        let found = read_text(path, SETTINGS_BYTES).ok().and_then(|text| Self::of(&text));
        match found.filter(|found| *found != self) {
            Some(other) => failure.followed_by(other.sentence()),
            None => failure,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::Profile;
    use crate::session::SessionSettings;

    #[test]
    fn the_files_of_the_program_are_recognised() {
        let kinds = [
            (FileKind::Plant, include_str!("../../plants/furuta-130.toml").to_owned()),
            (FileKind::Profile, include_str!("../../profiles/lab.toml").to_owned()),
            (FileKind::Profile, toml::to_string(&Profile::lab()).unwrap()),
            (FileKind::Plants, include_str!("../../scripts/comparison/eight.toml").to_owned()),
            (FileKind::Recipe, include_str!("../../scripts/comparison/rivals.toml").to_owned()),
            (FileKind::Session, SessionSettings::quick().to_toml().unwrap()),
            (FileKind::Qube, "board = \"A\"\n[signs]\ntheta_inverted = true\n".to_owned()),
        ];
        for (kind, text) in kinds {
            assert_eq!(FileKind::of(&text), Some(kind), "{text}");
        }
        assert_eq!(FileKind::of("name = \"x\""), None);
        assert_eq!(FileKind::of("no TOML"), None);
    }

    #[test]
    fn a_file_of_another_kind_is_named_and_one_of_the_kind_asked_for_is_not() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("mine.toml");
        std::fs::write(&path, include_str!("../../profiles/lab.toml")).unwrap();
        let as_plant = FileKind::Plant.refused(&path, "unknown field").cause().to_owned();
        assert_eq!(
            as_plant,
            "unknown field. The file is a profile, the numbers of one Qube: --profile takes it"
        );
        assert_eq!(FileKind::Profile.refused(&path, "wrong").cause(), "wrong");
        let missing = folder.path().join("nowhere.toml");
        assert_eq!(FileKind::Plant.refused(&missing, "missing").cause(), "missing");
    }
}
