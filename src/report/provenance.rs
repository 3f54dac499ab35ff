use super::page::{Cell, Page, significant};
use crate::telemetry::{CheckVerdict, Preflight, RolloutHeader};

/// Adds the section on the origin of the data: the facts of the header of `recording`, which is one
/// of the page's recordings with its name, if there is any, and `commands`, pairs of a purpose and
/// a command that repeats a part of the work.
pub fn add_provenance(
    page: &mut Page,
    recording: Option<(&str, &RolloutHeader)>,
    commands: &[(String, String)],
) {
    page.section("Provenance");
    if let Some((name, header)) = recording {
        page.paragraph(&format!("These facts are of one recording: {name}."));
        let rows: Vec<Vec<Cell>> = facts(header)
            .into_iter()
            .map(|(name, value)| vec![name.into(), value.into()])
            .collect();
        page.table(&["", ""], &rows, None);
        add_preflight(page, &header.preflight);
    }
    page.commands(commands);
}

fn facts(header: &RolloutHeader) -> Vec<(String, String)> {
    let settings = &header.settings;
    let calibration = &settings.calibration;
    let safety_box = &settings.safety_box;
    let mut facts = vec![
        (
            "program".to_owned(),
            format!("{}, revision {}", header.program_version, header.git_revision),
        ),
        ("seed".into(), header.seed.to_string()),
        ("plant".into(), settings.plant.name.to_string()),
    ];
    facts.extend(
        header.device.iter().map(|(name, value)| (format!("device: {name}"), value.to_owned())),
    );
    let inverted: Vec<&str> = [
        ("arm", calibration.theta_inverted),
        ("pendulum", calibration.alpha_inverted),
        ("motor", calibration.voltage_inverted),
    ]
    .into_iter()
    .filter_map(|(name, is_inverted)| is_inverted.then_some(name))
    .collect();
    let signs = if inverted.is_empty() { "none".to_owned() } else { inverted.join(", ") };
    facts.push((
        "calibration".into(),
        format!(
            "zero of the arm at {} counts, of the pendulum at {} counts; inverted signs: {signs}",
            calibration.theta_zero_counts, calibration.alpha_zero_counts
        ),
    ));
    facts.push((
        "safety box".into(),
        format!(
            "|θ| up to {} rad, |α| up to {} rad, arm up to {} rad/s, pendulum up to {} rad/s; guard: {}",
            significant(safety_box.theta),
            significant(safety_box.alpha),
            significant(safety_box.theta_dot),
            significant(safety_box.alpha_dot),
            if safety_box.guard.is_box() {
                "the box alone".to_owned()
            } else {
                format!("{:?}", safety_box.guard).to_lowercase()
            }
        ),
    ));
    facts.push((
        "clock".into(),
        match header.started_unix_ns {
            None => "virtual time".into(),
            Some(started_ns) => format!("real time, from {}", date(started_ns)),
        },
    ));
    facts
}

fn add_preflight(page: &mut Page, preflight: &Preflight) {
    match preflight {
        Preflight::Unknown => page.paragraph("The recording names no check of the device."),
        Preflight::NotNeeded => page.paragraph("The emulated Qube needs no check."),
        Preflight::SkippedByFlag => {
            page.paragraph("The operator skipped the check of the Qube before its first motion.");
        }
        Preflight::Done(checks) => {
            page.details("Check of the Qube before its first motion", |page| {
                let word = |verdict| match verdict {
                    CheckVerdict::Pass => "passed",
                    CheckVerdict::Fail => "FAILED",
                    CheckVerdict::Skipped => "skipped",
                };
                let rows: Vec<Vec<Cell>> = checks
                    .iter()
                    .map(|it| {
                        let name = it.name.as_str().into();
                        vec![name, word(it.verdict).into(), it.value.as_str().into()]
                    })
                    .collect();
                page.table(&["check", "verdict", "finding"], &rows, None);
            })
        }
    }
}

/// The date and time in UTC of a time in nanoseconds since 1970.
fn date(unix_ns: u64) -> String {
    let seconds = i64::try_from(unix_ns / 1_000_000_000).unwrap_or(i64::MAX);
    jiff::Timestamp::from_second(seconds).map_or_else(
        |_| "an impossible date".into(),
        |time| time.strftime("%Y-%m-%d %H:%M:%S UTC").to_string(),
    )
}
