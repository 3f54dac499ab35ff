//! A controller outside of this program, such as one in Python.

use crate::qube::State;

/// Longest name of an external controller, bytes.
pub const MAX_NAME_BYTES: usize = 200;

/// A controller outside of this program: its name and, in a replay, the voltages that it answered
/// in the recording.
///
/// Its policy file holds the name alone, so the controller cannot run from the file: without
/// recorded answers it returns NaN, and a tick brakes for a voltage that is not a number. A replay
/// supplies the answers of the recording and recomputes everything else.
#[derive(Clone, Debug, PartialEq)]
pub struct External {
    name: String,
    /// Answers in order, V.
    answers_v: Vec<f64>,
    next: usize,
}

impl External {
    /// A controller of this name, without answers. A name longer than 200 bytes is cut after the
    /// last character that fits.
    #[must_use]
    pub fn new(name: &str) -> Self {
        let cut = name.floor_char_boundary(MAX_NAME_BYTES);
        Self { name: name[..cut].to_owned(), answers_v: Vec::new(), next: 0 }
    }

    /// The same controller with these answers, V, one for each call of [`Self::voltage_v`].
    #[must_use]
    pub fn answering(self, answers_v: Vec<f64>) -> Self {
        Self { answers_v, next: 0, ..self }
    }

    /// The controller's name.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Starts again with the first answer.
    pub fn start(&mut self) {
        self.next = 0;
    }

    /// The next answer, V; NaN after the last answer.
    #[must_use]
    pub fn voltage_v(&mut self, _state: &State) -> f64 {
        let answer_v = self.answers_v.get(self.next).copied().unwrap_or(f64::NAN);
        self.next = self.next.saturating_add(1);
        answer_v
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_answers_come_in_order_after_each_start_and_then_nan() {
        let mut external = External::new("mine").answering(vec![1.0, -2.0]);
        for _ in 0..2 {
            external.start();
            let mut answer_v = || external.voltage_v(&State::default());
            assert_eq!([answer_v(), answer_v()], [1.0, -2.0]);
            assert!(answer_v().is_nan() && answer_v().is_nan());
        }
        assert!(External::new("").voltage_v(&State::default()).is_nan());
    }

    #[test]
    fn a_long_name_is_cut_between_characters() {
        let name = "ä".repeat(MAX_NAME_BYTES);
        assert_eq!(External::new(&name).name(), "ä".repeat(MAX_NAME_BYTES / 2));
    }
}
