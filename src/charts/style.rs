//! The style of all figures: colours that colour-blind people can tell apart (after Okabe and Ito
//! 2008), fonts and strokes.

use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use super::{Panel, PlotError};

/// Dark grey: axes, texts and nominal values.
pub const INK: RGBColor = RGBColor(40, 44, 52);
/// Light grey: grids and background lines.
pub const FAINT: RGBColor = RGBColor(215, 219, 224);
/// Blue: recorded or measured quantities, or means.
pub const BLUE: RGBColor = RGBColor(0, 114, 178);
/// Vermilion: simulated quantities, or a chosen point.
pub const VERMILION: RGBColor = RGBColor(213, 94, 0);
/// Green: sent voltages, the best so far, or acquisition functions.
pub const GREEN: RGBColor = RGBColor(0, 158, 115);
/// Red: limits, also the return of a success.
pub const LIMIT: RGBColor = RGBColor(138, 28, 28);

/// Colours of lines without a meaning of their own, in the order of the lines' indices.
const PALETTE: [RGBColor; 7] = [
    BLUE,
    VERMILION,
    GREEN,
    RGBColor(166, 83, 127),
    RGBColor(178, 119, 0),
    RGBColor(86, 180, 233),
    INK,
];

/// Colours of a picture in a page.
struct PageColours {
    text: RGBColor,
    grid: RGBColor,
    ground: RGBColor,
    blue: RGBColor,
    vermilion: RGBColor,
}

/// Colours in a light page.
const LIGHT_PAGE: PageColours = PageColours {
    text: RGBColor(0x5a, 0x63, 0x70),
    grid: RGBColor(0xd6, 0xda, 0xe0),
    ground: WHITE,
    blue: BLUE,
    vermilion: VERMILION,
};

/// Colours in a dark page.
const DARK_PAGE: PageColours = PageColours {
    text: RGBColor(0xa2, 0xab, 0xb8),
    grid: RGBColor(0x3a, 0x41, 0x4b),
    ground: RGBColor(0x14, 0x17, 0x1b),
    blue: RGBColor(0x5a, 0xb4, 0xee),
    vermilion: RGBColor(0xff, 0x93, 0x50),
};

/// Font of all figures.
pub const FONT: &str = "sans-serif";
/// Size of the texts at axes and in keys, pixels.
pub const TEXT: u32 = 15;
/// Estimated width of a letter at the size [`TEXT`], pixels; wide letters are wider, but few names
/// have many of them.
const LETTER: u32 = 9;
/// Size of titles, pixels.
pub const TITLE: u32 = 18;
/// Width of a line, pixels.
pub const LINE: u32 = 2;

/// Returns the estimated width of the widest of these texts at the size [`TEXT`], pixels.
pub fn widest<'a>(texts: impl IntoIterator<Item = &'a str>) -> u32 {
    let letters = texts.into_iter().map(|text| text.chars().count() as u32);
    LETTER * letters.max().unwrap_or(0)
}

/// Returns the colour of the line with this index; after seven lines the colours repeat.
pub fn colour(index: usize) -> RGBColor {
    PALETTE[index % PALETTE.len()]
}

/// Returns the style sheet of a picture in a page, light or dark as the reader's system is. Its
/// classes are: `p` the ground, `g` a grid, `a` a grey line, `b` a blue and `t` a vermilion line,
/// `d` and `dt` areas and texts in blue and in vermilion.
pub fn page_style() -> String {
    let PageColours { text, grid, ground, blue, vermilion } = LIGHT_PAGE;
    let [text, grid, ground, blue, vermilion] = [text, grid, ground, blue, vermilion].map(css);
    let light = format!(
        "text{{font:13px system-ui,'Noto Sans',Arial,sans-serif;fill:{text}}}.p{{fill:{ground}}}.g{{stroke:{grid}}}\
         .a{{stroke:{text}}}.b{{stroke:{blue};fill:none}}.d{{fill:{blue}}}.t{{stroke:{vermilion};fill:none}}\
         .dt{{fill:{vermilion}}}"
    );
    let PageColours { text, grid, ground, blue, vermilion } = DARK_PAGE;
    let [text, grid, ground, blue, vermilion] = [text, grid, ground, blue, vermilion].map(css);
    let dark = format!(
        "text{{fill:{text}}}.p{{fill:{ground}}}.g{{stroke:{grid}}}.a{{stroke:{text}}}.b{{stroke:{blue}}}\
         .d{{fill:{blue}}}.t{{stroke:{vermilion}}}.dt{{fill:{vermilion}}}"
    );
    format!("{light}@media(prefers-color-scheme:dark){{{dark}}}")
}

/// Returns a colour in the notation of style sheets.
fn css(RGBColor(red, green, blue): RGBColor) -> String {
    match (red, green, blue) {
        (0xff, 0xff, 0xff) => "#fff".to_owned(),
        _ => format!("#{red:02x}{green:02x}{blue:02x}"),
    }
}

/// The mark of an entry in a key (legend).
#[derive(Clone, Copy)]
pub enum Key {
    /// A line of this width, pixels.
    Line(RGBColor, u32),
    /// A dashed line.
    Dashed(RGBColor),
    /// A small circle.
    Dot(RGBColor),
}

/// Draws a key (the names with their marks) in rows at the top of a panel, and returns the part of
/// the panel below.
///
/// # Errors
/// The drawing library failed.
pub fn with_key<'a>(panel: &Panel<'a>, entries: &[(String, Key)]) -> Result<Panel<'a>, PlotError> {
    let width = panel.dim_in_pixel().0 as i32;
    let room = |name: &str| 48 + 8 * name.chars().count() as i32;
    let (mut x, mut row) = (14, 0);
    let mut places = Vec::new();
    for (name, key) in entries {
        if x > 14 && x + room(name) > width {
            (x, row) = (14, row + 1);
        }
        places.push((x, 14 + 22 * row, name, key));
        x += room(name);
    }
    let (top, rest) = panel.split_vertically(28 + 22 * row);
    for (x, y, name, key) in places {
        match *key {
            Key::Line(colour, width) => {
                top.draw(&PathElement::new([(x, y), (x + 26, y)], colour.stroke_width(width)))?;
            }
            Key::Dashed(colour) => {
                for part in 0..3 {
                    let from = x + 9 * part;
                    top.draw(&PathElement::new(
                        [(from, y), (from + 6, y)],
                        colour.stroke_width(LINE),
                    ))?;
                }
            }
            Key::Dot(colour) => top.draw(&Circle::new((x + 13, y), 4, colour.stroke_width(1)))?,
        }
        let style = (FONT, TEXT).into_font().color(&INK).pos(Pos::new(HPos::Left, VPos::Center));
        top.draw(&Text::new(name.clone(), (x + 32, y), style))?;
    }
    Ok(rest)
}
