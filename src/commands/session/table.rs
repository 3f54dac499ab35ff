use std::collections::BTreeMap;
use std::fmt::Write;

use serde_json::{Value, json};

use super::progress::{identified, refit_failed};
use crate::commands::exit::Failure;
use crate::commands::printable::one_line;
use crate::commands::{observer_resets_line, quietness_line, timing_lines};
use crate::experiment::statistics::{Interval, wilson_interval};
use crate::qube::{DomainParameter, Profile, Quantity};
use crate::scoring::Verdict;
use crate::session::{
    BestPolicy, EndedSearch, FailedRefit, GainSource, Identification, Purpose, RigResults,
    ScoredCandidate, SearchEnd, SessionPaths, SessionReport, TakenOutRig,
};
use crate::simulation::PsiSpace;
use crate::telemetry::Ending;

/// A session's results as a table for people and as JSON for scripts.
pub struct SessionTable(pub SessionReport);

impl SessionTable {
    /// Checks that the policy that the table names as the best, if any, can be run.
    pub fn check_best_policy(&self) -> Result<(), Failure> {
        let checked = self.0.best.as_ref().map_or(Ok(()), BestPolicy::check);
        checked.map_err(|error| {
            let message = one_line(&error.to_string()).into_owned();
            Failure::data_lost(format!("the best policy is lost: {message}"))
        })
    }

    /// The table for people. Its rows fit into 80 columns if psi has at most 20 entries; paths and
    /// the names in psi may be longer.
    pub fn text(&self) -> String {
        let mut text =
            String::from("\n   #  purpose      mean return  rollouts  psi in its box, 0 to 9\n");
        let report = &self.0;
        for scored in &report.candidates {
            let candidate = &scored.candidate;
            let purpose = word(candidate.purpose, || report.incumbent(candidate));
            if candidate.purpose == Purpose::Excitation {
                let made = scored.verdicts.len();
                let _ = writeln!(
                    text,
                    "{:4}  {purpose:11} {:>11}  {made:2} recorded",
                    candidate.number, "-"
                );
                continue;
            }
            let mean = match scored.mean_return() {
                Some(mean) => format!("{mean:11.1}"),
                None => format!("{:>11}", "-"),
            };
            let row = format!(
                "{:4}  {purpose:11} {mean}  {:2} of {:<2}  {}",
                candidate.number,
                scored.successes(),
                scored.verdicts.len(),
                digits(&report.psi, &candidate.point),
            );
            let _ = writeln!(text, "{}", row.trim_end());
        }
        if report.candidates.iter().any(|it| !it.candidate.point.is_empty()) {
            let names: Vec<_> = report.psi.names().collect();
            let _ = writeln!(text, "      psi: {}", names.join(" "));
        }
        if let Some(BestPolicy { candidate, policy }) = &report.best {
            let scored = &report.candidates[*candidate];
            let candidate = &scored.candidate;
            let whose = match candidate.purpose {
                Purpose::Incumbent => {
                    format!("the policy of candidate {}", report.incumbent(candidate))
                }
                _ => "the policy of the recommended psi".into(),
            };
            let _ = writeln!(
                text,
                "\nbest policy: {}\n{whose}: mean return {:.1} over {} rollouts\n{}",
                policy.display(),
                scored.mean_return().unwrap_or(0.0),
                scored.verdicts.len(),
                verified(scored),
            );
            text.push_str(&quietness_line(&scored.quietness));
            let longest = report.psi.names().map(|name| name.len()).max().unwrap_or(0);
            for (dimension, value) in report.psi.dimensions().iter().zip(&candidate.point) {
                let name = dimension.target.to_string();
                let line = match dimension.target.unit() {
                    "1" => format!("  {name:longest$}  {value:.5}"),
                    "std" => format!("  {name:longest$}  {value:.5} standard errors"),
                    unit => format!("  {name:longest$}  {value:.5} {unit}"),
                };
                text.push_str(&line);
                text.push('\n');
            }
        }
        text.push_str(&self.rig_lines());
        text.push_str(&self.identification_lines());
        if report.void_rollouts > 0 {
            let void = report.void_rollouts;
            let _ = writeln!(text, "void attempts at rollouts, which were repeated: {void}");
        }
        text.push_str(&observer_resets_line(report.observer_resets));
        text.push_str(&timing_lines(&report.latencies));
        let _ = writeln!(text, "everything is in {}", report.directory.display());
        text.push_str("qube-hil session --help explains the words of this table\n");
        text
    }

