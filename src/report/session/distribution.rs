//! The distribution of simulations that the session recommends, beside the nominal Qube.

use super::SessionSource;
use crate::qube::{DomainParameter, Quantity};
use crate::report::chart::{Axis, Chart, Mark, Series, Style};
use crate::report::page::{Cell, Page};
use crate::session::{ScoredCandidate, SessionSettings};
use crate::simulation::Distribution;

/// The masses and lengths of the thesis's figure 5.2, which are drawn first.
const FIRST: [DomainParameter; 4] = [
    DomainParameter::RotaryMass,
    DomainParameter::PendulumMass,
    DomainParameter::RotaryLength,
    DomainParameter::PendulumLength,
];

/// Number of places of a density.
const PLACES: usize = 121;

/// Adds the recommended distribution; nothing before the search has a result.
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
        match settings.psi.psi(&chosen.candidate.psi).and_then(|psi| settings.distribution(&psi)) {
            Ok(distribution) => distribution,
            Err(error) => return page.paragraph(&format!("It cannot be computed: {error}")),
        };
    let whose =
        if verified.is_some() { "the best verified policy" } else { "the best policy so far" };
    page.paragraph(&format!(
        "{whose} is that of candidate {trained_as}. In its training, each simulated Qube draws its properties from \
         these distributions; the dashed line marks the nominal Qube, as its maker describes it.",
        whose = crate::report::rollout::first_upper(whose)
    ));
    let nominal = settings.plant().nominal();
    let base = settings.base_distribution().ok();
    let order = FIRST.into_iter().map(Quantity::Parameter);
    let others = Quantity::all().filter(|quantity| !order.clone().any(|it| it == *quantity));
    let all: Vec<Quantity> = order.clone().chain(others).collect();
    page.grid(|page| {
        for quantity in all.iter().copied() {
            let drawn = distribution.get(quantity);
            let before = base.as_ref().map(|base| base.get(quantity));
            if drawn.standard_deviation() > 0.0 && drawn.mean().is_finite() {
                let name = words(quantity);
                page.chart(
                    &name,
                    "",
                    density_chart(quantity, &drawn, before.as_ref(), nominal.get(quantity)),
                );
            }
        }
    });
    page.details("All quantities as numbers", |page| {
        let rows: Vec<Vec<Cell>> = all
            .iter()
            .map(|&quantity| {
                let drawn = distribution.get(quantity);
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
    add_psi(page, &settings, &chosen.candidate.psi);
}

/// Adds the entries of psi with units and ranges.
fn add_psi(page: &mut Page, settings: &SessionSettings, psi: &[f64]) {
    page.details("Psi, which shapes it", |page| {
        let rows: Vec<Vec<Cell>> = settings
            .psi
            .dimensions()
            .iter()
            .zip(psi)
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

fn density_chart(
    quantity: Quantity,
    drawn: &Distribution,
    base: Option<&Distribution>,
    nominal: f64,
) -> Chart {
    let ends = |it: &Distribution| {
        let reach = 3.5 * it.standard_deviation();
        [it.mean() - reach, it.mean() + reach]
    };
    let mut places: Vec<f64> = ends(drawn).into_iter().chain([nominal]).collect();
    let base = base.filter(|base| base.standard_deviation() > 0.0 && *base != drawn);
    places.extend(base.into_iter().flat_map(ends));
    let low = places.iter().copied().fold(f64::INFINITY, f64::min);
    let high = places.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let margin = 0.03 * (high - low);
    let (low, high) = (low - margin, high + margin);
    let at = |index: usize| low + (high - low) * index as f64 / (PLACES - 1) as f64;
    let mut xs: Vec<f64> = (0..PLACES).map(at).collect();
    // A narrow density needs places of its own.
    let [from, to] = ends(drawn);
    xs.extend((0..PLACES).map(|index| from + (to - from) * index as f64 / (PLACES - 1) as f64));
    xs.sort_by(f64::total_cmp);
    let unit = quantity.unit();
    let curve = |it: &Distribution| xs.iter().map(|&x| Some(it.density(x))).collect::<Vec<_>>();
    let mut series = vec![Series::new("recommended", Style::Line, 0, curve(drawn))];
    series.extend(base.map(|base| Series::new("before the search", Style::Dashed, 1, curve(base))));
    Chart {
        x: Axis::new(words(quantity), unit),
        y: Axis::new("density", &per(unit)),
        series,
        marks: vec![Mark::vertical(nominal, "nominal")],
        x_range: Some([low, high]),
        height: Some(210),
        xs,
        ..Chart::default()
    }
}

/// The unit of a density.
fn per(unit: &str) -> String {
    if unit.contains([' ', '/']) { format!("1/({unit})") } else { format!("1/{unit}") }
}

/// A quantity in words, with its symbol.
pub(super) fn words(quantity: Quantity) -> String {
    use crate::qube::Nonideality as G;
    use DomainParameter as P;
    let name = match quantity {
        Quantity::Parameter(P::Gravity) => "gravity",
        Quantity::Parameter(P::MotorResistance) => "motor's resistance",
        Quantity::Parameter(P::MotorBackEmf) => "motor's back EMF",
        Quantity::Parameter(P::RotaryDamping) => "arm's damping",
        Quantity::Parameter(P::PendulumDamping) => "pendulum's damping",
        Quantity::Parameter(P::RotaryMass) => "arm's mass",
        Quantity::Parameter(P::PendulumMass) => "pendulum's mass",
        Quantity::Parameter(P::RotaryLength) => "arm's length",
        Quantity::Parameter(P::PendulumLength) => "pendulum's length",
        Quantity::Nonideality(G::CoulombTorque) => "arm's dry friction",
        Quantity::Nonideality(G::PositiveDeadZone) => "dead zone of positive voltages",
        Quantity::Nonideality(G::NegativeDeadZone) => "dead zone of negative voltages",
        Quantity::Nonideality(G::CableStiffness) => "cable's stiffness",
        Quantity::Nonideality(G::CableRest) => "cable's rest angle",
        Quantity::Nonideality(G::CommandDelay) => "delay of a command",
    };
    match quantity {
        Quantity::Parameter(_) => format!("{name}, {}", quantity.symbol()),
        Quantity::Nonideality(_) => name.to_owned(),
    }
}
