use std::path::{Path, PathBuf};

use thiserror::Error;

use super::MotionSample;
use super::csv::{CsvError, parse_csv};
use super::motion_sample::{device_time_s, with_turns_of};
use crate::qube::{PlantModel, State, applied_voltage_mv, volts};
use crate::recording::{self, Recording, RecordingError, is_recording};
use crate::safety::Limit;
use crate::storage::read_text;
use crate::telemetry::{Ending, Fault, Phase};

/// Largest text file that is read, bytes: 256 MiB.
const MAX_FILE_BYTES: u64 = 1 << 28;

/// A motion of a Qube with its voltages, from a recording of this program or a CSV file.
#[derive(Clone, Debug, PartialEq)]
pub struct MotionLog {
    /// At least two samples with increasing times.
    pub samples: Vec<MotionSample>,
    /// Plant that made the motion.
    pub plant: PlantModel,
}

/// The motion that a file holds.
#[derive(Clone, Debug)]
pub struct RecordedMotion {
    /// The motion.
    pub log: MotionLog,
    /// Reason why a recording holds only a part of its rollout; `None` if it holds the whole, and
    /// for a CSV file.
    pub incomplete: Option<Incomplete>,
    /// Serial number of the board that made a recording; `None` if its header names none, and for a
    /// CSV file.
    pub board: Option<String>,
}

/// The reason why a recording holds only a part of the motion that its rollout was to have.
#[derive(Clone, Copy, Debug, Error, PartialEq)]
pub enum Incomplete {
    /// The recording ends before its rollout.
    #[error("its end is missing")]
    Cut,
    /// The recorder lost ticks, or a block of the file is damaged.
    #[error("ticks are missing in it")]
    LostTicks,
    /// The state left the box.
    #[error("its rollout {0}")]
    LeftBox(Limit),
    /// Somebody stopped the rollout.
    #[error("its rollout was stopped")]
    Stopped,
    /// A fault ended the rollout.
    #[error("a fault ended its rollout: {0}")]
    Fault(Fault),
}

impl Incomplete {
    /// The reason why this recording is incomplete; `None` if it holds the whole rollout, even if
    /// the end of the file is damaged.
    #[must_use]
    pub fn of(recording: &Recording) -> Option<Self> {
        let Some(outcome) = &recording.outcome else { return Some(Self::Cut) };
        let lacks_ticks =
            outcome.records_lost > 0 || recording.lacks_ticks() || recording.lacks_end();
        match outcome.ending {
            _ if lacks_ticks => Some(Self::LostTicks),
            Ending::Completed => None,
            Ending::LeftBox(limit) => Some(Self::LeftBox(limit)),
            Ending::Stopped => Some(Self::Stopped),
            Ending::Fault(fault) => Some(Self::Fault(fault)),
        }
    }
}

/// The reason why a file gives no motion.
#[derive(Debug, Error)]
pub enum MotionLogError {
    /// The file could not be read.
    #[error("{path}: {source}")]
    Read {
        /// Path of the file.
        path: PathBuf,
        /// Cause of the failure.
        source: std::io::Error,
    },
    /// The MCAP file is not a recording.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// The recording has fewer than two samples under the policy.
    #[error(
        "{path}: the recording has fewer than two samples under the policy, so it has no motion that can be used: give another recording"
    )]
    NeverRan {
        /// Path of the file.
        path: PathBuf,
    },
    /// The text file is not a table of a motion.
    #[error("{path}: {why}")]
    Csv {
        /// Path of the file.
        path: PathBuf,
        /// Reason why it is refused.
        why: CsvError,
    },
}

impl MotionLog {
    /// Reads an MCAP recording of this program, or a CSV file with the columns `time_s`,
    /// `theta_rad`, `alpha_rad`, `theta_dot_rad_s`, `alpha_dot_rad_s`, `voltage_v` in any order. A
    /// CSV file is taken as a motion of the built-in Qube.
    ///
    /// # Errors
    /// The file cannot be read or holds no motion.
    pub fn read(path: &Path) -> Result<Self, MotionLogError> {
        Self::read_of(path, &PlantModel::QUBE).map(|motion| motion.log)
    }

