use plotters::prelude::*;

use super::posterior_panel::{self, Area, AxisNames, FONT, RED, places};
use super::problem::{RANGE, Samples};
use crate::charts::style::GREEN;
use crate::surrogate::{
    Criterion, ExpectedImprovement, FitSettings, GaussianProcess, MaximiserSettings, OnProcess,
    ProbabilityOfImprovement, UpperConfidenceBound, maximise,
};

/// Number of iterations, one a row.
const ROWS: usize = 4;
/// Number of random samples before the first iteration.
const FIRST: usize = 4;

/// Draws the thesis's figure 3.2: four iterations of the search with each of three acquisition
/// functions, from the same first samples. The functions are probability of improvement (PI),
/// expected improvement (EI) and upper confidence bound (UCB). Each iteration shows the posterior
/// with the samples, and below them the acquisition function with its maximum, which is the next
/// sample.
///
/// # Errors
/// The surrogate cannot be fitted, or the drawing library failed.
pub fn draw(seed: u64) -> anyhow::Result<String> {
    let mut svg = String::new();
    {
        let root = SVGBackend::with_string(&mut svg, (1140, 1360)).into_drawing_area();
        root.fill(&WHITE)?;
        let (heading, rest) = root.split_vertically(62);
        let title = "Four iterations of Bayesian optimisation from the same four samples";
        heading.draw(&Text::new(title, (20, 8), (FONT, 20)))?;
        let further = [("acquisition", GREEN), ("its maximum: the next sample", RED)];
        posterior_panel::draw_key(&heading.margin(34, 0, 0, 0), &further)?;
        let cells = rest.split_evenly((ROWS, 3));
        column(&cells, 0, seed, "PI", |best| ProbabilityOfImprovement { incumbent: best })?;
        column(&cells, 1, seed, "EI", |best| ExpectedImprovement { incumbent: best })?;
        column(&cells, 2, seed, "UCB (β = 2)", |_| UpperConfidenceBound { beta: 2.0 })?;
        root.present()?;
    }
    Ok(svg)
}

/// Draws the iterations with one acquisition function, whose `criterion` is made from the largest
/// value so far.
fn column<C: Criterion>(
    cells: &[Area],
    column: usize,
    seed: u64,
    name: &str,
    criterion: impl Fn(f64) -> C,
) -> anyhow::Result<()> {
    let mut samples = Samples::draw(FIRST, seed.wrapping_add(5));
    for row in 0..ROWS {
        let data = samples.dataset()?;
        let search_box = data.search_box().clone();
        let process = GaussianProcess::fit(data, &FitSettings::default())?;
        let incumbent = process.data().largest_value();
        let acquisition = OnProcess { process: &process, criterion: criterion(incumbent) };
        let next = maximise(&acquisition, &search_box, &[], &MaximiserSettings::default()).point[0];

        let (upper, lower) = cells[3 * row + column].split_vertically(200);
        let title = format!("{name}, iteration {}", row + 1);
        let mut chart =
            posterior_panel::draw(&upper, &title, &process, &samples, AxisNames::Hidden)?;
        chart.draw_series(vertical(next, -3.0, 1.5))?;
        let values: Vec<(f64, f64)> = places()
            .map(|x| {
                let posterior = process.posterior(&[x]);
                (x, acquisition.criterion.score(posterior.mean, posterior.deviation()).value)
            })
            .collect();
        acquisition_panel(&lower, name, &values, next)?;
        samples.add(next);
    }
    Ok(())
}

fn acquisition_panel(
    area: &Area,
    name: &str,
    values: &[(f64, f64)],
    next: f64,
) -> anyhow::Result<()> {
    let highest = values.iter().map(|value| value.1).fold(f64::NEG_INFINITY, f64::max);
    let lowest = values.iter().map(|value| value.1).fold(f64::INFINITY, f64::min);
    let margin = 0.1 * (highest - lowest).max(1e-12);
    let mut chart = ChartBuilder::on(area)
        .margin(6)
        .margin_right(16)
        .x_label_area_size(32)
        .y_label_area_size(50)
        .build_cartesian_2d(RANGE.0..RANGE.1, lowest..highest + margin)?;
    let short = |value: &f64| match value.abs() {
        0.0 => "0".into(),
        size if size < 0.01 => format!("{value:.3}"),
        size if size < 1.0 => format!("{value:.2}"),
        _ => format!("{value:.1}"),
    };
    chart
        .configure_mesh()
        .light_line_style(WHITE.mix(0.0))
        .x_labels(7)
        .y_labels(3)
        .y_label_formatter(&short)
        .x_desc("x")
        .y_desc(name.split(' ').next().unwrap_or(name))
        .label_style((FONT, 13))
        .axis_desc_style((FONT, 14))
        .draw()?;
    chart.draw_series(LineSeries::new(values.iter().copied(), GREEN.stroke_width(3)))?;
    chart.draw_series(vertical(next, lowest, highest + margin))?;
    Ok(())
}

fn vertical(x: f64, from: f64, to: f64) -> [PathElement<(f64, f64)>; 1] {
    [PathElement::new(vec![(x, from), (x, to)], RED.stroke_width(3))]
}
