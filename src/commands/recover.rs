use std::io;
use std::path::{Path, PathBuf};

use serde_json::json;

use super::exit::Failure;
use super::failures;
use super::output::Output;
use super::printable::one_line;
use super::replay::recording_failure;
use crate::recording::{RecordingError, Recovered, recover};
use crate::storage::MachineDisk;

/// Recover a truncated recording: save every intact tick into a new file
///
/// The old file stays unchanged. Exit code 0 when nothing of the rollout is lost, 3 when a part is
/// lost.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    qube-hil recover logs/monday/rollout-3.mcap\n  \
    qube-hil recover rollout-3.mcap --out saved.mcap; qube-hil replay saved.mcap")]
pub struct Arguments {
    /// Truncated or damaged recording
    #[arg(value_name = "FILE")]
    file: PathBuf,

    /// New file, which must not exist yet [default: FILE with the ending `.recovered.mcap` in place
    /// of its own]
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
}

/// Saves the intact part of a damaged recording in a new file, and reports the losses.
pub fn run(arguments: &Arguments, output: &Output) -> Result<(), Failure> {
    let out = arguments.out.clone().unwrap_or_else(|| recovered_name(&arguments.file));
    let recovered =
        recover(&MachineDisk, &arguments.file, &out).map_err(|error| match error {
            RecordingError::DiskFull { path } => Failure::failed(format!(
                "{}: the disk is full, and nothing was kept there. Make room, or name a file on another disk with --out",
                path.display()
            )),
            RecordingError::Create { path, source }
                if source.kind() == io::ErrorKind::AlreadyExists =>
            {
                Failure::usage(format!(
                    "{}: the file exists already and is kept. Name another one with --out",
                    path.display()
                ))
            }
            error => recording_failure(&error),
        })?;
    let path = arguments.file.display().to_string();
    let path = one_line(&path);
    match recovered {
        Recovered::WasWhole { loss } => {
            output.print(
                &format!("every byte of {path} can be read; nothing was written"),
                &json!({ "path": arguments.file.to_string_lossy(), "was_whole": true, "recovered": null }),
            );
            loss.map_or(Ok(()), |loss| Err(failures::incomplete(&arguments.file, &loss)))
        }
        Recovered::Saved {
            ticks,
            missing_ticks,
            missing_steps_at_end,
            lost_bytes,
            has_outcome,
            has_policy,
        } => {
            output.print(
                &format!("{}: {ticks} ticks saved", one_line(&out.display().to_string())),
                &json!({
                    "path": arguments.file.to_string_lossy(),
                    "was_whole": false,
                    "recovered": out.to_string_lossy(),
                    "ticks": ticks,
                    "missing_ticks": missing_ticks,
                    "missing_steps_at_end": missing_steps_at_end,
                    "lost_bytes": lost_bytes,
                    "has_outcome": has_outcome,
                    "has_policy": has_policy,
                }),
            );
            let misses_ticks = missing_ticks > 0 || missing_steps_at_end > 0;
            if lost_bytes == 0 && !misses_ticks && has_outcome && has_policy {
                return Ok(());
            }
            let at_end = match missing_steps_at_end {
                0 => String::new(),
                steps => format!(" and {steps} steps of the policy after it"),
            };
            let outcome = if has_outcome { "is" } else { "is not" };
            let policy = if has_policy {
                ""
            } else {
                "; its policy is lost, so that `replay` cannot run it again, and other commands can use the ticks"
            };
            Err(Failure::data_lost(format!(
                "{path}: {lost_bytes} bytes could not be saved; {missing_ticks} ticks are missing before the last one{at_end}; \
                 how the rollout ended {outcome} known{policy}"
            )))
        }
    }
}

fn recovered_name(file: &Path) -> PathBuf {
    file.with_extension("recovered.mcap")
}
