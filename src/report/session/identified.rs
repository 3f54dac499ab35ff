//! The section about the identified Qube: parameters, verdict, and its simulation beside
//! recordings.

use std::collections::BTreeMap;

use super::SessionSource;
use super::source::{COMPARED, ComparedMotion};
use crate::charts::correlations_element;
use crate::identification::{PredictionRegime, regime_error, start_state};
use crate::qube::{Profile, Quantity, QubeModel};
use crate::replay::simulate_from;
use crate::report::chart::{Axis, Chart, Mark, Series, Style};
use crate::report::densities::words;
use crate::report::page::{Cell, Page};
use crate::session::{FailedRefit, Identification, SessionPaths};

/// Adds the section about the identified Qube, with recordings beside simulations of this Qube, or
/// the reason why it was not identified; adds nothing for a session without identification.
pub(super) fn add_identification(page: &mut Page, source: &SessionSource) {
    match source.state.identification() {
        Identification::None => {}
        Identification::Refused(reason) => {
            page.section("Identification");
            page.paragraph(&format!(
                "The Qube was not identified, so the search treated it as an unknown one: {reason}"
            ));
        }
        Identification::Found { recordings, verdict, missing_effects, failed_refit, .. } => {
            page.section("Identification");
            let from =
                if *recordings == 1 { "1 recording" } else { &format!("{recordings} recordings") };
            let fit =
                if verdict == "fits" { "the model fits" } else { "the model fits, with doubts" };
            page.paragraph(&format!("The Qube was identified from {from}: {fit}."));
            for doubt in missing_effects {
                page.paragraph(&format!("Doubt: {doubt}"));
            }
            if let Some(FailedRefit { recordings, reason }) = failed_refit {
                page.paragraph(&format!(
                    "Doubt: a fit to {recordings} recordings gave no new profile: {reason}"
                ));
            }
            if let Some(reason) = source.state.unchanged_by_verification() {
                page.paragraph(&format!("The verification left the profile as it was: {reason}."));
            }
            if let Some((_, profile)) = source.profiles.last() {
                add_values(page, source, profile);
                add_correlations(page, profile);
            }
            if let Some((of, profile)) = source.profile_before_end() {
                if of != recordings {
                    page.paragraph(&format!(
                        "The following predictions use the profile as it was before the verification, {}, \
                         so that the verification tests it.",
                        SessionPaths::profile_name(*of)
                    ));
                }
                add_predictions(page, source, &profile.model());
            }
        }
    }
}

fn add_values(page: &mut Page, source: &SessionSource, profile: &Profile) {
    let nominal = source.settings.plant().nominal();
    let model = profile.model();
    let rows: Vec<Vec<Cell>> = Quantity::all()
        .map(|quantity| {
            let error = profile.standard_errors.get(quantity.name());
            vec![
                words(quantity).into(),
                Cell::significant(nominal.get(quantity)),
                Cell::significant(model.get(quantity)),
                error.map_or(Cell::Number("–".into()), |error| Cell::significant(*error)),
                quantity.unit().into(),
            ]
        })
        .collect();
    page.table(&["quantity", "nominal", "identified", "standard error", "unit"], &rows, None);
}

/// Adds the correlations of the errors; adds nothing for a profile without correlations.
fn add_correlations(page: &mut Page, profile: &Profile) {
    let Some(correlations) = &profile.correlations else { return };
    let quantities: Vec<Quantity> =
        correlations.names.iter().filter_map(|name| Quantity::from_name(name)).collect();
    let names: Vec<String> = quantities.iter().map(|quantity| words(*quantity)).collect();
    let entry = |row: usize, column: usize| correlations.of(quantities[row], quantities[column]);
    page.picture(
        "Correlations of the errors",
        "Near 1 or −1 two errors are strongly correlated: the recordings determine a combination of the two quantities better than \
         each of them.",
        &correlations_element(&names, entry),
    );
}

