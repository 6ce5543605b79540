//! Figures written and read back.

use std::fs;

use super::figure::{AxisScale, Category, CategoryPanel, LinePanel, Series};
use super::frame::palette;
use super::*;

fn series(name: &str, color: usize, points: &[(f64, f64)]) -> Series {
    Series {
        name: name.to_string(),
        points: points.to_vec(),
        faint: false,
        color,
    }
}

fn panel(y: AxisScale, series: Vec<Series>) -> LinePanel {
    LinePanel {
        title: "loss & <more>".to_string(),
        x_label: "step".to_string(),
        y_label: "loss".to_string(),
        x: AxisScale::Linear,
        y,
        series,
        marks: vec![(1.5, "chosen".to_string())],
    }
}

fn written(figure: &Figure) -> String {
    let dir = tempfile::tempdir().unwrap();
    let path = figure.write(&dir.path().join("chart.v1")).unwrap();
    assert_eq!(path, dir.path().join("chart.v1.svg"));
    assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
    fs::read_to_string(path).unwrap()
}

fn hex(RGBColor(red, green, blue): RGBColor) -> String {
    format!("#{red:02X}{green:02X}{blue:02X}")
}

fn attribute<'a>(line: &'a str, name: &str) -> &'a str {
    let value = line.split(&format!(" {name}=\"")).nth(1).unwrap();
    value.split('"').next().unwrap()
}

/// An attribute of all SVG elements of this kind and colour.
fn attributes(svg: &str, element: &str, color: RGBColor, name: &str) -> Vec<i32> {
    let (element, color) = (format!("<{element} "), hex(color));
    let lines = svg
        .lines()
        .filter(|line| line.starts_with(&element) && line.contains(&color));
    lines
        .map(|line| attribute(line, name).parse().unwrap())
        .collect()
}

fn says(svg: &str, word: &str) -> usize {
    svg.lines().filter(|line| *line == word).count()
}

/// The points of the lines in a colour, one list per line between gaps.
fn stretches(svg: &str, color: &str) -> Vec<Vec<(i32, i32)>> {
    let is_line = |line: &&str| {
        line.contains("<polyline") && line.contains(color) && line.contains("stroke-width=\"4\"")
    };
    let points = |line: &str| {
        let points = attribute(line, "points").split_whitespace();
        let pairs = points.map(|point| point.split_once(',').unwrap());
        pairs
            .map(|(x, y)| (x.parse().unwrap(), y.parse().unwrap()))
            .collect()
    };
    svg.lines().filter(is_line).map(points).collect()
}

#[test]
fn lines_go_through_their_points() {
    let rising = [(0.0, 0.1), (1.0, 1.0), (2.0, 10.0), (3.0, 100.0)];
    let lines = vec![
        series("up <1>", 0, &rising),
        series("down", 1, &[(0.0, 100.0), (3.0, 0.1)]),
    ];
    let svg = written(&Figure(vec![panel(AxisScale::Log, lines)]));
    let [up, down] = ["#0072B2", "#D55E00"].map(|color| stretches(&svg, color).remove(0));
    let (x, y): (Vec<_>, Vec<_>) = up.iter().copied().unzip();
    assert!(x.is_sorted() && y.is_sorted_by(|a, b| a > b), "{up:?}");
    // Equal steps on the linear axis, equal factors on the log one, to a drawing unit.
    let step = |values: &[i32], i: usize| values[i + 1] - values[i];
    assert!(
        (step(&x, 0) - step(&x, 2)).abs() <= 1 && step(&x, 0) > 300,
        "{up:?}"
    );
    assert!(
        (step(&y, 0) - step(&y, 2)).abs() <= 1 && step(&y, 0) < -100,
        "{up:?}"
    );
    assert_eq!(down, [(x[0], y[3]), (x[3], y[0])]);
    for word in [
        "up &lt;1&gt;",
        "down",
        "chosen",
        "loss &amp; &lt;more&gt;",
        "0.1",
        "100",
    ] {
        assert_eq!(says(&svg, word), 1, "{word}");
    }
    assert_eq!([says(&svg, "step"), says(&svg, "loss")], [1, 1]);
    let root = svg.lines().next().unwrap();
    let size = ["width", "height"].map(|name| attribute(root, name).parse::<u32>().unwrap());
    let view: Vec<u32> = attribute(root, "viewBox")
        .split(' ')
        .skip(2)
        .map(|side| side.parse().unwrap())
        .collect();
    assert_eq!(size, [view[0] / 2, view[1] / 2]);
    assert!(size[0] >= 776 && size[1] == 450, "{size:?}");
    assert!(svg.contains("sans-serif"));
    assert!(stretches(&svg, &hex(palette(2))).is_empty());
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
    let zeros = points.map(|(x, y)| (x, if y.is_nan() { 0.0 } else { y }));
    let lengths = |y, points: &[_]| -> Vec<usize> {
        let figure = Figure(vec![panel(y, vec![series("a", 0, points)])]);
        stretches(&written(&figure), "#0072B2")
            .iter()
            .map(Vec::len)
            .collect()
    };
    assert_eq!(lengths(AxisScale::Linear, &points), [2, 2]);
    assert_eq!(lengths(AxisScale::Linear, &zeros), [5]);
    assert_eq!(lengths(AxisScale::Log, &zeros), [2, 2]);
}

