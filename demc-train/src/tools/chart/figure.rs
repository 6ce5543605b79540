//! What a figure shows: panels of lines or of bars, without a word on how they are drawn.

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

/// A value of one variant with its interval.
#[derive(Clone, Debug, PartialEq)]
pub struct Bar {
    /// The height. One that is not finite, or not positive on a log axis, is shown as "n/a".
    pub value: f64,
    /// Lower and upper end of the interval around the value.
    pub interval: Option<(f64, f64)>,
    /// Individual values, one per seed or image, drawn as dots.
    pub points: Vec<f64>,
}

/// Bars of one metric, one per variant, with a shared y axis.
///
/// On a linear axis bars start at zero. Values that would look equal from zero are drawn as
/// horizontal lines on an axis that starts elsewhere. On a log axis bars start at the axis' lower
/// end.
#[derive(Clone, Debug, PartialEq)]
pub struct BarPanel {
    /// Title above the panel.
    pub title: String,
    /// Label of the y axis.
    pub y_label: String,
    /// Names of the variants in the order of `bars`: below the bars if they fit, else in a legend.
    pub names: Vec<String>,
    /// One bar per variant.
    pub bars: Vec<Bar>,
    /// Spacing of the y axis.
    pub y: AxisScale,
}

/// A picture with panels side by side.
#[derive(Clone, Debug, PartialEq)]
pub enum Figure {
    /// Lines.
    Lines(Vec<LinePanel>),
    /// Bars.
    Bars(Vec<BarPanel>),
}
