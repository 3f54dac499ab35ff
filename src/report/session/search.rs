//! The section about the search: returns of the candidates, and their table.

use super::SessionSource;
use crate::report::chart::{Chart, Mark};
use crate::report::page::{Cell, Page, significant};
use crate::report::returns::{CandidateReturns, returns_chart};
use crate::session::{Purpose, ScoredCandidate, TakenOutRig};

/// Adds the returns of all candidates whose policy has a result, and the table of all candidates,
/// excitations included.
pub(super) fn add_search(page: &mut Page, source: &SessionSource) {
    page.section("Search");
    let shown: Vec<&ScoredCandidate> = source
        .candidates
        .iter()
        .filter(|it| it.candidate.purpose != Purpose::Excitation && it.mean_return().is_some())
        .collect();
    if shown.is_empty() {
        page.paragraph("No policy has run on the Qube yet.");
    } else {
        let explanation = "A dot is one rollout, the line goes through the means of the candidates. Each step of \
             10 ms earns at most 1, with the pendulum upright, the arm in the middle and both at rest.";
        page.chart("Return of each candidate on the Qube", explanation, returns(source, &shown));
    }
    add_table(page, source);
}

fn returns(source: &SessionSource, shown: &[&ScoredCandidate]) -> Chart {
    let kind = |scored: &ScoredCandidate| match scored.candidate.purpose {
        Purpose::Excitation => "excitation",
        Purpose::Initial => "initial",
        Purpose::Search => "searched",
        Purpose::Verification | Purpose::Incumbent => "verification",
        Purpose::Baseline => "nominal policy",
    };
    let mut boundaries = Vec::new();
    for pair in shown.windows(2) {
        let (before, after) = (kind(pair[0]), kind(pair[1]));
        if before != after {
            let at = 0.5 * f64::from(pair[0].candidate.number + pair[1].candidate.number);
            boundaries.push(Mark::vertical(at, format!("{after} →")));
        }
    }
    let of_candidate = |scored: &&ScoredCandidate| CandidateReturns {
        number: scored.candidate.number,
        returns: scored.returns(),
        is_searched: scored.candidate.purpose.is_searched(),
    };
    let candidates: Vec<CandidateReturns> = shown.iter().map(of_candidate).collect();
    returns_chart(&candidates, f64::from(source.settings.extent.steps), boundaries)
}

fn add_table(page: &mut Page, source: &SessionSource) {
    let best = ScoredCandidate::best_verified(&source.candidates);
    let rows: Vec<Vec<Cell>> = source
        .candidates
        .iter()
        .map(|scored| {
            let candidate = &scored.candidate;
            let is_excitation = candidate.purpose == Purpose::Excitation;
            let mean = scored.mean_return().filter(|_| !is_excitation);
            let counted = if is_excitation {
                format!("{} recorded", scored.verdicts.len())
            } else {
                format!("{} of {}", scored.successes(), scored.verdicts.len())
            };
            let settings = source.search_settings(Some(candidate.number));
            let space = settings.map(|settings| settings.psi).filter(|space| {
                candidate.point.len() == space.dimensions().len()
                    && scored.model_without_psi.is_none()
            });
            let psi: Vec<String> = space.map_or_else(Vec::new, |space| {
                let entries = space.names().zip(&candidate.point);
                entries.map(|(name, value)| format!("{name} {}", significant(*value))).collect()
            });
            vec![
                Cell::Number(candidate.number.to_string()),
                source.purpose_words(candidate).into(),
                Cell::number(mean, 1),
                Cell::Text(counted),
                Cell::Text(psi.join(", ")),
            ]
        })
        .collect();
    if !rows.is_empty() {
        page.table(&["candidate", "purpose", "mean return", "successes", "psi"], &rows, best);
        page.paragraph(
            "Purpose: an excitation identifies the Qube; the search starts from the initial candidates; the \
             candidates of the search follow from the returns so far; the recommended one has the highest expected return; \
             \"N again\" is candidate N's own policy, run once more; nominal is a policy that was trained on the nominal Qube. \
             Psi determines the simulations in which a policy trains.",
        );
    }
    add_rigs(page, source);
}

/// Adds the mean return of each candidate on each rig, if several rigs share the session.
fn add_rigs(page: &mut Page, source: &SessionSource) {
    let rigs = &source.settings.rigs;
    if rigs.is_empty() {
        return;
    }
    let best = ScoredCandidate::best_verified(&source.candidates);
    let row = |scored: &ScoredCandidate| {
        let results = scored.by_rig();
        let on = |rig: u32| results.iter().find(|it| it.rig == rig)?.mean_return();
        let means = (1..=rigs.len() as u32).map(|rig| Cell::number(on(rig), 1));
        let number = Cell::Number(scored.candidate.number.to_string());
        [number].into_iter().chain(means).collect()
    };
    let rows: Vec<Vec<Cell>> = source.candidates.iter().map(row).collect();
    let names: Vec<String> = (1..=rigs.len()).map(|rig| format!("rig {rig}")).collect();
    let heads: Vec<&str> =
        ["candidate"].into_iter().chain(names.iter().map(String::as_str)).collect();
    page.heading("Mean return on each rig");
    page.table(&heads, &rows, best);
    for (name, rig) in names.iter().zip(rigs) {
        page.paragraph(&format!("{name}: {}.", rig.device));
    }
    for TakenOutRig { rig, reason } in source.state.taken_out() {
        page.paragraph(&format!(
            "Rig {rig} was taken out, and the others made its rollouts: {reason}"
        ));
    }
}
