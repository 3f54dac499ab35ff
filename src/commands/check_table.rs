//! Results of checks, as a table for people and as JSON for scripts.

use super::command_hints::remedy;
use serde_json::{Value, json};

use crate::telemetry::{CheckResult, CheckVerdict};

/// Width of a terminal line, characters.
const COLUMNS: usize = 80;

/// Indentation of the line with the remedy, characters.
const REMEDY_INDENT: usize = 4;

/// A row of a table: name, verdict, finding, and remedy.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Row {
    /// Name of the check.
    pub name: String,
    /// Verdict in a word, such as `pass` or `FAIL`; `-` for a check that was not done.
    pub word: &'static str,
    /// Finding, such as a measured value.
    pub value: String,
    /// Remedy, with the words that introduce it.
    pub remedy: Option<(&'static str, String)>,
}

impl From<&CheckResult> for Row {
    fn from(result: &CheckResult) -> Self {
        let word = match result.verdict {
            CheckVerdict::Pass => "pass",
            CheckVerdict::Fail => "FAIL",
            CheckVerdict::Skipped => "-",
        };
        Self {
            name: result.name.clone(),
            word,
            value: result.value.clone(),
            remedy: remedy(result).map(|remedy| ("remedy:", remedy)),
        }
    }
}

/// Renders the rows as a table of 80 columns; only a name or word that does not fit makes a line
/// longer.
pub fn table(rows: &[Row]) -> String {
    let name_width = rows.iter().map(|row| row.name.chars().count()).max().unwrap_or(0);
    let word_width = rows.iter().map(|row| row.word.chars().count()).max().unwrap_or(0);
    let indent = name_width + word_width + 4;
    let mut text = String::new();
    for row in rows {
        let head = format!("{:name_width$}  {:word_width$}  ", row.name, row.word);
        push_wrapped(&mut text, &head, &row.value, indent);
        if let Some((introduction, remedy)) = &row.remedy {
            // The remedy has nearly the whole width, so that a command which people copy stays on
            // one line.
            let margin = " ".repeat(REMEDY_INDENT);
            push_wrapped(&mut text, &margin, &format!("{introduction} {remedy}"), REMEDY_INDENT);
        }
    }
    text
}

/// Appends a paragraph after a head and breaks it into lines of at most [`COLUMNS`] characters,
/// with every line after the first indented. Words are never cut, so a word that does not fit makes
/// a longer line.
fn push_wrapped(text: &mut String, head: &str, paragraph: &str, indent: usize) {
    let mut line = head.to_owned();
    let mut is_empty = true;
    for word in paragraph.split(' ').filter(|word| !word.is_empty()) {
        if !is_empty && line.chars().count() + 1 + word.chars().count() > COLUMNS {
            text.push_str(line.trim_end());
            text.push('\n');
            line = " ".repeat(indent);
            is_empty = true;
        }
        if !is_empty {
            line.push(' ');
        }
        line.push_str(word);
        is_empty = false;
    }
    text.push_str(line.trim_end());
    text.push('\n');
}

/// Returns the results for `--json`; `pass` is null for a check that was not done, and `cure` is
/// the remedy with the command that helps.
pub fn checks_json(results: &[CheckResult]) -> Value {
    let pass = |verdict| match verdict {
        CheckVerdict::Pass => Some(true),
        CheckVerdict::Fail => Some(false),
        CheckVerdict::Skipped => None,
    };
    let checks: Vec<Value> = results
        .iter()
        .map(|result| {
            json!({
                "name": result.name,
                "pass": pass(result.verdict),
                "value": result.value,
                "cure": remedy(result),
            })
        })
        .collect();
    Value::Array(checks)
}

/// Names of the failed checks, for a command's last sentence.
pub fn failed_names(results: &[CheckResult]) -> String {
    let names: Vec<&str> = results
        .iter()
        .filter(|result| result.failed())
        .map(|result| result.name.as_str())
        .collect();
    names.join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_table_keeps_to_its_columns_and_loses_no_word() {
        let long = "word ".repeat(60);
        let rows = [
            Row { name: "short".into(), word: "pass", value: "0.9 ms".into(), remedy: None },
            Row {
                name: "a-rather-long-name".into(),
                word: "FAIL",
                value: long.clone(),
                remedy: Some(("remedy:", long)),
            },
        ];
        let text = table(&rows);
        assert!(text.lines().all(|line| line.chars().count() <= COLUMNS), "{text}");
        assert!(text.starts_with("short               pass  0.9 ms\n"), "{text}");
        assert_eq!(text.matches("word").count(), 120);
        assert_eq!(text.matches("remedy: word").count(), 1);
    }
}
