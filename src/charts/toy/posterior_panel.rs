use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;

use super::problem::{RANGE, Samples, curve};
use crate::charts::style::VERMILION;
pub use crate::charts::style::{BLUE, FONT};
use crate::surrogate::GaussianProcess;

pub type Area<'a> = DrawingArea<SVGBackend<'a>, plotters::coord::Shift>;
pub type Chart<'a, 'b> =
    ChartContext<'a, SVGBackend<'b>, Cartesian2d<RangedCoordf64, RangedCoordf64>>;

/// Colour of the true curve.
pub const GREY: RGBColor = RGBColor(90, 96, 106);
/// Colour of a chosen point: the next sample, or the most likely hyperparameters.
pub const RED: RGBColor = VERMILION;

/// The presence of names at the axes of a panel.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum AxisNames {
    Shown,
    Hidden,
}

/// Returns the values of x at which curves are drawn.
pub fn places() -> impl Iterator<Item = f64> + Clone {
    (0..=240).map(|index| RANGE.0 + (RANGE.1 - RANGE.0) * f64::from(index) / 240.0)
}

/// Draws the posterior: mean, a band of two standard deviations on either side, samples and the
/// true curve. Returns the chart, so that more can be drawn into it.
pub fn draw<'a, 'b>(
    area: &'a Area<'b>,
    title: &str,
    process: &GaussianProcess,
    samples: &Samples,
    axes: AxisNames,
) -> anyhow::Result<Chart<'a, 'b>> {
    let mut chart = ChartBuilder::on(area)
        .caption(title, (FONT, 16))
        .margin(6)
        .margin_right(16)
        .x_label_area_size(if axes == AxisNames::Shown { 34 } else { 22 })
        .y_label_area_size(50)
        .build_cartesian_2d(RANGE.0..RANGE.1, -3.0..1.5)?;
    let mut mesh = chart.configure_mesh();
    mesh.light_line_style(WHITE.mix(0.0)).x_labels(7).y_labels(6).label_style((FONT, 13));
    if axes == AxisNames::Shown {
        mesh.x_desc("x").y_desc("f(x)").axis_desc_style((FONT, 14));
    }
    mesh.draw()?;

    let band = |sign: f64| {
        places().map(move |x| {
            let posterior = process.posterior(&[x]);
            (x, (posterior.mean + sign * 2.0 * posterior.deviation()).clamp(-3.0, 1.5))
        })
    };
    let mut outline: Vec<(f64, f64)> = band(1.0).collect();
    outline.extend(band(-1.0).collect::<Vec<_>>().into_iter().rev());
    chart.draw_series([Polygon::new(outline, BLUE.mix(0.18).filled())])?;
    let truth = places().map(|x| (x, curve(x)));
    chart.draw_series(DashedLineSeries::new(truth, 5, 4, GREY.stroke_width(2)))?;
    let mean = places().map(|x| (x, process.mean(&[x]).clamp(-3.0, 1.5)));
    chart.draw_series(LineSeries::new(mean, BLUE.stroke_width(3)))?;
    let dots =
        samples.x.iter().zip(&samples.y).map(|(x, y)| Circle::new((x[0], *y), 4, BLACK.filled()));
    chart.draw_series(dots)?;
    Ok(chart)
}

/// Draws a key in one line: the marks of [`draw`], then the `further` marks.
pub fn draw_key(area: &Area, further: &[(&str, RGBColor)]) -> anyhow::Result<()> {
    let mut x = 20;
    let text = |x: i32, words: &str| Text::new(words.to_string(), (x, 4), (FONT, 15));
    let stroke = |x: i32, colour: RGBColor, width: u32| {
        PathElement::new(vec![(x, 12), (x + 26, 12)], colour.stroke_width(width))
    };
    area.draw(&stroke(x, BLUE, 2))?;
    area.draw(&text(x + 32, "posterior mean"))?;
    x += 160;
    area.draw(&Rectangle::new([(x, 6), (x + 26, 18)], BLUE.mix(0.18).filled()))?;
    area.draw(&text(x + 32, "± 2 standard deviations"))?;
    x += 220;
    for dash in 0..3 {
        area.draw(&PathElement::new(
            vec![(x + 9 * dash, 12), (x + 9 * dash + 5, 12)],
            GREY.stroke_width(2),
        ))?;
    }
    area.draw(&text(x + 32, "true curve"))?;
    x += 130;
    area.draw(&Circle::new((x + 13, 12), 3, BLACK.filled()))?;
    area.draw(&text(x + 26, "noisy samples"))?;
    x += 145;
    for (words, colour) in further {
        area.draw(&stroke(x, *colour, 2))?;
        area.draw(&text(x + 32, words))?;
        x += 48 + 8 * words.len() as i32;
    }
    Ok(())
}
