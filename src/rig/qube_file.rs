//! The file `qube.toml` with the properties of one Qube. `check --write` and `check --power-test`
//! write it. A command that drives a real Qube reads the file that `--qube` names, or else the
//! `qube.toml` of the working directory, if there is one.

use std::path::{Path, PathBuf};

use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize};

use super::{LibraryWatchdog, PowerTest, QubeFileError};
use crate::control::{HomingMethod, HomingSettings, LARGEST_OFFSET_RAD, TRAVELS_RAD};
use crate::estimation::{Calibration, EstimatorSettings};
use crate::qube::{MotorRating, PlantModel};
use crate::safety::SafetyBox;
use crate::storage::{MachineDisk, SETTINGS_BYTES, read_text, write_whole};

/// Name of the file in the working directory.
pub const QUBE_FILE: &str = "qube.toml";

/// The entries of the file that are in no table.
const TOP_KEYS: [&str; 3] = ["port", "board", "profile"];

/// The contents of `qube.toml`: the properties that differ from rig to rig.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct QubeFile {
    /// Serial port, or, for a Qube with the USB panel, the card: `hil:CARD@ID`. A port is best
    /// given by its id, because that name does not change when other devices are plugged in.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub port: Option<String>,
    /// Serial number of the board. It shows whether the file belongs to the rig: the signs of
    /// another rig would be dangerous.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub board: Option<String>,
    /// Path of the profile that `identify` wrote, relative to the folder of this file. The guard
    /// uses it if `board` is named too, and `run` and `session` compare their first rollouts with
    /// it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub profile: Option<PathBuf>,
    /// Signs of encoders and motor.
    pub signs: Signs,
    /// Method of homing, zero of the arm, and distance between the stops.
    pub homing: RigHoming,
    /// Limits at which a rollout ends.
    pub limits: RigLimits,
    /// Result of `check --power-test`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub power: Option<PowerTest>,
    /// Watchdog of a card behind the vendor's library, as the command `check` has measured it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub watchdog: Option<LibraryWatchdog>,
    /// Thermal rating of the motor: at least 0.05 A and 1 s, and neither number above the nominal
    /// rating.
    #[serde(deserialize_with = "motor_rating", skip_serializing_if = "is_nominal")]
    pub motor: MotorRating,
}

/// The signs of encoders and motor. One of the three may be chosen freely: with all three inverted,
/// they describe the mirror image of the machine, which moves in the same way.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Signs {
    /// True if the arm's encoder counts down when theta grows.
    pub theta_inverted: bool,
    /// True if the pendulum's encoder counts down when alpha grows.
    pub alpha_inverted: bool,
    /// True if a positive voltage turns the arm towards negative theta.
    pub voltage_inverted: bool,
}

/// The homing of a rig: the way in which the arm's zero is found.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RigHoming {
    /// Method: `stops` or `hand`.
    pub method: HomingMethod,
    /// Zero of the arm relative to the middle that homing finds, rad; -0.3 to 0.3.
    #[serde(deserialize_with = "offset")]
    pub theta_offset_rad: f64,
    /// Distance between this rig's stops, rad, 3.6 to 6.0, if an operator has accepted that it
    /// differs from the distance on a Qube.
    #[serde(deserialize_with = "travel", skip_serializing_if = "Option::is_none")]
    pub travel_rad: Option<f64>,
}

/// The limits of a rollout on this rig. They may be narrower than the task's limits, never wider.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RigLimits {
    /// Limit of the arm's angle, rad.
    #[serde(deserialize_with = "theta_limit")]
    pub theta_rad: f64,
    /// Limit of the pendulum's angle, rad.
    #[serde(deserialize_with = "alpha_limit")]
    pub alpha_rad: f64,
    /// Limit of the arm's velocity, rad/s.
    #[serde(deserialize_with = "theta_dot_limit")]
    pub theta_dot_rad_s: f64,
    /// Limit of the pendulum's velocity, rad/s.
    #[serde(deserialize_with = "alpha_dot_limit")]
    pub alpha_dot_rad_s: f64,
}

impl Default for RigLimits {
    fn default() -> Self {
        let SafetyBox { theta, alpha, theta_dot, alpha_dot, guard: _ } = SafetyBox::THESIS;
        Self {
            theta_rad: theta,
            alpha_rad: alpha,
            theta_dot_rad_s: theta_dot,
            alpha_dot_rad_s: alpha_dot,
        }
    }
}

impl From<Signs> for Calibration {
    fn from(signs: Signs) -> Self {
        Self {
            theta_inverted: signs.theta_inverted,
            alpha_inverted: signs.alpha_inverted,
            voltage_inverted: signs.voltage_inverted,
            ..Self::IDENTITY
        }
    }
}

