use super::{SessionSource, distribution, identified, posterior, search, time_line};
use crate::report::ReportError;
use crate::report::chart::{Axis, Chart, Mark, Series, Style};
use crate::report::motion::PackedMotion;
use crate::report::page::{Cell, Page};
use crate::report::provenance::add_provenance;
use crate::report::rollout::{ROLLOUT_HEADS, RolloutView, add_player, first_upper, rollout_cells};
use crate::report::timing::add_timing;
use crate::scoring::criterion::SUCCESS_RETURN;
use crate::session::{GainSource, Identification, Purpose, ScoredCandidate, SearchEnd};

/// The report on a session as one HTML page. `name` is the session's folder. `commands` are the
/// commands that repeat the session and use its result, each with its purpose.
///
/// # Errors
/// The data of the figures cannot be written.
pub fn session_page(
    source: &SessionSource,
    name: &str,
    commands: &[(String, String)],
) -> Result<String, ReportError> {
    let mut page = Page::new(format!("Session {name}"));
    let outcomes = outcome(source);
    page.outcome(&outcomes[0]);
    for sentence in &outcomes[1..] {
        page.paragraph(sentence);
    }
    search::add_search(&mut page, source);
    add_rollouts(&mut page, source);
    distribution::add_distribution(&mut page, source);
    identified::add_identification(&mut page, source);
    posterior::add_posterior(&mut page, source);
    add_curves(&mut page, source);
    time_line::add_time_line(&mut page, &source.time_line);
    add_timing(&mut page, &source.latencies);
    add_faults(&mut page, source);
    let last = source.rollouts.last().map(|(number, view)| {
        (format!("candidate {number}, rollout {}", view.header.rollout), &view.header)
    });
    let last = last.as_ref().map(|(name, header)| (name.as_str(), *header));
    add_provenance(&mut page, last, commands);
    Ok(page.finish()?)
}

/// The sentences about the outcome; the first is the headline.
fn outcome(source: &SessionSource) -> Vec<String> {
    let largest = source.settings.extent.steps;
    let mut sentences = Vec::new();
    let best =
        ScoredCandidate::best_verified(&source.candidates).map(|index| &source.candidates[index]);
    let finished = source.is_finished();
    match best {
        Some(best) => {
            let mean = best.mean_return().unwrap_or(0.0);
            let whose = match best.candidate.purpose {
                Purpose::Incumbent => format!("candidate {}", source.trained_as(&best.candidate)),
                _ => "the search's recommendation".into(),
            };
            sentences.push(format!(
                "The best policy, from {whose}, succeeded in {} of {} verifying rollouts on the Qube, with a mean return of \
                 {mean:.1} of at most {largest}.",
                best.successes(),
                best.verdicts.len(),
            ));
        }
        None if finished => sentences.push("The session ended without a verified policy.".into()),
        None => {
            let searched = source.candidates.iter().filter(|it| it.candidate.purpose.is_searched());
            let best = searched.clone().filter_map(ScoredCandidate::mean_return).reduce(f64::max);
            sentences.push(match best {
                Some(best) => format!(
                    "No policy is verified yet; the best of {} candidates has a mean return of {best:.1} of at most {largest}.",
                    searched.count()
                ),
                None => "No policy has run on the Qube yet.".into(),
            });
        }
    }
    if let Some(reason) = &source.policy_lost {
        sentences.push(format!(
            "The file of this policy is lost: {reason}. Each recording of its rollouts has the policy attached, as \
             policy.safetensors."
        ));
    }
    if source.settings_changed {
        sentences.push(
            "session.toml was changed after the session began, so that no command can repeat the session, and parts \
             of this page that use the settings may not describe the session: restore the file."
                .into(),
        );
    }
    if !finished {
        sentences.push("The session is not finished: this page shows the results so far.".into());
    }
    let used = source.candidates.iter().filter(|it| it.candidate.purpose.informs());
    let used: usize = used.map(|it| it.verdicts.len()).sum();
    let all: usize = source.candidates.iter().map(|it| it.verdicts.len()).sum();
    sentences.push(format!(
        "{all} rollouts were recorded; {used} of them informed the method, the others verify or compare. A rollout \
         succeeds if the pendulum is upright during the whole last second and the return is at least {SUCCESS_RETURN:.0}."
    ));
    if let (Identification::Found { .. }, Some(gain)) =
        (source.state.identification(), source.state.gain_at_end())
    {
        let plan = source.settings.identification.unwrap_or_default();
        let reason = SearchEnd::of(&source.candidates, plan.candidates);
        sentences.push(format!("The search ended: {reason}."));
        if reason != SearchEnd::Candidates(1) {
            let words = GainSource::of(&source.candidates).words(gain);
            sentences.push(first_upper(&words) + ".");
        }
    }
    let baseline = source.candidates.iter().find(|it| it.candidate.purpose == Purpose::Baseline);
    if let Some(mean) = baseline.and_then(ScoredCandidate::mean_return) {
        sentences.push(format!(
            "For comparison, a policy that was trained on the nominal Qube alone had a mean return of {mean:.1}."
        ));
    }
    sentences
}

