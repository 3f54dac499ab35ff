//! The failure of a command, with its exit code. `failures` chooses the code for each error of the
//! library.

use serde_json::{Value, json};

use super::command_hints::after_fault;
use super::printable::{print_message, with_short_numbers};
use crate::telemetry::Fault;

/// The failure of a command: its exit code, and a sentence for the user.
#[derive(Debug)]
pub struct Failure {
    code: u8,
    message: String,
    /// Fault that caused the failure; `None` if the cause is not in the table of faults.
    fault: Option<Fault>,
}

impl Failure {
    /// Makes a failure with exit code 1: the attempt did not succeed (a failed check, a full disk).
    pub fn failed(message: impl ToString) -> Self {
        Self { code: 1, message: message.to_string(), fault: None }
    }

    /// Makes a failure with exit code 2: the request is invalid (bad usage, bad input, no such
    /// port).
    pub fn usage(message: impl ToString) -> Self {
        Self { code: 2, message: message.to_string(), fault: None }
    }

    /// Makes a failure with exit code 3: finished, but data was lost or a replay differs.
    pub fn data_lost(message: impl ToString) -> Self {
        Self { code: 3, message: message.to_string(), fault: None }
    }

    /// Makes a failure with exit code 4: stopped by a latched safety fault.
    /// [`caused_by`](Self::caused_by) adds the fault.
    pub fn fault(message: impl ToString) -> Self {
        Self { code: 4, message: message.to_string(), fault: None }
    }

    /// Makes a failure with exit code 128 + signal: stopped by a signal; finished work is on disk.
    pub fn interrupted(signal: i32, message: impl ToString) -> Self {
        let code = 128_u8.wrapping_add(signal as u8);
        Self { code, message: message.to_string(), fault: None }
    }

    /// Returns the failure of work that consists of several named parts, some of which failed;
    /// `None` if none failed. The exit code is the gravest part's: a fault, after which the motor
    /// may be on, comes before a stop by a signal, and a stop before all other failures, of which
    /// the largest code counts. The fault is the fault of the first part that has one.
    pub fn of_parts(parts: &[(String, Self)]) -> Option<Self> {
        let gravity = |code: &u8| (*code == 4, *code);
        let code = parts.iter().map(|(_, failure)| failure.code).max_by_key(gravity)?;
        let causes: Vec<String> =
            parts.iter().map(|(name, failure)| format!("{name}: {}", failure.message)).collect();
        let fault = parts.iter().find_map(|(_, failure)| failure.fault);
        Some(Self { code, message: causes.join("\n"), fault })
    }

    /// Sets the fault that caused the failure, and adds the command that helps after it, if there
    /// is one.
    pub fn caused_by(self, fault: Option<Fault>) -> Self {
        let failure = Self { fault, ..self };
        match fault.and_then(after_fault) {
            Some(hint) => failure.followed_by(hint),
            None => failure,
        }
    }

    /// Adds words before the message.
    pub fn preceded_by(self, before: &str) -> Self {
        Self { message: format!("{before} {}", self.message), ..self }
    }

    /// Adds a sentence after the message.
    pub fn followed_by(self, sentence: &str) -> Self {
        let message = format!("{}. {sentence}", self.message.trim_end_matches('.'));
        Self { message, ..self }
    }

    /// Returns the sentence for the user.
    pub fn cause(&self) -> &str {
        &self.message
    }

    /// Returns whether a signal, a key or the live view stopped the command.
    pub fn is_stop(&self) -> bool {
        self.code >= 128
    }

    /// Returns whether the request was invalid.
    pub fn is_usage(&self) -> bool {
        self.code == 2
    }

    /// Returns the failure as JSON for scripts: exit code, cause, and of a fault its operator's
    /// step and its consequence.
    pub fn ended_by(&self) -> Value {
        json!({
            "exit_code": self.code,
            "fault": self.fault,
            "cause": with_short_numbers(&self.message),
            "operator_step": self.fault.map(Fault::operator_step),
            "consequence": self.fault.map(Fault::consequence),
        })
    }

    /// Prints the message on stderr and returns the exit code.
    pub fn report(&self) -> u8 {
        print_message(&format!("qube-hil: {}", with_short_numbers(&self.message)));
        self.code
    }
}

impl std::fmt::Display for Failure {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str(&with_short_numbers(&self.message))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fault_of_one_part_is_not_hidden_by_the_stop_of_another() {
        let parts = |failures: Vec<Failure>| -> Vec<(String, Failure)> {
            failures.into_iter().map(|failure| ("rig".to_owned(), failure)).collect()
        };
        let code = |failures| Failure::of_parts(&parts(failures)).map(|failure| failure.code);
        let stopped = || Failure::interrupted(2, "stopped");
        assert_eq!(code(vec![stopped(), Failure::fault("the motor may be on")]), Some(4));
        assert_eq!(code(vec![Failure::failed("a"), stopped(), Failure::data_lost("b")]), Some(130));
        assert_eq!(code(vec![Failure::failed("a"), Failure::data_lost("b")]), Some(3));
        assert_eq!(code(Vec::new()), None);
    }
}
