use plotters::prelude::*;

use super::style::{BLUE, FAINT, FONT, INK, TEXT, TITLE};
use super::{DrawingError, Panel, PlotError};
use crate::search::benchmark::VariantResult;

/// Width of the column with the variants' names in each panel, pixels.
const NAMES: u32 = 330;

/// Draws one panel for each problem. A problem is given by its name and the results of the search
/// variants. Its panel shows, for each variant, the expected return of the recommended point and
/// the 95 % interval of this return; a single repetition has no interval.
///
/// # Errors
/// The drawing library failed.
pub fn noise_svg(problems: &[(String, Vec<VariantResult>)]) -> Result<String, DrawingError> {
    let mut svg = String::new();
    draw(&mut svg, problems)?;
    Ok(svg)
}

fn draw(svg: &mut String, problems: &[(String, Vec<VariantResult>)]) -> Result<(), PlotError> {
    let rows = problems.len().max(1);
    let root = SVGBackend::with_string(svg, (1000, 300 * rows as u32)).into_drawing_area();
    root.fill(&WHITE)?;
    for (panel, (name, results)) in root.split_evenly((rows, 1)).iter().zip(problems) {
        noise_panel(panel, name, results)?;
    }
    root.present()
}

fn noise_panel(panel: &Panel<'_>, name: &str, results: &[VariantResult]) -> Result<(), PlotError> {
    // The half width of a single repetition's interval is not finite.
    let reach = |it: &VariantResult| {
        let half_width = it.expected_return.half_width;
        if half_width.is_finite() { half_width } else { 0.0 }
    };
    let ends = results.iter().flat_map(|it| {
        let mean = it.expected_return.mean;
        [mean - reach(it), mean + reach(it)]
    });
    let (low, high) =
        ends.fold((f64::MAX, f64::MIN), |(low, high), end| (low.min(end), high.max(end)));
    let margin = 0.06 * (high - low) + 1.0;
    let count = results.len().max(1) as i32;
    let mut chart = ChartBuilder::on(panel)
        .margin(10)
        .margin_right(24)
        .caption(name, (FONT, TITLE))
        .x_label_area_size(42)
        .y_label_area_size(NAMES)
        .build_cartesian_2d(low - margin..high + margin, (0..count - 1).into_segmented())?;
    // The first variant is the uppermost.
    let row = |index: usize| SegmentValue::CenterOf(count - 1 - index as i32);
    chart
        .configure_mesh()
        .light_line_style(TRANSPARENT)
        .bold_line_style(FAINT)
        .disable_y_mesh()
        .x_desc("expected return of the recommended point, with its 95 % interval")
        .y_labels(results.len())
        .y_label_formatter(&|place| match place {
            SegmentValue::CenterOf(place) => {
                let index = usize::try_from(count - 1 - place).ok();
                index
                    .and_then(|it| results.get(it))
                    .map_or("", |it| it.variant.description())
                    .into()
            }
            _ => String::new(),
        })
        .label_style((FONT, TEXT - 2))
        .axis_desc_style((FONT, TEXT))
        .draw()?;
    for (index, result) in results.iter().enumerate() {
        let interval = &result.expected_return;
        let end = |sign: f64| (interval.mean + sign * reach(result), row(index));
        chart.draw_series([PathElement::new([end(-1.0), end(1.0)], INK.stroke_width(2))])?;
        chart.draw_series([Circle::new((interval.mean, row(index)), 5, BLUE.filled())])?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::search::benchmark::SearchVariant;

    #[test]
    fn every_variant_has_its_name_its_mean_and_its_interval() {
        let found: Vec<Vec<f64>> =
            (0..SearchVariant::ALL.len()).map(|it| vec![300.0 + it as f64, 310.0, 320.0]).collect();
        let svg = noise_svg(&[("one".into(), VariantResult::table(&found))]).unwrap();
        for variant in SearchVariant::ALL {
            assert!(
                svg.contains(&variant.description().replace('&', "&amp;")),
                "{variant:?}: {svg}"
            );
        }
        assert_eq!(svg.matches("<circle").count(), SearchVariant::ALL.len());
    }

    #[test]
    fn a_single_repetition_is_drawn_without_an_interval() {
        let found = vec![vec![300.0]; SearchVariant::ALL.len()];
        let svg = noise_svg(&[("one".into(), VariantResult::table(&found))]).unwrap();
        assert_eq!(svg.matches("<circle").count(), SearchVariant::ALL.len());
        assert!(!svg.contains("NaN"));
    }
}
