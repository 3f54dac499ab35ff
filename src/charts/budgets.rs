use plotters::prelude::*;

use super::style::{FAINT, FONT, INK, Key, TEXT, TITLE, colour, with_key};
use super::{DrawingError, PlotError};

/// The share of a method's repetitions that succeed on a plant.
#[derive(Clone, Debug, PartialEq)]
pub struct ShareOfPlant {
    /// Name of the plant.
    pub plant: String,
    /// Name of the method.
    pub method: String,
    /// Budget: largest number of real rollouts, after which the recommendation is scored.
    pub budget: u32,
    /// Share that succeeds.
    pub share: f64,
    /// Ends of its 95 % interval.
    pub interval: [f64; 2],
}

/// Height of a plant's row, pixels.
const ROW: u32 = 60;

/// Draws the share of repetitions that succeed, with its interval, for each method on each plant: a panel for each
/// budget of real rollouts.
///
/// # Errors
/// The drawing library failed.
pub fn budgets_svg(title: &str, shares: &[ShareOfPlant]) -> Result<String, DrawingError> {
    let mut svg = String::new();
    draw(&mut svg, title, shares)?;
    Ok(svg)
}

/// The distinct values in the order in which they come.
fn distinct<T: PartialEq>(values: impl Iterator<Item = T>) -> Vec<T> {
    let mut distinct = Vec::new();
    for value in values {
        if !distinct.contains(&value) {
            distinct.push(value);
        }
    }
    distinct
}

fn draw(svg: &mut String, title: &str, shares: &[ShareOfPlant]) -> Result<(), PlotError> {
    let plants = distinct(shares.iter().map(|it| it.plant.as_str()));
    let methods = distinct(shares.iter().map(|it| it.method.as_str()));
    let mut budgets = distinct(shares.iter().map(|it| it.budget));
    budgets.sort_unstable();
    let height = 150 + ROW * plants.len() as u32;
    let root = SVGBackend::with_string(svg, (1000, height)).into_drawing_area();
    root.fill(&WHITE)?;
    let root = root.titled(title, (FONT, TITLE))?;
    let key: Vec<(String, Key)> = methods
        .iter()
        .enumerate()
        .map(|(index, name)| ((*name).to_owned(), Key::Dot(colour(index))))
        .collect();
    let panels = with_key(&root, &key)?;
    let rows = plants.len() as f64;
    let columns = panels.split_evenly((1, budgets.len().max(1)));
    for (column, (panel, budget)) in columns.iter().zip(&budgets).enumerate() {
        // The names of the plants are beside the first panel alone.
        let names = if column == 0 { 120 } else { 10 };
        let mut chart = ChartBuilder::on(panel)
            .margin(10)
            .caption(format!("after {budget} real rollouts"), (FONT, TEXT))
            .x_label_area_size(40)
            .y_label_area_size(names)
            .build_cartesian_2d(0.0..1.0, 0.0..rows)?;
        chart
            .configure_mesh()
            .disable_y_mesh()
            .light_line_style(TRANSPARENT)
            .bold_line_style(FAINT)
            .x_labels(6)
            .y_labels(0)
            .x_desc("share of repetitions that succeed, with its 95 % interval")
            .label_style((FONT, TEXT - 2))
            .axis_desc_style((FONT, TEXT - 2))
            .draw()?;
        for (row, plant) in plants.iter().enumerate() {
            let top = rows - row as f64;
            if column == 0 {
                let (x, y) = chart.backend_coord(&(0.0, top - 0.5));
                let [x0, y0] = [panel.get_pixel_range().0.start, panel.get_pixel_range().1.start];
                let style = (FONT, TEXT).into_font().color(&INK);
                panel.draw(&Text::new((*plant).to_owned(), (x - x0 - 115, y - y0 - 8), style))?;
            }
            let of_row = shares.iter().filter(|it| it.plant == *plant && it.budget == *budget);
            for it in of_row {
                let index = methods.iter().position(|name| *name == it.method).unwrap_or_default();
                let step = 0.8 / methods.len() as f64;
                let y = top - 0.1 - step * (index as f64 + 0.5);
                let [lower, upper] = it.interval;
                let line = [(lower, y), (upper, y)];
                chart.draw_series(LineSeries::new(line, colour(index).stroke_width(2)))?;
                chart.draw_series([Circle::new((it.share, y), 4, colour(index).filled())])?;
            }
        }
    }
    root.present()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_figure_has_a_panel_for_each_budget_and_a_dot_for_each_share() {
        let share = |plant: &str, method: &str, budget| ShareOfPlant {
            plant: plant.into(),
            method: method.into(),
            budget,
            share: 0.9,
            interval: [0.6, 0.98],
        };
        let shares = [
            share("lab", "robust", 0),
            share("lab", "posterior", 2),
            share("play", "posterior", 2),
        ];
        let svg = budgets_svg("success by plant", &shares).unwrap();
        for words in ["after 0 real", "after 2 real", "lab", "play", "robust", "posterior"] {
            assert!(svg.contains(words), "{words}: {svg}");
        }
        // Three shares, and two methods in the key.
        assert_eq!(svg.matches("<circle").count(), 5);
    }
}
