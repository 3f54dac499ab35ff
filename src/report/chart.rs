use serde::Serialize;

/// A figure as data, which the page's script draws.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Chart {
    /// Horizontal axis.
    pub x: Axis,
    /// Vertical axis.
    pub y: Axis,
    /// Positions on the horizontal axis, none below the one before it; a position may occur more
    /// than once.
    pub xs: Vec<f64>,
    /// Series, each with a value or a gap for every position of `xs`.
    pub series: Vec<Series>,
    /// Bands between two series.
    pub bands: Vec<Band>,
    /// Lines across the figure, with labels.
    pub marks: Vec<Mark>,
    /// True if the horizontal axis is logarithmic.
    pub logarithmic: bool,
    /// True if the vertical axis is logarithmic.
    pub y_logarithmic: bool,
    /// True if the horizontal axis has numbers at whole positions only.
    pub whole: bool,
    /// Range of the horizontal axis; `None` fits the data.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub x_range: Option<[f64; 2]>,
    /// Range of the vertical axis; `None` fits the data.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub y_range: Option<[f64; 2]>,
    /// Height, pixels; `None` for the height that the script chooses.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub height: Option<u32>,
}

/// An axis: a quantity and its unit, empty for a pure number.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Axis {
    label: String,
    unit: String,
}

/// A named series of values, one or a gap for each position of its figure.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Series {
    name: String,
    #[serde(serialize_with = "short")]
    values: Vec<Option<f64>>,
    style: Style,
    colour: usize,
    /// True if the line connects the values on both sides of a gap.
    spans: bool,
}

/// The way in which a series is drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Style {
    /// A line.
    Line,
    /// A line with a dot at each value.
    LineAndDots,
    /// A dashed line.
    Dashed,
    /// Dots alone.
    Dots,
    /// A line that keeps each value until the next.
    Steps,
    /// The edge of a band.
    Edge,
    /// Bars from zero.
    Bars,
}

/// A band between two series, by their indices.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Band {
    /// Index of the lower edge's series.
    pub lower: usize,
    /// Index of the upper edge's series.
    pub upper: usize,
    /// Index of the colour.
    pub colour: usize,
}

/// A line across a figure.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Mark {
    at: f64,
    label: String,
    vertical: bool,
    limit: bool,
}

/// A map of a function of two numbers, which shows the function's values on a grid as colours.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Map {
    /// Horizontal axis.
    pub x: Axis,
    /// Vertical axis.
    pub y: Axis,
    /// Axis of the values.
    pub value: Axis,
    /// Positions of the grid on the horizontal axis.
    pub xs: Vec<f64>,
    /// Positions of the grid on the vertical axis.
    pub ys: Vec<f64>,
    /// Values on the grid, row after row from the lowest `ys`.
    pub values: Vec<f64>,
    /// Points that are marked on the map.
    pub points: Vec<[f64; 2]>,
    /// Point that is marked with a cross.
    pub best: [f64; 2],
}

impl Axis {
    /// An axis of this quantity and unit; the unit `1` becomes empty.
    #[must_use]
    pub fn new(label: impl Into<String>, unit: &str) -> Self {
        let unit = if unit == "1" { "" } else { unit };
        Self { label: label.into(), unit: unit.into() }
    }
}

impl Series {
    /// A series with this index of a colour. Numbers that are not finite become gaps.
    #[must_use]
    pub fn new(
        name: impl Into<String>,
        style: Style,
        colour: usize,
        values: impl IntoIterator<Item = Option<f64>>,
    ) -> Self {
        let finite = |value: Option<f64>| value.filter(|it| it.is_finite());
        let values = values.into_iter().map(finite).collect();
        Self { name: name.into(), values, style, colour, spans: false }
    }

    /// Returns this series with a line that connects the values on both sides of a gap.
    #[must_use]
    pub fn over_gaps(self) -> Self {
        Self { spans: true, ..self }
    }
}

impl Mark {
    /// A vertical line at this position, with a label.
    #[must_use]
    pub fn vertical(at: f64, label: impl Into<String>) -> Self {
        Self { at, label: label.into(), vertical: true, limit: false }
    }

    /// A horizontal line at this value, with a label.
    #[must_use]
    pub fn horizontal(at: f64, label: impl Into<String>) -> Self {
        Self { at, label: label.into(), vertical: false, limit: false }
    }
}

/// Writes each value with six significant digits, which is finer than any screen; a gap is `null`.
fn short<S: serde::Serializer>(values: &[Option<f64>], serializer: S) -> Result<S::Ok, S::Error> {
    let digits = |value: f64| format!("{value:.5e}").parse().unwrap_or(value);
    serializer.collect_seq(values.iter().map(|value| value.map(digits)))
}
