use std::path::{Path, PathBuf};

use clap::ValueEnum;
use serde_json::json;

use super::destination::OutputFile;
use super::exit::Failure;
use super::failures;
use super::output::Output;
use super::parquet_table::parquet_table;
use super::replay::recording_failure;
use crate::recording::{Completeness, Recording, csv_table, read};
use crate::storage::{Disk, MachineDisk};

/// Write recordings as tables (CSV or Parquet): one row for each tick, in numbers that read back exactly
///
/// docs/reference/files.md lists the columns. The estimated state and the voltage have the names that `identify` and
/// `replay --simulate` read. Exit code 3 when a recording was truncated: the table then has its intact ticks.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    qube-hil export logs/monday/candidates/002/*.mcap --out tables\n  \
    qube-hil export rollout-0.mcap                 # writes rollout-0.csv\n  \
    qube-hil export --format parquet logs/monday/candidates/*/*.mcap")]
pub struct Arguments {
    /// Recordings (.mcap)
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,

    /// Folder for the tables; created if it does not exist [default: beside each recording]
    #[arg(long, value_name = "DIR", value_parser = folder)]
    out: Option<PathBuf>,

    /// Format of the tables: both have the same columns and numbers
    #[arg(long, value_enum, default_value_t = Format::Csv)]
    format: Format,

    /// Replace tables that exist
    #[arg(long)]
    force: bool,
}

/// Parses the folder: the name of a table is a mistake.
fn folder(text: &str) -> Result<PathBuf, String> {
    let extension = Path::new(text).extension().and_then(|it| it.to_str());
    match extension.map(str::to_ascii_lowercase).as_deref() {
        Some(format @ ("csv" | "parquet")) => Err(format!(
            "it is a folder, and each table has its recording's name in it: give the folder, and --format {format}"
        )),
        _ => Ok(text.into()),
    }
}

/// The formats of tables.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Format {
    /// Text with commas, which spreadsheets read
    Csv,
    /// Typed columns, which pandas, Polars and DuckDB read
    Parquet,
}

impl Format {
    fn extension(self) -> &'static str {
        match self {
            Self::Csv => "csv",
            Self::Parquet => "parquet",
        }
    }

    /// The bytes of a recording's table.
    fn table(self, recording: &Recording) -> Result<Vec<u8>, Failure> {
        match self {
            Self::Csv => Ok(csv_table(recording).into_bytes()),
            Self::Parquet => parquet_table(recording).map_err(Failure::failed),
        }
    }
}

/// Writes a table for each recording.
pub fn run(arguments: &Arguments, output: &Output) -> Result<(), Failure> {
    let Arguments { files, out, format, .. } = arguments;
    let tables: Vec<PathBuf> =
        files.iter().map(|file| table_of(file, out.as_deref(), *format)).collect();
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
        place.write(&format.table(&recording)?)?;
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
fn table_of(file: &Path, folder: Option<&Path>, format: Format) -> PathBuf {
    let table = file.with_extension(format.extension());
    match (folder, table.file_name()) {
        (Some(folder), Some(name)) => folder.join(name),
        _ => table,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_name_of_a_table_is_no_folder() {
        for (name, format) in [("x.parquet", "--format parquet"), ("logs/x.CSV", "--format csv")] {
            let told = folder(name).unwrap_err();
            assert!(told.contains(format), "{told}");
        }
        for name in ["tables", "logs/2.5", "../csv"] {
            assert_eq!(folder(name).unwrap(), Path::new(name));
        }
    }
}
