use serde_json::json;

use super::check_table::{Row, table};
use super::exit::Failure;
use super::output::Output;
use super::printable::print_message;
use super::stop::Stop;
use crate::preflight::doctor::{Diagnosis, Suitability, diagnose};

/// Check this computer: real-time rights, ports, FTDI timers, the vendor's library, and timing
/// accuracy
///
/// Nothing is changed and nothing moves. Exit code 0 when all is well or there is only advice, 1
/// when something must be fixed first.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    qube-hil doctor\n  \
    qube-hil doctor --seconds 60 --device /dev/ttyUSB0")]
pub struct Arguments {
    /// Time for which the timer is watched, s
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..=3600))]
    seconds: u32,

    /// Port to check, or hil:CARD@ID for a Qube with the USB panel; may be repeated [default: all
    /// USB serial ports]
    #[arg(long, value_name = "PORT")]
    device: Vec<String>,
}

/// Performs the checks and prints the findings.
pub fn run(arguments: &Arguments, output: &Output) -> Result<(), Failure> {
    let stop = Stop::saying("stopping: the measurement ends")?;
    print_message(&format!("watching the timer for {} s", arguments.seconds));
    let found = diagnose(&arguments.device, arguments.seconds, &stop.flag)
        .map_err(|error| Failure::failed(format!("the timer cannot be watched: {error}")))?;
    if stop.requested() {
        return Err(stop.failure("stopped"));
    }
    let unfit: Vec<&str> = found
        .iter()
        .filter(|diagnosis| diagnosis.verdict == Suitability::Unfit)
        .map(|diagnosis| diagnosis.name.as_str())
        .collect();
    let advice = found.iter().filter(|diagnosis| diagnosis.verdict == Suitability::Advice).count();
    let summary = match (unfit.len(), advice) {
        (0, 0) => "all is well".to_owned(),
        (0, advice) => format!("ready; advice: {advice}"),
        (unfit, _) => format!("not ready: {unfit} must be fixed"),
    };
    let rows: Vec<Row> = found.iter().map(row).collect();
    let checks: Vec<_> = found
        .iter()
        .map(|diagnosis| {
            json!({
                "name": diagnosis.name,
                "pass": diagnosis.verdict != Suitability::Unfit,
                "verdict": diagnosis.verdict,
                "value": diagnosis.value,
                "cure": diagnosis.remedy,
            })
        })
        .collect();
    output.print(&format!("{}\n{summary}\n", table(&rows)), &json!({ "checks": checks }));
    if unfit.is_empty() {
        return Ok(());
    }
    Err(Failure::failed(format!("this computer is not ready yet: {}", unfit.join(", "))))
}

fn row(diagnosis: &Diagnosis) -> Row {
    let word = match diagnosis.verdict {
        Suitability::Well => "well",
        Suitability::Advice => "advice",
        Suitability::Unfit => "UNFIT",
    };
    Row {
        name: diagnosis.name.clone(),
        word,
        value: diagnosis.value.clone(),
        remedy: diagnosis.remedy.clone().map(|remedy| ("remedy:", remedy)),
    }
}
