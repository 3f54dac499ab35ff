use plotters::prelude::*;

use super::style::{BLUE, FAINT, FONT, GREEN, INK, Key, LINE, TEXT, TITLE, with_key};
use super::{DrawingError, Panel, PlotError, best_so_far};

/// Draws figure 5.3 of the thesis: the mean return in simulation after each update, with one row
/// for each model. A model is given by its name and, for each training, the returns after its
/// updates. The left panel shows the current policies, the right one the best policies so far; each
/// has a line for every training and one for their mean.
///
/// # Errors
/// The drawing library failed.
pub fn training_progress_svg(models: &[(String, Vec<Vec<f64>>)]) -> Result<String, DrawingError> {
    let mut svg = String::new();
    draw(&mut svg, models)?;
    Ok(svg)
}

fn draw(svg: &mut String, models: &[(String, Vec<Vec<f64>>)]) -> Result<(), PlotError> {
    let rows = models.len().max(1);
    let root = SVGBackend::with_string(svg, (1000, 30 + 220 * rows as u32)).into_drawing_area();
    root.fill(&WHITE)?;
    let entries = [
        ("one training", Key::Line(GREY, 1)),
        ("mean of the current policies", Key::Line(BLUE, LINE)),
        ("mean of the best policies so far", Key::Line(GREEN, LINE)),
    ];
    let entries = entries.map(|(name, key)| (name.to_owned(), key));
    let panels = with_key(&root, &entries)?.split_evenly((rows, 2));
    for ((name, trainings), pair) in models.iter().zip(panels.chunks(2)) {
        let best: Vec<Vec<f64>> = trainings.iter().map(|it| best_so_far(it)).collect();
        panel(&pair[0], &format!("{name}: current policy"), trainings, BLUE)?;
        panel(&pair[1], &format!("{name}: best policy so far"), &best, GREEN)?;
    }
    root.present()
}

/// Colour of the lines of single trainings, between the colours of the grid and the axes.
const GREY: RGBColor = RGBColor(160, 168, 178);

fn panel(
    area: &Panel<'_>,
    title: &str,
    trainings: &[Vec<f64>],
    colour: RGBColor,
) -> Result<(), PlotError> {
    let updates = trainings.iter().map(Vec::len).max().unwrap_or(0).max(2);
    let mut chart = ChartBuilder::on(area)
        .margin(10)
        .caption(title, (FONT, TITLE))
        .x_label_area_size(38)
        .y_label_area_size(56)
        .build_cartesian_2d(1.0..updates as f64, 0.0..600.0)?;
    chart
        .configure_mesh()
        .light_line_style(TRANSPARENT)
        .bold_line_style(FAINT)
        .x_desc("update")
        .x_labels(6)
        .x_label_formatter(&|update| format!("{update:.0}"))
        .y_desc("return in simulation")
        .y_labels(4)
        .y_label_formatter(&|return_| format!("{return_:.0}"))
        .axis_style(INK)
        .label_style((FONT, TEXT - 2))
        .axis_desc_style((FONT, TEXT))
        .draw()?;
    let points = |returns: &[f64]| -> Vec<(f64, f64)> {
        (1..).map(f64::from).zip(returns.iter().copied()).collect()
    };
    for training in trainings {
        chart.draw_series(LineSeries::new(points(training), GREY.stroke_width(1)))?;
    }
    let mean = points(&mean_by_update(trainings));
    chart.draw_series(LineSeries::new(mean, colour.stroke_width(LINE)))?;
    Ok(())
}

/// Returns the mean return of all trainings after each update, up to the last update of the
/// shortest.
fn mean_by_update(trainings: &[Vec<f64>]) -> Vec<f64> {
    let updates = trainings.iter().map(Vec::len).min().unwrap_or(0);
    let mean =
        |update: usize| trainings.iter().map(|it| it[update]).sum::<f64>() / trainings.len() as f64;
    (0..updates).map(mean).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_best_so_far_never_falls_and_the_mean_ends_with_the_shortest_training() {
        assert_eq!(best_so_far(&[3.0, 1.0, 5.0, 4.0]), [3.0, 3.0, 5.0, 5.0]);
        assert_eq!(mean_by_update(&[vec![1.0, 3.0, 9.0], vec![3.0, 5.0]]), [2.0, 4.0]);
        assert!(mean_by_update(&[]).is_empty());
    }

    #[test]
    fn each_model_has_two_panels_with_a_line_for_each_training_and_one_for_their_mean() {
        let trainings = vec![vec![5.0, 300.0, 500.0], vec![10.0, 200.0, 540.0]];
        let models = [("nominal".to_owned(), trainings.clone()), ("opt".to_owned(), trainings)];
        let svg = training_progress_svg(&models).unwrap();
        for title in ["nominal: current policy", "opt: best policy so far"] {
            assert!(svg.contains(title), "{title}");
        }
        let lines = |colour: &str| svg.matches(&format!("stroke=\"{colour}\"")).count();
        // One more of each colour is in the key.
        assert_eq!([lines("#A0A8B2"), lines("#0072B2"), lines("#009E73")], [9, 3, 3]);
    }
}
