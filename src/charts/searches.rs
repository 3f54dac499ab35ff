use plotters::prelude::*;

use super::style::{BLUE, FAINT, FONT, GREEN, INK, Key, LIMIT, LINE, TEXT, TITLE, with_key};
use super::{DrawingError, Panel, PlotError, best_so_far};

/// Draws the searches, a row for each recipe. A recipe is given by its name and the returns of each
/// candidate's rollouts. On the left are the mean return of each candidate and, as dots, its
/// rollouts; on the right is the best mean so far. A candidate without returns keeps its place and
/// has no mean. `success` is the return that a rollout needs to count as a success, if it also
/// balances to the end.
///
/// # Errors
/// The drawing library failed.
pub fn searches_svg(
    recipes: &[(String, Vec<Vec<f64>>)],
    success: f64,
) -> Result<String, DrawingError> {
    let mut svg = String::new();
    searches(&mut svg, recipes, success)?;
    Ok(svg)
}

fn searches(
    svg: &mut String,
    recipes: &[(String, Vec<Vec<f64>>)],
    success: f64,
) -> Result<(), PlotError> {
    let rows = recipes.len().max(1);
    let root = SVGBackend::with_string(svg, (1000, 30 + 320 * rows as u32)).into_drawing_area();
    root.fill(&WHITE)?;
    let entries = [
        ("one rollout".to_owned(), Key::Dot(INK)),
        ("mean of a candidate".to_owned(), Key::Line(BLUE, LINE)),
        ("best mean so far".to_owned(), Key::Line(GREEN, LINE)),
        (format!("success from {success:.0}"), Key::Dashed(LIMIT)),
    ];
    let panels = with_key(&root, &entries)?.split_evenly((rows, 2));
    for ((name, candidates), pair) in recipes.iter().zip(panels.chunks(2)) {
        let means: Vec<f64> = candidates.iter().map(|it| mean(it)).collect();
        let best = best_so_far(&means);
        let title = format!("{name}: each candidate");
        search_panel(&pair[0], &title, success, &means, BLUE, candidates)?;
        search_panel(&pair[1], &format!("{name}: best so far"), success, &best, GREEN, &[])?;
    }
    root.present()
}

fn search_panel(
    panel: &Panel<'_>,
    title: &str,
    success: f64,
    line: &[f64],
    colour: RGBColor,
    dots: &[Vec<f64>],
) -> Result<(), PlotError> {
    let count = line.len().max(1) as i32;
    let mut chart = ChartBuilder::on(panel)
        .margin(10)
        .caption(title, (FONT, TITLE))
        .x_label_area_size(40)
        .y_label_area_size(56)
        .build_cartesian_2d((0..count - 1).into_segmented(), 0.0..600.0)?;
    chart
        .configure_mesh()
        .light_line_style(TRANSPARENT)
        .bold_line_style(FAINT)
        .disable_x_mesh()
        .x_desc("candidate")
        .x_labels(line.len().clamp(1, 13))
        .x_label_formatter(&|place| match place {
            SegmentValue::CenterOf(candidate) => candidate.to_string(),
            _ => String::new(),
        })
        .y_desc("return on the Qube")
        .y_label_formatter(&|return_| format!("{return_:.0}"))
        .label_style((FONT, TEXT - 2))
        .axis_desc_style((FONT, TEXT))
        .draw()?;
    let centre = |candidate: usize| SegmentValue::CenterOf(candidate as i32);
    let ends = [(SegmentValue::Exact(0), success), (SegmentValue::Exact(count), success)];
    chart.draw_series(DashedLineSeries::new(ends, 6, 5, LIMIT.stroke_width(1)))?;
    // A candidate without returns has no mean, which is not 0.
    let with_value = line.iter().enumerate().filter(|(_, value)| value.is_finite());
    let points = with_value.map(|(candidate, value)| (centre(candidate), *value));
    chart.draw_series(LineSeries::new(points, colour.stroke_width(LINE)))?;
    let dots = dots.iter().enumerate().flat_map(|(candidate, returns)| {
        returns.iter().map(move |return_| (centre(candidate), *return_))
    });
    chart.draw_series(dots.map(|at| Circle::new(at, 4, INK.stroke_width(1))))?;
    Ok(())
}

/// Returns the mean of a candidate's returns; NaN if there are none.
fn mean(returns: &[f64]) -> f64 {
    returns.iter().sum::<f64>() / returns.len() as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_figure_shows_every_rollout_and_numbers_each_candidate_once() {
        let returns = vec![vec![5.0, 500.0], vec![540.0], vec![1.0], vec![2.0], vec![3.0]];
        let svg = searches_svg(&[("opt".to_owned(), returns)], 400.0).unwrap();
        // The seventh circle is in the key.
        assert!(svg.contains("opt: best so far") && svg.matches("<circle").count() == 7);
        for candidate in 0..5 {
            let label = format!("\n{candidate}\n");
            assert_eq!(
                svg.matches(&label).count(),
                if candidate == 0 { 4 } else { 2 },
                "{candidate}"
            );
        }
        assert!(svg.contains("one rollout") && svg.contains("success from 400"));
    }

    #[test]
    fn a_candidate_without_returns_keeps_its_place_and_has_no_mean() {
        let points = |returns: Vec<Vec<f64>>| {
            let svg = searches_svg(&[("opt".to_owned(), returns)], 400.0).unwrap();
            assert_eq!(svg.matches("\n2\n").count(), 2, "the third candidate is on both axes");
            let lines = svg.split("<polyline").skip(1).filter(|it| it.contains("#0072B2"));
            let line = lines.last().unwrap().split("points=\"").nth(1).unwrap();
            line.split('"').next().unwrap().split_whitespace().map(str::to_owned).collect()
        };
        let all: Vec<String> = points(vec![vec![500.0], vec![450.0], vec![540.0]]);
        let gap: Vec<String> = points(vec![vec![500.0], vec![], vec![540.0]]);
        assert_eq!(gap, [all[0].clone(), all[2].clone()]);
        let end: Vec<String> = points(vec![vec![500.0], vec![450.0], vec![]]);
        assert_eq!(end, all[..2]);
    }
}
