use plotters::prelude::*;

use super::{DrawingError, Panel, PlotError};

/// Draws the thesis's figure 5.3: for each recipe, by its name, the return of each candidate in turn, and of
/// the best so far; dots are single rollouts.
///
/// # Errors
/// The drawing library failed.
pub fn searches_svg(recipes: &[(String, Vec<Vec<f64>>)]) -> Result<String, DrawingError> {
    let mut svg = String::new();
    searches(&mut svg, recipes)?;
    Ok(svg)
}

fn searches(svg: &mut String, recipes: &[(String, Vec<Vec<f64>>)]) -> Result<(), PlotError> {
    let rows = recipes.len().max(1);
    let root = SVGBackend::with_string(svg, (1000, 320 * rows as u32)).into_drawing_area();
    root.fill(&WHITE)?;
    let panels = root.split_evenly((rows, 2));
    for ((name, candidates), pair) in recipes.iter().zip(panels.chunks(2)) {
        let means: Vec<f64> = candidates.iter().map(|it| mean(it)).collect();
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

/// The mean of a candidate's returns; NaN without any.
fn mean(returns: &[f64]) -> f64 {
    returns.iter().sum::<f64>() / returns.len() as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_figure_shows_every_rollout() {
        let returns = vec![vec![5.0, 500.0], vec![540.0]];
        let svg = searches_svg(&[("opt".to_owned(), returns)]).unwrap();
        assert!(svg.contains("opt: best so far") && svg.matches("<circle").count() == 3);
    }
}
