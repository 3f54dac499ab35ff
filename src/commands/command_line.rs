//! Parses the command line. Errors about the value of an option name the option.

use std::error::Error;
use std::ffi::OsString;
use std::io::ErrorKind as InputOutput;
use std::num::{IntErrorKind, ParseIntError};

use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::{Command, CommandFactory, FromArgMatches};

use super::CommandLine;
use super::exit::Failure;
use super::output::Output;
use super::printable::print_message;

/// Parses these arguments, of which the first is the program's name. If the result is an error, the
/// help or the version, it is printed, and the exit code is returned as `Err`.
pub fn read(arguments: Vec<OsString>) -> Result<CommandLine, u8> {
    let error = match parsed(&arguments) {
        Ok(command_line) => return Ok(command_line),
        Err(error) => error,
    };
    if !error.use_stderr() {
        return Err(print_help(&error));
    }
    // If stderr is closed, the error cannot be shown.
    let _ = error.print();
    let cause = cause_of(&error);
    let output = Output::new(arguments.iter().any(|argument| argument == "--json"));
    let _ = output.finish(Err(Failure::usage(cause)));
    Err(2)
}

/// Parses the arguments; an error has the text and the usage that help most.
fn parsed(arguments: &[OsString]) -> Result<CommandLine, clap::Error> {
    let mut command = command();
    let matches = command.try_get_matches_from_mut(arguments);
    let read = matches.and_then(|matches| CommandLine::from_arg_matches(&matches));
    read.map_err(|error| {
        let better =
            value_with_a_dash(&error, arguments).or_else(|| not_a_whole_number(&error, arguments));
        let (kind, message) = match (better, kept_when_resumed(&error, arguments)) {
            (Some(message), _) => (ErrorKind::InvalidValue, message),
            (None, Some(message)) => (ErrorKind::ArgumentConflict, message),
            (None, None) => return error,
        };
        named(command, arguments).error(kind, message)
    })
}

/// Returns the subcommand that the arguments name, whose usage an error then shows.
fn named(command: Command, arguments: &[OsString]) -> Command {
    arguments.iter().skip(1).fold(command, |command, argument| {
        command.find_subcommand(argument).cloned().unwrap_or(command)
    })
}

/// Prints the help or the version, which clap reports as an error; returns the exit code.
fn print_help(help: &clap::Error) -> u8 {
    match help.print() {
        // A broken pipe is no error: the reader has closed it on purpose.
        Err(error) if error.kind() != InputOutput::BrokenPipe => {
            print_message(&format!("error: the help could not be printed: {error}"));
            1
        }
        _ => 0,
    }
}

/// Returns the first paragraph of an error, which describes the mistake, on one line.
pub fn cause_of(error: &clap::Error) -> String {
    let message = error.to_string();
    // Missing arguments are listed below the first line.
    let lines: Vec<&str> =
        message.lines().map(str::trim).take_while(|line| !line.is_empty()).collect();
    lines.join(" ").trim_start_matches("error: ").to_owned()
}

/// Returns the program's commands. A negative number counts as a value, because no option is a
/// digit.
pub fn command() -> Command {
    CommandLine::command().mut_subcommands(|command| {
        command.mut_args(|argument| {
            let takes_values = argument.get_action().takes_values();
            if takes_values { argument.allow_negative_numbers(true) } else { argument }
        })
    })
}

/// Returns the explanation for a value that was taken for an option because it begins with a dash;
/// `None` for other errors.
fn value_with_a_dash(error: &clap::Error, arguments: &[OsString]) -> Option<String> {
    let Some(ContextValue::String(unknown)) = error.get(ContextKind::InvalidArg) else {
        return None;
    };
    if error.kind() != ErrorKind::UnknownArgument {
        return None;
    }
    let texts: Vec<_> = arguments.iter().map(|argument| argument.to_string_lossy()).collect();
    let place = texts.iter().position(|text| text.starts_with(unknown.as_str()))?;
    let option = texts.get(place.checked_sub(1)?)?;
    let command = command();
    let command = texts.iter().find_map(|text| command.find_subcommand(text.as_ref()))?;
    let is_it = |name: &str| option.strip_prefix("--") == Some(name);
    let mut options = command.get_arguments().filter(|option| option.get_action().takes_values());
    options.any(|option| option.get_long().is_some_and(is_it)).then(|| {
        let value = &texts[place];
        format!(
            "{option}: a value that begins with '-' is taken for an option: write {option}={value}"
        )
    })
}

/// Returns the explanation for an option beside `--resume` that resumed work does not take; `None`
/// for other errors.
fn kept_when_resumed(error: &clap::Error, arguments: &[OsString]) -> Option<String> {
    let names_resume = |kind| match error.get(kind) {
        Some(ContextValue::String(name)) => name.starts_with("--resume"),
        Some(ContextValue::Strings(names)) => names.iter().any(|it| it.starts_with("--resume")),
        _ => false,
    };
    let is_conflict = error.kind() == ErrorKind::ArgumentConflict
        && (names_resume(ContextKind::InvalidArg) || names_resume(ContextKind::PriorArg));
    if !is_conflict {
        return None;
    }
    let advice = match arguments.get(1)?.to_str()? {
        "session" => "a session keeps its settings; begin a new one with --config",
        "experiment" => "an experiment keeps its settings; begin a new one with --out",
        _ => return None,
    };
    Some(format!("{}: {advice}", cause_of(error)))
}

/// Returns the explanation for a value that is not digits where a whole number is expected; `None`
/// for other errors.
fn not_a_whole_number(error: &clap::Error, arguments: &[OsString]) -> Option<String> {
    let cause: &ParseIntError = error.source()?.downcast_ref()?;
    let option = error.get(ContextKind::InvalidArg)?;
    let ContextValue::String(value) = error.get(ContextKind::InvalidValue)? else { return None };
    if *cause.kind() != IntErrorKind::InvalidDigit {
        return None;
    }
    // The range of clap's parser is not known here, so the command line is tried with 0 in place of
    // the value.
    let with_0 = arguments.iter().map(|argument| {
        let text = argument.to_string_lossy();
        match text.strip_suffix(value.as_str()) {
            Some(option) if option.is_empty() || option.ends_with('=') => format!("{option}0"),
            _ => text.into_owned(),
        }
    });
    let is_refused = command().try_get_matches_from(with_0).is_err_and(|error| {
        error.kind() == ErrorKind::ValueValidation
            && error.get(ContextKind::InvalidArg) == Some(option)
    });
    let bound = if is_refused { "above 0" } else { "that is not below 0" };
    Some(format!("invalid value '{value}' for '{option}': give a whole number {bound}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_commands_are_put_together_without_a_contradiction() {
        command().debug_assert();
    }

    #[test]
    fn a_refused_value_is_followed_by_the_usage_of_its_own_command() {
        let cases: [(&[&str], &str); 6] = [
            (&["session", "--seed", "-1"], "session"),
            (&["--json", "run", "--policy", "classical", "--seed", "1.5"], "run"),
            (&["session", "--out", "-foo"], "session"),
            (&["session", "--resume", "a", "--seed", "1"], "session"),
            (&["run", "--json", "--bogus"], "run"),
            (&["config", "print", "--bogus"], "config print"),
        ];
        for (arguments, command) in cases {
            let arguments: Vec<OsString> =
                ["qube-hil"].iter().chain(arguments).map(OsString::from).collect();
            let message = parsed(&arguments).unwrap_err().to_string();
            assert!(message.contains(&format!("Usage: qube-hil {command} ")), "{message}");
        }
    }
}
