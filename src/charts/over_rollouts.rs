use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use super::at_budget::{ShareOfPlant, distinct};
use super::style::{FAINT, FONT, INK, Key, TEXT, TITLE, colour, with_key};
use super::{DrawingError, PlotError};

/// Most panels in a row.
const COLUMNS: usize = 4;
/// Width of a panel, pixels.
const WIDTH: u32 = 250;
/// Height of a panel, pixels.
const HEIGHT: u32 = 210;
/// Height of title, key and the words below the panels together, pixels.
const AROUND: u32 = 100;
/// Share of the distance between two budgets over which the points of one budget lie side by side.
const SPREAD: f64 = 0.6;

/// Draws the share of repetitions that succeed over the real rollouts, with its interval: a panel
/// for each plant with a line for each method, or, with more methods than plants, a panel for each
/// method with a line for each plant. The budgets have equal distances.
///
/// # Errors
/// The drawing library failed.
pub fn over_rollouts_svg(title: &str, shares: &[ShareOfPlant]) -> Result<String, DrawingError> {
    let mut svg = String::new();
    draw(&mut svg, title, shares)?;
    Ok(svg)
}

fn draw(svg: &mut String, title: &str, shares: &[ShareOfPlant]) -> Result<(), PlotError> {
    let plants = distinct(shares.iter().map(|it| it.plant.as_str()));
    let methods = distinct(shares.iter().map(|it| it.method.as_str()));
    let mut budgets = distinct(shares.iter().map(|it| it.budget));
    budgets.sort_unstable();
    let panels_are_methods = methods.len() > plants.len();
    let (panels, lines) = if panels_are_methods { (methods, plants) } else { (plants, methods) };
    let panel_and_line = |it: &ShareOfPlant| {
        if panels_are_methods {
            (it.method.clone(), it.plant.clone())
        } else {
            (it.plant.clone(), it.method.clone())
        }
    };
    let columns = panels.len().clamp(1, COLUMNS);
    let rows = panels.len().div_ceil(columns).max(1);
    let size = (WIDTH * columns as u32, AROUND + HEIGHT * rows as u32);
    let root = SVGBackend::with_string(svg, size).into_drawing_area();
    root.fill(&WHITE)?;
    let root = root.titled(title, (FONT, TITLE))?;
    let named = |(index, name): (usize, &&str)| ((*name).to_owned(), Key::Dot(colour(index)));
    let below = with_key(&root, &lines.iter().enumerate().map(named).collect::<Vec<_>>())?;
    let (below, foot) = below.split_vertically(below.dim_in_pixel().1 - 24);
    let style = (FONT, TEXT - 2).into_font().color(&INK);
    let centred = style.pos(Pos::new(HPos::Center, VPos::Top));
    let words = "share of repetitions that succeed, with its 95 % interval, over real rollouts";
    foot.draw(&Text::new(words, (foot.dim_in_pixel().0 as i32 / 2, 2), centred.clone()))?;
    for (area, name) in below.split_evenly((rows, columns)).iter().zip(&panels) {
        let mut chart = ChartBuilder::on(area)
            .margin(8)
            .caption(name, (FONT, TEXT))
            .x_label_area_size(20)
            .y_label_area_size(34)
            .build_cartesian_2d(-0.5..budgets.len() as f64 - 0.5, -0.02..1.02)?;
        chart
            .configure_mesh()
            .disable_x_mesh()
            .light_line_style(TRANSPARENT)
            .bold_line_style(FAINT)
            .x_labels(0)
            .y_labels(5)
            .y_label_formatter(&|share| format!("{share:.1}"))
            .label_style((FONT, TEXT - 2))
            .draw()?;
        for (place, budget) in budgets.iter().enumerate() {
            let (x, y) = chart.backend_coord(&(place as f64, -0.02));
            let (left, top) = (area.get_pixel_range().0.start, area.get_pixel_range().1.start);
            area.draw(&Text::new(budget.to_string(), (x - left, y - top + 4), centred.clone()))?;
        }
        for (index, line) in lines.iter().enumerate() {
            let aside = SPREAD * ((index as f64 + 0.5) / lines.len() as f64 - 0.5);
            let own = shares.iter().filter(|it| {
                let (of_panel, of_line) = panel_and_line(it);
                of_panel == *name && of_line == *line
            });
            let mut points: Vec<(usize, &ShareOfPlant)> = own
                .map(|it| (budgets.iter().position(|of| *of == it.budget).unwrap_or(0), it))
                .collect();
            points.sort_unstable_by_key(|(place, _)| *place);
            let at = |place: usize| place as f64 + aside;
            let shares = points.iter().map(|(place, it)| (at(*place), it.share));
            chart.draw_series(LineSeries::new(shares, colour(index).mix(0.5)))?;
            for (place, it) in points {
                let [lower, upper] = it.interval;
                let bar = [(at(place), lower), (at(place), upper)];
                chart.draw_series(LineSeries::new(bar, colour(index).stroke_width(2)))?;
                chart.draw_series([Circle::new(
                    (at(place), it.share),
                    3,
                    colour(index).filled(),
                )])?;
            }
        }
    }
    root.present()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn share(plant: &str, method: &str, budget: u32) -> ShareOfPlant {
        let (plant, method) = (plant.into(), method.into());
        ShareOfPlant { plant, method, budget, share: 0.9, interval: [0.6, 0.98] }
    }

    #[test]
    fn the_figure_has_a_panel_for_each_plant_and_a_dot_for_each_share() {
        let shares = [
            share("lab", "robust", 0),
            share("lab", "posterior", 2),
            share("lab", "posterior", 20),
            share("play", "posterior", 2),
        ];
        let svg = over_rollouts_svg("success", &shares).unwrap();
        for words in ["lab", "play", "robust", "posterior", "\n20\n"] {
            assert!(svg.contains(words), "{words}: {svg}");
        }
        // Four shares, and two methods in the key.
        assert_eq!(svg.matches("<circle").count(), 6);
        assert!(svg.contains("viewBox=\"0 0 500 310\""), "{svg}");
        // With more methods than plants there is a panel for each method, and a row of four.
        let methods = ["robust", "posterior", "simopt", "cem", "npdr"];
        let svg = over_rollouts_svg("success", &methods.map(|method| share("lab", method, 0)));
        assert!(svg.unwrap().contains("viewBox=\"0 0 1000 520\""));
    }
}
