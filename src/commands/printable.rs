//! Makes foreign text safe for a terminal: file names, names in policies and recordings, and a
//! device's description of itself.

use std::borrow::Cow;
use std::io::Write;

use crate::report::is_obeyed;

/// Escapes everything that a terminal would obey instead of showing: control characters (except
/// line ends and tabs, which the program's own tables contain), and characters that change the
/// direction of writing or have no width.
pub fn printable(text: &str) -> Cow<'_, str> {
    escaped(text, |letter| !matches!(letter, '\n' | '\t') && is_obeyed(letter))
}

/// Escapes text and keeps it on one line, so that foreign text in a sentence cannot begin a line.
pub fn one_line(text: &str) -> Cow<'_, str> {
    escaped(text, is_obeyed)
}

/// Escapes the characters in one line of JSON that a terminal would obey and that JSON itself
/// leaves as they are. The JSON keeps its meaning.
pub fn printable_json(line: &str) -> Cow<'_, str> {
    if !line.contains(is_obeyed) {
        return Cow::Borrowed(line);
    }
    let mut whole = String::with_capacity(line.len());
    for letter in line.chars() {
        if is_obeyed(letter) {
            let mut units = [0; 2];
            for unit in letter.encode_utf16(&mut units) {
                whole.push_str(&format!("\\u{unit:04x}"));
            }
        } else {
            whole.push(letter);
        }
    }
    Cow::Owned(whole)
}

/// Largest number of digits, with the point, of a number that is shown as it is; a `u64` has at
/// most 20.
const MAX_DIGITS: usize = 24;

/// Returns the text with each number of more than `MAX_DIGITS` digits in scientific notation: 1
/// with 300 zeros becomes `1e300`.
pub fn with_short_numbers(text: &str) -> String {
    let mut short = String::with_capacity(text.len());
    let mut rest = text;
    let is_of_number = |letter: char| letter.is_ascii_digit() || letter == '.';
    while let Some(start) = rest.find(is_of_number) {
        let (before, from) = rest.split_at(start);
        let end = from.find(|letter| !is_of_number(letter)).unwrap_or(from.len());
        let (number, after) = from.split_at(end);
        let digits = number.trim_end_matches('.');
        short.push_str(before);
        match digits.parse::<f64>() {
            Ok(value) if digits.len() > MAX_DIGITS => {
                short.push_str(&format!("{value:e}"));
                short.push_str(&number[digits.len()..]);
            }
            _ => short.push_str(number),
        }
        rest = after;
    }
    short + rest
}

/// Prints a message to the user on stderr. A message that cannot be written is lost: neither a full
/// disk nor a reader that has gone away may end a motion, or change the exit code that names its
/// fault.
pub fn print_message(text: &str) {
    let _ = writeln!(std::io::stderr(), "{}", printable(text.trim_end()));
}

fn escaped(text: &str, is_hidden: impl Fn(char) -> bool) -> Cow<'_, str> {
    if !text.contains(&is_hidden) {
        return Cow::Borrowed(text);
    }
    let mut whole = String::with_capacity(text.len() + 16);
    for letter in text.chars() {
        if is_hidden(letter) {
            whole.extend(letter.escape_default());
        } else {
            whole.push(letter);
        }
    }
    Cow::Owned(whole)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A text with ESC, CSI in one and in two characters, OSC, a bell, a backspace, DEL, bidi
    /// overrides and isolates, a line separator, and a tag.
    const HOSTILE: &str = "a\u{1b}[2Jb\u{9b}31mc\u{1b}]0;title\u{7}d\u{8}e\u{7f}f\u{202e}g\u{2066}h\
                           \u{2028}i\u{e0041}j\r";

    #[test]
    fn nothing_that_a_terminal_obeys_is_left() {
        for text in [printable(HOSTILE), one_line(HOSTILE), printable_json(HOSTILE)] {
            assert!(!text.contains(is_obeyed), "{text:?}");
            for letter in 'a'..='j' {
                assert!(text.contains(letter), "{letter} is missing in {text:?}");
            }
        }
        assert!(printable(HOSTILE).contains("\\u{1b}[2J"));
    }

    #[test]
    fn long_numbers_become_short_and_others_stay() {
        let message = format!("c.toml, line 2: safety_box.theta = {}: give at most 2.3.", 1e300);
        let short = "c.toml, line 2: safety_box.theta = 1e300: give at most 2.3.";
        assert_eq!(with_short_numbers(&message), short);
        assert_eq!(with_short_numbers(&format!("{}", -1.5e-30)), "-1.5e-30");
        for whole in ["seed 18446744073709551615", "1.2.3", "651164fd8ff6016e", "a. b"] {
            assert_eq!(with_short_numbers(whole), whole);
        }
    }

    #[test]
    fn line_ends_stay_in_tables_and_are_escaped_in_a_sentence() {
        assert_eq!(printable("one\n\ttwo"), "one\n\ttwo");
        assert_eq!(one_line("name\nrollout 0: success"), "name\\nrollout 0: success");
        assert_eq!(printable("θ̇ 20 °"), "θ̇ 20 °");
    }

    #[test]
    fn escaped_json_has_the_same_value() {
        let line = serde_json::to_string(&HOSTILE).unwrap();
        let shown = printable_json(&line);
        assert!(!shown.contains(is_obeyed), "{shown:?}");
        assert_eq!(serde_json::from_str::<String>(&shown).unwrap(), HOSTILE);
    }
}
