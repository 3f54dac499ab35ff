use std::fmt::Write;

use super::escaped;
use super::style::page_style;
use crate::qube::Correlations;

/// Width and height of one square, pixels.
const SQUARE: usize = 40;

/// Width of the names to the left of the squares, pixels.
const NAMES: usize = 250;

/// Style of the numbers in a file: black or white, because coloured squares lie behind them.
const ENTRIES: &str = ".entry{text-anchor:middle;fill:#000}\
     @media(prefers-color-scheme:dark){.entry{fill:#fff}}";

/// Margin around the squares and their names in a file, pixels.
const MARGIN: usize = 12;

/// Draws the correlations of a fit's errors as the SVG of a file. Its colours are light or dark as
/// the reader's system is.
#[must_use]
pub fn correlations_svg(Correlations { names, rows }: &Correlations) -> String {
    let (width, height) = size(names.len());
    let (width, height) = (width + 2 * MARGIN, height + 2 * MARGIN);
    let style = page_style();
    let squares = squares(names, |row, column| rows[row][column]);
    format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" width=\"{width}\" height=\"{height}\" \
         role=\"img\"><title>correlations of the errors</title><style>{style}{ENTRIES}</style>\
         <rect class=\"p\" width=\"{width}\" height=\"{height}\"/>\
         <g transform=\"translate({MARGIN} {MARGIN})\">{squares}</g></svg>\n"
    )
}

/// Draws the correlations of the quantities with these names as an SVG element of an HTML page. The
/// page's style sheet colours the classes `d`, positive, and `dt`, negative, within the class
/// `matrix`, and centres the texts of the class `entry`.
#[must_use]
pub fn correlations_element(names: &[String], entry: impl Fn(usize, usize) -> f64) -> String {
    let (width, height) = size(names.len());
    let squares = squares(names, entry);
    format!(
        "<svg class=\"matrix\" width=\"{width}\" height=\"{height}\" role=\"img\">{squares}</svg>"
    )
}

/// Returns the width and height of the drawing for this many quantities, pixels.
fn size(quantities: usize) -> (usize, usize) {
    (NAMES + SQUARE * quantities, SQUARE * (quantities + 1))
}

/// Draws a square with its correlation for each pair of quantities, blue for a positive one,
/// vermilion for a negative one, and deeper the nearer it is to 1 or -1; with the numbered names to
/// the left, and their numbers below.
fn squares(names: &[String], entry: impl Fn(usize, usize) -> f64) -> String {
    let mut svg = String::new();
    for (row, name) in names.iter().enumerate() {
        let middle = SQUARE * row + SQUARE / 2 + 4;
        let _ = write!(svg, "<text x=\"0\" y=\"{middle}\">{}: {}</text>", row + 1, escaped(name));
        for column in 0..row {
            let value = entry(row, column);
            let class = if value < 0.0 { "dt" } else { "d" };
            let (x, y) = (NAMES + SQUARE * column, SQUARE * row);
            let _ = write!(
                svg,
                "<rect class=\"{class}\" x=\"{x}\" y=\"{y}\" width=\"{SQUARE}\" height=\"{SQUARE}\" \
                 fill-opacity=\"{:.2}\"/><text class=\"entry\" x=\"{}\" y=\"{middle}\">{value:.2}</text>",
                0.65 * value.abs().min(1.0),
                x + SQUARE / 2,
            );
        }
        let _ = write!(
            svg,
            "<text class=\"entry\" x=\"{}\" y=\"{}\">{}</text>",
            NAMES + SQUARE * row + SQUARE / 2,
            SQUARE * names.len() + SQUARE / 2,
            row + 1
        );
    }
    svg
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_pair_has_its_number_and_opposite_signs_have_different_colours() {
        let names = ["R_m", "<k_m>", "M_r"].map(String::from).to_vec();
        let rows = vec![vec![1.0], vec![-0.94, 1.0], vec![0.5, 0.0, 1.0]];
        let file = correlations_svg(&Correlations { names: names.clone(), rows: rows.clone() });
        let element = correlations_element(&names, |row, column| rows[row][column]);
        for svg in [file, element] {
            assert_eq!(svg.matches("fill-opacity").count(), 3, "{svg}");
            assert_eq!(svg.matches("class=\"dt\"").count(), 1, "{svg}");
            assert!(svg.contains("fill-opacity=\"0.61\"") && svg.contains(">-0.94<"), "{svg}");
            assert!(svg.contains("2: &lt;k_m&gt;") && svg.contains("3: M_r"), "{svg}");
        }
    }
}
