//! A panel of lines.

use super::axis::{Axis, shows};
use super::frame::{self, Entries, ROW, WORDS, Words};
use super::shape::{Area, At, Drawing, GREY, INK, pale, palette};
use super::{Panel, Series};

/// Line widths in pixels: of a series, of a faint one.
const WIDTHS: [u32; 2] = [4, 2];
/// Radius of a point that has no neighbours, of a faint one.
const RADII: [u32; 2] = [7, 4];
/// How much of its colour a faint series keeps.
const FAINT: f64 = 0.35;
/// Pixels between a mark's line and its label.
const BESIDE: f64 = 8.0;
/// Series of up to so many points show each of them.
const FEW: usize = 40;
/// Free shares of the axes beyond the data.
const MARGINS: [[f64; 2]; 2] = [[0.03; 2], [0.06; 2]];

/// The legend's entries for a panel.
pub(super) fn entries(panel: &Panel) -> Entries {
    let named = |series: &&Series| !series.faint && !series.name.is_empty();
    let shown = panel.series.iter().filter(named);
    shown.map(|s| (s.name.clone(), s.color)).collect()
}

/// Draws `panel` into `cell`.
pub(super) fn draw(drawing: &mut Drawing, cell: Area, panel: &Panel) {
    let points = || panel.series.iter().flat_map(|series| &series.points);
    let shown = || points().filter(|point| is_shown(panel, point));
    // From left to right and from the top row of labels down: no label stands on the line of another.
    let is_mark = |mark: &&(f64, String)| shows(panel.x, mark.0);
    let mut marks: Vec<_> = panel.marks.iter().filter(is_mark).collect();
    marks.sort_by(|a, b| a.0.total_cmp(&b.0));
    let xs = shown()
        .map(|point| point.0)
        .chain(marks.iter().map(|mark| mark.0));
    let x = Axis::over(panel.x, xs, MARGINS[0]);
    let y = Axis::over(panel.y, shown().map(|point| point.1), MARGINS[1]);
    let words = Words {
        title: &panel.title,
        x_label: &panel.x_label,
        y_label: &panel.y_label,
    };
    let inside = frame::around(drawing, cell, words, y.as_ref(), marks.len());
    let (Some(x), Some(y)) = (x, y) else {
        frame::axes(drawing, inside);
        return frame::no_data(drawing, inside);
    };
    frame::y_ticks(drawing, inside, &y);
    frame::x_ticks(drawing, inside, &x);
    frame::axes(drawing, inside);
    for faint in [true, false] {
        for series in panel.series.iter().filter(|series| series.faint == faint) {
            for run in runs(panel, series) {
                let run = run.iter().map(|p| inside.at(x.at(p.0), y.at(p.1)));
                draw_run(drawing, series, run.collect());
            }
        }
    }
    let above = |i: usize| (marks.len() - i) as f64 * ROW - ROW / 2.0;
    for (i, (value, _)) in marks.iter().enumerate() {
        draw_mark(drawing, inside, x.at(*value), above(i));
    }
    for (i, (value, label)) in marks.iter().enumerate() {
        name_mark(drawing, inside, x.at(*value), above(i), label);
    }
}

fn is_shown(panel: &Panel, point: &(f64, f64)) -> bool {
    shows(panel.x, point.0) && shows(panel.y, point.1)
}

/// The stretches of a series between points that cannot be shown.
fn runs<'a>(panel: &Panel, series: &'a Series) -> Vec<&'a [(f64, f64)]> {
    let stretches = series.points.split(|point| !is_shown(panel, point));
    stretches.filter(|stretch| !stretch.is_empty()).collect()
}

fn draw_run(drawing: &mut Drawing, series: &Series, run: Vec<At>) {
    let kind = usize::from(series.faint);
    let color = match series.faint {
        true => pale(palette(series.color), FAINT),
        false => palette(series.color),
    };
    if run.len() == 1 || (series.points.len() <= FEW && !series.faint) {
        for at in &run {
            drawing.dot(*at, RADII[kind], color);
        }
    }
    match run.len() {
        1 => {}
        _ if series.faint => drawing.line(run, WIDTHS[kind], color),
        _ => frame::colored_line(drawing, run, WIDTHS[kind], series.color),
    }
}

