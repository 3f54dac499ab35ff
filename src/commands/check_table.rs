//! Results of checks, as a table for people and as JSON for scripts.

use serde_json::{Value, json};

use crate::telemetry::{CheckResult, CheckVerdict};

/// What a terminal shows without wrapping.
const COLUMNS: usize = 80;

/// Where the line with the cure begins.
const REMEDY_INDENT: usize = 4;

/// One line of a table: name, a word, what was found, and what to do about it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Row {
    /// What was looked at.
    pub name: String,
    /// `pass`, `FAIL` ...
    pub word: &'static str,
    /// What was found.
    pub value: String,
    /// What to do, after a word that introduces it.
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
            remedy: result.cure.clone().map(|cure| ("cure:", cure)),
        }
    }
}

/// The rows below each other, wrapped so that 80 columns hold them.
pub fn table(rows: &[Row]) -> String {
    let name_width = rows.iter().map(|row| row.name.chars().count()).max().unwrap_or(0);
    let word_width = rows.iter().map(|row| row.word.chars().count()).max().unwrap_or(0);
    let indent = name_width + word_width + 4;
    let mut text = String::new();
    for row in rows {
        let head = format!("{:name_width$}  {:word_width$}  ", row.name, row.word);
        push_wrapped(&mut text, &head, &row.value, indent);
        if let Some((introduction, remedy)) = &row.remedy {
            // Nearly the whole width: a command that is to be pasted should stay on one line.
            let margin = " ".repeat(REMEDY_INDENT);
            push_wrapped(&mut text, &margin, &format!("{introduction} {remedy}"), REMEDY_INDENT);
        }
    }
    text
}

/// Adds one paragraph after its head, with its other lines indented; words are never cut, so that
/// a command stays whole where it can.
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

/// The results as `--json` has them; `pass` is null where a check was not done.
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
                "cure": result.cure,
            })
        })
        .collect();
    Value::Array(checks)
}

/// Names of the checks that failed, for the sentence that ends a command.
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
                remedy: Some(("cure:", long)),
            },
        ];
        let text = table(&rows);
        assert!(text.lines().all(|line| line.chars().count() <= COLUMNS), "{text}");
        assert!(text.starts_with("short               pass  0.9 ms\n"), "{text}");
        assert_eq!(text.matches("word").count(), 120);
        assert_eq!(text.matches("cure: word").count(), 1);
    }
}