impl From<Calibration> for Signs {
    fn from(calibration: Calibration) -> Self {
        Self {
            theta_inverted: calibration.theta_inverted,
            alpha_inverted: calibration.alpha_inverted,
            voltage_inverted: calibration.voltage_inverted,
        }
    }
}

impl QubeFile {
    /// Reads a `qube.toml`.
    ///
    /// # Errors
    /// The file cannot be read, or is not TOML, or has an unknown key or an invalid value; the
    /// error names the line.
    pub fn load(path: &Path) -> Result<Self, QubeFileError> {
        let text = read_text(path, SETTINGS_BYTES)
            .map_err(|source| QubeFileError::Unreadable { path: path.to_owned(), source })?;
        toml::from_str(&text).map_err(|source| match misplaced(&text, &source) {
            Some((line, key, table)) => {
                let (path, table) = (path.to_owned(), table.to_owned());
                QubeFileError::Misplaced { path, line, key, table }
            }
            None => QubeFileError::Invalid { path: path.to_owned(), source: Box::new(source) },
        })
    }

    /// Writes the file atomically; its first line names `writer`.
    ///
    /// # Errors
    /// The disk is full or failing, or the folder is not writable.
    pub fn save(&self, path: &Path, writer: &str) -> Result<(), QubeFileError> {
        let text = format!(
            "# Written by {writer}. Signs were found by pushing the arm; change the\n\
             # rest as you like. Limits may be narrower than the task's, not wider.\n\n{}",
            toml::to_string_pretty(self)?
        );
        write_whole(&MachineDisk, path, text.as_bytes()).map_err(QubeFileError::NotWritten)
    }

    /// Returns the entries that hold for the rig with this board. If the file belongs to another
    /// board, only the method of homing, the limits and the motor's rating remain; limits and
    /// rating can only make a rollout safer. Port, board, profile, power test, watchdog, offset and
    /// travel of the homing, and the signs are left out.
    #[must_use]
    pub fn of_board(self, board: &str) -> Self {
        if self.board.as_deref().is_none_or(|own| own == board) {
            return self;
        }
        let homing = RigHoming { method: self.homing.method, ..RigHoming::default() };
        Self { homing, limits: self.limits, motor: self.motor, ..Self::default() }
    }

    /// The result of the power test, if it was done with this file's board. In a file that names no
    /// board the result does not count, because the board may have been replaced since.
    #[must_use]
    pub fn power(&self) -> Option<&PowerTest> {
        let is_own = |test: &&PowerTest| self.board.as_ref() == Some(&test.board);
        self.power.as_ref().filter(is_own)
    }

    /// The homing settings of this Qube, with this estimator of the velocities during homing.
    #[must_use]
    pub fn homing(&self, estimator: EstimatorSettings) -> HomingSettings {
        HomingSettings {
            method: self.homing.method,
            theta_offset_rad: self.homing.theta_offset_rad,
            travel_rad: self.homing.travel_rad,
            hand_counts: None,
            signs: self.signs.into(),
            estimator,
            plant: PlantModel::QUBE,
        }
    }

    /// A box with the narrower of each limit of the task and of this Qube, under the task's guard.
    #[must_use]
    pub fn within_limits(&self, of_the_task: &SafetyBox) -> SafetyBox {
        SafetyBox {
            theta: of_the_task.theta.min(self.limits.theta_rad),
            alpha: of_the_task.alpha.min(self.limits.alpha_rad),
            theta_dot: of_the_task.theta_dot.min(self.limits.theta_dot_rad_s),
            alpha_dot: of_the_task.alpha_dot.min(self.limits.alpha_dot_rad_s),
            guard: of_the_task.guard,
        }
    }
}

/// The line and the name of an entry that belongs at the top of the file and is in a table, and
/// the head of this table; `None` for another error.
fn misplaced<'a>(text: &'a str, error: &toml::de::Error) -> Option<(usize, String, &'a str)> {
    let key = error.message().strip_prefix("unknown field `")?.split('`').next()?;
    if !TOP_KEYS.contains(&key) {
        return None;
    }
    let before = text.get(..error.span()?.start)?;
    let table = before.lines().rev().find(|line| line.trim_start().starts_with('['))?.trim();
    Some((1 + before.matches('\n').count(), key.to_owned(), table))
}

// Values are checked while they are parsed, so that an error names its line.

fn offset<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    let value = f64::deserialize(deserializer)?;
    if value.abs() <= LARGEST_OFFSET_RAD {
        Ok(value)
    } else {
        Err(D::Error::custom(format!(
            "{value} is too far from the middle: give -{LARGEST_OFFSET_RAD} to {LARGEST_OFFSET_RAD} rad"
        )))
    }
}

