use plotters::prelude::*;

use super::{DrawingError, Panel, PlotError};
use crate::qube::{DomainParameter, DomainParameters};
use crate::simulation::DomainDistribution;

/// Masses and lengths, the parameters of figure 5.2.
const SHOWN: [DomainParameter; 4] = [
    DomainParameter::RotaryMass,
    DomainParameter::PendulumMass,
    DomainParameter::RotaryLength,
    DomainParameter::PendulumLength,
];

/// Number of points of a density.
const POINTS: usize = 300;

/// Draws the thesis's figure 5.2: the densities of masses and lengths for each recipe, by its name; a dashed
/// line marks the nominal value.
///
/// # Errors
/// The drawing library failed.
pub fn densities_svg(recipes: &[(String, DomainDistribution)]) -> Result<String, DrawingError> {
    let mut svg = String::new();
    densities(&mut svg, recipes)?;
    Ok(svg)
}

fn densities(svg: &mut String, recipes: &[(String, DomainDistribution)]) -> Result<(), PlotError> {
    let root = SVGBackend::with_string(svg, (1000, 750)).into_drawing_area();
    root.fill(&WHITE)?;
    for (panel, parameter) in root.split_evenly((2, 2)).iter().zip(SHOWN) {
        density_panel(panel, parameter, recipes)?;
    }
    root.present()
}

fn density_panel(
    panel: &Panel<'_>,
    parameter: DomainParameter,
    recipes: &[(String, DomainDistribution)],
) -> Result<(), PlotError> {
    let nominal = DomainParameters::NOMINAL.get(parameter);
    let (low, high) = (0.3 * nominal, 1.7 * nominal);
    let at = |index: usize| low + (high - low) * index as f64 / (POINTS - 1) as f64;
    let curves: Vec<Vec<(f64, f64)>> = recipes
        .iter()
        .map(|(_, distribution)| {
            let drawn = distribution.get(parameter);
            (0..POINTS).map(|index| (at(index), drawn.density(at(index)) * nominal)).collect()
        })
        .collect();
    // A single narrow density must not flatten the others.
    let highest = |curve: &Vec<(f64, f64)>| curve.iter().map(|point| point.1).fold(0.0, f64::max);
    let top = curves.iter().map(highest).fold(1.0, f64::max).min(12.0) * 1.1;
    let mut chart = ChartBuilder::on(panel)
        .margin(10)
        .caption(parameter.symbol(), ("sans-serif", 18))
        .x_label_area_size(35)
        .y_label_area_size(55)
        .build_cartesian_2d(low..high, 0.0..top)?;
    chart
        .configure_mesh()
        .light_line_style(TRANSPARENT)
        .x_labels(6)
        .y_desc("density x nominal value")
        .draw()?;
    for (index, ((name, _), curve)) in recipes.iter().zip(curves).enumerate() {
        if highest(&curve) == 0.0 {
            continue;
        }
        let colour = Palette99::pick(index).to_rgba();
        chart
            .draw_series(LineSeries::new(curve, colour.stroke_width(2)))?
            .label(name)
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 16, y)], colour.stroke_width(2)));
    }
    chart.draw_series(DashedLineSeries::new(
        [(nominal, 0.0), (nominal, top)],
        4,
        4,
        BLACK.stroke_width(1),
    ))?;
    chart
        .configure_series_labels()
        .position(SeriesLabelPosition::UpperRight)
        .background_style(WHITE.mix(0.8))
        .draw()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulation::Family;

    #[test]
    fn the_figure_shows_every_recipe() {
        let recipes = [
            ("handcrafted".to_owned(), DomainDistribution::handcrafted(Family::Normal)),
            ("nominal".to_owned(), DomainDistribution::nominal()),
        ];
        let svg = densities_svg(&recipes).unwrap();
        assert!(svg.contains("handcrafted") && svg.contains("L_p") && svg.ends_with("</svg>\n"));
    }
}
