use std::f64::consts::PI;
use std::io::Read;
use std::path::{Path, PathBuf};

use thiserror::Error;

use super::csv::{CsvError, parse_csv};
use crate::qube::State;
use crate::recording::{self, Recording, RecordingError};
use crate::storage::{open_regular, read_text};
use crate::telemetry::Phase;

/// The largest text file that is read.
const MAX_FILE_BYTES: u64 = 1 << 28;

/// One sample of a motion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MotionSample {
    /// Since the first sample of the log's own time, s.
    pub time_s: f64,
    /// Angles and velocities as they were measured.
    pub state: State,
    /// The motor voltage from this sample to the next, V.
    pub voltage_v: f64,
}

/// A motion of a Qube with the voltages that made it, from one of our recordings or from a CSV file.
#[derive(Clone, Debug, PartialEq)]
pub struct MotionLog {
    /// At least two samples, their times growing.
    pub samples: Vec<MotionSample>,
}

/// Why a file gives no motion.
#[derive(Debug, Error)]
pub enum MotionLogError {
    /// The file could not be read.
    #[error("{path}: {source}")]
    Read {
        /// Which.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// An MCAP file that is no recording.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// A recording in which the policy never had the motor.
    #[error(
        "{path}: the policy never had the motor in this rollout; there is no motion to lay beside the simulator"
    )]
    NeverRan {
        /// Which.
        path: PathBuf,
    },
    /// A text file that is no table of a motion.
    #[error("{path}: {why}")]
    Csv {
        /// Which.
        path: PathBuf,
        /// Why.
        why: CsvError,
    },
}

impl MotionLog {
    /// Reads an MCAP recording of this program or a CSV file with the columns `time_s`,
    /// `theta_rad`, `alpha_rad`, `theta_dot_rad_s`, `alpha_dot_rad_s`, `voltage_v` in any order.
    ///
    /// # Errors
    /// The file cannot be read or holds no motion.
    pub fn read(path: &Path) -> Result<Self, MotionLogError> {
        if is_mcap(path).map_err(|source| read_error(path, source))? {
            let recording = recording::read(path)?;
            return Self::of_recording(&recording)
                .ok_or_else(|| MotionLogError::NeverRan { path: path.to_owned() });
        }
        let text = read_text(path, MAX_FILE_BYTES).map_err(|source| read_error(path, source))?;
        let samples =
            parse_csv(&text).map_err(|why| MotionLogError::Csv { path: path.to_owned(), why })?;
        Ok(Self { samples })
    }

    /// The motion while the policy had the motor, by the device's own time. None if there are not
    /// two samples of it. Angles are those that the encoders showed: what the policy saw may be a
    /// prediction.
    ///
    /// A tick whose sample did not come gives none: the voltage before it was held over, so the
    /// sample before it says what the motor got.
    #[must_use]
    pub fn of_recording(recording: &Recording) -> Option<Self> {
        let running = recording.ticks.iter().filter(|tick| tick.phase == Phase::Running);
        let mut samples: Vec<MotionSample> = Vec::new();
        let mut start_us = None;
        for tick in running {
            let Some(measurement) = &tick.measurement else { continue };
            let start_us = *start_us.get_or_insert(measurement.device_time_us);
            let time_s = measurement.device_time_us.saturating_sub(start_us) as f64 * 1e-6;
            if samples.last().is_none_or(|last| time_s > last.time_s) {
                let voltage_v = f64::from(tick.voltage_mv) / 1000.0;
                let (theta, counted) =
                    recording.header.settings.calibration.angles_rad(measurement);
                // The tick counts whole turns from the start of the rollout.
                let turns = ((tick.state.alpha - counted) / (2.0 * PI)).round();
                let alpha = counted + 2.0 * PI * turns;
                let state = State { theta, alpha, ..tick.state };
                samples.push(MotionSample { time_s, state, voltage_v });
            }
        }
        (samples.len() >= 2).then_some(Self { samples })
    }
}

/// Whether a file starts as MCAP files do.
///
/// # Errors
/// The file cannot be read.
fn is_mcap(path: &Path) -> std::io::Result<bool> {
    let mut start = Vec::new();
    open_regular(path)?.take(mcap::MAGIC.len() as u64).read_to_end(&mut start)?;
    Ok(start == mcap::MAGIC)
}

fn read_error(path: &Path, source: std::io::Error) -> MotionLogError {
    MotionLogError::Read { path: path.to_owned(), source }
}
