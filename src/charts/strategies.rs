use plotters::prelude::*;

use super::{DrawingError, PlotError};

/// A line of steps with its name.
#[derive(Clone, Debug, PartialEq)]
pub struct StepLine {
    /// Name beside the figure.
    pub name: String,
    /// Corners of the line: real rollouts and share of repetitions.
    pub corners: Vec<(f64, f64)>,
}

/// Draws the share of repetitions whose recommendation has succeeded against real rollouts, a step line for
/// each method. A line below 1 at its end has repetitions that never succeed. `last` is the right end of the
/// axis.
///
/// # Errors
/// The drawing library failed.
pub fn strategies_svg(title: &str, lines: &[StepLine], last: f64) -> Result<String, DrawingError> {
    let mut svg = String::new();
    draw(&mut svg, title, lines, last)?;
    Ok(svg)
}

fn draw(svg: &mut String, title: &str, steps: &[StepLine], last: f64) -> Result<(), PlotError> {
    let root = SVGBackend::with_string(svg, (1000, 450)).into_drawing_area();
    root.fill(&WHITE)?;
    // Lines end anywhere at the right; their names are beside them.
    let (lines, names) = root.split_horizontally(880);
    let mut chart = ChartBuilder::on(&lines)
        .margin(10)
        .caption(title, ("sans-serif", 18))
        .x_label_area_size(35)
        .y_label_area_size(45)
        // A logarithmic axis shows one or two recordings as well as a hundred rollouts.
        .build_cartesian_2d((1.0..last).log_scale(), 0.0..1.05)?;
    chart
        .configure_mesh()
        .light_line_style(TRANSPARENT)
        .x_desc("real rollouts")
        .y_desc("share of repetitions")
        .x_label_formatter(&|rollouts| format!("{rollouts:.0}"))
        .draw()?;
    for (index, line) in steps.iter().enumerate() {
        let style = Palette99::pick(index).to_rgba().stroke_width(2);
        chart.draw_series(LineSeries::new(line.corners.iter().copied(), style))?;
        let below = 60 + 24 * index as i32;
        names.draw(&PathElement::new([(8, below), (28, below)], style))?;
        names.draw(&Text::new(line.name.as_str(), (34, below - 7), ("sans-serif", 14)))?;
    }
    root.present()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_figure_names_every_line() {
        let line = |name: &str, corners| StepLine { name: name.into(), corners };
        let lines = [line("cem", vec![(1.0, 0.0), (125.0, 0.5)]), line("random", Vec::new())];
        let svg = strategies_svg("opt-nominal on lab", &lines, 125.0).unwrap();
        assert!(svg.contains("cem") && svg.contains("opt-nominal on lab"), "{svg}");
        assert!(svg.ends_with("</svg>\n"));
    }
}
