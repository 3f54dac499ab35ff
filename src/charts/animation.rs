use std::fmt::Write;

use super::escaped;
use super::style::page_style;
use crate::qube::State;
use crate::replay::MotionLog;

/// Frames per second; a browser interpolates between frames.
const FRAMES_PER_S: f64 = 25.0;

/// Longest part of a motion that is drawn, s; the rest of a longer motion is left out.
const LONGEST_S: f64 = 20.0;

/// Width and height of the picture, pixels.
const SIZE: (f64, f64) = (640.0, 300.0);

/// Place of the arm's axis in the picture, pixels.
const CENTRE: (f64, f64) = (150.0, 150.0);

/// Place of the diagram of the angles: left, top, width, height, pixels.
const DIAGRAM: (f64, f64, f64, f64) = (345.0, 44.0, 275.0, 200.0);

/// Length on the screen of the longer of arm and pendulum, pixels.
const REACH: f64 = 100.0;

/// Angle of the view above the arm's plane, rad.
const TILT_RAD: f64 = 0.42;

/// Draws the first 20 s of a motion as an animated SVG that repeats at the motion's own speed: arm
/// and pendulum on the left, their angles with a line at the present time on the right. The picture
/// needs no script, so that pages and slides can show it.
#[must_use]
pub fn animation_svg(title: &str, log: &MotionLog) -> String {
    let frames = frames(log);
    let duration_s = duration_s(&frames);
    let (width, height) = SIZE;
    let style = page_style();
    let mut svg = String::new();
    let _ = write!(
        svg,
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" width=\"{width}\" height=\"{height}\" \
         role=\"img\"><title>{}</title><style>{style}</style><rect class=\"p\" width=\"{width}\" height=\"{height}\" rx=\"6\"/>",
        escaped(title)
    );
    draw_pendulum(&mut svg, log, &frames, duration_s);
    draw_angles(&mut svg, &frames, duration_s);
    svg.push_str("</svg>\n");
    svg
}

/// Returns the state at each frame: the state of the last sample up to the frame's time.
fn frames(log: &MotionLog) -> Vec<State> {
    let samples = &log.samples;
    let start_s = samples.first().map_or(0.0, |sample| sample.time_s);
    let end_s = samples.last().map_or(0.0, |sample| sample.time_s - start_s).clamp(0.0, LONGEST_S);
    let count = (end_s * FRAMES_PER_S) as usize + 1;
    let mut next = samples.iter().peekable();
    let mut state = State::default();
    (0..count)
        .map(|frame| {
            let now_s = start_s + frame as f64 / FRAMES_PER_S;
            while let Some(sample) = next.next_if(|sample| sample.time_s <= now_s + 1e-9) {
                state = sample.state;
            }
            state
        })
        .collect()
}

/// Returns the time from the first frame to the last, s, over which a browser spreads all values
/// evenly; with a single frame the time of one frame.
fn duration_s(frames: &[State]) -> f64 {
    (frames.len().max(2) - 1) as f64 / FRAMES_PER_S
}

fn draw_pendulum(svg: &mut String, log: &MotionLog, frames: &[State], duration_s: f64) {
    let parameters = &log.plant.parameters;
    let (arm, pendulum) = (parameters.rotary_length_m, parameters.pendulum_length_m);
    let scale = REACH / arm.max(pendulum);
    let (arm, pendulum) = (scale * arm, scale * pendulum);
    // On the screen, y points to the right, z up and x towards the reader.
    let flat =
        |x: f64, y: f64, z: f64| (CENTRE.0 + y, CENTRE.1 + x * TILT_RAD.sin() - z * TILT_RAD.cos());
    let places: Vec<[f64; 4]> = frames
        .iter()
        .map(|state| {
            let (sin_theta, cos_theta) = state.theta.sin_cos();
            let (sin_alpha, cos_alpha) = state.alpha.sin_cos();
            let tip = (arm * cos_theta, arm * sin_theta);
            let swing = pendulum * sin_alpha;
            let (x, y) = flat(tip.0, tip.1, 0.0);
            let end =
                flat(tip.0 - swing * sin_theta, tip.1 + swing * cos_theta, -pendulum * cos_alpha);
            [x, y, end.0, end.1]
        })
        .collect();
    let (x, y) = CENTRE;
    let tilted = arm * TILT_RAD.sin();
    let _ = write!(
        svg,
        "<ellipse class=\"g\" cx=\"{x}\" cy=\"{y}\" rx=\"{arm:.1}\" ry=\"{tilted:.1}\" fill=\"none\"/>\
         <path class=\"g\" d=\"M{x} {y}v100\" stroke-width=\"9\" stroke-linecap=\"round\"/>"
    );
    let moved = |names: [(&str, usize); 4]| {
        let mut inside = String::new();
        for (name, column) in names.into_iter().filter(|(name, _)| !name.is_empty()) {
            let values = places.iter().map(|place| place[column]);
            inside.push_str(&animated(name, values, duration_s));
        }
        inside
    };
    let none = ("", 0);
    let _ = write!(
        svg,
        "<line class=\"a\" x1=\"{x}\" y1=\"{y}\" x2=\"{x}\" y2=\"{y}\" stroke-width=\"7\" stroke-linecap=\"round\">{}</line>\
         <line class=\"b\" stroke-width=\"6\" stroke-linecap=\"round\">{}</line><circle class=\"d\" r=\"8\">{}</circle>",
        moved([("x2", 0), ("y2", 1), none, none]),
        moved([("x1", 0), ("y1", 1), ("x2", 2), ("y2", 3)]),
        moved([("cx", 2), ("cy", 3), none, none]),
    );
}

