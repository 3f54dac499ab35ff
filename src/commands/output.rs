use std::io::Write;

use serde::Serialize;

use super::printable::{printable, printable_json};

/// Where results go: stdout, as text for people or as one JSON object for scripts.
#[derive(Debug)]
pub struct Output {
    json: bool,
}

impl Output {
    /// For people, or with `json` for scripts.
    pub fn new(json: bool) -> Self {
        Self { json }
    }

    /// Prints a result in one of its two forms. A reader that has gone away is no failure.
    pub fn print(&self, text: &str, value: &impl Serialize) {
        let mut stdout = std::io::stdout().lock();
        let _ = match (self.json, serde_json::to_string(value)) {
            (true, Ok(line)) => writeln!(stdout, "{}", printable_json(&line)),
            (false, _) | (true, Err(_)) => writeln!(stdout, "{}", printable(text.trim_end())),
        };
        let _ = stdout.flush();
    }
}