fn motor_rating<'de, D: Deserializer<'de>>(deserializer: D) -> Result<MotorRating, D::Error> {
    let rating = MotorRating::deserialize(deserializer)?;
    let MotorRating { continuous_a, time_constant_s } = MotorRating::NOMINAL;
    if rating.is_plausible() && rating.is_within(&MotorRating::NOMINAL) {
        return Ok(rating);
    }
    Err(D::Error::custom(format!(
        "continuous_a = {}, time_constant_s = {} is no rating of a motor that this file may name: give continuous_a of at \
         least {}, at most {continuous_a}, and time_constant_s of at least {}, at most {time_constant_s}",
        rating.continuous_a,
        rating.time_constant_s,
        MotorRating::CURRENTS_A.start(),
        MotorRating::TIME_CONSTANTS_S.start(),
    )))
}

fn is_nominal(rating: &MotorRating) -> bool {
    *rating == MotorRating::NOMINAL
}

fn travel<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<f64>, D::Error> {
    let value = f64::deserialize(deserializer)?;
    if TRAVELS_RAD.contains(&value) {
        Ok(Some(value))
    } else {
        let (least, most) = (TRAVELS_RAD.start(), TRAVELS_RAD.end());
        Err(D::Error::custom(format!(
            "{value} is not a valid travel from stop to stop: give {least} to {most} rad"
        )))
    }
}

fn limit<'de, D: Deserializer<'de>>(deserializer: D, widest: f64) -> Result<f64, D::Error> {
    let value = f64::deserialize(deserializer)?;
    if value > 0.0 && value <= widest {
        Ok(value)
    } else {
        Err(D::Error::custom(format!(
            "{value} is not a valid limit: give a number above 0, at most {widest}"
        )))
    }
}

fn theta_limit<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    limit(deserializer, SafetyBox::THESIS.theta)
}

fn alpha_limit<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    limit(deserializer, SafetyBox::THESIS.alpha)
}

fn theta_dot_limit<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    limit(deserializer, SafetyBox::THESIS.theta_dot)
}

