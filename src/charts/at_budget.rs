use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use super::style::{FAINT, FONT, INK, Key, TEXT, TITLE, colour, widest, with_key};
use super::{DrawingError, PlotError};

/// The share of a method's repetitions that succeed on a plant.
#[derive(Clone, Debug, PartialEq)]
pub struct ShareOfPlant {
    /// Name of the plant.
    pub plant: String,
    /// Name of the method.
    pub method: String,
    /// Budget: largest number of real rollouts before the recommendation is scored.
    pub budget: u32,
    /// Share of the repetitions that succeed, 0 to 1.
    pub share: f64,
    /// Lower and upper end of the share's 95 % interval, 0 to 1.
    pub interval: [f64; 2],
}

/// Smallest width of the column with the rows' names, pixels.
const NAMES: u32 = 120;
/// Place of a name in its column, pixels from the left.
const NAME_X: i32 = 14;
/// Width of the panel, pixels.
const PANEL: u32 = 880;

/// Draws the share of repetitions that succeed, with its interval, for each method on each plant.
/// All shares have the same budget of real rollouts. Rows are the plants and colours the methods;
/// with more methods than plants, rows are the methods and colours the plants.
///
/// # Errors
/// The drawing library failed.
pub fn at_budget_svg(title: &str, shares: &[ShareOfPlant]) -> Result<String, DrawingError> {
    let mut svg = String::new();
    draw(&mut svg, title, shares)?;
    Ok(svg)
}

/// Returns the distinct values, in the order of their first appearance.
pub(super) fn distinct<T: PartialEq>(values: impl Iterator<Item = T>) -> Vec<T> {
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
    let rows_are_methods = methods.len() > plants.len();
    let (rows, colours) = if rows_are_methods { (methods, plants) } else { (plants, methods) };
    let row_of = |it: &ShareOfPlant| {
        let name = if rows_are_methods { &it.method } else { &it.plant };
        rows.iter().position(|row| row == name).unwrap_or_default()
    };
    let colour_of = |it: &ShareOfPlant| {
        let name = if rows_are_methods { &it.plant } else { &it.method };
        colours.iter().position(|of| of == name).unwrap_or_default()
    };
    let row_height = 14 + 9 * colours.len() as u32;
    let height = 160 + row_height * rows.len() as u32;
    let names_width = (NAME_X as u32 + widest(rows.iter().copied()) + 10).max(NAMES);
    let root = SVGBackend::with_string(svg, (names_width + PANEL, height)).into_drawing_area();
    root.fill(&WHITE)?;
    let root = root.titled(title, (FONT, TITLE))?;
    let key: Vec<(String, Key)> = colours
        .iter()
        .enumerate()
        .map(|(index, name)| ((*name).to_owned(), Key::Dot(colour(index))))
        .collect();
    let below = with_key(&root, &key)?;
    let (below, foot) = below.split_vertically(below.dim_in_pixel().1 - 24);
    let centred = (FONT, TEXT - 2).into_font().color(&INK).pos(Pos::new(HPos::Center, VPos::Top));
    let words = "share of repetitions that succeed, with its 95 % interval";
    let centre = (names_width as i32 + foot.dim_in_pixel().0 as i32) / 2;
    foot.draw(&Text::new(words, (centre, 2), centred))?;
    let (names, panel) = below.split_horizontally(names_width);
    let budget = shares.first().map_or(0, |it| it.budget);
    let mut chart = ChartBuilder::on(&panel)
        .margin(10)
        .caption(format!("after {budget} real rollouts"), (FONT, TEXT))
        .x_label_area_size(22)
        .y_label_area_size(2)
        .build_cartesian_2d(0.0..1.0, 0.0..rows.len() as f64)?;
    chart
        .configure_mesh()
        .disable_y_mesh()
        .light_line_style(TRANSPARENT)
        .bold_line_style(FAINT)
        .x_labels(6)
        .y_labels(0)
        .label_style((FONT, TEXT - 2))
        .draw()?;
    for (row, name) in rows.iter().enumerate() {
        let top = (rows.len() - row) as f64;
        chart.draw_series(LineSeries::new([(0.0, top), (1.0, top)], FAINT))?;
        let (_, y) = chart.backend_coord(&(0.0, top - 0.5));
        let y = y - names.get_pixel_range().1.start;
        let style = (FONT, TEXT).into_font().color(&INK);
        names.draw(&Text::new((*name).to_owned(), (NAME_X, y - 8), style))?;
    }
    for it in shares {
        let (top, index) = ((rows.len() - row_of(it)) as f64, colour_of(it));
        let step = 0.8 / colours.len() as f64;
        let y = top - 0.1 - step * (index as f64 + 0.5);
        let [lower, upper] = it.interval;
        let line = [(lower, y), (upper, y)];
        chart.draw_series(LineSeries::new(line, colour(index).stroke_width(2)))?;
        chart.draw_series([Circle::new((it.share, y), 4, colour(index).filled())])?;
    }
    root.present()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_figure_has_a_row_for_each_plant_and_a_dot_for_each_share() {
        let share = |plant: &str, method: &str| ShareOfPlant {
            plant: plant.into(),
            method: method.into(),
            budget: 2,
            share: 0.9,
            interval: [0.6, 0.98],
        };
        let shares =
            [share("lab", "robust"), share("lab", "posterior"), share("play", "posterior")];
        let svg = at_budget_svg("success by plant", &shares).unwrap();
        for words in ["after 2 real", "lab", "play", "robust", "posterior"] {
            assert!(svg.contains(words), "{words}: {svg}");
        }
        // Three shares, and two methods in the key.
        assert_eq!(svg.matches("<circle").count(), 5);
        // With more methods than plants the key has the plants.
        let methods = ["robust", "posterior", "simopt"].map(|method| share("lab", method));
        let svg = at_budget_svg("success by plant", &methods).unwrap();
        assert_eq!(svg.matches("<circle").count(), 4);
        assert!(svg.contains("viewBox=\"0 0 1000 "), "{svg}");
        // A long name has a wider column, so that it is not drawn across the panel.
        let svg = at_budget_svg("long", &[share("mine-2026+gap1.5+vary5%", "robust")]).unwrap();
        assert!(svg.contains("viewBox=\"0 0 1111 "), "{svg}");
    }
}
