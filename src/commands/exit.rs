//! The one place where outcomes become exit codes.

use std::process::ExitCode;

use serde_json::{Value, json};

use super::printable::{tell, with_short_numbers};
use crate::telemetry::Fault;

/// Why a command did not end well: its exit code, and one sentence for the user.
#[derive(Debug)]
pub struct Failure {
    code: u8,
    message: String,
    /// The fault of the table that it was, where it was one.
    fault: Option<Fault>,
}

impl Failure {
    /// 1: it was tried and did not succeed (a check that did not pass, a full disk).
    pub fn failed(message: impl ToString) -> Self {
        Self { code: 1, message: message.to_string(), fault: None }
    }

    /// 2: what was asked for cannot be done as asked (bad usage, bad input, no such port).
    pub fn usage(message: impl ToString) -> Self {
        Self { code: 2, message: message.to_string(), fault: None }
    }

    /// 3: finished, but data was lost or a replay differs.
    pub fn data_lost(message: impl ToString) -> Self {
        Self { code: 3, message: message.to_string(), fault: None }
    }

    /// 4: stopped by a latched safety fault.
    pub fn fault(message: impl ToString) -> Self {
        Self { code: 4, message: message.to_string(), fault: None }
    }

    /// 128 + signal: stopped by a signal, with the state kept.
    pub fn interrupted(signal: i32, message: impl ToString) -> Self {
        let code = 128_u8.wrapping_add(signal as u8);
        Self { code, message: message.to_string(), fault: None }
    }

    /// The same failure, with the fault that it was.
    pub fn of(self, fault: Option<Fault>) -> Self {
        Self { fault, ..self }
    }

    /// The same failure, told behind what came before it.
    pub fn after(self, before: &str) -> Self {
        Self { message: format!("{before} {}", self.message), ..self }
    }

    /// The same failure, with a sentence more.
    pub fn followed_by(self, sentence: &str) -> Self {
        let message = format!("{}. {sentence}", self.message.trim_end_matches('.'));
        Self { message, ..self }
    }

    /// Whether what was asked for could not be done as asked.
    pub fn is_usage(&self) -> bool {
        self.code == 2
    }

    /// Why a run ended before its end, for scripts.
    pub fn ended_by(&self) -> Value {
        json!({
            "exit_code": self.code,
            "fault": self.fault,
            "cause": with_short_numbers(&self.message),
            "operator_step": self.fault.map(Fault::operator_step),
            "consequence": self.fault.map(Fault::consequence),
        })
    }

    /// Tells the user, and the exit code.
    pub fn report(&self) -> ExitCode {
        tell(&format!("qube-hil: {}", with_short_numbers(&self.message)));
        ExitCode::from(self.code)
    }
}