fn add_rollouts(page: &mut Page, source: &SessionSource) {
    page.section("Rollouts");
    if source.rollouts.is_empty() {
        return page.paragraph("No rollout is recorded so far.");
    }
    let best = ScoredCandidate::best_verified(&source.candidates)
        .map(|index| source.candidates[index].candidate.number);
    let mut motions: Vec<PackedMotion> = Vec::new();
    let mut rows: Vec<Vec<Cell>> = Vec::new();
    for (number, view) in &source.rollouts {
        let candidate = &source.state.candidates()[*number as usize];
        let purpose = source.purpose_words(candidate);
        let group = format!("candidate {number}: {purpose}");
        let rollout = view.header.rollout;
        let outcome = match candidate.purpose {
            Purpose::Excitation => "excitation".into(),
            _ => view.result(),
        };
        let name = format!("candidate {number}, rollout {rollout}: {outcome}");
        motions.push(view.motion.clone().named(group, name, sentence(candidate.purpose, view)));
        let mut row = vec![Cell::Number(number.to_string()), Cell::Number(rollout.to_string())];
        let mut cells = rollout_cells(view);
        if candidate.purpose == Purpose::Excitation {
            (cells[0], cells[1]) = ("excitation".into(), Cell::Number("–".into()));
        }
        row.extend(cells);
        rows.push(row);
    }
    let first = source.rollouts.iter().position(|(number, _)| Some(*number) == best);
    add_player(page, motions, first.unwrap_or(0));
    let heads: Vec<&str> = ["candidate", "rollout"].into_iter().chain(ROLLOUT_HEADS).collect();
    page.heading("All rollouts");
    page.paragraph(
        "Voltage change, sign changes and copper loss are means while the pendulum balances: a quiet policy has small \
         ones. The motor's load is the largest of the rollout, as a share of its continuous rating.",
    );
    page.table(&heads, &rows, None);
}

/// The sentence about a rollout below the player; an excitation has no result.
fn sentence(purpose: Purpose, view: &RolloutView) -> String {
    let sentence = view.sentence();
    match purpose {
        Purpose::Excitation => {
            let rest = sentence.split_once(". ").map_or("", |(_, rest)| rest);
            format!("An excitation, from which the Qube is identified. {rest}")
        }
        _ => sentence,
    }
}

fn add_curves(page: &mut Page, source: &SessionSource) {
    if source.curves.is_empty() {
        return;
    }
    page.section("Trainings");
    let curves = source.curves.iter().filter(|(_, curve)| !curve.is_empty());
    let mut xs: Vec<f64> =
        curves.clone().flat_map(|(_, curve)| curve.iter().map(|point| point.steps)).collect();
    xs.sort_by(f64::total_cmp);
    xs.dedup();
    let mut series = Vec::new();
    for (number, curve) in curves {
        let mut points = curve.iter().peekable();
        let values: Vec<Option<f64>> = xs
            .iter()
            .map(|x| points.next_if(|point| point.steps == *x).map(|point| point.mean_return))
            .collect();
        let colour = *number as usize;
        series.push(
            Series::new(format!("candidate {number}"), Style::Line, colour, values).over_gaps(),
        );
    }
    let chart = Chart {
        x: Axis::new("simulated control steps", ""),
        y: Axis::new("return", ""),
        xs,
        series,
        marks: vec![Mark::horizontal(SUCCESS_RETURN, format!("success from {SUCCESS_RETURN:.0}"))],
        y_range: Some([0.0, 1.04 * f64::from(source.settings.extent.steps)]),
        ..Chart::default()
    };
    page.chart(
        "Mean return in the simulations that each policy trains in",
        "Evaluated without exploration after each update. A fall at the end does no harm: the best policy is kept.",
        chart,
    );
}

fn add_faults(page: &mut Page, source: &SessionSource) {
    page.section("Void attempts");
    if source.void.is_empty() {
        page.paragraph("No attempt at a rollout was void.");
    } else {
        page.paragraph(
            "These attempts were void, after a fault or with ticks missing; a session repeats a void rollout.",
        );
        let rows: Vec<Vec<Cell>> = source
            .void
            .iter()
            .map(|it| {
                let numbers = [it.attempt.candidate, it.attempt.rollout, it.attempt.attempt]
                    .map(|number| Cell::Number(number.to_string()));
                numbers.into_iter().chain([it.reason.as_str().into()]).collect()
            })
            .collect();
        page.table(&["candidate", "rollout", "attempt", "reason"], &rows, None);
    }
    if source.observer_resets > 0 {
        page.paragraph(&format!(
            "Number of times that the observer diverged: {}. Its model or delay does not match this Qube.",
            source.observer_resets
        ));
    }
    for problem in &source.problems {
        page.paragraph(&format!("Left out of this page: {problem}"));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::session::{SessionPaths, SessionSettings};
    use crate::storage::MachineDisk;

    #[test]
    fn a_lost_policy_and_changed_settings_are_reported() {
        let folder = tempfile::tempdir().unwrap();
        let path = SessionPaths::new(folder.path()).configuration();
        std::fs::write(path, SessionSettings::quick().to_toml().unwrap()).unwrap();
        let mut source = SessionSource::read(&MachineDisk, folder.path()).unwrap();
        let told = outcome(&source).join(" ");
        assert!(!told.contains("lost") && !told.contains("was changed"), "{told}");
        source.policy_lost = Some("policy.safetensors: No such file".into());
        source.settings_changed = true;
        let told = outcome(&source).join(" ");
        assert!(told.contains("is lost: policy.safetensors: No such file. Each recording"));
        assert!(told.contains("session.toml was changed after the session began"), "{told}");
    }
}
