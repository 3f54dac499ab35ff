//! The safety box in settings files, where the name of each limit ends in its unit. Names without a
//! unit, as in `theta`, are read too, because earlier versions wrote them.

use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::safety::{Guard, HardwareRefusal, SafetyBox};

/// The names of each limit: without its unit, as [`SafetyBox`] has it, and with its unit, as files
/// have it.
pub const NAMES: [(&str, &str); 4] = [
    ("theta", "theta_rad"),
    ("alpha", "alpha_rad"),
    ("theta_dot", "theta_dot_rad_s"),
    ("alpha_dot", "alpha_dot_rad_s"),
];

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct BoxFile {
    #[serde(alias = "theta")]
    theta_rad: f64,
    #[serde(alias = "alpha")]
    alpha_rad: f64,
    #[serde(alias = "theta_dot")]
    theta_dot_rad_s: f64,
    #[serde(alias = "alpha_dot")]
    alpha_dot_rad_s: f64,
    guard: Guard,
}

impl From<SafetyBox> for BoxFile {
    fn from(safety_box: SafetyBox) -> Self {
        let SafetyBox { theta, alpha, theta_dot, alpha_dot, guard } = safety_box;
        Self {
            theta_rad: theta,
            alpha_rad: alpha,
            theta_dot_rad_s: theta_dot,
            alpha_dot_rad_s: alpha_dot,
            guard,
        }
    }
}

impl From<BoxFile> for SafetyBox {
    fn from(file: BoxFile) -> Self {
        let BoxFile { theta_rad, alpha_rad, theta_dot_rad_s, alpha_dot_rad_s, guard } = file;
        Self {
            theta: theta_rad,
            alpha: alpha_rad,
            theta_dot: theta_dot_rad_s,
            alpha_dot: alpha_dot_rad_s,
            guard,
        }
    }
}

impl Default for BoxFile {
    /// The box of the thesis. A file that leaves out a limit or the guard gets the value of this
    /// box.
    fn default() -> Self {
        SafetyBox::THESIS.into()
    }
}

/// Writes a box with the names of files, rad and rad/s.
///
/// # Errors
/// The serializer fails.
pub fn serialize<S: Serializer>(safety_box: &SafetyBox, serializer: S) -> Result<S::Ok, S::Error> {
    BoxFile::from(*safety_box).serialize(serializer)
}

/// Reads a box, rad and rad/s; a limit or guard that is left out has the value of the thesis's box.
///
/// # Errors
/// A name is unknown, a limit is named twice, or a value has another type. The limits' sizes are
/// not checked.
pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<SafetyBox, D::Error> {
    BoxFile::deserialize(deserializer).map(SafetyBox::from)
}

/// A refusal of a box in words, with the limit under its name in files.
#[must_use]
pub fn refusal_in_files(refusal: &HardwareRefusal) -> String {
    let wrong = refusal.to_string();
    let renamed = NAMES.iter().find_map(|(bare, name)| {
        let value = wrong.strip_prefix(&format!("safety_box.{bare} "))?;
        Some(format!("safety_box.{name} {value}"))
    });
    renamed.unwrap_or(wrong)
}
