use std::fmt;

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Length of the longest name of a plant, characters.
const LONGEST: usize = 32;

/// The name of a plant: 1 to 32 ASCII letters, digits, dots, hyphens and underscores.
///
/// The value contains the characters themselves and not a pointer to them, so that settings which
/// name a plant can be copied into a tick.
#[derive(Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct PlantName {
    letters: [u8; LONGEST],
    length: u8,
}

impl PlantName {
    /// The name of the built-in Qube.
    pub const QUBE: Self = {
        let mut letters = [0; LONGEST];
        (letters[0], letters[1], letters[2], letters[3]) = (b'q', b'u', b'b', b'e');
        Self { letters, length: 4 }
    };

    /// Returns whether this is the name of the built-in Qube.
    #[must_use]
    pub fn is_qube(&self) -> bool {
        *self == Self::QUBE
    }

    /// The name as text.
    #[must_use]
    pub fn as_str(&self) -> &str {
        std::str::from_utf8(&self.letters[..usize::from(self.length)]).unwrap_or_default()
    }
}

impl Default for PlantName {
    fn default() -> Self {
        Self::QUBE
    }
}

/// The error for a text that is no name of a plant.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[error(
    "{name:?} is no name of a plant: give 1 to {LONGEST} letters, digits, dots, hyphens and underscores"
)]
pub struct NoPlantName {
    /// Text given.
    pub name: String,
}

impl TryFrom<String> for PlantName {
    type Error = NoPlantName;

    fn try_from(name: String) -> Result<Self, NoPlantName> {
        let allowed = |letter: &u8| letter.is_ascii_alphanumeric() || b"-_.".contains(letter);
        if name.is_empty() || name.len() > LONGEST || !name.as_bytes().iter().all(allowed) {
            return Err(NoPlantName { name });
        }
        let mut letters = [0; LONGEST];
        letters[..name.len()].copy_from_slice(name.as_bytes());
        Ok(Self { letters, length: name.len() as u8 })
    }
}

impl From<PlantName> for String {
    fn from(name: PlantName) -> Self {
        name.as_str().to_owned()
    }
}

impl fmt::Display for PlantName {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(self.as_str())
    }
}

impl fmt::Debug for PlantName {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{:?}", self.as_str())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_keeps_its_characters_and_others_are_refused() {
        assert_eq!(PlantName::QUBE.as_str(), "qube");
        assert_eq!(PlantName::try_from("qube".to_owned()), Ok(PlantName::QUBE));
        for name in ["", "two words", "ü", &"x".repeat(33)] {
            assert!(PlantName::try_from(name.to_owned()).is_err(), "{name}");
        }
    }
}