    /// Reads a file like [`Self::read`], but takes a CSV file, which names no plant, as a motion of
    /// `plant`. A recording names its own plant.
    ///
    /// # Errors
    /// The file cannot be read or holds no motion.
    pub fn read_of(path: &Path, plant: &PlantModel) -> Result<RecordedMotion, MotionLogError> {
        // A file whose name ends in `mcap` is read as a recording even if it was cut off within its
        // first bytes: it is no table either.
        let has_name_of_recording = path.extension().is_some_and(|ending| ending == "mcap");
        if is_recording(path).map_err(|source| read_error(path, source))? || has_name_of_recording {
            let recording = recording::read(path)?;
            let log = Self::of_recording(&recording)
                .ok_or_else(|| MotionLogError::NeverRan { path: path.to_owned() })?;
            let incomplete = Incomplete::of(&recording);
            let board = recording.header.board().map(str::to_owned);
            return Ok(RecordedMotion { log, incomplete, board });
        }
        let text = read_text(path, MAX_FILE_BYTES).map_err(|source| read_error(path, source))?;
        let samples =
            parse_csv(&text).map_err(|why| MotionLogError::Csv { path: path.to_owned(), why })?;
        let log = Self { samples, plant: *plant };
        Ok(RecordedMotion { log, incomplete: None, board: None })
    }

    /// The motion while the policy drove the motor, with times by the device's clock; `None` with
    /// fewer than two samples. The angles come from the encoders, because the policy may have seen
    /// predicted angles; the velocities come from the state that the policy saw.
    ///
    /// The voltages are the applied ones, in the motor driver's steps of about 24 mV
    /// ([`applied_voltage_mv`]); the protocol requires these steps from the board of every plant
    /// (PROTOCOL.md, section 7). Commanded voltages would be too inexact: the rounding of a command
    /// lasts until the next command, and over seconds its effect on the arm exceeds an encoder
    /// count.
    ///
    /// A tick without a sample is left out: the motor kept the previous voltage, which the previous
    /// sample gives. A sample whose device time is not later than the previous one is left out too.
    #[must_use]
    pub fn of_recording(recording: &Recording) -> Option<Self> {
        let running = recording.ticks.iter().filter(|tick| tick.phase == Phase::Running);
        let mut samples: Vec<MotionSample> = Vec::new();
        let mut start_us = None;
        for tick in running {
            let Some(measurement) = &tick.measurement else { continue };
            let start_us = *start_us.get_or_insert(measurement.device_time_us);
            let time_s = device_time_s(measurement.device_time_us, start_us);
            if samples.last().is_none_or(|last| time_s > last.time_s) {
                let voltage_v = volts(applied_voltage_mv(tick.voltage_mv));
                let (theta, counted) =
                    recording.header.settings.calibration.angles_rad(measurement);
                let alpha = with_turns_of(tick.state.alpha, counted);
                let state = State { theta, alpha, ..tick.state };
                samples.push(MotionSample { time_s, state, voltage_v });
            }
        }
        let plant = recording.header.settings.plant;
        (samples.len() >= 2).then_some(Self { samples, plant })
    }
}

