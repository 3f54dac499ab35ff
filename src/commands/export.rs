use std::path::{Path, PathBuf};

use serde_json::json;

use super::destination::OutputFile;
use super::exit::Failure;
use super::failures;
use super::output::Output;
use super::replay::recording_failure;
use crate::recording::{Completeness, csv_table, read};
use crate::storage::{Disk, MachineDisk};

/// Write recordings as tables (CSV): one row for each tick, in numbers that read back exactly
///
/// docs/reference/files.md lists the columns. The estimated state and the voltage have the names that `identify` and
/// `replay --simulate` read. Exit code 3 when a recording was truncated: the table then has its intact ticks.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    qube-hil export logs/monday/candidates/002/*.mcap --out tables\n  \
    qube-hil export rollout-0.mcap                 # writes rollout-0.csv")]
pub struct Arguments {
    /// Recordings (.mcap)
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,

    /// Folder for the tables; created if it does not exist [default: beside each recording]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,

    /// Replace tables that exist
    #[arg(long)]
    force: bool,
}

/// Writes a table for each recording.
pub fn run(arguments: &Arguments, output: &Output) -> Result<(), Failure> {
    let tables: Vec<PathBuf> =
        arguments.files.iter().map(|file| table_of(file, arguments.out.as_deref())).collect();
    for (index, table) in tables.iter().enumerate() {
        if tables[..index].contains(table) {
            return Err(Failure::usage(format!(
                "two recordings would become {}: leave --out out, or name the recordings of one folder",
                table.display()
            )));
        }
    }
    if let Some(folder) = &arguments.out {
        MachineDisk.create_folder(folder).map_err(|error| failures::not_written(folder, &error))?;
    }
    let (mut ticks, mut lost) = (0, None);
    for (file, table) in arguments.files.iter().zip(&tables) {
        let place = OutputFile::prepare(table, arguments.force)?;
        let recording = read(file).map_err(|error| recording_failure(&error))?;
        place.write(csv_table(&recording).as_bytes())?;
        ticks += recording.ticks.len();
        if let Completeness::CutOff { lost_bytes, .. } = recording.completeness {
            lost.get_or_insert_with(|| {
                Failure::data_lost(format!(
                    "{} is cut off: {lost_bytes} bytes are lost",
                    file.display()
                ))
            });
        }
    }
    let shown: Vec<String> = tables.iter().map(|table| table.display().to_string()).collect();
    let text = format!("{} with {ticks} ticks in all", shown.join("\n"));
    output.print(&text, &json!({ "tables": shown, "ticks": ticks }));
    lost.map_or(Ok(()), Err)
}

/// The table of a recording.
fn table_of(file: &Path, folder: Option<&Path>) -> PathBuf {
    let table = file.with_extension("csv");
    match (folder, table.file_name()) {
        (Some(folder), Some(name)) => folder.join(name),
        _ => table,
    }
}
