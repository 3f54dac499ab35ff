//! Questions to the operator, each answered by a whole line.

use rustix::io::Errno;

use super::printable::print_message;
use super::stop::Stop;
use super::terminal;

/// Asks a question and returns the line that was typed after it, without its end; `None` if a stop
/// was requested, or if the input has ended or cannot be read. Keys that were typed before the
/// question are discarded.
pub fn ask(question: &str, stop: &Stop) -> Option<String> {
    terminal::discard_typed_keys();
    print_message(&format!("\n{question}"));
    let mut line = Vec::new();
    while !stop.requested() {
        if !terminal::wait_for_input(None) {
            continue;
        }
        // The bytes are read one by one, so that the rest of a pipe is left for the next question.
        let mut byte = [0];
        match terminal::read_input(&mut byte) {
            Ok(0) if line.is_empty() => return None,
            Ok(1) if byte[0] != b'\n' => line.push(byte[0]),
            Ok(_) => return Some(String::from_utf8_lossy(&line).into_owned()),
            Err(Errno::INTR | Errno::AGAIN) => {}
            Err(_) => return None,
        }
    }
    None
}

/// Asks a question whose answer begins with `y` or `n`, in either case, and repeats it after any
/// other answer. An empty answer counts as `at_enter`, if there is such a value. Returns `None` in
/// the same cases as [`ask`].
pub fn ask_choice<T>(
    question: &str,
    stop: &Stop,
    (yes, no): (T, T),
    at_enter: Option<T>,
) -> Option<T> {
    loop {
        let answer = ask(question, stop)?;
        match (answer.trim().chars().next(), at_enter.is_some()) {
            (Some('y' | 'Y'), _) => return Some(yes),
            (Some('n' | 'N'), _) => return Some(no),
            (None, true) => return at_enter,
            _ => {}
        }
    }
}