/// A dashed line at `x`, and a thin one on to the row of its label `above` the panel.
fn draw_mark(drawing: &mut Drawing, inside: Area, x: f64, above: f64) {
    let (bottom, top) = (inside.at(x, 0.0), inside.at(x, 1.0));
    drawing.dashed(&[bottom, top], 3, INK);
    drawing.line(vec![top, (top.0, top.1 - above - ROW / 2.0)], 2, GREY);
}

/// The label of a mark, to the right of its line, or to the left where it would be cut off.
fn name_mark(drawing: &mut Drawing, inside: Area, x: f64, above: f64, label: &str) {
    let label = drawing.fitted(label, WORDS, inside.width() / 2.0 - BESIDE);
    let half = drawing.text_width(&label, WORDS) / 2.0 + BESIDE;
    let (line, top) = inside.at(x, 1.0);
    let across = match line + 2.0 * half < inside.right {
        true => line + half,
        false => line - half,
    };
    drawing.text_on_white((across, top - above), &label, WORDS);
}

#[cfg(test)]
mod tests {
    use super::super::Scale;
    use super::super::paint::Font;
    use super::super::shape::Shape;
    use super::*;

    fn drawn(points: &[(f64, f64)], y: Scale) -> Vec<Shape> {
        let panel = Panel {
            title: String::new(),
            x_label: String::new(),
            y_label: String::new(),
            x: Scale::Linear,
            y,
            series: vec![Series {
                name: "a".to_string(),
                points: points.to_vec(),
                faint: false,
                color: 1,
            }],
            marks: vec![],
        };
        let mut drawing = Drawing::new(800.0, 600.0, Font::embedded().unwrap());
        let cell = Area {
            left: 0.0,
            top: 0.0,
            right: 800.0,
            bottom: 600.0,
        };
        draw(&mut drawing, cell, &panel);
        drawing.shapes
    }

    fn lines(shapes: &[Shape]) -> Vec<&Vec<At>> {
        let of = |shape| match shape {
            &Shape::Line {
                ref points, color, ..
            } if color == palette(1) => Some(points),
            _ => None,
        };
        shapes.iter().filter_map(of).collect()
    }

    #[test]
    fn points_that_cannot_be_shown_leave_a_gap() {
        let points = [
            (0.0, 1.0),
            (1.0, 2.0),
            (2.0, f64::NAN),
            (3.0, 1.0),
            (4.0, 3.0),
        ];
        assert_eq!(lines(&drawn(&points, Scale::Linear)).len(), 2);
        let points = points.map(|(x, y)| (x, if y.is_nan() { 0.0 } else { y }));
        assert_eq!(lines(&drawn(&points, Scale::Linear)).len(), 1);
        assert_eq!(lines(&drawn(&points, Scale::Log)).len(), 2);
    }

    #[test]
    fn log_axis_makes_factors_equal_steps() {
        let shapes = drawn(&[(0.0, 0.01), (1.0, 0.1), (2.0, 1.0)], Scale::Log);
        let line = lines(&shapes)[0];
        let (first, second) = (line[0].1 - line[1].1, line[1].1 - line[2].1);
        assert!(first > 50.0 && (first - second).abs() < 1e-6, "{line:?}");
        assert!((line[1].0 - line[0].0 - (line[2].0 - line[1].0)).abs() < 1e-6);
    }

    #[test]
    fn single_point_is_a_dot_and_none_is_said() {
        let shapes = drawn(&[(5.0, 0.2)], Scale::Log);
        let dots = shapes
            .iter()
            .filter(|shape| matches!(shape, Shape::Dot { .. }));
        assert_eq!(dots.count(), 1);
        let says = |shapes: &[Shape]| {
            shapes
                .iter()
                .any(|shape| matches!(shape, Shape::Text { text, .. } if text == "no data"))
        };
        assert!(!says(&shapes));
        assert!(says(&drawn(&[(1.0, 0.0), (2.0, -1.0)], Scale::Log)));
        assert!(says(&drawn(&[], Scale::Linear)));
    }
}
