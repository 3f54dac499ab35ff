use std::collections::BTreeSet;
use std::fmt;
use std::path::{Path, PathBuf};

use thiserror::Error;

use super::fitness::{Unfit, check_recording};
use super::stretch::duration_of;
use crate::qube::{PlantModel, PlantName};
use crate::replay::{Incomplete, MotionLog, MotionLogError, MotionSample, RecordedMotion};

/// Recordings of one plant that can be fitted or predicted, in `N` groups.
#[derive(Debug)]
pub struct Recordings<const N: usize> {
    /// Motions of the recordings of each group.
    pub groups: [Vec<MotionLog>; N],
    /// Paths of the recordings of each group, in the same order.
    pub files: [Vec<PathBuf>; N],
    /// Unusable recordings; they are left out, because others of their group are used.
    pub left_out: Vec<LeftOut>,
    /// Plant of all recordings. If there is no recording, it is the plant that the caller gave, or
    /// else the built-in Qube.
    pub plant: PlantModel,
    /// Serial numbers of the boards that made the recordings of the first group, each once.
    pub boards: Vec<String>,
    /// Recordings that hold only a part of their rollout.
    pub incomplete: Vec<IncompleteRecording>,
}

/// Recordings of one plant without the unusable recordings.
#[derive(Debug, Default)]
struct FittableRecordings {
    /// Motions of the recordings that are used.
    logs: Vec<MotionLog>,
    /// Paths of the recordings that are used, in the same order.
    files: Vec<PathBuf>,
    /// Unusable recordings; they are left out, because others are used.
    left_out: Vec<LeftOut>,
    /// Serial numbers of the boards that made the recordings that are used.
    boards: BTreeSet<String>,
    /// Recordings in use that hold only a part of their rollout.
    incomplete: Vec<IncompleteRecording>,
}

/// A recording that holds only a part of its rollout.
#[derive(Clone, Debug, PartialEq)]
pub struct IncompleteRecording {
    /// Path of the file.
    pub path: PathBuf,
    /// Reason why the rest is missing.
    pub why: Incomplete,
    /// Duration of the motion that is used, s.
    pub used_s: f64,
}

/// An unusable recording, which determines too little for a fit: the policy never drove the
/// motor or only briefly, the voltage was never large, or hardly anything moves.
#[derive(Debug)]
pub struct LeftOut {
    /// Path of the file.
    pub path: PathBuf,
    /// Reason why the recording is left out, in a sentence that names the file.
    pub why: RecordingsError,
}

/// The reason why recordings cannot be used together for an identification.
#[derive(Debug, Error)]
pub enum RecordingsError {
    /// A file gives no motion.
    #[error(transparent)]
    Motion(#[from] MotionLogError),
    /// A recording names the same plant as the others, but describes it differently.
    #[error(
        "{path}: it was recorded with another description of the plant {plant}: identify one plant at a time"
    )]
    OtherDescription {
        /// Path of the file.
        path: PathBuf,
        /// Name of the plant.
        plant: PlantName,
    },
    /// A recording is of another plant than the others.
    #[error("{path}: it is of the plant {plant}, not of {others}: identify one plant at a time")]
    OtherPlant {
        /// Path of the file.
        path: PathBuf,
        /// Plant of the recording.
        plant: PlantName,
        /// Plant of the others.
        others: PlantName,
    },
    /// A recording cannot be fitted.
    #[error("{path}: {why}")]
    Unfit {
        /// Path of the file.
        path: PathBuf,
        /// Reason why it is refused.
        why: Unfit,
    },
    /// A file holds the motion of another file, or a part of that motion.
    #[error(
        "{path} holds the same motion as {other}: the same data would count as new evidence. Name each recording once"
    )]
    SameMotion {
        /// Path of the file with the shorter motion; the later file if both are equally long.
        path: PathBuf,
        /// Path of the other file.
        other: PathBuf,
    },
    /// Two paths name the same file.
    #[error(
        "{path} is named twice: the same data would count as new evidence. Name each recording once"
    )]
    NamedTwice {
        /// The later of the two paths.
        path: PathBuf,
    },
}

impl RecordingsError {
    /// Returns whether the recording shows no defect, but cannot be used
    /// ([`Unfit::is_unusable`]). Others can be fitted without it.
    fn is_unusable(&self) -> bool {
        match self {
            Self::Motion(MotionLogError::NeverRan { .. }) => true,
            Self::Unfit { why, .. } => why.is_unusable(),
            _ => false,
        }
    }
}