fn alpha_dot_limit<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    limit(deserializer, SafetyBox::THESIS.alpha_dot)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read_back(text: &str) -> Result<QubeFile, QubeFileError> {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join(QUBE_FILE);
        std::fs::write(&path, text).unwrap();
        QubeFile::load(&path)
    }

    #[test]
    fn a_motor_may_be_rated_lower_and_not_higher() {
        let rated = read_back("[motor]\ntime_constant_s = 12.0\n").unwrap().motor;
        assert_eq!(rated, MotorRating { time_constant_s: 12.0, ..MotorRating::NOMINAL });
        assert_eq!(read_back("").unwrap().motor, MotorRating::NOMINAL);
        for wrong in [
            "continuous_a = 0.6",
            "continuous_a = 0.0",
            "continuous_a = nan",
            "time_constant_s = 31.0",
            "time_constant_s = -1.0",
            "continuous_a = 0.049",
            "time_constant_s = 0.9",
        ] {
            let error = read_back(&format!("[motor]\n{wrong}\n")).unwrap_err().to_string();
            let given = wrong.trim_end_matches(".0");
            assert!(error.to_lowercase().contains(given), "{wrong}: {error}");
            assert!(error.contains("at most 0.54"), "{wrong}: {error}");
        }
        assert!(read_back("[motor]\nresistance = 8.4\n").is_err());
    }

    #[test]
    fn a_written_file_reads_back_the_same() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join(QUBE_FILE);
        let file = QubeFile {
            port: Some("/dev/serial/by-id/usb-Arduino_Uno-if00".into()),
            board: Some("0123456789abcdef".into()),
            profile: Some("lab.toml".into()),
            signs: Signs { alpha_inverted: true, ..Signs::default() },
            homing: RigHoming {
                method: HomingMethod::Hand,
                theta_offset_rad: -0.05,
                travel_rad: Some(4.32),
            },
            limits: RigLimits { theta_rad: 2.0, ..RigLimits::default() },
            power: Some(PowerTest {
                usb_lost: crate::rig::UsbLost::KeepsVoltage,
                date: "2026-01-31".into(),
                board: "0123456789abcdef".into(),
            }),
            watchdog: Some(LibraryWatchdog {
                expired_ms: 51.3,
                date: "2026-01-31".into(),
                board: "0123456789abcdef".into(),
            }),
            motor: MotorRating { continuous_a: 0.5, ..MotorRating::NOMINAL },
        };
        for file in [file, QubeFile::default()] {
            file.save(&path, "this test").unwrap();
            assert_eq!(QubeFile::load(&path).unwrap(), file);
        }
    }

    #[test]
    fn the_rig_of_another_board_keeps_only_entries_that_make_it_safer() {
        let text = "port = \"/dev/qube\"\nboard = \"a\"\nprofile = \"lab.toml\"\n\
                    [signs]\nalpha_inverted = true\n\
                    [homing]\nmethod = \"hand\"\ntheta_offset_rad = 0.1\ntravel_rad = 4.3\n\
                    [limits]\ntheta_rad = 2.0\n[motor]\ncontinuous_a = 0.5\n\
                    [power]\nusb_lost = \"motor off\"\ndate = \"2026-01-31\"\nboard = \"a\"\n";
        let file = read_back(text).unwrap();
        assert_eq!(file.clone().of_board("a"), file);
        assert!(file.power().is_some());
        let moved = QubeFile { board: Some("b".into()), ..file.clone() };
        assert_eq!(moved.power(), None, "the power test names its own board");
        let other = file.of_board("b");
        let kept =
            "[homing]\nmethod = \"hand\"\n[limits]\ntheta_rad = 2.0\n[motor]\ncontinuous_a = 0.5\n";
        assert_eq!(other, read_back(kept).unwrap());
    }

    #[test]
    fn an_empty_file_is_a_qube_without_peculiarities() {
        let file = read_back("").unwrap();
        assert_eq!(file, QubeFile::default());
        assert_eq!(file.within_limits(&SafetyBox::THESIS), SafetyBox::THESIS);
        assert_eq!(Calibration::from(file.signs), Calibration::IDENTITY);
    }

    #[test]
    fn limits_only_narrow_a_box() {
        type Limit = fn(&mut SafetyBox) -> &mut f64;
        let limits: [(&str, Limit); 4] = [
            ("theta_rad", |it| &mut it.theta),
            ("alpha_rad", |it| &mut it.alpha),
            ("theta_dot_rad_s", |it| &mut it.theta_dot),
            ("alpha_dot_rad_s", |it| &mut it.alpha_dot),
        ];
        for (name, limit) in limits {
            let file = read_back(&format!("[limits]\n{name} = 1.5\n")).unwrap();
            for (of_the_task, narrower) in [(1.0, 1.0), (1.5, 1.5), (2.0, 1.5)] {
                let mut task = SafetyBox::GUARDED;
                *limit(&mut task) = of_the_task;
                let mut expected = SafetyBox::GUARDED;
                *limit(&mut expected) = narrower;
                assert_eq!(file.within_limits(&task), expected, "{name}");
            }
        }
    }

    #[test]
    fn an_entry_that_belongs_at_the_top_is_refused_in_a_table() {
        for (key, table) in [("profile", "[limits]"), ("port", "[motor]"), ("board", "[signs]")] {
            let text = format!("\n{table}\n{key} = \"mine.toml\"\n");
            let message = read_back(&text).unwrap_err().to_string();
            let told = format!("line 3: {key} is in the table {table}: it belongs at the top");
            assert!(message.contains(&told), "{message}");
        }
        let message = read_back("prot = \"/dev/qube\"\n").unwrap_err().to_string();
        assert!(message.contains("unknown field"), "{message}");
    }

    #[test]
    fn misspelt_keys_and_impossible_values_are_named_with_their_line() {
        for (text, words) in [
            ("[signs]\ntheta_invertd = true\n", ["line 2", "theta_invertd"]),
            ("\nprot = \"/dev/ttyACM0\"\n", ["line 2", "prot"]),
            ("[signs]\nalpha_inverted = 1\n", ["line 2", "bool"]),
            ("[homing]\nmethod = \"feel\"\n", ["line 2", "feel"]),
            ("[homing]\nmethod = \"stops\"\ntheta_offset_rad = 2.0\n", ["line 3", "too far"]),
            ("[limits]\n\ntheta_rad = 2.39\n", ["line 3", "at most 2.3"]),
            ("[limits]\nalpha_dot_rad_s = -1.0\n", ["line 2", "above 0"]),
            ("[limits]\ntheta_dot_rad_s = nan\n", ["line 2", "above 0"]),
            ("[power]\nusb_lost = \"off\"\n", ["line 2", "motor off"]),
            ("[power]\nusb_lost = \"unknown\"\ndate = \"yesterday\"\n", ["line 3", "yesterday"]),
            ("[power]\nusb_lost = \"unknown\"\ndate = \"2026-13-01\"\n", ["line 3", "no date"]),
            ("[watchdog]\nexpired_ms = -1e300\n", ["line 2", "from 0 to 60000"]),
            ("[watchdog]\nexpired_ms = nan\n", ["line 2", "NaN"]),
            ("[watchdog]\nexpired_ms = 50.0\ndate = \"\"\n", ["line 3", "no date"]),
        ] {
            let message = read_back(text).unwrap_err().to_string();
            for word in words.iter().chain(&[QUBE_FILE]) {
                assert!(message.contains(word), "{word:?} is missing in: {message}");
            }
        }
    }
}
