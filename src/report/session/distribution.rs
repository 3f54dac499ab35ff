//! The section about the distribution of simulations in which the session's best policy was trained,
//! beside the nominal Qube.

use super::SessionSource;
use crate::qube::Quantity;
use crate::report::densities::{FIRST, density_chart, has_spread, words};
use crate::report::page::{Cell, Page};
use crate::session::{ScoredCandidate, SessionSettings};

/// Adds the distribution of the best verified policy, or before a verification that of the searched
/// candidate with the best mean return so far; adds nothing without either.
pub(super) fn add_distribution(page: &mut Page, source: &SessionSource) {
    let verified = ScoredCandidate::best_verified(&source.candidates);
    let searched = || source.candidates.iter().filter(|it| it.candidate.purpose.is_searched());
    let best_so_far = || {
        let with_mean = searched().filter_map(|it| Some((it.mean_return()?, it)));
        with_mean.max_by(|one, other| one.0.total_cmp(&other.0)).map(|(_, it)| it)
    };
    let Some(chosen) = verified.map(|index| &source.candidates[index]).or_else(best_so_far) else {
        return;
    };
    let trained_as = source.trained_as(&chosen.candidate);
    let settings = source.search_settings(Some(trained_as));
    page.section("The distribution of simulations");
    let distribution =
        match settings.psi.psi(&chosen.candidate.point).and_then(|psi| settings.distribution(&psi))
        {
            Ok(distribution) => distribution,
            Err(error) => return page.paragraph(&format!("It cannot be computed: {error}")),
        };
    let whose =
        if verified.is_some() { "the best verified policy" } else { "the best policy so far" };
    page.paragraph(&format!(
        "{whose} is from candidate {trained_as}. In its training, each simulated Qube draws its properties from \
         these distributions; the dashed vertical line marks the nominal Qube, as its maker describes it.",
        whose = crate::report::rollout::first_upper(whose)
    ));
    let directions = distribution.directions().len();
    if directions > 0 {
        page.paragraph(&format!(
            "The draws are correlated: {directions} joint deviations, the errors of the fit, move several properties at \
             once. Each curve shows one property whatever the others are."
        ));
    }
    let nominal = settings.plant().nominal();
    let base = settings.base_distribution().ok();
    let order = FIRST.into_iter().map(Quantity::Parameter);
    let others = Quantity::all().filter(|quantity| !order.clone().any(|it| it == *quantity));
    let all: Vec<Quantity> = order.clone().chain(others).collect();
    page.grid(|page| {
        for quantity in all.iter().copied() {
            let drawn = distribution.marginal(quantity);
            let before = base.as_ref().map(|base| base.marginal(quantity));
            if has_spread(&drawn) {
                let mut curves = vec![("in its training", drawn)];
                curves.extend(before.filter(|it| *it != drawn).map(|it| ("before the search", it)));
                let caption = crate::report::rollout::first_upper(&words(quantity));
                page.chart(&caption, "", density_chart(quantity, &curves, nominal.get(quantity)));
            }
        }
    });
    page.details("All quantities as numbers", |page| {
        let rows: Vec<Vec<Cell>> = all
            .iter()
            .map(|&quantity| {
                let drawn = distribution.marginal(quantity);
                let value = nominal.get(quantity);
                let ratio = (value != 0.0).then(|| drawn.mean() / value);
                vec![
                    words(quantity).into(),
                    Cell::significant(value),
                    Cell::significant(drawn.mean()),
                    Cell::significant(drawn.standard_deviation()),
                    Cell::number(ratio, 3),
                    quantity.unit().into(),
                ]
            })
            .collect();
        let heads = ["quantity", "nominal", "mean", "standard deviation", "mean / nominal", "unit"];
        page.table(&heads, &rows, None);
    });
    add_psi(page, &settings, &chosen.candidate.point);
}

/// Adds the entries of the chosen psi with units and ranges.
fn add_psi(page: &mut Page, settings: &SessionSettings, point: &[f64]) {
    page.details("Psi, which shapes the distribution", |page| {
        let rows: Vec<Vec<Cell>> = settings
            .psi
            .dimensions()
            .iter()
            .zip(point)
            .map(|(dimension, value)| {
                vec![
                    dimension.target.to_string().into(),
                    Cell::significant(*value),
                    Cell::significant(dimension.lower),
                    Cell::significant(dimension.upper),
                    dimension.target.unit().into(),
                ]
            })
            .collect();
        page.table(&["entry", "value", "from", "to", "unit"], &rows, None);
    });
}
