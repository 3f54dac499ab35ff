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

/// The log marginal likelihood as a function of lengthscale and noise.
struct Surface {
    /// Log marginal likelihoods: a row for each noise, a column for each lengthscale.
    values: Vec<Vec<f64>>,
    best: Hyperparameters,
    highest: f64,
}

/// Returns the centre of a cell on an axis with this range, as an exponent of ten.
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
        let value = |length: f64, noise: f64| {
            let parameters = hyperparameters(length, noise);
            log_marginal_likelihood(data, Kernel::Matern52, &parameters).map(|found| found.value)
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
        // A finer grid around the best cell's centre reaches to the centres of its neighbours.
        let cell = |range: (f64, f64)| (range.1 - range.0) / CELLS as f64;
        let (length, noise) = (highest.1, highest.2);
        for length_step in -20..=20 {
            for noise_step in -20..=20 {
                let length = length + cell(LENGTHSCALES) * f64::from(length_step) / 20.0;
                let noise = noise + cell(NOISES) * f64::from(noise_step) / 20.0;
                let found = value(length, noise)?;
                if found > highest.0 {
                    highest = (found, length, noise);
                }
            }
        }
        Ok(Self { values, best: hyperparameters(highest.1, highest.2), highest: highest.0 })
    }

    /// Returns the value at or below which the surface has the lowest colour: the maximum minus
    /// nine times the maximum's magnitude, or minus 9 if that magnitude is below 1.
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
        let power = |exponent: &f64| {
            let value = 10f64.powf(*exponent);
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
        for step in 0..steps {
            let fraction = f64::from(step) / f64::from(steps - 1);
            let y = bottom - (bottom - top) * step / steps;
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

/// Returns a five-pointed star.
fn star(radius: i32) -> Polygon<(i32, i32)> {
    let corner = |index: i32| {
        let angle = std::f64::consts::PI * (f64::from(index) / 5.0 - 0.5);
        let distance = f64::from(radius) * if index % 2 == 0 { 1.0 } else { 0.42 };
        ((distance * angle.cos()).round() as i32, (distance * angle.sin()).round() as i32)
    };
    Polygon::new((0..10).map(corner).collect::<Vec<_>>(), RED.filled())
}

/// Returns the colour for a fraction from 0 to 1, from dark violet over green to yellow (after
/// matplotlib's viridis). Equal steps look equally large, also in grey and to the colour-blind.
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
    let weight = place - below as f64;
    let (low, high) = (STOPS[below], STOPS[below + 1]);
    let mix = |low: f64, high: f64| (low + weight * (high - low)).round() as u8;
    RGBColor(mix(low.0, high.0), mix(low.1, high.1), mix(low.2, high.2))
}
