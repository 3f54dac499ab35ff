use std::cell::{Cell, RefCell};
use std::io::{self, ErrorKind, Write};
use std::path::Path;

use serde::{Serialize, Serializer};
use serde_json::json;

use super::exit::Failure;
use super::printable::{printable, printable_json};

/// A printer of results on stdout, as text for people or as one JSON object for scripts.
#[derive(Debug)]
pub struct Output {
    json: bool,
    printed: Cell<bool>,
    error: RefCell<Option<io::Error>>,
}

impl Output {
    /// Makes an output for people, or with `json` for scripts.
    pub fn new(json: bool) -> Self {
        Self { json, printed: Cell::new(false), error: RefCell::new(None) }
    }

    /// Returns whether results are printed for scripts, as JSON.
    pub fn is_for_scripts(&self) -> bool {
        self.json
    }

    /// Prints a part of a result for people before the rest is known.
    pub fn print_for_people(&self, text: &str) {
        if !self.json {
            self.print(text, &());
        }
    }

    /// Prints the complete result for scripts.
    pub fn print_for_scripts(&self, value: &impl Serialize) {
        if self.json {
            self.print("", value);
        }
    }

    /// Prints a result: `text` for people, or `value` for scripts as JSON on one line (`text` if
    /// `value` cannot be JSON). [`Self::finish`] reports an error of printing.
    pub fn print(&self, text: &str, value: &impl Serialize) {
        let mut stdout = io::stdout().lock();
        let written = match (self.json, serde_json::to_string(value)) {
            (true, Ok(line)) => writeln!(stdout, "{}", printable_json(&line)),
            (false, _) | (true, Err(_)) => writeln!(stdout, "{}", printable(text.trim_end())),
        };
        self.printed.set(true);
        match written.and_then(|()| stdout.flush()) {
            // A broken pipe is no error: the reader has closed it on purpose.
            Err(error) if error.kind() != ErrorKind::BrokenPipe => {
                *self.error.borrow_mut() = Some(error);
            }
            _ => {}
        }
    }

    /// Completes a command: returns its outcome, or the failure to print its result. For scripts, a
    /// failure before anything was printed is printed as an object with the key `ended_by`.
    pub fn finish(&self, outcome: Result<(), Failure>) -> Result<(), Failure> {
        let outcome = outcome.and_then(|()| match self.error.take() {
            Some(error) => {
                Err(Failure::failed(format!("the result could not be printed: {error}")))
            }
            None => Ok(()),
        });
        if let Err(failure) = &outcome
            && !self.printed.get()
        {
            self.print_for_scripts(&json!({ "ended_by": failure.ended_by() }));
        }
        outcome
    }
}

/// Serialises a path as text; bytes that are not UTF-8 are replaced, because JSON requires UTF-8.
pub fn path_as_text<S: Serializer>(path: &Path, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(&path.to_string_lossy())
}
