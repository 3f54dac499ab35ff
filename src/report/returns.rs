use super::chart::{Axis, Chart, Mark, Series, Style};
use crate::scoring::criterion::SUCCESS_RETURN;

/// A candidate of a search in the figure of returns.
#[derive(Clone, Debug, PartialEq)]
pub struct CandidateReturns {
    /// Number of the candidate.
    pub number: u32,
    /// Returns of its rollouts; at least one.
    pub returns: Vec<f64>,
    /// True if the candidate belongs to the search and therefore counts for the line of the best
    /// mean return so far.
    pub is_searched: bool,
}

/// The points at one position of the horizontal axis: either a rollout's return, or a candidate's
/// mean return and the best mean so far.
struct Place {
    at: f64,
    rollout: Option<f64>,
    mean: Option<f64>,
    best: Option<f64>,
}

/// A figure of the returns of candidates, which must be in increasing order of their numbers.
/// `largest` is the largest return that is possible; `boundaries` are further lines across the
/// figure.
#[must_use]
pub fn returns_chart(
    candidates: &[CandidateReturns],
    largest: f64,
    boundaries: Vec<Mark>,
) -> Chart {
    let mut places: Vec<Place> = Vec::new();
    let (mut best, mut least) = (f64::NEG_INFINITY, f64::INFINITY);
    for CandidateReturns { number, returns, is_searched } in candidates {
        let at = f64::from(*number);
        for &return_ in returns {
            least = least.min(return_);
            places.push(Place { at, rollout: Some(return_), mean: None, best: None });
        }
        let mean = returns.iter().sum::<f64>() / returns.len().max(1) as f64;
        if *is_searched {
            best = best.max(mean);
        }
        let so_far = is_searched.then_some(best);
        places.push(Place { at, rollout: None, mean: Some(mean), best: so_far });
    }
    let first = candidates.first().map_or(0.0, |it| f64::from(it.number));
    let last = candidates.last().map_or(0.0, |it| f64::from(it.number));
    let mut marks =
        vec![Mark::horizontal(SUCCESS_RETURN, format!("success from {SUCCESS_RETURN:.0}"))];
    marks.extend(boundaries);
    // If every return exceeds the success criterion, the axis begins near the criterion, so that
    // the differences between returns can be seen.
    let lowest = if least > SUCCESS_RETURN { 0.9 * SUCCESS_RETURN } else { 0.0 };
    let column = |of: fn(&Place) -> Option<f64>| places.iter().map(of).collect::<Vec<_>>();
    Chart {
        x: Axis::new("candidate", ""),
        y: Axis::new("return", ""),
        xs: places.iter().map(|place| place.at).collect(),
        series: vec![
            Series::new("mean", Style::LineAndDots, 0, column(|it| it.mean)).over_gaps(),
            Series::new("best of the search so far", Style::Steps, 2, column(|it| it.best))
                .over_gaps(),
            // The dots come last, so that no line hides them.
            Series::new("rollout", Style::Dots, 4, column(|it| it.rollout)),
        ],
        marks,
        whole: true,
        x_range: Some([first - 0.5, last + 0.5]),
        y_range: Some([lowest, 1.03 * largest]),
        ..Chart::default()
    }
}
