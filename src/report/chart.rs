use serde::Serialize;

/// A figure as data, which the page's script draws.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Chart {
    /// Horizontal axis.
    pub x: Axis,
    /// Vertical axis.
    pub y: Axis,
    /// Places on the horizontal axis, in order; a place may occur more than once.
    pub xs: Vec<f64>,
    /// Series, each with a value or a gap for every place.
    pub series: Vec<Series>,
    /// Bands between two series.
    pub bands: Vec<Band>,
    /// Lines across the figure, with names.
    pub marks: Vec<Mark>,
    /// Whether the horizontal axis is logarithmic.
    pub logarithmic: bool,
    /// Whether the vertical axis is logarithmic.
    pub y_logarithmic: bool,
    /// Whether the horizontal axis has whole numbers only.
    pub whole: bool,
    /// Range of the horizontal axis; `None` fits the data.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub x_range: Option<[f64; 2]>,
    /// Range of the vertical axis; `None` fits the data.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub y_range: Option<[f64; 2]>,
    /// Height in pixels; `None` for the usual one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub height: Option<u32>,
}

/// An axis: a quantity and its unit, empty for a pure number.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Axis {
    label: String,
    unit: String,
}

/// A named row of values.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Series {
    name: String,
    #[serde(serialize_with = "short")]
    values: Vec<Option<f64>>,
    style: Style,
    colour: usize,
    /// Whether a line goes on over gaps.
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

/// A map of a function of two numbers.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Map {
    /// Horizontal axis.
    pub x: Axis,
    /// Vertical axis.
    pub y: Axis,
    /// Axis of the values.
    pub value: Axis,
    /// Places on the horizontal axis.
    pub xs: Vec<f64>,
    /// Places on the vertical axis.
    pub ys: Vec<f64>,
    /// Values, row after row from the lowest.
    pub values: Vec<f64>,
    /// Points on the map.
    pub points: Vec<[f64; 2]>,
    /// Point that is marked with a cross.
    pub best: [f64; 2],
}

impl Axis {
    /// An axis of this quantity.
    #[must_use]
    pub fn new(label: impl Into<String>, unit: &str) -> Self {
        let unit = if unit == "1" { "" } else { unit };
        Self { label: label.into(), unit: unit.into() }
    }
}

impl Series {
    /// A series whose colour has this index. Numbers that are not finite are gaps.
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

    /// The same series, whose line goes on over gaps.
    #[must_use]
    pub fn over_gaps(self) -> Self {
        Self { spans: true, ..self }
    }
}

impl Mark {
    /// A vertical line.
    #[must_use]
    pub fn vertical(at: f64, label: impl Into<String>) -> Self {
        Self { at, label: label.into(), vertical: true, limit: false }
    }

    /// A horizontal line.
    #[must_use]
    pub fn horizontal(at: f64, label: impl Into<String>) -> Self {
        Self { at, label: label.into(), vertical: false, limit: false }
    }
}

/// Writes six digits of each value, which is finer than any screen.
fn short<S: serde::Serializer>(values: &[Option<f64>], serializer: S) -> Result<S::Ok, S::Error> {
    let digits = |value: f64| format!("{value:.5e}").parse().unwrap_or(value);
    serializer.collect_seq(values.iter().map(|value| value.map(digits)))
}
