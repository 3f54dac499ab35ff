//! The safety box as files of settings write it: each limit with its unit. Files without units, as older
//! programs wrote them, are read too.

use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::safety::{Guard, SafetyBox};

/// Each limit by its name in the box, and by its name in files.
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
    /// The thesis's box, whose guard a file means that names none.
    fn default() -> Self {
        SafetyBox::THESIS.into()
    }
}

/// Writes a box.
///
/// # Errors
/// The format's own.
pub fn serialize<S: Serializer>(safety_box: &SafetyBox, serializer: S) -> Result<S::Ok, S::Error> {
    BoxFile::from(*safety_box).serialize(serializer)
}

/// Reads a box.
///
/// # Errors
/// An unknown name, a limit that is named twice, a value of another type.
pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<SafetyBox, D::Error> {
    BoxFile::deserialize(deserializer).map(SafetyBox::from)
}
