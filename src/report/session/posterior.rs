//! What the surrogate believes of the return over psi.

use super::SessionSource;
use crate::report::chart::{Axis, Band, Chart, Map, Mark, Series, Style};
use crate::report::page::Page;
use crate::search::Observation;
use crate::session::SessionSettings;
use crate::simulation::PsiDimension;
use crate::surrogate::GaussianProcess;

/// Smallest number of candidates from which a posterior says something.
const ENOUGH: usize = 3;

/// Number of places along a slice.
const PLACES: usize = 61;

/// Number of places along each side of the map.
const SIDE: usize = 31;

/// Adds slices of the posterior through the recommended psi, and a map of the two most relevant entries.
pub(super) fn add_posterior(page: &mut Page, source: &SessionSource) {
    let data: Vec<Observation> = source
        .candidates
        .iter()
        .filter(|it| it.candidate.purpose.is_searched() && !it.verdicts.is_empty())
        .map(|it| it.observation())
        .collect();
    page.section("What the search believes");
    if data.len() < ENOUGH {
        page.paragraph(&format!(
            "A surrogate of the return over psi needs {ENOUGH} candidates; the session has {} with rollouts.",
            data.len()
        ));
        return;
    }
    let settings = source.search_settings(None);
    let fitted = settings.surrogate(&data).and_then(|process| {
        Ok(match process {
            Some(process) => Some((process, settings.search()?.best(&data)?)),
            None => None,
        })
    });
    match fitted {
        Ok(Some((process, best))) => draw(page, &settings, &process, &best.point, &data),
        Ok(None) => {
            page.paragraph(&format!("The strategy {} has no surrogate.", settings.strategy.name()))
        }
        Err(error) => page.paragraph(&format!("The surrogate cannot be fitted: {error}")),
    }
}

fn draw(
    page: &mut Page,
    settings: &SessionSettings,
    process: &GaussianProcess,
    best: &[f64],
    data: &[Observation],
) {
    page.paragraph(
        "A Gaussian process is fitted to the mean returns. Each slice changes one entry of psi and keeps the others \
         as recommended; the dots are the candidates, which lie off the slice in the other entries.",
    );
    let dimensions = settings.psi.dimensions();
    // A short lengthscale means that the return changes along that entry.
    let lengthscales = &process.hyperparameters().lengthscales;
    let mut relevant: Vec<usize> = (0..dimensions.len()).collect();
    relevant.sort_by(|one, other| lengthscales[*one].total_cmp(&lengthscales[*other]));
    if let [first, second, ..] = relevant[..] {
        page.map(
            "Expected return over the two most relevant entries of psi",
            "The cross is the recommended psi, the circles are the candidates.",
            map(process, dimensions, best, data, [first, second]),
        );
    }
    page.grid(|page| {
        for index in relevant {
            let name = dimensions[index].target.to_string();
            page.chart(&name, "", slice(process, &dimensions[index], best, data, index));
        }
    });
}

fn axis(dimension: &PsiDimension) -> Axis {
    Axis::new(dimension.target.to_string(), dimension.target.unit())
}

/// Places from one end of an entry's range to the other.
fn places(dimension: &PsiDimension, count: usize) -> impl Iterator<Item = f64> {
    let (lower, upper) = (dimension.lower, dimension.upper);
    (0..count).map(move |index| lower + (upper - lower) * index as f64 / (count - 1) as f64)
}

fn slice(
    process: &GaussianProcess,
    dimension: &PsiDimension,
    best: &[f64],
    data: &[Observation],
    index: usize,
) -> Chart {
    // Places with their posterior, and candidates with their mean return.
    let mut rows: Vec<(f64, Option<[f64; 3]>, Option<f64>)> = places(dimension, PLACES)
        .map(|at| {
            let mut point = best.to_vec();
            point[index] = at;
            let posterior = process.posterior(&point);
            let reach = 2.0 * posterior.deviation();
            (at, Some([posterior.mean, posterior.mean - reach, posterior.mean + reach]), None)
        })
        .collect();
    rows.extend(data.iter().map(|it| (it.point[index], None, Some(it.mean_return()))));
    rows.sort_by(|one, other| one.0.total_cmp(&other.0));
    let column =
        |of: usize| rows.iter().map(move |row| row.1.map(|values| values[of])).collect::<Vec<_>>();
    Chart {
        x: axis(dimension),
        y: Axis::new("return", ""),
        xs: rows.iter().map(|row| row.0).collect(),
        series: vec![
            Series::new("expected", Style::Line, 0, column(0)).over_gaps(),
            Series::new("− 2 deviations", Style::Edge, 0, column(1)).over_gaps(),
            Series::new("+ 2 deviations", Style::Edge, 0, column(2)).over_gaps(),
            Series::new("candidate", Style::Dots, 1, rows.iter().map(|row| row.2)),
        ],
        bands: vec![Band { lower: 1, upper: 2, colour: 0 }],
        marks: vec![Mark::vertical(best[index], "recommended")],
        x_range: Some([dimension.lower, dimension.upper]),
        height: Some(230),
        ..Chart::default()
    }
}

fn map(
    process: &GaussianProcess,
    dimensions: &[PsiDimension],
    best: &[f64],
    data: &[Observation],
    [across, up]: [usize; 2],
) -> Map {
    let xs: Vec<f64> = places(&dimensions[across], SIDE).collect();
    let ys: Vec<f64> = places(&dimensions[up], SIDE).collect();
    let mut values = Vec::with_capacity(SIDE * SIDE);
    for y in &ys {
        for x in &xs {
            let mut point = best.to_vec();
            (point[across], point[up]) = (*x, *y);
            values.push(process.mean(&point));
        }
    }
    Map {
        x: axis(&dimensions[across]),
        y: axis(&dimensions[up]),
        value: Axis::new("expected return", ""),
        xs,
        ys,
        values,
        points: data.iter().map(|it| [it.point[across], it.point[up]]).collect(),
        best: [best[across], best[up]],
    }
}
