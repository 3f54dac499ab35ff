use std::path::PathBuf;

use clap_mangen::Man;
use serde_json::json;

use super::command_line::command;
use super::destination::OutputFolder;
use super::exit::Failure;
use super::failures;
use super::output::Output;
use crate::storage::{MachineDisk, write_whole};

/// Write the manual pages: one for the program and one for each command
///
/// The packages for Debian and Ubuntu install them: man qube-hil, man qube-hil-session.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    qube-hil manual --out man && man -l man/qube-hil-run.1")]
pub struct Arguments {
    /// Folder for the pages; created if it does not exist. Pages of the same name are replaced
    #[arg(long, value_name = "DIR", default_value = "man")]
    out: PathBuf,
}

/// Writes the pages.
pub fn run(arguments: &Arguments, output: &Output) -> Result<(), Failure> {
    let folder = &arguments.out;
    let place = OutputFolder::of_option("--out", folder)?;
    let mut whole = command().disable_help_subcommand(true);
    whole.build();
    let mut found = Vec::new();
    add_pages(&whole, &mut found);
    let mut files = Vec::new();
    for (name, page) in &found {
        let path = place.path().join(name);
        write_whole(&MachineDisk, &path, page).map_err(|error| failures::folder(&error.into()))?;
        files.push(path.display().to_string());
    }
    let text = format!("{} manual pages in {}", files.len(), folder.display());
    output.print(&text, &json!({ "files": files }));
    Ok(())
}

/// Adds the pages of a command's subcommands and then the command's own page to `found`, each with
/// the name of its file.
fn add_pages(command: &clap::Command, found: &mut Vec<(String, Vec<u8>)>) {
    for below in command.get_subcommands().filter(|below| !below.is_hide_set()) {
        add_pages(below, found);
    }
    let name = command.get_display_name().unwrap_or_else(|| command.get_name()).to_owned();
    let page = Man::new(command.clone());
    let file = page.get_filename();
    let mut bytes = Vec::new();
    // Writing into memory cannot fail.
    if page.render(&mut bytes).is_ok() {
        debug_assert!(file.starts_with(&name), "{file}");
        found.push((file, bytes));
    }
}
