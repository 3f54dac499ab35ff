//! The report on single recordings.

use super::ReportError;
use super::page::{Cell, Page};
use super::provenance::add_provenance;
use super::rollout::{ROLLOUT_HEADS, RolloutView, add_player, first_upper, rollout_cells};
use super::timing::add_timing;
use crate::recording::Recording;
use crate::replay::SimulatedSpecimen;
use crate::scoring::Latencies;

/// The HTML page of recordings, each with its name. Beside each motion it shows a simulation of the
/// same voltages: of `specimen` or, if that is `None`, of the nominal specimen of the recording's
/// plant.
/// `commands` are pairs of a purpose and a command that repeats a part of the page.
///
/// # Errors
/// The data of the figures cannot be written.
pub fn recordings_page(
    recordings: &[(String, Recording)],
    specimen: Option<&SimulatedSpecimen>,
    commands: &[(String, String)],
) -> Result<String, ReportError> {
    let title = match recordings {
        [(name, _)] => format!("Recording {name}"),
        _ => format!("{} recordings", recordings.len()),
    };
    let mut page = Page::new(title);
    let mut latencies = Latencies::default();
    let views: Vec<(&str, RolloutView)> = recordings
        .iter()
        .map(|(name, recording)| {
            latencies.add(&recording.ticks);
            let nominal = SimulatedSpecimen::nominal(&recording.header.settings.plant);
            (name.as_str(), RolloutView::of(recording, specimen.unwrap_or(&nominal)))
        })
        .collect();
    match &views[..] {
        [(_, view)] => page.outcome(&(first_upper(&view.result()) + ".")),
        _ => {
            let successes = views.iter().filter(|(_, view)| view.verdict.is_success()).count();
            page.outcome(&format!("{successes} of {} rollouts succeed.", views.len()));
        }
    }
    page.section("Rollouts");
    let motions = views.iter().map(|(name, view)| {
        let name = format!("{name}: {}", view.result());
        let policy = format!("policy {}", view.header.policy);
        view.motion.clone().named(policy, name, view.sentence())
    });
    add_player(&mut page, motions.collect(), 0);
    let heads: Vec<&str> = ["recording"].into_iter().chain(ROLLOUT_HEADS).collect();
    let rows: Vec<Vec<Cell>> = views
        .iter()
        .map(|(name, view)| [Cell::from(*name)].into_iter().chain(rollout_cells(view)).collect())
        .collect();
    page.table(&heads, &rows, None);
    if let [(_, view)] = &views[..] {
        page.heading("How near the rollout came to its limits");
        let foreseen = view.guard.map(|(approach, time_s)| {
            let foreseen = approach.foreseen;
            let (largest, end) = (f64::from(foreseen.largest_rad), f64::from(foreseen.end_rad));
            let share = Some(100.0 * largest / end).filter(|share| share.is_finite());
            vec![
                "arm's angle that the guard predicted".into(),
                Cell::number(Some(largest).filter(|it| it.is_finite()), 2),
                Cell::number(Some(end), 2),
                "rad".into(),
                Cell::number(share, 0),
                Cell::number(Some(time_s), 2),
            ]
        });
        let rows: Vec<Vec<Cell>> = view
            .nearest
            .iter()
            .map(|it| {
                vec![
                    it.quantity.into(),
                    Cell::number(Some(it.value), 2),
                    Cell::number(Some(it.limit), 2),
                    it.unit.into(),
                    Cell::number(Some(100.0 * it.share), 0),
                    Cell::number(Some(it.time_s), 2),
                ]
            })
            .chain(foreseen)
            .collect();
        page.table(
            &["quantity", "largest", "limit", "unit", "% of the limit", "at, s"],
            &rows,
            None,
        );
    }
    add_timing(&mut page, &latencies);
    add_provenance(&mut page, views.last().map(|(name, view)| (*name, &view.header)), commands);
    Ok(page.finish()?)
}