fn read_error(path: &Path, source: std::io::Error) -> MotionLogError {
    MotionLogError::Read { path: path.to_owned(), source }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use super::*;
    use crate::recording::{Completeness, samples};
    use crate::telemetry::RolloutOutcome;

    #[test]
    fn the_table_of_a_recording_gives_its_motion() {
        let mut header = samples::header();
        header.settings.calibration.theta_zero_counts += 17;
        let mut ticks: Vec<_> = (0..25).map(samples::tick).collect();
        for (index, tick) in ticks.iter_mut().enumerate() {
            // The policy saw predicted angles, counted from another turn than the encoder's.
            tick.state.theta += 0.01;
            tick.state.alpha += 2.0 * PI + 0.02;
            tick.phase = if index < 3 { Phase::Settling } else { Phase::Running };
            if let Some(measurement) = &mut tick.measurement {
                measurement.device_time_us = 1_000_003 + 10_007 * index as u64;
            }
        }
        let again = ticks[11].measurement.as_ref().map(|it| it.device_time_us);
        if let (Some(time_us), Some(measurement)) = (again, &mut ticks[12].measurement) {
            measurement.device_time_us = time_us;
        }
        let recording = Recording {
            header,
            policy: samples::POLICY.to_vec(),
            ticks,
            outcome: Some(samples::outcome()),
            completeness: Completeness::Whole,
        };
        let motion = MotionLog::of_recording(&recording).unwrap();
        assert!(motion.samples.len() > 15);
        let table = recording::csv_table(&recording);
        assert_eq!(parse_csv(&table).unwrap(), motion.samples);
        // Python has the time in seconds.
        let (header, rows) = table.split_once('\n').unwrap();
        let place = header.split(',').position(|it| it == "device_time_us").unwrap();
        let in_seconds = rows.lines().map(|row| {
            let mut fields: Vec<String> = row.split(',').map(str::to_owned).collect();
            if let Ok(time_us) = fields[place].parse::<u64>() {
                fields[place] = (1e-6 * time_us as f64).to_string();
            }
            fields.join(",")
        });
        let header = header.replace("device_time_us", "device_time_s");
        let table = format!("{header}\n{}", in_seconds.collect::<Vec<_>>().join("\n"));
        assert_eq!(parse_csv(&table).unwrap(), motion.samples);
    }

    #[test]
    fn a_recording_that_holds_a_part_of_its_rollout_says_why() {
        let recording = |ending: Ending, records_lost: u64| Recording {
            header: samples::header(),
            policy: samples::POLICY.to_vec(),
            ticks: (0..25).map(samples::tick).collect(),
            outcome: Some(RolloutOutcome { ending, records_lost, ..samples::outcome() }),
            completeness: Completeness::Whole,
        };
        let whole = recording(Ending::Completed, 0);
        assert_eq!(Incomplete::of(&whole), None);
        // Only the end of this file is damaged.
        let lost_bytes = 20;
        let completeness = Completeness::CutOff { lost_bytes, reason: "the end".into() };
        assert_eq!(Incomplete::of(&Recording { completeness, ..whole.clone() }), None);
        let cut = Recording { outcome: None, completeness: Completeness::Recovered, ..whole };
        assert_eq!(Incomplete::of(&cut), Some(Incomplete::Cut));
        assert_eq!(Incomplete::of(&recording(Ending::Completed, 3)), Some(Incomplete::LostTicks));
        let mut lossy = recording(Ending::Completed, 0);
        lossy.ticks.remove(1);
        assert_eq!(Incomplete::of(&lossy), Some(Incomplete::LostTicks));
        // The last block of this file was damaged, so its last ticks could not be recovered.
        let mut end_lost = recording(Ending::Completed, 0);
        end_lost.ticks.truncate(19);
        assert_eq!(Incomplete::of(&end_lost), Some(Incomplete::LostTicks));
        assert_eq!(end_lost.loss().unwrap(), "ends after 14 of the 15 steps of its policy");
        for (ending, words) in [
            (Ending::LeftBox(Limit::Theta), "left the box"),
            (Ending::Stopped, "was stopped"),
            (Ending::Fault(Fault::LinkGone), "a fault ended its rollout"),
        ] {
            let why = Incomplete::of(&recording(ending, 0)).unwrap().to_string();
            assert!(why.contains(words), "{why}");
        }
    }
}
