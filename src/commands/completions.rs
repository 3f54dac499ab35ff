use clap_complete::{Shell, generate};
use serde_json::json;

use super::command_line::command;
use super::exit::Failure;
use super::output::Output;

/// Print the completions of commands and options for a shell
///
/// The packages for Debian and Ubuntu install them.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    source <(qube-hil completions bash)                  # in this shell\n  \
    qube-hil completions fish > ~/.config/fish/completions/qube-hil.fish")]
pub struct Arguments {
    /// Shell that reads the completions
    shell: Shell,
}

/// Prints the completion script.
pub fn run(arguments: &Arguments, output: &Output) -> Result<(), Failure> {
    let mut script = Vec::new();
    generate(arguments.shell, &mut command(), "qube-hil", &mut script);
    let script = String::from_utf8_lossy(&script);
    output.print(&script, &json!({ "script": script }));
    Ok(())
}
