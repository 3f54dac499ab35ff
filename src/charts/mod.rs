//! Figures as SVG, drawn from data that other rooms computed. Only the figures of [`toy`] compute
//! their own data. The interactive plots of reports and of the live view are not drawn here but by
//! uPlot in the browser, from data that these pages contain or receive.
//!
//! Only the feature `cli` builds this room, so that the library without `cli` needs no drawing
//! library. The room may import `qube`, `simulation`, `replay`, `search` and `surrogate`.

mod animation;
mod at_budget;
mod correlations;
mod densities;
mod methods;
mod motion;
mod noise;
mod over_rollouts;
mod regret;
mod searches;
mod style;
pub mod toy;
mod training_progress;

pub use animation::animation_svg;
pub use at_budget::{ShareOfPlant, at_budget_svg};
pub use correlations::{correlations_element, correlations_svg};
pub use densities::densities_svg;
pub use methods::{StepLine, methods_svg};
pub use motion::motion_svg;
pub use noise::noise_svg;
pub use over_rollouts::over_rollouts_svg;
pub use regret::regret_svg;
pub use searches::searches_svg;
pub use training_progress::training_progress_svg;

use plotters::coord::Shift;
use plotters::prelude::{DrawingArea, DrawingAreaErrorKind, SVGBackend};
use thiserror::Error;

type Panel<'a> = DrawingArea<SVGBackend<'a>, Shift>;
type PlotError = DrawingAreaErrorKind<std::io::Error>;

/// Returns, for each value, the largest number up to and including it; NaN is ignored, and without
/// a number the result is minus infinity.
fn best_so_far(values: &[f64]) -> Vec<f64> {
    let mut best = f64::NEG_INFINITY;
    let best_with = |value: &f64| {
        best = best.max(*value);
        best
    };
    values.iter().map(best_with).collect()
}

/// Escapes the characters that have a meaning in the texts of an SVG.
fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

/// The error that a figure cannot be drawn, because the drawing library failed.
#[derive(Debug, Error)]
#[error("the figure could not be drawn: {reason}")]
pub struct DrawingError {
    /// Cause of the failure.
    reason: String,
}

impl From<PlotError> for DrawingError {
    fn from(error: PlotError) -> Self {
        Self { reason: error.to_string() }
    }
}
