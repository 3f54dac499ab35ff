use plotters::prelude::*;

use super::style::{FAINT, FONT, INK, TEXT, TITLE, colour, widest};
use super::{DrawingError, PlotError};

/// A step line of the figure, with its name.
#[derive(Clone, Debug, PartialEq)]
pub struct StepLine {
    /// Name beside the panel.
    pub name: String,
    /// Corners of the line: number of real rollouts, and share of the repetitions, 0 to 1.
    pub corners: Vec<(f64, f64)>,
}

/// Distance of each line below the line before it, as a share of the repetitions. It keeps equal
/// lines from hiding each other.
const APART: f64 = 0.012;

/// Width of the lines' panel, pixels.
const PANEL: u32 = 860;
/// Smallest width of the names' column, pixels.
const NAMES: u32 = 140;
/// Place of a name in its column, pixels from the left.
const NAME_X: i32 = 38;
/// Place of the first name, pixels from the top.
const NAME_Y: i32 = 60;
/// Distance of the names, pixels.
const NAME_STEP: i32 = 24;
/// Height of the note below the panel, pixels.
const NOTE: u32 = 24;

/// Draws, for each method, the share of repetitions whose recommendation has succeeded, as a step
/// line over the number of real rollouts. A line that ends below 1 has repetitions that never
/// succeeded. `last` is the number of rollouts at the right end of the axis, above 1.
///
/// # Errors
/// The drawing library failed.
pub fn methods_svg(title: &str, lines: &[StepLine], last: f64) -> Result<String, DrawingError> {
    let mut svg = String::new();
    draw(&mut svg, title, lines, last)?;
    Ok(svg)
}

fn draw(svg: &mut String, title: &str, steps: &[StepLine], last: f64) -> Result<(), PlotError> {
    let names: Vec<String> = steps
        .iter()
        .map(|line| {
            let never = line.corners.iter().all(|corner| corner.1 == 0.0);
            if never { format!("{}: never", line.name) } else { line.name.clone() }
        })
        .collect();
    let column = NAME_X as u32 + widest(names.iter().map(String::as_str)) + 10;
    let width = PANEL + column.max(NAMES);
    let height = (NAME_Y + NAME_STEP * steps.len() as i32) as u32;
    let height = height.max(476);
    let root = SVGBackend::with_string(svg, (width, height + NOTE)).into_drawing_area();
    root.fill(&WHITE)?;
    let (root, note) = root.split_vertically(height);
    let words = "Lines are drawn a little apart, so that equal lines do not hide each other. A line that ends below 1 has repetitions that never succeeded.";
    note.draw(&Text::new(words, (60, 2), (FONT, TEXT - 2).into_font().color(&INK)))?;
    // The names have a column of their own, because the lines end at any height.
    let (lines, column) = root.split_horizontally(PANEL);
    let below = APART * steps.len() as f64 + 0.02;
    let mut chart = ChartBuilder::on(&lines)
        .margin(10)
        .caption(title, (FONT, TITLE))
        .x_label_area_size(42)
        .y_label_area_size(52)
        // A logarithmic axis shows both one or two recordings and a hundred rollouts.
        .build_cartesian_2d((1.0..last).log_scale(), -below..1.05)?;
    chart
        .configure_mesh()
        .light_line_style(TRANSPARENT)
        .bold_line_style(FAINT)
        .x_desc("real rollouts")
        .y_desc("share of repetitions")
        .x_label_formatter(&|rollouts| format!("{rollouts:.0}"))
        .y_label_formatter(&|share| {
            if *share < -1e-9 { String::new() } else { format!("{share:.1}") }
        })
        .label_style((FONT, TEXT - 2))
        .axis_desc_style((FONT, TEXT))
        .draw()?;
    for (index, (line, name)) in steps.iter().zip(names).enumerate() {
        let style = colour(index).stroke_width(3);
        let lower = APART * index as f64;
        let corners = line.corners.iter().map(|(rollouts, share)| (*rollouts, share - lower));
        chart.draw_series(LineSeries::new(corners, style))?;
        let below = NAME_Y + NAME_STEP * index as i32;
        column.draw(&PathElement::new([(8, below), (32, below)], style))?;
        let place = (NAME_X, below - 8);
        column.draw(&Text::new(name, place, (FONT, TEXT).into_font().color(&INK)))?;
    }
    root.present()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_figure_names_every_line_and_hides_none() {
        let line = |name: &str, corners| StepLine { name: name.into(), corners };
        let flat = vec![(1.0, 0.0), (125.0, 0.0)];
        let lines =
            [line("cem", flat.clone()), line("random", flat), line("bayrn", vec![(1.0, 0.5)])];
        let svg = methods_svg("opt-nominal on lab", &lines, 125.0).unwrap();
        assert!(svg.contains("cem: never") && svg.contains("opt-nominal on lab"), "{svg}");
        assert!(svg.ends_with("</svg>\n"));
        let flat: Vec<&str> = svg
            .lines()
            .filter(|it| it.contains("polyline") && it.contains("stroke-width=\"3\""))
            .collect();
        let heights: std::collections::BTreeSet<&str> = flat
            .iter()
            .filter_map(|it| it.split("points=\"").nth(1)?.split([',', ' ']).nth(1))
            .collect();
        assert!(heights.len() >= 3, "{flat:?}");
    }

    #[test]
    fn the_figure_grows_with_long_names_and_many_lines() {
        let line = |name: &str| StepLine { name: name.into(), corners: vec![(1.0, 0.0)] };
        let few = methods_svg("few", &[line("cem")], 125.0).unwrap();
        assert!(few.contains("viewBox=\"0 0 1000 500\""), "{few}");
        let lines = vec![line("identify-mean"); 20];
        let many = methods_svg("many", &lines, 125.0).unwrap();
        // The longest name is `identify-mean: never`, and the twentieth is 60 + 24 * 19 pixels from
        // the top.
        assert!(many.contains("viewBox=\"0 0 1088 564\""), "{many}");
    }
}
