use std::path::PathBuf;

use clap::Subcommand;
use serde_json::json;
use toml::Value;

use super::exit::Failure;
use super::output::Output;
use super::session::SessionPreset;
use crate::qube::PlantModel;
use crate::session::{IdentificationSettings, SessionSettings};

/// Explain the settings of a session, or check a file of them
///
/// `print` writes every setting with its default, unit, accepted values and meaning, as a file for
/// `session --config`. A line that begins with # and no space is a setting that is absent by
/// default. `check` reads files as `session --config` does: an error names line and key; for a
/// valid file, the settings that it changes are listed.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    qube-hil config print > mine.toml          # every setting, to edit\n  \
    qube-hil config check mine.toml            # before hours of work\n  \
    qube-hil session --config mine.toml")]
pub struct Arguments {
    #[command(subcommand)]
    action: Action,
}

#[derive(Debug, Subcommand)]
enum Action {
    /// Print every setting with default, unit, accepted values and meaning
    Print {
        /// Preset whose settings are printed as the defaults
        #[arg(long, value_enum, default_value_t = SessionPreset::Quick)]
        preset: SessionPreset,
    },
    /// Check files of settings; exit code 2 and the line of the first error if one is invalid
    Check {
        /// Files of settings (.toml)
        #[arg(required = true, value_name = "FILE")]
        files: Vec<PathBuf>,

        /// Preset whose settings the files override
        #[arg(long, value_enum, default_value_t = SessionPreset::Quick)]
        preset: SessionPreset,
    },
}

/// The effect of a file of settings without the table `[identification]`, where `config print` shows
/// this table for the preset.
pub const WITHOUT_IDENTIFICATION: &str = "without the table [identification] the method is bayrn, a search that does not identify the Qube";

const HEAD: &str = "\
# The settings of a session, each with its meaning, unit and accepted values. Keep only the lines that you change:
# all other settings come from the preset. There are three exceptions. A list such as [[psi]] replaces the preset's
# list. [profile] has to be whole, because it describes one identified Qube. Without the table [identification] the
# default method is bayrn, a search that does not identify the Qube. A line that begins with # and no space shows a
# setting that is absent by default, with an example of its value.
# A plant other than the Qube is described in a file of its own (--plant).";

/// Prints the settings or checks files of them.
pub fn run(arguments: &Arguments, output: &Output) -> Result<(), Failure> {
    match &arguments.action {
        Action::Print { preset } => print(*preset, output),
        Action::Check { files, preset } => check(files, *preset, output),
    }
}

/// Returns the settings that `print` shows: the preset's, and for `quick` also the table
/// `[identification]`, because a session without arguments identifies its Qube.
fn printed(preset: SessionPreset) -> SessionSettings {
    let identification = match preset {
        SessionPreset::Quick => Some(IdentificationSettings::DEFAULT),
        SessionPreset::Thesis => None,
    };
    SessionSettings { identification, ..preset.settings(&PlantModel::QUBE, None) }
}

fn print(preset: SessionPreset, output: &Output) -> Result<(), Failure> {
    let settings = printed(preset);
    let list = settings.list().map_err(Failure::failed)?;
    let rows: Vec<_> = list
        .iter()
        .map(|setting| {
            json!({
                "key": setting.key,
                "default": setting.default,
                "unit": (!setting.unit.is_empty()).then_some(setting.unit),
                "range": setting.range,
                "meaning": setting.meaning,
            })
        })
        .collect();
    let text = settings.explained().map_err(Failure::failed)?;
    output.print(&format!("{HEAD}\n\n{text}"), &json!({ "settings": rows }));
    Ok(())
}

fn check(files: &[PathBuf], preset: SessionPreset, output: &Output) -> Result<(), Failure> {
    let (mut texts, mut rows) = (Vec::new(), Vec::new());
    for file in files {
        let settings =
            preset.settings(&PlantModel::QUBE, None).configured_by(file).map_err(Failure::usage)?;
        let mut defaults = printed(preset);
        // A file without the table [identification] selects another method. That is one change, so
        // the settings in the table do not count as changed.
        let leaves_out = defaults.identification.is_some() && settings.identification.is_none();
        if leaves_out {
            defaults.identification = None;
        }
        let changes = settings.differences(&defaults).map_err(Failure::failed)?;
        let shown = file.display().to_string();
        let mut text = match changes.len() {
            0 => format!("{shown}: valid; it changes nothing"),
            1 => format!("{shown}: valid; it changes one setting"),
            many => format!("{shown}: valid; it changes {many} settings"),
        };
        for change in &changes {
            let [value, default] = [&change.value, &change.default].map(value_text);
            text += &format!("\n  {} = {value} (default {default})", change.key);
        }
        if leaves_out {
            text += &format!("\n  {WITHOUT_IDENTIFICATION}");
        }
        texts.push(text);
        let method = if settings.identification.is_some() { "identified" } else { "bayrn" };
        let changes: Vec<_> = changes
            .into_iter()
            .map(|it| json!({ "key": it.key, "value": it.value, "default": it.default }))
            .collect();
        rows.push(json!({ "file": shown, "method": method, "changes": changes }));
    }
    output.print(&texts.join("\n"), &json!({ "files": rows }));
    Ok(())
}

fn value_text(value: &Option<Value>) -> String {
    match value {
        None => "absent".into(),
        Some(Value::Array(entries)) => format!("a list of {}", entries.len()),
        Some(value) => value.to_string(),
    }
}
