use plotters::prelude::*;

use super::style::{self, FAINT, FONT, INK, Key, LINE, TEXT, TITLE, with_key};
use super::{DrawingError, Panel, PlotError};
use crate::search::StrategyKind;
use crate::search::benchmark::{Quartiles, RegretCurve};

/// Smallest regret that is drawn; a smaller one, such as 0, is drawn at this value.
const FLOOR: f64 = 1e-6;

/// Returns the colour of a strategy.
fn colour(strategy: StrategyKind) -> RGBColor {
    match strategy {
        StrategyKind::BayRn => style::colour(0),
        StrategyKind::Cem => style::colour(1),
        StrategyKind::CmaEs => style::colour(2),
        StrategyKind::Random => INK,
        StrategyKind::Sobol => style::colour(3),
    }
}

/// Draws one panel for each objective: for each strategy the median of the simple regret after each
/// evaluation, with a band from the lower to the upper quartile, on a logarithmic axis. The curves
/// of one objective follow one another in `curves`, and all curves have the same number of
/// repetitions. BayRn's curve lies on top, because BayRn's initial points are also the random
/// search's.
///
/// # Errors
/// The drawing library failed.
pub fn regret_svg(curves: &[RegretCurve]) -> Result<String, DrawingError> {
    let panels: Vec<&[RegretCurve]> =
        curves.chunk_by(|one, next| one.objective == next.objective).collect();
    let rows = panels.len().div_ceil(3).max(1);
    let mut svg = String::new();
    {
        let size = (1200, 84 + 360 * rows as u32);
        let root = SVGBackend::with_string(&mut svg, size).into_drawing_area();
        root.fill(&WHITE)?;
        let (heading, below) = root.split_vertically(34);
        let repetitions = curves.first().map_or(0, |curve| curve.repetitions);
        let title = format!(
            "Simple regret (maximum minus best value found): median and quartiles of {repetitions} repetitions"
        );
        heading.draw(&Text::new(title, (14, 10), (FONT, TITLE).into_font().color(&INK)))?;
        let key =
            StrategyKind::ALL.map(|it| (it.name().to_owned(), Key::Line(colour(it), LINE + 1)));
        let rest = with_key(&below, &key)?;
        for (panel, area) in panels.into_iter().zip(rest.split_evenly((rows, 3))) {
            draw_panel(panel, &area)?;
        }
        root.present()?;
    }
    Ok(svg)
}

fn draw_panel(curves: &[RegretCurve], area: &Panel<'_>) -> Result<(), PlotError> {
    let Some(first) = curves.first() else {
        return Ok(());
    };
    let seen = |pick: fn(&Quartiles) -> f64| {
        curves.iter().flat_map(|curve| &curve.regret).map(pick).map(|regret| regret.max(FLOOR))
    };
    let lowest = seen(|q| q.lower).fold(f64::INFINITY, f64::min);
    let highest = seen(|q| q.upper).fold(FLOOR, f64::max);
    let evaluations = first.regret.len() as f64;
    let mut chart = ChartBuilder::on(area)
        .caption(
            format!("{}, {} dimensions", first.objective.name(), first.dimensions),
            (FONT, TITLE),
        )
        .margin(8)
        .margin_right(18)
        .x_label_area_size(38)
        .y_label_area_size(62)
        .build_cartesian_2d(
            1.0..evaluations.max(2.0),
            lowest.log10() - 0.1..highest.log10() + 0.1,
        )?;
    chart
        .configure_mesh()
        .light_line_style(TRANSPARENT)
        .bold_line_style(FAINT)
        .x_labels(7)
        .y_labels(6)
        .x_label_formatter(&|x| format!("{x:.0}"))
        .y_label_formatter(&|y| {
            // The axis has the logarithm of the regret, but its labels are regrets.
            let value = 10f64.powf(*y);
            match *y {
                y if y < -1.95 => format!("{value:.0e}"),
                y if y < -0.05 => format!("{value:.2}"),
                y if y < 0.95 => format!("{value:.1}"),
                _ => format!("{value:.0}"),
            }
        })
        .x_desc("evaluations")
        .y_desc("simple regret")
        .label_style((FONT, TEXT - 2))
        .axis_desc_style((FONT, TEXT))
        .draw()?;
    let is_below = |curve: &&RegretCurve| curve.strategy != StrategyKind::BayRn;
    let (below, above): (Vec<&RegretCurve>, Vec<_>) = curves.iter().partition(is_below);
    for curve in below.into_iter().chain(above) {
        let line = |pick: fn(&Quartiles) -> f64| {
            curve
                .regret
                .iter()
                .enumerate()
                .map(move |(i, q)| (i as f64 + 1.0, pick(q).max(FLOOR).log10()))
        };
        let colour = colour(curve.strategy);
        let mut outline: Vec<(f64, f64)> = line(|q| q.upper).collect();
        outline.extend(line(|q| q.lower).collect::<Vec<_>>().into_iter().rev());
        chart.draw_series([Polygon::new(outline, colour.mix(0.12).filled())])?;
        chart.draw_series(LineSeries::new(line(|q| q.median), colour.stroke_width(LINE)))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::search::benchmark::Objective;

    #[test]
    fn the_curve_of_bayrn_lies_on_top() {
        let curves = StrategyKind::ALL
            .map(|it| RegretCurve::new(Objective::Branin, it, &[vec![9.0, 3.0, 1.0]]));
        let svg = regret_svg(&curves).unwrap();
        let last = |strategy| {
            let RGBColor(red, green, blue) = colour(strategy);
            svg.rfind(&format!("stroke=\"#{red:02X}{green:02X}{blue:02X}\""))
        };
        let others = StrategyKind::ALL.into_iter().filter(|it| *it != StrategyKind::BayRn);
        let top = last(StrategyKind::BayRn);
        assert!(top.is_some());
        assert!(others.map(last).all(|other| other < top), "{svg}");
    }

    #[test]
    fn every_panel_has_its_name_and_ticks_that_can_be_read() {
        let curves: Vec<RegretCurve> = [Objective::Branin, Objective::Ackley]
            .into_iter()
            .flat_map(|objective| {
                StrategyKind::ALL.map(|strategy| {
                    RegretCurve::new(objective, strategy, &vec![vec![540.0, 3.0, 0.0]; 2])
                })
            })
            .collect();
        let svg = regret_svg(&curves).unwrap();
        for words in ["branin, 2 dimensions", "ackley, 16 dimensions", "cmaes", "evaluations"] {
            assert!(svg.contains(words), "{words}");
        }
        let ticks: Vec<&str> =
            svg.lines().map(str::trim).filter(|line| line.parse::<f64>().is_ok()).collect();
        assert!(ticks.len() > 10, "{ticks:?}");
        assert!(ticks.iter().all(|tick| tick.len() <= 5), "{ticks:?}");
        assert!(ticks.contains(&"100") && ticks.contains(&"1.0"), "{ticks:?}");
        assert!(ticks.iter().any(|tick| tick.starts_with("1e-")), "{ticks:?}");
    }
}
