use plotters::prelude::*;

use super::posterior_panel::{self, Area, AxisNames, FONT, RED};
use super::problem::Samples;
use crate::surrogate::{
    Dataset, GaussianProcess, Hyperparameters, Kernel, SurrogateError, log_marginal_likelihood,
};

/// Number of samples in each of the three blocks of the figure.
pub const SAMPLES: [usize; 3] = [3, 7, 15];

/// Number of columns, each with a sample seed of its own.
const COLUMNS: u64 = 3;
/// Range of the lengthscale on its axis, as exponents of ten; the unit is the width of the search
/// range.
const LENGTHSCALES: (f64, f64) = (-2.0, 1.0);
/// Range of the noise's standard deviation on its axis, as exponents of ten; the unit is the
/// samples' standard deviation.
const NOISES: (f64, f64) = (-2.0, 0.5);
/// Cells of the surface along each axis.
const CELLS: usize = 90;
/// Number of colour levels of the surface.
const LEVELS: usize = 48;

/// Draws one block with a column for each of three sample seeds: above, the posterior at the most
/// likely hyperparameters; below, the log marginal likelihood over lengthscale and noise.
pub fn draw(samples: usize, seed: u64) -> anyhow::Result<String> {
    let mut svg = String::new();
    {
        let root = SVGBackend::with_string(&mut svg, (1140, 720)).into_drawing_area();
        root.fill(&WHITE)?;
        let (heading, rest) = root.split_vertically(62);
        let title = format!(
            "Surrogate of {samples} samples at its most likely hyperparameters (Matérn 5/2, signal variance 1)"
        );
        heading.draw(&Text::new(title, (20, 8), (FONT, 20)))?;
        posterior_panel::draw_key(&heading.margin(34, 0, 0, 0), &[])?;
        let (panels, _) = rest.split_horizontally(1140);
        let cells = panels.split_evenly((2, COLUMNS as usize));
        for column in 0..COLUMNS {
            let drawn = Samples::draw(samples, seed.wrapping_add(100 * column + 1));
            let data = drawn.dataset()?;
            let surface = Surface::new(&data)?;
            let process = GaussianProcess::new(data, Kernel::Matern52, surface.best.clone())?;
            let name = format!("sample seed {}", column + 1);
            let upper = &cells[column as usize];
            posterior_panel::draw(upper, &name, &process, &drawn, AxisNames::Shown)?;
            surface.draw(&cells[(COLUMNS + column) as usize])?;
        }
        root.present()?;
    }
    Ok(svg)
}

/// The log marginal likelihood over lengthscale and noise.
struct Surface {
    /// Log marginal likelihoods: a row for each noise, a column for each lengthscale.
    values: Vec<Vec<f64>>,
    best: Hyperparameters,
    highest: f64,
}

/// The centre of a cell on an axis with this range, as an exponent of ten.
fn exponent(range: (f64, f64), cell: usize) -> f64 {
    range.0 + (range.1 - range.0) * (cell as f64 + 0.5) / CELLS as f64
}

fn hyperparameters(lengthscale_exponent: f64, noise_exponent: f64) -> Hyperparameters {
    Hyperparameters {
        mean: 0.0,
        lengthscales: vec![10f64.powf(lengthscale_exponent)],
        signal_variance: 1.0,
        noise_variance: 10f64.powf(2.0 * noise_exponent),
    }
}

impl Surface {
    fn new(data: &Dataset) -> Result<Self, SurrogateError> {
        let value = |l: f64, s: f64| {
            log_marginal_likelihood(data, Kernel::Matern52, &hyperparameters(l, s)).map(|e| e.value)
        };
        let mut values = Vec::with_capacity(CELLS);
        let mut highest = (f64::NEG_INFINITY, 0.0, 0.0);
        for row in 0..CELLS {
            let noise = exponent(NOISES, row);
            let mut line = Vec::with_capacity(CELLS);
            for column in 0..CELLS {
                let length = exponent(LENGTHSCALES, column);
                let found = value(length, noise)?;
                if found > highest.0 {
                    highest = (found, length, noise);
                }
                line.push(found);
            }
            values.push(line);
        }
        // A finer grid covers the best cell and its neighbours.
        let cell = |range: (f64, f64)| (range.1 - range.0) / CELLS as f64;
        let (length, noise) = (highest.1, highest.2);
        for i in -20..=20 {
            for j in -20..=20 {
                let l = length + cell(LENGTHSCALES) * f64::from(i) / 20.0;
                let s = noise + cell(NOISES) * f64::from(j) / 20.0;
                let found = value(l, s)?;
                if found > highest.0 {
                    highest = (found, l, s);
                }
            }
        }
        Ok(Self { values, best: hyperparameters(highest.1, highest.2), highest: highest.0 })
    }

    /// The value at or below which the surface has the lowest colour: the maximum minus nine times
    /// the maximum's magnitude, or minus 9 if that magnitude is below 1.
    fn floor(&self) -> f64 {
        self.highest - 9.0 * self.highest.abs().max(1.0)
    }