    /// The mean return of each candidate on each rig, and the rigs that were taken out; empty if
    /// the session has one rig.
    fn rig_lines(&self) -> String {
        let report = &self.0;
        if report.rigs.is_empty() {
            return String::new();
        }
        let mut text = String::from("\nmean return on each rig\n   #");
        for rig in 1..=report.rigs.len() {
            let _ = write!(text, "  {:>9}", format!("rig {rig}"));
        }
        text.push('\n');
        for scored in &report.candidates {
            let results = scored.by_rig();
            let _ = write!(text, "{:4}", scored.candidate.number);
            for rig in 1..=report.rigs.len() as u32 {
                let mean =
                    results.iter().find(|it| it.rig == rig).and_then(RigResults::mean_return);
                let _ = match mean {
                    Some(mean) => write!(text, "  {mean:9.1}"),
                    None => write!(text, "  {:>9}", "-"),
                };
            }
            text.push('\n');
        }
        for (rig, device) in (1..).zip(&report.rigs) {
            let _ = writeln!(text, "rig {rig}: {device}");
            if let Some(TakenOutRig { reason, .. }) =
                report.taken_out.iter().find(|out| out.rig == rig)
            {
                let _ = writeln!(text, "  it was taken out: {}", one_line(reason));
            }
        }
        text
    }

    /// The identification, and the gain that was expected when the search ended; empty before an
    /// identification, and if the session was not to identify its Qube.
    fn identification_lines(&self) -> String {
        let report = &self.0;
        let mut text = match &report.identification {
            Identification::None => return String::new(),
            Identification::Refused(reason) => {
                return format!(
                    "\nthe Qube was not identified, so the search treated it as an unknown one: \
                     {}\n",
                    one_line(reason)
                );
            }
            Identification::Found { recordings, missing_effects, failed_refit, .. } => {
                let profile = report.directory.join(SessionPaths::profile_name(*recordings));
                let mut message = identified(*recordings, missing_effects);
                if let Some(FailedRefit { recordings, reason }) = failed_refit {
                    message += "\n";
                    message += &refit_failed(*recordings, &one_line(reason));
                }
                format!(
                    "\n{message}\nits profile, with the errors of its values: {}\n",
                    profile.display()
                )
            }
        };
        text.push_str(&least_certain(report.profile.as_ref()));
        if let Some(EndedSearch { end, expected_gain }) = report.ended {
            let _ = writeln!(text, "the search ended: {end}");
            if end != SearchEnd::Candidates(1) {
                let source = GainSource::of(&report.candidates);
                let _ = writeln!(text, "{}", source.words(expected_gain));
            }
        }
        let _ = writeln!(
            text,
            "real rollouts that the method used: {} (verification is not counted)",
            report.real_rollouts()
        );
        text
    }

    /// The table as JSON, for scripts; the caller adds the path of the report, the elapsed time and
    /// the reason of the end.
    pub fn json(&self) -> Value {
        let report = &self.0;
        let valued = |scored: &ScoredCandidate| valued(&report.psi, scored);
        let all = |is| report.of_purpose(is).map(valued).collect::<Vec<Value>>();
        let best = report.best.as_ref().map(|BestPolicy { candidate, policy }| {
            let scored = &report.candidates[*candidate];
            let mut best = valued(scored);
            best["policy"] = json!(policy.to_string_lossy());
            best["balancing"] = json!(scored.quietness.figures());
            best
        });
        let mut table = json!({
            "candidates": all(Purpose::is_searched),
            "verified": all(Purpose::verifies),
            "best": best,
            "excitations": all(|purpose| purpose == Purpose::Excitation),
            "baseline": all(|purpose| purpose == Purpose::Baseline),
            "identification": identification(&report.identification),
            "expected_gain": report.ended.map(|ended| ended.expected_gain),
            "search_ended": report.ended.map(|ended| ended.end.to_string()),
            "real_rollouts": report.real_rollouts(),
            "rollouts": report.rollouts(),
            "void_rollouts": report.void_rollouts,
            "times_astray": report.observer_resets,
            "missed_deadlines": report.latencies.missed_deadlines(),
            "lateness_us": report.latencies.lateness_us(),
            "sample_to_act_us": report.latencies.sample_to_act_us(),
            "directory": report.directory.to_string_lossy(),
        });
        if !report.rigs.is_empty() {
            table["rig_policy"] = json!("shared");
            table["rigs"] =
                (1..).zip(&report.rigs).map(|(rig, device)| self.rig(rig, device)).collect();
        }
        table
    }

