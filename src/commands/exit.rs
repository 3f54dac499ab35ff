//! The one place where outcomes become exit codes.

use std::process::ExitCode;

use super::printable::tell;

/// Why a command did not end well: its exit code, and one sentence for the user.
#[derive(Debug)]
pub struct Failure {
    code: u8,
    message: String,
}

impl Failure {
    /// 1: it was tried and did not succeed (a check that did not pass, a full disk).
    pub fn failed(message: impl ToString) -> Self {
        Self { code: 1, message: message.to_string() }
    }

    /// 2: what was asked for cannot be done as asked (bad usage, bad input, no such port).
    pub fn usage(message: impl ToString) -> Self {
        Self { code: 2, message: message.to_string() }
    }

    /// 3: finished, but data was lost or a replay differs.
    pub fn data_lost(message: impl ToString) -> Self {
        Self { code: 3, message: message.to_string() }
    }

    /// 4: stopped by a latched safety fault.
    pub fn fault(message: impl ToString) -> Self {
        Self { code: 4, message: message.to_string() }
    }

    /// 128 + signal: stopped by a signal, with the state kept.
    pub fn interrupted(signal: i32, message: impl ToString) -> Self {
        Self { code: 128_u8.wrapping_add(signal as u8), message: message.to_string() }
    }

    /// Tells the user, and the exit code.
    pub fn report(&self) -> ExitCode {
        tell(&format!("qube-hil: {}", self.message));
        ExitCode::from(self.code)
    }
}