    fn draw(&self, area: &Area) -> anyhow::Result<()> {
        let floor = self.floor();
        let (map, scale) = area.split_horizontally(area.dim_in_pixel().0 - 74);
        let mut chart = ChartBuilder::on(&map)
            .caption("log marginal likelihood", (FONT, 15))
            .margin(6)
            .margin_right(16)
            .x_label_area_size(38)
            .y_label_area_size(52)
            .build_cartesian_2d(LENGTHSCALES.0..LENGTHSCALES.1, NOISES.0..NOISES.1)?;
        let power = |e: &f64| {
            let value = 10f64.powf(*e);
            if value >= 1.0 { format!("{value:.0}") } else { format!("{value:.2}") }
        };
        chart
            .configure_mesh()
            .disable_mesh()
            .x_labels(4)
            .y_labels(4)
            .x_label_formatter(&power)
            .y_label_formatter(&power)
            .x_desc("lengthscale / width of range")
            .y_desc("noise deviation")
            .label_style((FONT, 13))
            .axis_desc_style((FONT, 14))
            .draw()?;
        let level = |value: f64| {
            let fraction = ((value - floor) / (self.highest - floor)).clamp(0.0, 1.0);
            (fraction * LEVELS as f64).round() as usize
        };
        let (half_x, half_y) = (
            0.5 * (LENGTHSCALES.1 - LENGTHSCALES.0) / CELLS as f64,
            0.5 * (NOISES.1 - NOISES.0) / CELLS as f64,
        );
        for (row, line) in self.values.iter().enumerate() {
            let y = exponent(NOISES, row);
            // Cells of one colour are drawn as one rectangle, which makes the file ten times
            // smaller.
            for run in runs(line.iter().map(|value| level(*value))) {
                let left = exponent(LENGTHSCALES, run.first) - half_x;
                let right = exponent(LENGTHSCALES, run.last) + half_x;
                // A small overlap hides the seams.
                let corners = [(left, y - half_y), (right + 0.3 * half_x, y + 1.3 * half_y)];
                let colour = viridis(run.level as f64 / LEVELS as f64);
                chart.draw_series([Rectangle::new(corners, colour.filled())])?;
            }
        }
        let at = (self.best.lengthscales[0].log10(), 0.5 * self.best.noise_variance.log10());
        chart.draw_series([EmptyElement::at(at) + star(9)])?;

        let (height, steps) = (map.dim_in_pixel().1 as i32, 60);
        let (top, bottom) = (34, height - 52);
        for i in 0..steps {
            let fraction = f64::from(i) / f64::from(steps - 1);
            let y = bottom - (bottom - top) * i / steps;
            let corners = [(4, y - (bottom - top) / steps - 1), (18, y)];
            scale.draw(&Rectangle::new(corners, viridis(fraction).filled()))?;
        }
        for (fraction, note) in [(0.0, "≤ "), (0.5, ""), (1.0, "")] {
            let y = bottom - ((bottom - top) as f64 * fraction) as i32;
            let value = floor + fraction * (self.highest - floor);
            scale.draw(&Text::new(format!("{note}{value:.0}"), (22, y - 7), (FONT, 13)))?;
        }
        Ok(())
    }
}

/// Neighbouring cells of the same colour level in a row of the surface.
struct Run {
    first: usize,
    last: usize,
    level: usize,
}

fn runs(levels: impl Iterator<Item = usize>) -> Vec<Run> {
    let mut found: Vec<Run> = Vec::new();
    for (column, level) in levels.enumerate() {
        match found.last_mut() {
            Some(run) if run.level == level => run.last = column,
            _ => found.push(Run { first: column, last: column, level }),
        }
    }
    found
}

/// A five-pointed star.
fn star(radius: i32) -> Polygon<(i32, i32)> {
    let corner = |i: i32| {
        let angle = std::f64::consts::PI * (f64::from(i) / 5.0 - 0.5);
        let r = f64::from(radius) * if i % 2 == 0 { 1.0 } else { 0.42 };
        ((r * angle.cos()).round() as i32, (r * angle.sin()).round() as i32)
    };
    Polygon::new((0..10).map(corner).collect::<Vec<_>>(), RED.filled())
}

/// The colour for a fraction from 0 to 1, from dark violet over green to yellow (after matplotlib's
/// viridis). Equal steps look equally large, also in grey and to the colour-blind.
fn viridis(fraction: f64) -> RGBColor {
    const STOPS: [(f64, f64, f64); 6] = [
        (68.0, 1.0, 84.0),
        (65.0, 68.0, 135.0),
        (42.0, 120.0, 142.0),
        (34.0, 168.0, 132.0),
        (122.0, 209.0, 81.0),
        (253.0, 231.0, 37.0),
    ];
    let place = fraction * (STOPS.len() - 1) as f64;
    let below = (place.floor() as usize).min(STOPS.len() - 2);
    let t = place - below as f64;
    let (a, b) = (STOPS[below], STOPS[below + 1]);
    let mix = |a: f64, b: f64| (a + t * (b - a)).round() as u8;
    RGBColor(mix(a.0, b.0), mix(a.1, b.1), mix(a.2, b.2))
}
