//! Captures the lines that the program writes to stderr while the screen has the terminal.

use std::io::{self, BufRead, BufReader, Read};
use std::os::fd::OwnedFd;
use std::thread::{Builder, JoinHandle};

use rustix::io::fcntl_dupfd_cloexec;
use rustix::stdio::{dup2_stderr, stderr};

/// Longest line, bytes; a longer line is passed on in parts of at most this length.
const LONGEST_LINE: u64 = 4096;

/// A capture of stderr: until it is dropped, each line goes to a function.
#[derive(Debug)]
pub struct CapturedStderr {
    before: OwnedFd,
    reader: Option<JoinHandle<()>>,
}

impl CapturedStderr {
    /// Begins the capture; a thread passes each line to `take`.
    ///
    /// # Errors
    /// The pipe, the duplicate of stderr or the thread cannot be made.
    pub fn begin(mut take: impl FnMut(String) + Send + 'static) -> io::Result<Self> {
        let (lines, writer) = io::pipe()?;
        let before = fcntl_dupfd_cloexec(stderr(), 3)?;
        let reader = Builder::new().name("messages".into()).spawn(move || {
            let mut lines = BufReader::new(lines);
            let mut line = Vec::new();
            while let Ok(1..) = (&mut lines).take(LONGEST_LINE).read_until(b'\n', &mut line) {
                take(shown(&line));
                line.clear();
            }
        })?;
        dup2_stderr(&writer)?;
        Ok(Self { before, reader: Some(reader) })
    }
}

impl Drop for CapturedStderr {
    fn drop(&mut self) {
        // This closes the only writing end of the pipe, so the reader takes the rest and ends.
        if dup2_stderr(&self.before).is_ok()
            && let Some(reader) = self.reader.take()
        {
            let _ = reader.join();
        }
    }
}

/// Returns a line as text, without white space at its end and without the colours of log messages.
fn shown(line: &[u8]) -> String {
    let text = String::from_utf8_lossy(line);
    let mut plain = String::with_capacity(text.len());
    let mut letters = text.trim_end().chars();
    while let Some(letter) = letters.next() {
        if letter == '\u{1b}' {
            // A colour: ESC [ numbers m.
            for of_sequence in letters.by_ref() {
                if of_sequence.is_ascii_alphabetic() {
                    break;
                }
            }
        } else {
            plain.push(letter);
        }
    }
    plain
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_log_line_loses_its_colours_and_its_end() {
        assert_eq!(
            shown("\u{1b}[33m WARN\u{1b}[0m late by 3 ms\r\n".as_bytes()),
            " WARN late by 3 ms"
        );
        assert_eq!(shown(b"plain\n"), "plain");
        assert_eq!(shown(b"\x1b["), "");
    }
}