    /// One of several rigs as JSON.
    fn rig(&self, rig: u32, device: &str) -> Value {
        let taken_out = self.0.taken_out.iter().find(|out| out.rig == rig);
        json!({ "rig": rig, "device": device, "taken_out": taken_out.map(|out| &out.reason) })
    }
}

/// The identification as JSON.
fn identification(known: &Identification) -> Value {
    match known {
        Identification::None => Value::Null,
        Identification::Refused(reason) => json!({ "refused": reason }),
        Identification::Found { recordings, verdict, missing_effects, failed_refit, .. } => {
            let mut known =
                json!({ "recordings": recordings, "verdict": verdict, "doubts": missing_effects });
            if let Some(FailedRefit { recordings, reason }) = failed_refit {
                known["failed_refit"] = json!({ "recordings": recordings, "reason": reason });
            }
            known
        }
    }
}

/// The table's word for a candidate's purpose. `incumbent` gives the number of the candidate whose
/// policy this one runs again.
fn word(purpose: Purpose, incumbent: impl FnOnce() -> u32) -> String {
    match purpose {
        Purpose::Excitation => "excitation".into(),
        Purpose::Baseline => "nominal".into(),
        Purpose::Initial => "initial".into(),
        Purpose::Search => "search".into(),
        Purpose::Verification => "recommended".into(),
        Purpose::Incumbent => format!("{} again", incumbent()),
    }
}

fn valued(psi: &PsiSpace, scored: &ScoredCandidate) -> Value {
    let mut value = json!({
        "candidate": scored.candidate.number,
        "purpose": scored.candidate.purpose,
        "psi": psi.by_name(&scored.candidate.point),
        "returns": scored.returns(),
        "mean_return": scored.mean_return(),
        "successes": scored.successes(),
    });
    let by_rig = scored.by_rig();
    if !by_rig.is_empty() {
        let of_rig = |it: &RigResults| {
            json!({
                "rig": it.rig,
                "returns": it.returns,
                "mean_return": it.mean_return(),
                "successes": it.successes,
            })
        };
        value["by_rig"] = by_rig.iter().map(of_rig).collect();
    }
    value
}

/// The position of each entry of psi within its box, as a digit from 0 (lower end) to 9 (upper
/// end).
fn digits(space: &PsiSpace, point: &[f64]) -> String {
    space
        .dimensions()
        .iter()
        .zip(point)
        .map(|(dimension, value)| {
            let place = (value - dimension.lower) / (dimension.upper - dimension.lower);
            ((place * 10.0) as u32).min(9).to_string()
        })
        .collect::<Vec<_>>()
        .join(" ")
}

/// The number of rollouts of the best policy that balance, with the 95 % interval of its rate of
/// success, and the endings of the rollouts that do not balance.
fn verified(scored: &ScoredCandidate) -> String {
    let (successes, rollouts) = (scored.successes(), scored.verdicts.len());
    let Interval { lower, upper } = wilson_interval(successes, rollouts);
    let (least, most) = (100.0 * lower, 100.0 * upper);
    let mut text = format!(
        "{successes} of {rollouts} balance, so the rate of success is {least:.0} to {most:.0} % (95 % interval)"
    );
    let mut endings: BTreeMap<String, usize> = BTreeMap::new();
    for verdict in scored.verdicts.iter().filter(|verdict| !verdict.is_success()) {
        let Verdict::Result { outcome, .. } = verdict else { continue };
        let ending = match outcome.ending {
            Ending::LeftBox(limit) => limit.to_string(),
            _ => "did not balance to the end".into(),
        };
        *endings.entry(ending).or_default() += 1;
    }
    for (ending, count) in endings {
        let _ = write!(text, "\n{count} of {rollouts} times it {ending}");
    }
    text
}