impl fmt::Display for IncompleteRecording {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { path, why, used_s } = self;
        write!(formatter, "{} ({why}; {used_s:.2} s of it are used)", path.display())
    }
}

/// Reads groups of recordings and refuses recordings that cannot be fitted. Unusable
/// recordings are left out, unless a whole group is unusable. All others must be of the same
/// plant: of `plant`, or else of the plant of the first of them. A CSV file names no plant and is
/// taken to be of `plant`, else of the plant of the recordings before it, else of the built-in
/// Qube.
///
/// # Errors
/// A file cannot be read or fitted, is of another plant than the others, is named twice, or holds
/// the motion of another file or a part of it; or a whole group is unusable.
pub fn read_recordings<const N: usize>(
    groups: [&[PathBuf]; N],
    mut plant: Option<PlantModel>,
) -> Result<Recordings<N>, RecordingsError> {
    let (mut incomplete, mut left_out) = (Vec::new(), Vec::new());
    let mut boards = BTreeSet::new();
    let mut read: [Vec<MotionLog>; N] = std::array::from_fn(|_| Vec::new());
    let mut used: [Vec<PathBuf>; N] = std::array::from_fn(|_| Vec::new());
    for (group, paths) in groups.into_iter().enumerate() {
        let fittable = read_fittable(paths, &mut plant)?;
        (read[group], used[group]) = (fittable.logs, fittable.files);
        left_out.extend(fittable.left_out);
        incomplete.extend(fittable.incomplete);
        if group == 0 {
            boards = fittable.boards;
        }
    }
    if let Some(path) = duplicate(groups.into_iter().flatten()) {
        return Err(RecordingsError::NamedTwice { path: path.clone() });
    }
    let all: Vec<(&PathBuf, &MotionLog)> =
        used.iter().flatten().zip(read.iter().flatten()).collect();
    for (index, &(path, log)) in all.iter().enumerate() {
        let same = all[..index].iter().find(|(_, other)| hold_same_motion(log, other));
        if let Some(&(other, whole)) = same {
            // The shorter recording can be left out.
            let is_part = log.samples.len() <= whole.samples.len();
            let (path, other) = if is_part { (path, other) } else { (other, path) };
            let (path, other) = (path.clone(), other.clone());
            return Err(RecordingsError::SameMotion { path, other });
        }
    }
    let (plant, boards) = (plant.unwrap_or_default(), boards.into_iter().collect());
    Ok(Recordings { groups: read, files: used, left_out, plant, boards, incomplete })
}

/// Reads recordings for a fit, which uses all but the unusable recordings. The recordings that
/// it uses must be of the same plant: of `plant`, or else of the plant of the first of them, which
/// `plant` then becomes.
///
/// # Errors
/// A file cannot be read, is of another plant, has a defect because of which it cannot be fitted,
/// or all recordings are unusable.
fn read_fittable(
    paths: &[PathBuf],
    plant: &mut Option<PlantModel>,
) -> Result<FittableRecordings, RecordingsError> {
    let mut fittable = FittableRecordings::default();
    for path in paths {
        match read_one(path, plant, &mut fittable.incomplete) {
            Ok((log, board)) => {
                fittable.logs.push(log);
                fittable.files.push(path.clone());
                fittable.boards.extend(board);
            }
            Err(why) if why.is_unusable() => {
                fittable.left_out.push(LeftOut { path: path.clone(), why });
            }
            Err(why) => return Err(why),
        }
    }
    if fittable.logs.is_empty() && !fittable.left_out.is_empty() {
        return Err(fittable.left_out.swap_remove(0).why);
    }
    Ok(fittable)
}

/// Largest difference of an angle between a recording and a table that was exported from it, rad.
const ANGLE_WITHIN_RAD: f64 = 1e-4;

/// Largest difference of a voltage between a recording and a table that was exported from it, V: a
/// table without the applied voltage has the command, which the wire rounds to steps of 24 mV.
const VOLTAGE_WITHIN_V: f64 = 0.025;

/// Returns whether one of two motions is contained in the other: a copy, a table exported from it,
/// or the saved part of a cut recording.
fn hold_same_motion(one: &MotionLog, other: &MotionLog) -> bool {
    let (short, long) = if one.samples.len() <= other.samples.len() {
        (&one.samples, &other.samples)
    } else {
        (&other.samples, &one.samples)
    };
    let same = |one: &MotionSample, other: &MotionSample| {
        (one.state.theta - other.state.theta).abs() <= ANGLE_WITHIN_RAD
            && (one.state.alpha - other.state.alpha).abs() <= ANGLE_WITHIN_RAD
            && (one.voltage_v - other.voltage_v).abs() <= VOLTAGE_WITHIN_V
    };
    let starts = 0..=long.len() - short.len();
    starts
        .into_iter()
        .any(|start| short.iter().zip(&long[start..]).all(|(one, other)| same(one, other)))
}

