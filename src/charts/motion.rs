use plotters::prelude::*;

use super::style::{BLUE, FAINT, FONT, GREEN, INK, Key, LINE, TEXT, TITLE, VERMILION, with_key};
use super::{DrawingError, Panel, PlotError};
use crate::qube::State;
use crate::replay::{MotionLog, OpenLoop};

/// Draws a recorded motion and its simulation as SVG: theta, alpha, and the voltage that drove
/// both.
///
/// The recording is a broad pale line under the line of the simulation, so that a good simulation
/// does not hide the recording.
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

/// Width of the recorded line, pixels.
const BROAD: u32 = 5;

fn draw(
    svg: &mut String,
    title: &str,
    log: &MotionLog,
    open_loop: &OpenLoop,
) -> Result<(), PlotError> {
    let root = SVGBackend::with_string(svg, (900, 860)).into_drawing_area();
    root.fill(&WHITE)?;
    let rmse = open_loop.rmse;
    let root = root.titled(title, (FONT, TITLE))?;
    let entries = [
        ("recorded".to_owned(), Key::Line(pale(BLUE), BROAD)),
        ("simulated with the same voltages".to_owned(), Key::Line(VERMILION, LINE)),
        ("voltage".to_owned(), Key::Line(GREEN, LINE)),
    ];
    let rest = with_key(&root, &entries)?;
    let (angles, voltage) = rest.split_vertically(560);
    let panels = angles.split_evenly((2, 1));
    let theta = format!("theta [rad], RMS error {:.3}", rmse.theta_rad);
    let alpha = format!("alpha [rad], RMS error {:.3}", rmse.alpha_rad);
    let states = |angle: fn(&State) -> f64| {
        let recorded = log.samples.iter().map(|sample| angle(&sample.state)).collect::<Vec<_>>();
        (recorded, open_loop.simulated.iter().map(angle).collect::<Vec<_>>())
    };
    for (panel, label, angle) in [
        (&panels[0], &theta, (|state| state.theta) as fn(&State) -> f64),
        (&panels[1], &alpha, |state| state.alpha),
    ] {
        let (recorded, simulated) = states(angle);
        let lines = [(recorded, pale(BLUE), BROAD), (simulated, VERMILION, LINE)];
        draw_lines(panel, label, log, &lines)?;
    }
    let sent: Vec<f64> = log.samples.iter().map(|sample| sample.voltage_v).collect();
    draw_lines(&voltage, "voltage [V]", log, &[(sent, GREEN, 1)])?;
    root.present()
}

/// Mixes a colour with white.
fn pale(colour: RGBColor) -> RGBColor {
    let mix = |part: u8| (0.45 * f64::from(part) + 0.55 * 255.0) as u8;
    RGBColor(mix(colour.0), mix(colour.1), mix(colour.2))
}

fn draw_lines(
    panel: &Panel<'_>,
    label: &str,
    log: &MotionLog,
    lines: &[(Vec<f64>, RGBColor, u32)],
) -> Result<(), PlotError> {
    let start_s = log.samples.first().map_or(0.0, |sample| sample.time_s);
    let times = || log.samples.iter().map(|sample| sample.time_s - start_s);
    let values = || lines.iter().flat_map(|(values, ..)| values.iter().copied());
    let (low, high) = (values().fold(f64::MAX, f64::min), values().fold(f64::MIN, f64::max));
    let margin = 0.05 * (high - low) + 0.01;
    let end_s = times().fold(0.0, f64::max);
    let mut chart = ChartBuilder::on(panel)
        .margin(8)
        .margin_right(20)
        .x_label_area_size(40)
        .y_label_area_size(58)
        .build_cartesian_2d(0.0..end_s, low - margin..high + margin)?;
    chart
        .configure_mesh()
        .x_desc("time [s]")
        .y_desc(label)
        .y_labels(7)
        .light_line_style(TRANSPARENT)
        .bold_line_style(FAINT)
        .axis_style(INK)
        .label_style((FONT, TEXT - 2))
        .axis_desc_style((FONT, TEXT))
        .draw()?;
    for (values, colour, width) in lines {
        let points = times().zip(values.iter().copied());
        chart.draw_series(LineSeries::new(points, colour.stroke_width(*width)))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::QubeModel;
    use crate::replay::{MotionSample, simulate_from_first_state};

    #[test]
    fn all_curves_and_both_errors_are_in_the_picture() {
        let samples = (0..50)
            .map(|step| MotionSample {
                time_s: f64::from(step) * 0.01,
                state: State { theta: 0.1, alpha: 0.2, ..State::default() },
                voltage_v: 1.0,
            })
            .collect();
        let log = MotionLog { samples, plant: crate::qube::PlantModel::QUBE };
        let open_loop = simulate_from_first_state(&log, &QubeModel::NOMINAL).unwrap();
        let svg = motion_svg("a < b & c", &log, &open_loop).unwrap();
        assert!(svg.starts_with("<svg") && svg.trim_end().ends_with("</svg>"));
        for text in [
            "recorded",
            "simulated",
            "theta [rad]",
            "alpha [rad]",
            "voltage [V]",
            "a &lt; b &amp; c",
        ] {
            assert!(svg.contains(text), "{text}");
        }
        let lines = |color: &str| {
            svg.lines().filter(|line| line.contains("polyline") && line.contains(color)).count()
        };
        // Two angles, or one voltage, and the key.
        assert_eq!((lines("#8CBFDC"), lines("#D55E00"), lines("#009E73")), (3, 3, 2));
    }
}
