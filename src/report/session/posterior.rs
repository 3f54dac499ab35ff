//! The section about the surrogate: its posterior of the return over psi.

use thiserror::Error;

use super::SessionSource;
use crate::report::chart::{Axis, Band, Chart, Map, Mark, Series, Style};
use crate::report::page::Page;
use crate::search::{Observation, SearchError};
use crate::session::SessionSettings;
use crate::simulation::PsiDimension;
use crate::surrogate::GaussianProcess;

/// Smallest number of candidates to which a surrogate is fitted.
const FEWEST_CANDIDATES: usize = 3;

/// Number of points along a slice.
const PLACES: usize = 61;

/// Number of points along each side of the map.
const SIDE: usize = 31;

/// A session's surrogate of the return over psi, fitted to all returns so far that inform the
/// search.
#[derive(Debug)]
pub struct SessionSurrogate {
    /// Settings of the search; the entries of their psi are the surrogate's coordinates.
    pub settings: SessionSettings,
    /// Candidates and their returns, to which the process was fitted.
    pub data: Vec<Observation>,
    /// The Gaussian process.
    pub process: GaussianProcess,
    /// Psi that the search recommends.
    pub best: Vec<f64>,
}

/// The reason why a session has no surrogate, as a sentence for the report.
#[derive(Debug, Error, PartialEq)]
pub enum NoSurrogate {
    /// There are too few candidates.
    #[error(
        "A surrogate of the return over psi needs {FEWEST_CANDIDATES} candidates; the session has {0} with rollouts of a policy \
         that was trained at their psi."
    )]
    TooFew(usize),
    /// The strategy of the session fits no surrogate.
    #[error("The strategy {0} has no surrogate.")]
    NoneInStrategy(&'static str),
    /// A profile that the session identified cannot be read.
    #[error(
        "The surrogate is unknown, because a profile that determines its coordinates cannot be read."
    )]
    ProfileLost,
    /// The data cannot be fitted.
    #[error("The surrogate cannot be fitted: {0}")]
    Unfit(#[from] SearchError),
}

impl SessionSource {
    /// Fits the surrogate to the candidates' returns.
    ///
    /// # Errors
    /// The candidates are too few, the strategy has no surrogate, a profile cannot be read, or the
    /// data cannot be fitted.
    pub fn surrogate(&self) -> Result<SessionSurrogate, NoSurrogate> {
        let searched = self.candidates.iter().filter(|it| it.candidate.purpose.is_searched());
        let informing = searched.filter(|it| it.informs_search());
        let data: Vec<Observation> = informing.map(|it| it.observation()).collect();
        if data.len() < FEWEST_CANDIDATES {
            return Err(NoSurrogate::TooFew(data.len()));
        }
        let settings = self.search_settings(None).ok_or(NoSurrogate::ProfileLost)?;
        let process = settings
            .surrogate(&data)?
            .ok_or_else(|| NoSurrogate::NoneInStrategy(settings.strategy.name()))?;
        let best = settings.search()?.recommend(&data)?.point;
        Ok(SessionSurrogate { settings, data, process, best })
    }
}

/// Adds slices of the posterior through the recommended psi and, if psi has several entries, a map
/// over the two most relevant ones; without a surrogate, adds the reason why there is none.
pub(super) fn add_posterior(page: &mut Page, source: &SessionSource) {
    page.section("Surrogate of the return");
    match source.surrogate() {
        Ok(surrogate) => draw(page, &surrogate),
        Err(reason) => page.paragraph(&reason.to_string()),
    }
}

fn draw(page: &mut Page, surrogate: &SessionSurrogate) {
    let SessionSurrogate { settings, data, process, best } = surrogate;
    let (data, best) = (data.as_slice(), best.as_slice());
    page.paragraph(
        "A Gaussian process is fitted to the mean returns. Each slice changes one entry of psi and keeps the others \
         as recommended; the dots are the candidates; their other entries of psi differ from the recommended ones, so they \
         need not lie on the curve.",
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

/// Evenly spaced values from the lower to the upper end of an entry's range.
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
    // Each row is either a place with its posterior or a candidate with its mean return.
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