fn add_predictions(page: &mut Page, source: &SessionSource, model: &QubeModel) {
    let motions = &source.motions;
    if let Some(excitation) = motions.iter().find(|it| it.excitation) {
        let words = if excitation.fitted { "fitted to it" } else { "not fitted to it" };
        page.heading(&format!("{}, an excitation: the model was {words}", excitation.name));
        let start = start_state(&excitation.log, model);
        match simulate_from(&excitation.log, model, start) {
            Ok(predicted) => {
                let states = &predicted.simulated;
                for (caption, angle) in [
                    ("θ, the arm", (|state| state.theta) as fn(&crate::qube::State) -> f64),
                    ("α, the pendulum", |state| state.alpha),
                ] {
                    let [both, residual] = prediction(excitation, states, angle, caption);
                    page.chart(
                        caption,
                        "The model starts from the state that explains the first 0.2 s best and then gets the \
                         voltages alone.",
                        both,
                    );
                    page.chart("Residual", "Recorded minus predicted.", residual);
                }
            }
            Err(error) => page.paragraph(&error.to_string()),
        }
    }
    let mut rows: Vec<Vec<Cell>> = Vec::new();
    for motion in motions.iter().filter(|it| !it.excitation) {
        let logs = std::slice::from_ref(&motion.log);
        let mut row: Vec<Cell> = vec![
            motion.name.as_str().into(),
            if motion.fitted { "fitted" } else { "held out" }.into(),
        ];
        for regime in PredictionRegime::ALL {
            let error = regime_error(logs, model, regime);
            let figure = |value: f64| Cell::number((error.predictions > 0).then_some(value), 3);
            row.extend([figure(error.rms.theta_rad), figure(error.rms.alpha_rad)]);
        }
        rows.push(row);
    }
    if !rows.is_empty() {
        page.heading("Rollouts, predicted piece by piece");
        page.paragraph(
            "Each piece is predicted from a start state of its own: half a second while the pendulum swings, a tenth \
             of a second while it balances. The table shows the error at the end of a piece, root mean square over all \
             pieces, rad; a dash where no piece is long enough. A rollout that is held out was not used for the fit.",
        );
        if let Some(sentence) = left_out(&source.comparable) {
            page.paragraph(&sentence);
        }
        let heads = ["rollout", "used", "swing, θ", "swing, α", "balance, θ", "balance, α"];
        page.table(&heads, &rows, None);
    }
}

/// Says how many of the fitted and of the held-out rollouts the table of predictions shows, where
/// it does not show all; `None` if the table has all rollouts.
fn left_out(comparable: &BTreeMap<bool, usize>) -> Option<String> {
    let shown = |fitted: bool, words: &str| {
        let count = comparable.get(&fitted).copied().unwrap_or(0);
        (count > COMPARED).then(|| format!("the first {COMPARED} of {count} {words}"))
    };
    let parts = [shown(true, "fitted rollouts"), shown(false, "rollouts that are held out")];
    let parts: Vec<String> = parts.into_iter().flatten().collect();
    (!parts.is_empty()).then(|| format!("The table shows {}.", parts.join(" and ")))
}

fn prediction(
    motion: &ComparedMotion,
    states: &[crate::qube::State],
    angle: fn(&crate::qube::State) -> f64,
    caption: &str,
) -> [Chart; 2] {
    let samples = &motion.log.samples;
    let pairs = || {
        let pairs = samples.iter().zip(states);
        pairs.map(|(sample, state)| (angle(&sample.state), angle(state)))
    };
    let both = Chart {
        x: Axis::new("time", "s"),
        y: Axis::new(caption, "rad"),
        xs: samples.iter().map(|sample| (sample.time_s * 1e4).round() / 1e4).collect(),
        series: vec![
            Series::new("recorded", Style::Line, 0, pairs().map(|(recorded, _)| Some(recorded))),
            Series::new(
                "predicted",
                Style::Dashed,
                1,
                pairs().map(|(_, predicted)| Some(predicted)),
            ),
        ],
        ..Chart::default()
    };
    let residuals = pairs().map(|(recorded, predicted)| Some(1e3 * (recorded - predicted)));
    let residual = Chart {
        y: Axis::new("residual", "mrad"),
        series: vec![Series::new("residual", Style::Line, 2, residuals)],
        marks: vec![Mark::horizontal(0.0, "")],
        height: Some(160),
        ..both.clone()
    };
    [both, residual]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rollouts_that_the_table_leaves_out_are_counted() {
        assert_eq!(left_out(&BTreeMap::from([(true, 3), (false, 1)])), None);
        assert_eq!(
            left_out(&BTreeMap::from([(true, 12), (false, 3)])).as_deref(),
            Some("The table shows the first 3 of 12 fitted rollouts.")
        );
        assert_eq!(
            left_out(&BTreeMap::from([(true, 12), (false, 8)])).as_deref(),
            Some(
                "The table shows the first 3 of 12 fitted rollouts and the first 3 of 8 rollouts that are held out."
            )
        );
    }
}