/// Reads one file; returns its motion and the board that made it, if the file names the board.
fn read_one(
    path: &Path,
    plant: &mut Option<PlantModel>,
    incomplete: &mut Vec<IncompleteRecording>,
) -> Result<(MotionLog, Option<String>), RecordingsError> {
    let RecordedMotion { log, incomplete: why, board } =
        MotionLog::read_of(path, &plant.unwrap_or_default())?;
    // The check comes first, because a recording that is left out must not set the others' plant.
    check_recording(&log).map_err(|why| RecordingsError::Unfit { path: path.into(), why })?;
    let (own, others) = (&log.plant, plant.get_or_insert(log.plant));
    if own != others {
        let path = path.into();
        return Err(if own.name == others.name {
            RecordingsError::OtherDescription { path, plant: own.name }
        } else {
            RecordingsError::OtherPlant { path, plant: own.name, others: others.name }
        });
    }
    let used_s = duration_of(&log.samples);
    incomplete.extend(why.map(|why| IncompleteRecording { path: path.into(), why, used_s }));
    Ok((log, board))
}

/// The series of a recording: its path without the number and ending of its name, such as
/// `chirps/rollout-` of `chirps/rollout-2.mcap`. The recordings of a series are made after one
/// homing.
#[must_use]
pub fn series_of(path: &Path) -> PathBuf {
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    path.with_file_name(stem.trim_end_matches(|character: char| character.is_ascii_digit()))
}

/// The first of these paths that names the file of an earlier path, even in another spelling;
/// `None` if each file is named once.
#[must_use]
pub fn duplicate<'a>(files: impl IntoIterator<Item = &'a PathBuf>) -> Option<&'a PathBuf> {
    let mut seen = BTreeSet::new();
    files.into_iter().find(|path| {
        let whole = path.canonicalize().unwrap_or_else(|_| PathBuf::from(path));
        !seen.insert(whole)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::State;

    #[test]
    fn a_file_is_named_twice_even_by_another_path() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("a.mcap");
        std::fs::write(&file, "").unwrap();
        let indirect =
            folder.path().join("..").join(folder.path().file_name().unwrap()).join("a.mcap");
        let missing = folder.path().join("b.mcap");
        assert_eq!(duplicate([&file, &missing]), None);
        assert_eq!(duplicate([&file, &missing, &indirect]), Some(&indirect));
        assert_eq!(duplicate([&missing, &missing]), Some(&missing));
    }

    #[test]
    fn a_table_with_commands_in_place_of_applied_voltages_holds_the_same_motion() {
        let log = |voltage_of: fn(f64) -> f64, turned_rad: f64| {
            let sample = |tick: u32| {
                let time_s = f64::from(tick) * 0.01;
                let state = State { theta: turned_rad * time_s, ..State::default() };
                MotionSample { time_s, state, voltage_v: voltage_of(time_s.sin()) }
            };
            MotionLog { samples: (0..100).map(sample).collect(), plant: PlantModel::QUBE }
        };
        let command = |volts: f64| volts;
        let applied = |volts: f64| (volts * 999.0 / 24.0).round() * 24.0 / 999.0;
        assert!(hold_same_motion(&log(command, 0.5), &log(applied, 0.5)));
        assert!(!hold_same_motion(&log(command, 0.5), &log(applied, 0.51)));
        assert!(!hold_same_motion(&log(command, 0.5), &log(|volts| volts + 0.1, 0.5)));
    }

    #[test]
    fn recordings_whose_names_differ_in_their_last_number_are_a_series() {
        let series = |path: &str| series_of(Path::new(path));
        assert_eq!(series("chirps/rollout-0.mcap"), series("chirps/rollout-12.mcap"));
        assert_eq!(series("chirp_plus1.5V_1.csv"), series("chirp_plus1.5V_3.csv"));
        assert_ne!(series("chirp_plus1.5V_1.csv"), series("chirp_minus1.5V_1.csv"));
        assert_ne!(series("monday/rollout-0.mcap"), series("friday/rollout-0.mcap"));
    }
}