/// The three parameters of a profile with the largest relative errors, as a line; empty without a
/// profile or without errors in it. Friction, dead zones and cable may be 0, so that a relative
/// error does not describe them.
fn least_certain(profile: Option<&Profile>) -> String {
    let Some(profile) = profile else { return String::new() };
    let model = profile.model();
    let relative = |parameter: DomainParameter| {
        let quantity = Quantity::Parameter(parameter);
        let share = profile.standard_error(quantity) / model.get(quantity).abs();
        (share.is_finite() && share > 0.0).then_some((quantity.name(), share))
    };
    let mut errors: Vec<_> = DomainParameter::ALL.into_iter().filter_map(relative).collect();
    errors.sort_by(|(_, one), (_, other)| other.total_cmp(one));
    let parts: Vec<_> = errors
        .iter()
        .take(3)
        .map(|(name, share)| match 100.0 * share {
            percent if percent <= 100.0 => format!("{name} +- {percent:.0} %"),
            _ => format!("{name} +- over 100 %"),
        })
        .collect();
    if parts.is_empty() { String::new() } else { format!("least certain: {}\n", parts.join(", ")) }
}

#[cfg(test)]
mod tests {
    use clap::Args as _;

    use super::super::Arguments;
    use super::*;
    use crate::scoring::Latencies;
    use crate::session::Candidate;

    fn empty_table() -> SessionTable {
        SessionTable(SessionReport {
            psi: PsiSpace::default(),
            candidates: Vec::new(),
            latencies: Latencies::default(),
            void_rollouts: 0,
            observer_resets: 0,
            directory: "logs/one".into(),
            identification: Identification::None,
            profile: None,
            ended: None,
            rigs: Vec::new(),
            taken_out: Vec::new(),
            best: None,
        })
    }

    #[test]
    fn the_help_to_which_the_table_points_defines_its_columns_and_purposes() {
        let text = empty_table().text();
        let pointer = "\nqube-hil session --help explains the words of this table\n";
        assert!(text.ends_with(pointer), "{text}");
        let command = Arguments::augment_args(clap::Command::new("session"));
        let help = command.get_after_help().unwrap().to_string();
        let header = text.lines().nth(1).unwrap();
        let columns = header.split("  ").map(str::trim).filter(|it| !["", "#"].contains(it));
        // The last column is headed `psi in its box, 0 to 9`.
        let columns: Vec<&str> = columns.filter_map(|it| it.split(" in ").next()).collect();
        assert_eq!(columns.len(), 4, "{header}");
        for column in columns {
            let is_defined = help.lines().any(|line| line.starts_with(&format!("  {column}  ")));
            assert!(is_defined, "{column}: {help}");
        }
        for purpose in [
            Purpose::Excitation,
            Purpose::Initial,
            Purpose::Search,
            Purpose::Verification,
            Purpose::Incumbent,
            Purpose::Baseline,
        ] {
            let word = word(purpose, || 7).replace('7', "N");
            assert!(help.contains(&format!(" {word}: ")), "{word}: {help}");
        }
    }

    #[test]
    fn each_value_of_the_best_psi_has_its_unit() {
        let mut table = empty_table();
        let psi = PsiSpace::of_posterior(1);
        let point = vec![0.5; psi.dimensions().len()];
        (table.0.psi, table.0.best) =
            (psi, Some(BestPolicy { candidate: 0, policy: "policy.safetensors".into() }));
        let candidate = Candidate {
            number: 0,
            purpose: Purpose::Incumbent,
            point,
            trained: true,
            policy_checksum: None,
            finished: Vec::new(),
            void: 0,
            void_before: 0,
            policy_of: None,
            identified_from: None,
        };
        table.0.candidates = vec![ScoredCandidate::new(candidate, [])];
        let text = table.text();
        for line in [
            "  log_width  0.50000\n",
            "  shift_1    0.50000 standard errors\n",
            "  mean_lag   0.50000 s\n",
        ] {
            assert!(text.contains(line), "{line}: {text}");
        }
    }

    #[test]
    fn observer_resets_are_reported_if_there_were_any() {
        let mut table = empty_table();
        let text = table.text();
        assert!(!text.contains("void") && !text.contains("observer"), "{text}");
        (table.0.void_rollouts, table.0.observer_resets) = (3, 7);
        let text = table.text();
        assert!(text.contains("were repeated: 3\n"), "{text}");
        assert!(text.contains("observer diverged 7 times"), "{text}");
    }
}
