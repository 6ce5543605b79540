//! What a figure shows: panels of lines or of categories, without a word on how they are drawn.

/// A line of points in a [`LinePanel`].
#[derive(Clone, Debug, PartialEq)]
pub struct Series {
    /// Name in the legend.
    pub name: String,
    /// Points (x, y) in drawing order. One that is not finite, or not positive on a log axis,
    /// leaves a gap.
    pub points: Vec<(f64, f64)>,
    /// Thin and pale, below the others and without a legend entry: raw values under a smoothed
    /// curve.
    pub faint: bool,
    /// Index in the palette of eight colours, which repeats in greyer tones.
    pub color: usize,
}

/// Spacing of an axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AxisScale {
    /// Equal differences have equal lengths.
    Linear,
    /// Equal factors have equal lengths.
    Log,
}

/// A coordinate system with lines.
#[derive(Clone, Debug, PartialEq)]
pub struct LinePanel {
    /// Title above the panel.
    pub title: String,
    /// Label of the x axis.
    pub x_label: String,
    /// Label of the y axis.
    pub y_label: String,
    /// Spacing of the x axis.
    pub x: AxisScale,
    /// Spacing of the y axis.
    pub y: AxisScale,
    /// The lines; later ones are drawn on top.
    pub series: Vec<Series>,
    /// Vertical lines with a label, such as a suggested learning rate.
    pub marks: Vec<(f64, String)>,
}

/// A picture with panels side by side.
#[derive(Clone, Debug, PartialEq)]
pub struct Figure(pub Vec<LinePanel>);

/// A name with its value.
#[derive(Clone, Debug, PartialEq)]
pub struct Category {
    /// The name, at the left of the panel.
    pub name: String,
    /// The value.
    pub value: f64,
    /// The ends of its interval.
    pub interval: Option<[f64; 2]>,
    /// Index in the palette.
    pub color: usize,
}

/// Named values below each other.
#[derive(Clone, Debug, PartialEq)]
pub struct CategoryPanel {
    /// Title above the panel.
    pub title: String,
    /// Label of the x axis.
    pub x_label: String,
    /// Spacing of the x axis.
    pub x: AxisScale,
    /// Whether bars reach from zero to the values, instead of points.
    pub bars: bool,
    /// From top to bottom.
    pub rows: Vec<Category>,
    /// A vertical line, such as at equality.
    pub line: Option<f64>,
}

/// A picture with panels of categories side by side.
#[derive(Clone, Debug, PartialEq)]
pub struct CategoryFigure(pub Vec<CategoryPanel>);
