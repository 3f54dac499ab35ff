use plotters::prelude::*;

use super::{DrawingError, Panel, PlotError};
use crate::qube::State;
use crate::replay::{MotionLog, OpenLoop};

const RECORDED: RGBColor = RGBColor(31, 119, 180);
const SIMULATED: RGBColor = RGBColor(214, 39, 40);

/// Draws a log and its simulation as SVG: theta above, alpha below.
///
/// # Errors
/// The drawing library failed.
pub fn motion_svg(
    title: &str,
    log: &MotionLog,
    open_loop: &OpenLoop,
) -> Result<String, DrawingError> {
    let mut svg = String::new();
    draw(&mut svg, title, log, open_loop)?;
    Ok(svg)
}

fn draw(
    svg: &mut String,
    title: &str,
    log: &MotionLog,
    open_loop: &OpenLoop,
) -> Result<(), PlotError> {
    let root = SVGBackend::with_string(svg, (900, 700)).into_drawing_area();
    root.fill(&WHITE)?;
    let rmse = open_loop.rmse;
    let root = root.titled(title, ("sans-serif", 18))?;
    let panels = root.split_evenly((2, 1));
    let theta = format!("theta [rad], RMS error {:.3}", rmse.theta_rad);
    let alpha = format!("alpha [rad], RMS error {:.3}", rmse.alpha_rad);
    draw_angle(&panels[0], &theta, log, open_loop, |state| state.theta)?;
    draw_angle(&panels[1], &alpha, log, open_loop, |state| state.alpha)?;
    root.present()
}

fn draw_angle(
    panel: &Panel<'_>,
    label: &str,
    log: &MotionLog,
    open_loop: &OpenLoop,
    angle: fn(&State) -> f64,
) -> Result<(), PlotError> {
    let start_s = log.samples.first().map_or(0.0, |sample| sample.time_s);
    let times = || log.samples.iter().map(|sample| sample.time_s - start_s);
    let recorded: Vec<_> =
        times().zip(log.samples.iter().map(|sample| angle(&sample.state))).collect();
    let simulated: Vec<_> = times().zip(open_loop.simulated.iter().map(angle)).collect();
    let values = || recorded.iter().chain(&simulated).map(|(_, value)| *value);
    let (low, high) = (values().fold(f64::MAX, f64::min), values().fold(f64::MIN, f64::max));
    let margin = 0.05 * (high - low) + 0.01;
    let end_s = times().fold(0.0, f64::max);
    let mut chart = ChartBuilder::on(panel)
        .margin(10)
        .x_label_area_size(35)
        .y_label_area_size(55)
        .build_cartesian_2d(0.0..end_s, low - margin..high + margin)?;
    chart.configure_mesh().x_desc("time [s]").y_desc(label).light_line_style(WHITE).draw()?;
    for (points, name, color) in
        [(recorded, "recorded", RECORDED), (simulated, "simulated", SIMULATED)]
    {
        chart
            .draw_series(LineSeries::new(points, color.stroke_width(2)))?
            .label(name)
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 20, y)], color.stroke_width(2)));
    }
    chart
        .configure_series_labels()
        .position(SeriesLabelPosition::UpperLeft)
        .background_style(WHITE.mix(0.8))
        .border_style(BLACK)
        .draw()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::QubeModel;
    use crate::replay::{MotionSample, simulate_beside};

    #[test]
    fn both_curves_and_both_errors_are_in_the_picture() {
        let samples = (0..50)
            .map(|step| MotionSample {
                time_s: f64::from(step) * 0.01,
                state: State { theta: 0.1, alpha: 0.2, ..State::default() },
                voltage_v: 1.0,
            })
            .collect();
        let log = MotionLog { samples, plant: crate::qube::PlantModel::QUBE };
        let open_loop = simulate_beside(&log, &QubeModel::NOMINAL).unwrap();
        let svg = motion_svg("a < b & c", &log, &open_loop).unwrap();
        assert!(svg.starts_with("<svg") && svg.trim_end().ends_with("</svg>"));
        for text in ["recorded", "simulated", "theta [rad]", "alpha [rad]", "a &lt; b &amp; c"] {
            assert!(svg.contains(text), "{text}");
        }
        let lines = |color: &str| {
            svg.lines().filter(|line| line.contains("polyline") && line.contains(color)).count()
        };
        assert_eq!((lines("#1F77B4"), lines("#D62728")), (4, 4), "two panels, each with a legend");
    }
}