fn draw_angles(svg: &mut String, frames: &[State], duration_s: f64) {
    let (left, top, width, height) = DIAGRAM;
    let angles = || frames.iter().flat_map(|state| [state.theta, state.alpha]);
    let low = angles().fold(-0.5, f64::min);
    let high = angles().fold(0.5, f64::max);
    let x = |frame: usize| left + width * frame as f64 / (frames.len().max(2) - 1) as f64;
    let y = |angle: f64| top + height * (high - angle) / (high - low);
    for turns in -8..=8 {
        let angle = f64::from(turns) * std::f64::consts::PI;
        if (low..=high).contains(&angle) {
            let at = y(angle);
            let name = match turns {
                0 => "0".to_owned(),
                1 => "π".to_owned(),
                -1 => "−π".to_owned(),
                turns => format!("{turns}π").replace('-', "−"),
            };
            let _ = write!(
                svg,
                "<path class=\"g\" d=\"M{left} {at:.1}h{width}\"/><text x=\"{:.0}\" y=\"{:.1}\" text-anchor=\"end\">{name}</text>",
                left - 6.0,
                at + 4.0
            );
        }
    }
    for (class, angle) in
        [("t", (|state| state.theta) as fn(&State) -> f64), ("b", |state| state.alpha)]
    {
        let mut points = String::new();
        for (frame, state) in frames.iter().enumerate() {
            let _ = write!(points, "{:.1},{:.1} ", x(frame), y(angle(state)));
        }
        let _ = write!(
            svg,
            "<polyline class=\"{class}\" stroke-width=\"2\" points=\"{}\"/>",
            points.trim_end()
        );
    }
    let bottom = top + height + 22.0;
    let _ = write!(
        svg,
        "<text x=\"{left}\" y=\"{:.0}\"><tspan class=\"dt\">θ, the arm</tspan> and <tspan class=\"d\">α, the pendulum</tspan> [rad]</text>\
         <text x=\"{left}\" y=\"{bottom}\">0</text><text x=\"{:.0}\" y=\"{bottom}\" text-anchor=\"end\">{duration_s:.0} s</text>\
         <text x=\"{:.0}\" y=\"{bottom}\" text-anchor=\"middle\">time</text>",
        top - 18.0,
        left + width,
        left + 0.5 * width,
    );
    let moved = |name| animated(name, (0..frames.len()).map(&x), duration_s);
    let _ = write!(
        svg,
        "<line class=\"a\" y1=\"{top}\" y2=\"{:.0}\">{}{}</line>",
        top + height,
        moved("x1"),
        moved("x2")
    );
}

/// Returns the SVG element that moves the attribute `name` through these values in `duration_s` and
/// repeats.
fn animated(name: &str, values: impl Iterator<Item = f64>, duration_s: f64) -> String {
    let values: Vec<String> = values.map(|value| format!("{value:.1}")).collect();
    format!(
        "<animate attributeName=\"{name}\" dur=\"{duration_s}s\" repeatCount=\"indefinite\" values=\"{}\"/>",
        values.join(";")
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::PlantModel;
    use crate::replay::MotionSample;

    fn log(duration_s: f64) -> MotionLog {
        let count = (duration_s * 100.0) as u32;
        let sample = |step: u32| MotionSample {
            time_s: 3.0 + f64::from(step) * 0.01,
            state: State { theta: 0.3, alpha: std::f64::consts::PI, ..State::default() },
            voltage_v: 1.0,
        };
        MotionLog { samples: (0..=count).map(sample).collect(), plant: PlantModel::QUBE }
    }

    #[test]
    fn a_swing_up_of_6_s_is_a_small_picture_that_repeats_every_6_s() {
        let svg = animation_svg("a < b", &log(6.0));
        assert!(svg.starts_with("<svg") && svg.contains("a &lt; b"));
        assert!(svg.len() < 40_000, "{}", svg.len());
        assert_eq!(svg.matches("dur=\"6s\"").count(), 10);
        let values = svg.split("attributeName=\"cy\"").nth(1).unwrap().split('"').nth(5).unwrap();
        assert_eq!(values.split(';').count(), 151);
        // The pendulum is upright, so its end is above the arm.
        let first: f64 = values.split(';').next().unwrap().parse().unwrap();
        assert!(first < CENTRE.1, "{first}");
    }

    #[test]
    fn a_very_long_motion_stays_a_small_picture() {
        assert!(animation_svg("", &log(1000.0)).len() < 120_000);
    }
}
