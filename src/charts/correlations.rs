use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use super::style::{BLUE, FONT, INK, TEXT, TITLE, VERMILION};
use super::{DrawingError, PlotError};
use crate::qube::Correlations;

/// Width and height of one square, pixels.
const SQUARE: i32 = 46;

/// Room for the names to the left of the squares and below them, pixels.
const NAMES: i32 = 210;

/// Draws the correlations of a fit's errors as SVG: a square for each pair of quantities, blue for
/// a positive correlation, vermilion for a negative one, and deeper the nearer it is to 1 or -1.
///
/// # Errors
/// The drawing library failed.
pub fn correlations_svg(correlations: &Correlations) -> Result<String, DrawingError> {
    let mut svg = String::new();
    draw(&mut svg, correlations)?;
    Ok(svg)
}

fn draw(svg: &mut String, Correlations { names, rows }: &Correlations) -> Result<(), PlotError> {
    let side = SQUARE * names.len() as i32;
    let (top, size) = (40, ((NAMES + side + 20) as u32, (40 + side + NAMES) as u32));
    let root = SVGBackend::with_string(svg, size).into_drawing_area();
    root.fill(&WHITE)?;
    let title = "correlations of the errors";
    root.draw(&Text::new(title, (10, 10), (FONT, TITLE).into_font().color(&INK)))?;
    let font = (FONT, TEXT - 2).into_font();
    let left = font.color(&INK).pos(Pos::new(HPos::Right, VPos::Center));
    let turned = font.transform(FontTransform::Rotate270).color(&INK);
    let below = turned.pos(Pos::new(HPos::Right, VPos::Center));
    let number = (FONT, TEXT - 3).into_font().color(&INK).pos(Pos::new(HPos::Center, VPos::Center));
    for (index, name) in names.iter().enumerate() {
        let middle = SQUARE * index as i32 + SQUARE / 2;
        root.draw(&Text::new(name.as_str(), (NAMES - 8, top + middle), left.clone()))?;
        root.draw(&Text::new(name.as_str(), (NAMES + middle, top + side + 8), below.clone()))?;
    }
    for (row, values) in rows.iter().enumerate() {
        for (column, value) in values.iter().enumerate() {
            let corner = (NAMES + SQUARE * column as i32, top + SQUARE * row as i32);
            let end = (corner.0 + SQUARE - 2, corner.1 + SQUARE - 2);
            root.draw(&Rectangle::new([corner, end], shade(*value).filled()))?;
            let middle = (corner.0 + SQUARE / 2, corner.1 + SQUARE / 2);
            root.draw(&Text::new(format!("{value:.2}"), middle, number.clone()))?;
        }
    }
    root.present()
}

/// The colour of a correlation: white for none, and pale enough at 1 for the number on it.
fn shade(correlation: f64) -> RGBColor {
    let RGBColor(red, green, blue) = if correlation < 0.0 { VERMILION } else { BLUE };
    let share = 0.7 * correlation.abs().min(1.0);
    let mix = |part: u8| (share * f64::from(part) + (1.0 - share) * 255.0) as u8;
    RGBColor(mix(red), mix(green), mix(blue))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_pair_has_its_number_and_opposite_signs_other_colours() {
        let names = ["R_m", "k_m", "M_r"].map(String::from).to_vec();
        let rows = vec![vec![1.0], vec![0.8, 1.0], vec![-0.8, 0.0, 1.0]];
        let svg = correlations_svg(&Correlations { names, rows }).unwrap();
        for (text, times) in [("1.00", 3), ("-0.80", 1), ("R_m", 2), ("k_m", 2), ("M_r", 2)] {
            assert_eq!(svg.matches(text).count(), times, "{text}: {svg}");
        }
        assert_ne!(shade(0.8), shade(-0.8));
        assert_eq!(shade(0.0), RGBColor(255, 255, 255));
    }
}