#[test]
fn faint_series_are_pale_and_not_in_the_legend() {
    let mut raw = series("raw", 2, &[(0.0, 0.0), (1.0, 5.0), (2.0, 1.0)]);
    raw.faint = true;
    let smooth = series("smooth", 2, &[(0.0, 1.0), (1.0, 2.0), (2.0, 1.5)]);
    let late = series("late", 10, &[(0.0, 4.0), (2.0, 4.0)]);
    let panel = panel(AxisScale::Linear, vec![smooth, raw, late]);
    let svg = written(&Figure(vec![panel]));
    assert_eq!(
        ["smooth", "raw", "late"].map(|name| says(&svg, name)),
        [1, 0, 1]
    );
    let pale = svg.find("#A6DDCE").expect("35 % of the colour on white");
    let line = svg.find("stroke=\"#009E73\" stroke-width=\"4\"").unwrap();
    assert!(pale < line, "the pale line is underneath");
    assert_eq!(stretches(&svg, &hex(palette(10))).len(), 1);
    assert_ne!(palette(2), palette(10));
}

#[test]
fn one_legend_names_each_series_once() {
    let line = |name| {
        panel(
            AxisScale::Linear,
            vec![series(name, 0, &[(0.0, 0.0), (1.0, 1.0)])],
        )
    };
    let panels = vec![line("a"), line("a"), line("b")];
    let svg = written(&Figure(panels));
    assert_eq!([says(&svg, "a"), says(&svg, "b")], [1, 1]);
}

#[test]
fn single_points_are_dots_and_empty_panels_say_so() {
    let points = |points: &[_]| panel(AxisScale::Log, vec![series("a", 0, points)]);
    let svg = written(&Figure(vec![points(&[(5.0, 0.2)])]));
    assert_eq!(says(&svg, "no data"), 0);
    assert_eq!(attributes(&svg, "circle", palette(0), "r"), [7]);
    let none = points(&[(1.0, 0.0), (2.0, f64::NAN)]);
    for figure in [Figure(vec![]), Figure(vec![none])] {
        assert_eq!(says(&written(&figure), "no data"), 1);
    }
}

#[test]
fn an_invalid_stem_is_named_and_writes_nothing() {
    let figure = Figure(vec![]);
    let error = figure.write(Path::new("no/such/dir/chart")).unwrap_err();
    assert!(
        format!("{error:#}").contains("no/such/dir/chart.svg"),
        "{error:#}"
    );
    let dir = tempfile::tempdir().unwrap();
    let error = figure.write(&dir.path().join("")).unwrap_err().to_string();
    assert!(error.contains("expected a file name"), "{error}");
    assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 0);
}

/// The viewer's font decides the width of text: 0.62 of its size per character is that of DejaVu
/// Sans.
#[test]
fn the_picture_has_room_for_the_longest_name() {
    let name = "runs/a-run-directory-with-a-long-name-24000-steps";
    let line = series(name, 0, &[(0.0, 1.0), (1.0, 2.0)]);
    let svg = written(&Figure(vec![panel(AxisScale::Linear, vec![line])]));
    let lines: Vec<&str> = svg.lines().collect();
    let label = lines.iter().position(|line| *line == name).unwrap() - 1;
    let [x, size]: [f64; 2] =
        ["x", "font-size"].map(|name| attribute(lines[label], name).parse().unwrap());
    let shown: f64 = attribute(lines[0], "width").parse().unwrap();
    let end = x + 0.62 * size * name.len() as f64;
    assert!(end < 2.0 * shown, "{end} of {}", 2.0 * shown);
}

#[test]
fn a_name_may_have_its_ending_already() {
    let name = |stem: &str, ending: &str| {
        let path = with_extension(Path::new(stem), ending).expect("a name");
        path.to_str().expect("UTF-8").to_owned()
    };
    assert_eq!(name("a/p", "svg"), "a/p.svg");
    assert_eq!(name("a/p.svg", "svg"), "a/p.svg");
    assert_eq!(name("a/p.svg", "csv"), "a/p.csv");
    assert_eq!(name("a/run.2", "svg"), "a/run.2.svg");
    assert!(with_extension(Path::new("a/"), "svg").is_err());
}

/// The widths of the bars of these values.
fn bars(values: &[f64]) -> (Vec<i32>, String) {
    let rows = values.iter().map(|value| Category {
        name: "variant".to_string(),
        value: *value,
        interval: Some([0.9 * value, 1.1 * value]),
        color: 0,
    });
    let panel = CategoryPanel {
        title: "RelMSE".to_string(),
        x_label: "mean".to_string(),
        x: AxisScale::Linear,
        bars: true,
        rows: rows.collect(),
        line: None,
    };
    let dir = tempfile::tempdir().unwrap();
    let path = CategoryFigure(vec![panel])
        .write(&dir.path().join("bars"))
        .unwrap();
    let svg = fs::read_to_string(path).unwrap();
    (attributes(&svg, "rect", palette(0), "width"), svg)
}

#[test]
fn a_bar_much_longer_than_the_others_is_cut() {
    let (widths, svg) = bars(&[0.1, 0.2, 1.5]);
    assert_eq!(says(&svg, "1.5"), 1);
    assert!((2 * widths[0] - widths[1]).abs() <= 2, "{widths:?}");
    assert!(widths[2] > 2 * widths[1], "{widths:?}");
    assert!(widths[2] < 5 * widths[1] / 2, "{widths:?}");

    let (widths, svg) = bars(&[0.1, 0.2, 0.3]);
    assert_eq!(says(&svg, "0.3"), 1, "a label of the axis");
    assert!((3 * widths[0] - widths[2]).abs() <= 3, "{widths:?}");
}
