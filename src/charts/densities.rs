use plotters::prelude::*;

use super::style::{FAINT, FONT, INK, Key, LINE, TEXT, TITLE, colour, with_key};
use super::{DrawingError, Panel, PlotError};
use crate::qube::{DomainParameter, PlantModel, Quantity};
use crate::simulation::DomainDistribution;

/// Number of points of a drawn density.
const POINTS: usize = 600;

/// Draws the thesis's figure 5.2: the densities of masses and lengths for each recipe, which is
/// given with its name. A panel shows 0.3 to 1.7 times the plant's nominal value, which a dashed
/// line marks. A recipe without spread in a parameter has no curve in its panel; one without spread
/// in all four has only an entry in the key. Each density is divided by its own peak, because the
/// high peak of a narrow density would flatten all others.
///
/// # Errors
/// The drawing library failed.
pub fn densities_svg(
    recipes: &[(String, DomainDistribution)],
    plant: &PlantModel,
) -> Result<String, DrawingError> {
    let mut svg = String::new();
    densities(&mut svg, recipes, plant)?;
    Ok(svg)
}

fn densities(
    svg: &mut String,
    recipes: &[(String, DomainDistribution)],
    plant: &PlantModel,
) -> Result<(), PlotError> {
    let root = SVGBackend::with_string(svg, (1000, 780)).into_drawing_area();
    root.fill(&WHITE)?;
    let spread = |distribution: &DomainDistribution| {
        DomainParameter::MASSES_AND_LENGTHS
            .iter()
            .any(|it| distribution.marginal(*it).standard_deviation() > 0.0)
    };
    let named = recipes.iter().enumerate();
    let mut entries: Vec<(String, Key)> = named
        .map(|(index, (name, distribution))| match spread(distribution) {
            true => (name.clone(), Key::Line(colour(index), LINE)),
            false => (format!("{name}: no spread"), Key::Line(WHITE, LINE)),
        })
        .collect();
    entries.push(("nominal value".into(), Key::Dashed(INK)));
    let panels = with_key(&root, &entries)?.split_evenly((2, 2));
    for (panel, parameter) in panels.iter().zip(DomainParameter::MASSES_AND_LENGTHS) {
        density_panel(panel, parameter, recipes, plant.parameters.get(parameter))?;
    }
    root.present()
}

fn density_panel(
    panel: &Panel<'_>,
    parameter: DomainParameter,
    recipes: &[(String, DomainDistribution)],
    nominal: f64,
) -> Result<(), PlotError> {
    let (low, high) = (0.3 * nominal, 1.7 * nominal);
    let at = |index: usize| low + (high - low) * index as f64 / (POINTS - 1) as f64;
    let unit = Quantity::Parameter(parameter).unit();
    let mut chart = ChartBuilder::on(panel)
        .margin(10)
        .margin_right(24)
        .caption(parameter.symbol(), (FONT, TITLE))
        .x_label_area_size(42)
        .y_label_area_size(52)
        .build_cartesian_2d(low..high, 0.0..1.08)?;
    chart
        .configure_mesh()
        .light_line_style(TRANSPARENT)
        .bold_line_style(FAINT)
        .x_labels(6)
        .y_labels(5)
        .x_desc(format!("{} [{unit}]", parameter.symbol()))
        .y_desc("density / its peak")
        .label_style((FONT, TEXT - 2))
        .axis_desc_style((FONT, TEXT))
        .draw()?;
    chart.draw_series(DashedLineSeries::new(
        [(nominal, 0.0), (nominal, 1.08)],
        6,
        5,
        INK.stroke_width(1),
    ))?;
    for (index, (_, distribution)) in recipes.iter().enumerate() {
        let drawn = distribution.marginal(parameter);
        let peak = drawn.density(drawn.mean());
        if peak == 0.0 {
            continue;
        }
        let curve = (0..POINTS).map(|point| (at(point), drawn.density(at(point)) / peak));
        chart.draw_series(LineSeries::new(curve, colour(index).stroke_width(LINE)))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulation::Family;

    #[test]
    fn the_figure_names_every_recipe_unit_and_line() {
        let recipes = [
            ("handcrafted".to_owned(), DomainDistribution::handcrafted(Family::Normal)),
            ("nominal".to_owned(), DomainDistribution::nominal()),
        ];
        let svg = densities_svg(&recipes, &PlantModel::QUBE).unwrap();
        for text in ["handcrafted", "nominal: no spread", "nominal value", "L_p [m]", "M_r [kg]"] {
            assert!(svg.contains(text), "{text}");
        }
        assert!(svg.ends_with("</svg>\n"));
    }
}
