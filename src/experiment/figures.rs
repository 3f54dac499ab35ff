//! The thesis's figures 5.2 and 5.3 for an experiment, as SVG.

use plotters::coord::Shift;
use plotters::prelude::*;

use super::search::searched;
use super::{Experiment, ExperimentError, Recipe};
use crate::qube::{DomainParameter, DomainParameters};
use crate::simulation::{Distribution, DomainDistribution};

type Panel<'a> = DrawingArea<SVGBackend<'a>, Shift>;
pub(super) type PlotError = DrawingAreaErrorKind<std::io::Error>;

/// Masses and lengths, the parameters of figure 5.2.
const SHOWN: [DomainParameter; 4] = [
    DomainParameter::RotaryMass,
    DomainParameter::PendulumMass,
    DomainParameter::RotaryLength,
    DomainParameter::PendulumLength,
];

/// Number of points of a density.
const POINTS: usize = 300;

/// The returns of each candidate's rollouts in a search, in the order of candidates.
type Searched = Vec<Vec<f64>>;

/// Draws figure 5.2: the densities of masses and lengths for every recipe whose psi is known; a dashed line
/// marks the nominal value.
///
/// # Errors
/// A search cannot be read, or the drawing library fails.
/// A search cannot be read; the drawing library failed.
pub fn densities_svg(experiment: &Experiment) -> Result<String, ExperimentError> {
    let mut drawn = Vec::new();
    for recipe in &experiment.settings().recipes {
        if let Some(psi) = experiment.psi(recipe)? {
            drawn.push((recipe.name.clone(), recipe.distribution(&psi)?));
        }
    }
    let mut svg = String::new();
    densities(&mut svg, &drawn).map_err(drawing_failed)?;
    Ok(svg)
}

/// Draws figure 5.3: for each optimised recipe the return of each candidate in turn, and of the best so
/// far; dots are single rollouts.
///
/// # Errors
/// A search cannot be read, or the drawing library fails.
pub fn searches_svg(experiment: &Experiment) -> Result<String, ExperimentError> {
    let is_optimised = |recipe: &&Recipe| recipe.model.is_optimised();
    let mut drawn = Vec::new();
    for recipe in experiment.settings().recipes.iter().filter(is_optimised) {
        let folder = experiment.folder().search(&recipe.name);
        let returns = searched(&folder, 0)?.into_iter().map(|candidate| candidate.returns);
        drawn.push((recipe.name.clone(), returns.collect()));
    }
    let mut svg = String::new();
    searches(&mut svg, &drawn).map_err(drawing_failed)?;
    Ok(svg)
}

pub(super) fn drawing_failed(error: PlotError) -> ExperimentError {
    ExperimentError::Drawing { reason: error.to_string() }
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
            (0..POINTS).map(|index| (at(index), density(&drawn, at(index)) * nominal)).collect()
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

/// The density at a value; zero for a constant, which has no density.
fn density(distribution: &Distribution, value: f64) -> f64 {
    let (mean, deviation) = (distribution.mean(), distribution.standard_deviation());
    if deviation == 0.0 {
        return 0.0;
    }
    let z = (value - mean) / deviation;
    match distribution {
        Distribution::Constant { .. } => 0.0,
        Distribution::Normal { .. } => {
            (-0.5 * z * z).exp() / (deviation * (2.0 * std::f64::consts::PI).sqrt())
        }
        Distribution::Uniform { .. } if z.abs() <= 3.0_f64.sqrt() => {
            1.0 / (12.0_f64.sqrt() * deviation)
        }
        Distribution::Uniform { .. } => 0.0,
    }
}

fn searches(svg: &mut String, recipes: &[(String, Searched)]) -> Result<(), PlotError> {
    let rows = recipes.len().max(1);
    let root = SVGBackend::with_string(svg, (1000, 320 * rows as u32)).into_drawing_area();
    root.fill(&WHITE)?;
    let panels = root.split_evenly((rows, 2));
    for ((name, candidates), pair) in recipes.iter().zip(panels.chunks(2)) {
        let means: Vec<f64> = candidates.iter().map(|it| super::statistics::mean(it)).collect();
        let best: Vec<f64> = means
            .iter()
            .scan(f64::NEG_INFINITY, |best, mean| {
                *best = best.max(*mean);
                Some(*best)
            })
            .collect();
        search_panel(&pair[0], &format!("{name}: each candidate"), &means, candidates)?;
        search_panel(&pair[1], &format!("{name}: best so far"), &best, &[])?;
    }
    root.present()
}

fn search_panel(
    panel: &Panel<'_>,
    title: &str,
    line: &[f64],
    dots: &[Vec<f64>],
) -> Result<(), PlotError> {
    let last = line.len().max(2) as f64 - 0.5;
    let mut chart = ChartBuilder::on(panel)
        .margin(10)
        .caption(title, ("sans-serif", 16))
        .x_label_area_size(35)
        .y_label_area_size(55)
        .build_cartesian_2d(-0.5..last, 0.0..600.0)?;
    chart
        .configure_mesh()
        .light_line_style(TRANSPARENT)
        .x_desc("candidate")
        .x_label_formatter(&|candidate| format!("{candidate:.0}"))
        .y_desc("return on the Qube")
        .y_label_formatter(&|return_| format!("{return_:.0}"))
        .draw()?;
    let dots = dots.iter().enumerate().flat_map(|(candidate, returns)| {
        returns.iter().map(move |return_| (candidate as f64, *return_))
    });
    chart.draw_series(dots.map(|at| Circle::new(at, 2, BLACK.mix(0.4).filled())))?;
    let points = line.iter().enumerate().map(|(candidate, value)| (candidate as f64, *value));
    chart.draw_series(LineSeries::new(points, RGBColor(31, 119, 180).stroke_width(2)))?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulation::Family;

    #[test]
    fn densities_integrate_to_one() {
        let (mean, standard_deviation) = (0.1, 0.02);
        for family in [Family::Normal, Family::Uniform] {
            let distribution = family.with_moments(mean, standard_deviation);
            let sum: f64 = (0..2000).map(|i| density(&distribution, f64::from(i) * 1e-4)).sum();
            assert!((sum * 1e-4 - 1.0).abs() < 2e-3, "{family:?}: {sum}");
        }
    }

    #[test]
    fn the_figures_are_drawn_with_every_recipe() {
        let recipes = [
            ("handcrafted".to_owned(), DomainDistribution::handcrafted(Family::Normal)),
            ("nominal".to_owned(), DomainDistribution::nominal()),
        ];
        let mut svg = String::new();
        densities(&mut svg, &recipes).unwrap();
        assert!(svg.contains("handcrafted") && svg.contains("L_p") && svg.ends_with("</svg>\n"));
        let mut svg = String::new();
        searches(&mut svg, &[("opt".to_owned(), vec![vec![5.0, 500.0], vec![540.0]])]).unwrap();
        assert!(svg.contains("opt: best so far") && svg.matches("<circle").count() == 3);
    }
}
