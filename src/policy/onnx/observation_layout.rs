//! The layout of another program's observation. It converts the weights of a first layer, and the
//! bounds of its inputs, to this program's observation.

use thiserror::Error;

use crate::qube::{ALPHA_DOT_FACTOR, MAX_HISTORY, OBSERVATION_SIZE, THETA_DOT_FACTOR};

/// Names of the quantities that an observation may contain, in the order of this program's
/// observation, each with the factor that this program multiplies it by.
const NAMES: [(&str, f64); OBSERVATION_SIZE + MAX_HISTORY] = [
    ("sin_theta", 1.0),
    ("cos_theta", 1.0),
    ("sin_alpha", 1.0),
    ("cos_alpha", 1.0),
    ("theta_dot", THETA_DOT_FACTOR),
    ("alpha_dot", ALPHA_DOT_FACTOR),
    ("command_1", 1.0),
    ("command_2", 1.0),
    ("command_3", 1.0),
    ("command_4", 1.0),
];

/// The entries of another program's observation: the quantity of each, and the factor on it.
///
/// Quantities are in this program's conventions: angles in rad with alpha = 0 where the pendulum
/// hangs, velocities in rad/s, and the last commands as fractions of 5 V, `command_1` the newest. A
/// factor of -1 reverses a sign: `-1*cos_alpha` is the cosine of an angle that is 0 where the
/// pendulum is upright.
#[derive(Clone, Debug, PartialEq)]
pub struct ObservationLayout {
    /// For each entry, the index in this program's observation, and the factor on this program's
    /// entry there.
    entries: Vec<(usize, f64)>,
    inputs: usize,
}

/// The reason why a text names no layout of an observation.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
pub enum LayoutError {
    /// The name of an entry is unknown, or its factor is 0 or no finite number.
    #[error(
        "{entry:?} is not an entry of an observation: give some of {names}, each with or without a factor \
         other than 0, as 0.1*theta_dot", names = NAMES.map(|(name, _)| name).join(", ")
    )]
    UnknownEntry {
        /// Entry given.
        entry: String,
    },
    /// Two entries name the same quantity, which is most likely a slip of the pen.
    #[error("observation names {name} twice: name each entry once")]
    RepeatedEntry {
        /// Name of the quantity.
        name: &'static str,
    },
}

impl ObservationLayout {
    /// This program's own observation with this many last commands, at most [`MAX_HISTORY`].
    #[must_use]
    pub fn own(history: usize) -> Self {
        let inputs = OBSERVATION_SIZE + history.min(MAX_HISTORY);
        Self { entries: (0..inputs).map(|index| (index, 1.0)).collect(), inputs }
    }

    /// Reads names separated by commas, each with or without a factor, as in `0.1*theta_dot,
    /// -1*cos_alpha`.
    ///
    /// # Errors
    /// Names the first entry whose name is unknown or was named before, or whose factor is 0 or no
    /// finite number.
    pub fn parse(text: &str) -> Result<Self, LayoutError> {
        let mut entries: Vec<(usize, f64)> = Vec::new();
        for entry in text.split(',').map(str::trim) {
            let (factor, name) = entry.split_once('*').unwrap_or(("1", entry));
            let factor: f64 = factor.trim().parse().unwrap_or(f64::NAN);
            let known = NAMES.iter().position(|(known, _)| *known == name.trim());
            match known.filter(|_| factor.is_finite() && factor != 0.0) {
                Some(index) if entries.iter().any(|&(named, _)| named == index) => {
                    return Err(LayoutError::RepeatedEntry { name: NAMES[index].0 });
                }
                Some(index) => entries.push((index, factor / NAMES[index].1)),
                None => return Err(LayoutError::UnknownEntry { entry: entry.to_owned() }),
            }
        }
        let last = entries.iter().map(|&(index, _)| index + 1).max().unwrap_or_default();
        Ok(Self { entries, inputs: last.max(OBSERVATION_SIZE) })
    }

    /// Number of entries.
    #[must_use]
    pub fn len(&self) -> usize {
        self.entries.len()
    }

    /// Returns whether the layout has no entry.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.entries.is_empty()
    }

    /// Length of this program's observation with all commands up to the oldest one that is named.
    #[must_use]
    pub fn inputs(&self) -> usize {
        self.inputs
    }

    /// Converts weights of the first layer, `[outputs][entries]`, to weights on this program's
    /// observation, `[outputs][inputs]`.
    pub(super) fn arranged(&self, weight: &[f32]) -> Vec<f32> {
        let mut arranged = vec![0.0_f64; weight.len() / self.len().max(1) * self.inputs];
        let rows = arranged.chunks_exact_mut(self.inputs);
        for (row, given) in rows.zip(weight.chunks_exact(self.len().max(1))) {
            for (&(index, factor), &weight) in self.entries.iter().zip(given) {
                row[index] += factor * f64::from(weight);
            }
        }
        arranged.into_iter().map(|weight| weight as f32).collect()
    }

    /// Converts bounds of the entries to bounds of this program's observation.
    pub(super) fn arranged_bounds(&self, bounds: &[[f32; 2]]) -> Vec<[f32; 2]> {
        let mut arranged = vec![[f32::NEG_INFINITY, f32::INFINITY]; self.inputs];
        for (&(index, factor), bounds) in self.entries.iter().zip(bounds) {
            let [one, other] = bounds.map(|bound| (f64::from(bound) / factor) as f32);
            arranged[index] = if factor < 0.0 { [other, one] } else { [one, other] };
        }
        arranged
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn entries_are_put_where_this_program_has_them() {
        let layout = ObservationLayout::parse("theta_dot, -1*cos_alpha, command_1").unwrap();
        assert_eq!((layout.len(), layout.inputs()), (3, 7));
        let arranged = layout.arranged(&[2.0, 3.0, 4.0]);
        assert_eq!(arranged, [0.0, 0.0, 0.0, -3.0, 20.0, 0.0, 4.0]);
        assert_eq!(ObservationLayout::own(1).arranged(&[1.0; 7]), [1.0; 7]);
        let bounds = layout.arranged_bounds(&[[-5.0, 4.0], [-1.0, 0.5], [0.0, 1.0]]);
        assert_eq!((bounds[4], bounds[3], bounds[6]), ([-0.5, 0.4], [-0.5, 1.0], [0.0, 1.0]));
        assert_eq!(bounds[0], [f32::NEG_INFINITY, f32::INFINITY]);
    }

    #[test]
    fn an_entry_that_is_named_twice_is_refused() {
        let refused = ObservationLayout::parse("sin_theta, cos_theta, 2*sin_theta").unwrap_err();
        assert_eq!(refused, LayoutError::RepeatedEntry { name: "sin_theta" });
    }

    #[test]
    fn an_unknown_entry_is_named() {
        for (wrong, message) in
            [("sin_beta", "sin_beta"), ("0*theta_dot", "0*theta_dot"), ("", "\"\"")]
        {
            let error = ObservationLayout::parse(wrong).unwrap_err().to_string();
            assert!(error.contains(message) && error.contains("command_4, each"), "{error}");
        }
    }
}
