use std::io::Write;

use serde::Serialize;

use super::printable::{printable, printable_json};

/// Prints results to stdout, as text for people or as one JSON object for scripts.
#[derive(Debug)]
pub struct Output {
    json: bool,
}

impl Output {
    /// An output for people, or with `json` for scripts.
    pub fn new(json: bool) -> Self {
        Self { json }
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

    /// Prints a result in one of its two forms. A reader that has gone is not a failure.
    pub fn print(&self, text: &str, value: &impl Serialize) {
        let mut stdout = std::io::stdout().lock();
        let _ = match (self.json, serde_json::to_string(value)) {
            (true, Ok(line)) => writeln!(stdout, "{}", printable_json(&line)),
            (false, _) | (true, Err(_)) => writeln!(stdout, "{}", printable(text.trim_end())),
        };
        let _ = stdout.flush();
    }
}
