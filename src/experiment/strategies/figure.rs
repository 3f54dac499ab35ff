use plotters::prelude::*;

use super::{StrategyResult, StrategyResults};
use crate::experiment::ExperimentError;
use crate::experiment::figures::{PlotError, drawing_failed};

/// Draws the share of repetitions whose recommendation has succeeded against real rollouts, a step line for
/// each method. A line below 1 at its end has repetitions that never succeed.
///
/// # Errors
/// The drawing library fails.
/// The drawing library failed.
pub fn strategies_svg(results: &StrategyResults) -> Result<String, ExperimentError> {
    let mut svg = String::new();
    draw(&mut svg, results).map_err(drawing_failed)?;
    Ok(svg)
}

fn draw(svg: &mut String, results: &StrategyResults) -> Result<(), PlotError> {
    let root = SVGBackend::with_string(svg, (1000, 450)).into_drawing_area();
    root.fill(&WHITE)?;
    // Lines end anywhere at the right; their names are beside them.
    let (lines, names) = root.split_horizontally(880);
    let budgets = results.strategies.iter().filter_map(StrategyResult::budget);
    let last = f64::from(budgets.max().unwrap_or(1).max(2));
    let title = format!("{} on {}: recommendations that succeed", results.recipe, results.plant);
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
    for (index, strategy) in results.strategies.iter().enumerate() {
        let style = Palette99::pick(index).to_rgba().stroke_width(2);
        chart.draw_series(LineSeries::new(steps(strategy), style))?;
        let below = 60 + 24 * index as i32;
        names.draw(&PathElement::new([(8, below), (28, below)], style))?;
        let name = strategy.method.name();
        names.draw(&Text::new(name, (34, below - 7), ("sans-serif", 14)))?;
    }
    root.present()
}

/// The corners of a method's line, from 1 rollout to the end of its budget.
fn steps(strategy: &StrategyResult) -> Vec<(f64, f64)> {
    let Some(budget) = strategy.budget() else { return Vec::new() };
    let share = |count: usize| count as f64 / strategy.repetitions.len() as f64;
    let mut corners = vec![(1.0, 0.0)];
    for (index, rollouts) in strategy.rollouts_needed().into_iter().enumerate() {
        corners.push((f64::from(rollouts), share(index)));
        corners.push((f64::from(rollouts), share(index + 1)));
    }
    corners.push((f64::from(budget), share(strategy.reached())));
    corners
}

#[cfg(test)]
mod tests {
    use super::super::results::tests::result;
    use super::*;

    #[test]
    fn a_line_climbs_where_answers_succeed_and_ends_with_the_budget() {
        let strategy = result(&[Some(40), None, Some(10), Some(20)]);
        let corners = steps(&strategy);
        assert_eq!(corners.first(), Some(&(1.0, 0.0)));
        assert!(corners.contains(&(10.0, 0.25)) && corners.contains(&(20.0, 0.25)));
        assert_eq!(corners.last(), Some(&(125.0, 0.75)));
        assert!(corners.is_sorted_by(|a, b| a.0 <= b.0 && a.1 <= b.1));
    }

    #[test]
    fn the_figure_names_every_strategy() {
        let results = StrategyResults {
            recipe: "opt-nominal".into(),
            plant: "lab".into(),
            strategies: vec![result(&[Some(5), None]), result(&[])],
        };
        let svg = strategies_svg(&results).unwrap();
        assert!(svg.contains("cem") && svg.contains("opt-nominal on lab"), "{svg}");
        assert!(svg.ends_with("</svg>\n"));
    }
}
