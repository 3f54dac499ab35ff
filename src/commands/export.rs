use std::ffi::OsString;
use std::path::{Path, PathBuf};

use clap::ValueEnum;
use clap::builder::{OsStringValueParser, TypedValueParser};
use serde_json::json;

use super::destination::{OutputFile, OutputFolder};
use super::exit::Failure;
use super::failures;
use super::onnx_model::onnx_model;
use super::output::Output;
use super::parquet_table::parquet_table;
use super::replay::recording_failure;
use crate::identification::duplicate;
use crate::recording::{Recording, csv_table, read};
use crate::storage::Existing;

/// Write recordings as tables (CSV or Parquet), or policies as ONNX models
///
/// A table has one row for each tick, in numbers that read back exactly; docs/reference/files.md
/// lists the columns. The estimated state and the voltage have the column names that `identify` and
/// `replay --simulate` read. Exit code 3 when a recording was truncated: the table then has its
/// intact ticks. A model has the network from the observation to the voltage, and its metadata
/// describe the computations before and after the network; `import` gives the same policy again.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    qube-hil export logs/monday/candidates/002/*.mcap --out tables\n  \
    qube-hil export rollout-0.mcap                 # writes rollout-0.csv\n  \
    qube-hil export --format parquet logs/monday/candidates/*/*.mcap\n  \
    qube-hil export --onnx policies/robust.safetensors --out models")]
pub struct Arguments {
    /// Recordings (.mcap), or with --onnx policies (.safetensors)
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,

    /// Folder for the tables or models; created if it does not exist [default: beside each file]
    #[arg(long, value_name = "DIR", value_parser = OsStringValueParser::new().try_map(folder))]
    out: Option<PathBuf>,

    /// Format of the tables: both have the same columns and numbers
    #[arg(long, value_enum, default_value_t = Format::Csv)]
    format: Format,

    /// The files are policies that are networks; write each as an ONNX model
    #[arg(long, conflicts_with = "format")]
    onnx: bool,

    /// Replace tables or models that exist
    #[arg(long)]
    force: bool,
}

/// Parses the folder of `--out`; refuses the name of a table, a likely mistake.
fn folder(name: OsString) -> Result<PathBuf, String> {
    let extension = Path::new(&name).extension().and_then(|it| it.to_str());
    match extension.map(str::to_ascii_lowercase).as_deref() {
        Some(format @ ("csv" | "parquet")) => Err(format!(
            "--out names a folder, in which each table has its recording's name: give a folder, and --format {format}"
        )),
        _ => Ok(name.into()),
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

    /// Returns the contents of a recording's table in this format.
    fn table(self, recording: &Recording) -> Result<Vec<u8>, Failure> {
        match self {
            Self::Csv => Ok(csv_table(recording).into_bytes()),
            Self::Parquet => parquet_table(recording).map_err(Failure::failed),
        }
    }
}

/// Writes a table for each recording, or a model for each policy, if every file can be exported.
pub fn run(arguments: &Arguments, output: &Output) -> Result<(), Failure> {
    let Arguments { files, out, format, onnx, .. } = arguments;
    let extension = if *onnx { "onnx" } else { format.extension() };
    let written: Vec<PathBuf> =
        files.iter().map(|file| written_of(file, out.as_deref(), extension)).collect();
    if let Some(file) = duplicate(files) {
        let file = file.display();
        return Err(Failure::usage(format!("{file} is named twice: name each file once")));
    }
    for (index, place) in written.iter().enumerate() {
        if written[..index].contains(place) {
            return Err(Failure::usage(format!(
                "two files would become {}: leave --out out, or name the files of one folder",
                place.display()
            )));
        }
    }
    let asked = out.as_deref().map(|folder| OutputFolder::of_option("--out", folder));
    let _folder = asked.transpose()?;
    if *onnx {
        write_models(arguments, &written, output)
    } else {
        write_tables(arguments, &written, output)
    }
}

fn write_models(arguments: &Arguments, models: &[PathBuf], output: &Output) -> Result<(), Failure> {
    let places = places(models, arguments.force)?;
    let contents: Vec<Vec<u8>> =
        arguments.files.iter().map(|file| onnx_model(file)).collect::<Result<_, _>>()?;
    for (place, content) in places.iter().zip(&contents) {
        place.write(content)?;
    }
    let shown = shown(models);
    output.print(&shown.join("\n"), &json!({ "models": shown }));
    Ok(())
}

fn write_tables(arguments: &Arguments, tables: &[PathBuf], output: &Output) -> Result<(), Failure> {
    let read = |file: &PathBuf| read(file).map_err(|error| recording_failure(&error));
    let places = places(tables, arguments.force)?;
    // Each recording is read once more when its table is written, because all of them at once may
    // need much memory.
    for file in &arguments.files {
        read(file)?;
    }
    let (mut ticks, mut lost) = (0, None);
    for (file, place) in arguments.files.iter().zip(&places) {
        let recording = read(file)?;
        place.write(&arguments.format.table(&recording)?)?;
        ticks += recording.ticks.len();
        if let (Some(loss), None) = (recording.loss(), &lost) {
            lost = Some(failures::incomplete(file, &loss));
        }
    }
    let shown = shown(tables);
    let text = format!("{} with {ticks} ticks in all", shown.join("\n"));
    output.print(&text, &json!({ "tables": shown, "ticks": ticks }));
    lost.map_or(Ok(()), Err)
}

/// Returns the files of tables or models, in their order, as [`place`] checks them.
fn places(paths: &[PathBuf], force: bool) -> Result<Vec<OutputFile>, Failure> {
    paths.iter().map(|path| place(path, force)).collect()
}

/// Returns the file of a table or model. An existing one is refused unless `force` is set.
fn place(path: &Path, force: bool) -> Result<OutputFile, Failure> {
    // The name follows from the name of the recording or policy, so the message advises no other
    // name.
    if !force && path.symlink_metadata().is_ok_and(|it| it.is_file() || it.is_symlink()) {
        return Err(Failure::usage(format!(
            "{} exists already: name another folder by --out, or replace it with --force",
            path.display()
        )));
    }
    OutputFile::prepare(path, Existing::replaced_if(force))
}

fn shown(paths: &[PathBuf]) -> Vec<String> {
    paths.iter().map(|path| path.display().to_string()).collect()
}

/// Returns the path of the table or model that is made from a file: in `folder`, or beside the
/// file.
fn written_of(file: &Path, folder: Option<&Path>, extension: &str) -> PathBuf {
    let written = file.with_extension(extension);
    match (folder, written.file_name()) {
        (Some(folder), Some(name)) => folder.join(name),
        _ => written,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_refusal_of_an_existing_table_begins_with_its_path_and_advises_another_folder() {
        let directory = tempfile::tempdir().unwrap();
        let table = directory.path().join("rollout-0.csv");
        std::fs::write(&table, "of another").unwrap();
        let failure = place(&table, false).unwrap_err();
        let cause = failure.cause();
        assert!(failure.is_usage() && cause.starts_with(table.to_str().unwrap()), "{cause}");
        assert!(cause.contains("another folder") && cause.contains("--force"), "{cause}");
        assert!(place(&table, true).is_ok());
    }

    #[test]
    fn the_name_of_a_table_is_no_folder() {
        for (name, format) in [("x.parquet", "--format parquet"), ("logs/x.CSV", "--format csv")] {
            let message = folder(name.into()).unwrap_err();
            assert!(message.contains(format), "{message}");
        }
        for name in ["tables", "logs/2.5", "../csv"] {
            assert_eq!(folder(name.into()).unwrap(), Path::new(name));
        }
    }
}
