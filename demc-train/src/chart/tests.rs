//! Figures as files, read back.

use std::fs;

use super::page::palette;
use super::*;

fn series(name: &str, color: usize, points: &[(f64, f64)]) -> Series {
    Series {
        name: name.to_string(),
        points: points.to_vec(),
        faint: false,
        color,
    }
}

fn panel(y: Scale, series: Vec<Series>) -> Panel {
    Panel {
        title: "loss & <more>".to_string(),
        x_label: "step".to_string(),
        y_label: "loss".to_string(),
        x: Scale::Linear,
        y,
        series,
        marks: vec![(1.5, "chosen".to_string())],
    }
}

fn bars(names: &[&str], values: &[f64]) -> BarPanel {
    let bar = |value: &f64| Bar {
        value: *value,
        interval: Some((0.99 * value, 1.01 * value)),
        points: vec![*value],
    };
    BarPanel {
        title: "bars".to_string(),
        y_label: String::new(),
        names: names.iter().map(|name| name.to_string()).collect(),
        bars: values.iter().map(bar).collect(),
        y: Scale::Linear,
    }
}

/// Writes a figure and returns the SVG's text and the PNG's size and pixels.
fn written(figure: &Figure) -> (String, (u32, u32), Vec<RGBColor>) {
    let dir = tempfile::tempdir().unwrap();
    let [svg, png] = figure.write(&dir.path().join("chart.v1")).unwrap();
    assert_eq!(svg, dir.path().join("chart.v1.svg"));
    assert_eq!(png, dir.path().join("chart.v1.png"));
    assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 2);
    let file = std::io::BufReader::new(fs::File::open(png).unwrap());
    let mut reader = png::Decoder::new(file).read_info().unwrap();
    let size = (reader.info().width, reader.info().height);
    let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
    reader.next_frame(&mut pixels).unwrap();
    let colors = pixels.chunks_exact(3).map(|p| RGBColor(p[0], p[1], p[2]));
    (fs::read_to_string(svg).unwrap(), size, colors.collect())
}

fn count(pixels: &[RGBColor], color: RGBColor) -> usize {
    pixels.iter().filter(|pixel| **pixel == color).count()
}

/// How often the SVG says exactly `word`.
fn says(svg: &str, word: &str) -> usize {
    svg.lines().filter(|line| *line == word).count()
}

/// The points of the series in a colour, a stretch each.
fn stretches(svg: &str, color: &str) -> Vec<Vec<(i32, i32)>> {
    let is_line = |line: &&str| {
        line.contains("<polyline") && line.contains(color) && line.contains("stroke-width=\"4\"")
    };
    let of = |line: &str| {
        let points = line.split("points=\"").nth(1).unwrap();
        let points = points.split('"').next().unwrap().split_whitespace();
        let pairs = points.map(|point| point.split_once(',').unwrap());
        pairs
            .map(|(x, y)| (x.parse().unwrap(), y.parse().unwrap()))
            .collect()
    };
    svg.lines().filter(is_line).map(of).collect()
}

#[test]
fn lines_are_where_their_points_are_in_both_files() {
    let rising = [(0.0, 0.1), (1.0, 1.0), (2.0, 10.0), (3.0, 100.0)];
    let lines = vec![
        series("up <1>", 0, &rising),
        series("down", 1, &[(0.0, 100.0), (3.0, 0.1)]),
    ];
    let (svg, size, pixels) = written(&Figure::Lines(vec![panel(Scale::Log, lines)]));
    let [up, down] = ["#0072B2", "#D55E00"].map(|color| stretches(&svg, color).remove(0));
    let (x, y): (Vec<_>, Vec<_>) = up.iter().copied().unzip();
    assert!(x.is_sorted() && y.is_sorted_by(|a, b| a > b), "{up:?}");
    // Equal steps on the linear axis, equal factors on the log one, to a pixel.
    let step = |at: &[i32], i: usize| at[i + 1] - at[i];
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
    let shown = format!("width=\"{}\" height=\"{}\"", size.0 / 2, size.1 / 2);
    assert!(svg.contains(&shown) && svg.contains("sans-serif"));
    assert!(size.0 >= 1552 && size.1 == 900, "{size:?}");
    let at = |(x, y): (i32, i32)| pixels[y as usize * size.0 as usize + x as usize];
    assert_eq!(
        [at(up[1]), at(up[2]), at(down[0])],
        [palette(0), palette(0), palette(1)]
    );
    assert!(count(&pixels, palette(1)) > 1000);
    assert_eq!(count(&pixels, palette(2)), 0);
    assert!(count(&pixels, WHITE) > pixels.len() / 2);
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
        let figure = Figure::Lines(vec![panel(y, vec![series("a", 0, points)])]);
        stretches(&written(&figure).0, "#0072B2")
            .iter()
            .map(Vec::len)
            .collect()
    };
    assert_eq!(lengths(Scale::Linear, &points), [2, 2]);
    assert_eq!(lengths(Scale::Linear, &zeros), [5]);
    assert_eq!(lengths(Scale::Log, &zeros), [2, 2]);
}

#[test]
fn faint_series_are_pale_and_not_in_the_legend() {
    let mut raw = series("raw", 2, &[(0.0, 0.0), (1.0, 5.0), (2.0, 1.0)]);
    raw.faint = true;
    let smooth = series("smooth", 2, &[(0.0, 1.0), (1.0, 2.0), (2.0, 1.5)]);
    let late = series("late", 10, &[(0.0, 4.0), (2.0, 4.0)]);
    let panel = panel(Scale::Linear, vec![smooth, raw, late]);
    let (svg, _, pixels) = written(&Figure::Lines(vec![panel]));
    assert_eq!(
        ["smooth", "raw", "late"].map(|name| says(&svg, name)),
        [1, 0, 1]
    );
    let pale = svg.find("#A6DDCE").expect("35 % of the colour on white");
    let line = svg.find("stroke=\"#009E73\" stroke-width=\"4\"").unwrap();
    assert!(pale < line, "the pale line is underneath");
    assert!(count(&pixels, palette(2)) > 1000 && count(&pixels, palette(10)) > 1000);
    assert_ne!(palette(2), palette(10));
}

#[test]
fn bars_stand_on_zero_unless_they_are_near_each_other() {
    let names = ["DEMC", "SEMC"];
    let figure = |values| Figure::Bars(vec![bars(&names, values)]);
    let (svg, _, pixels) = written(&figure(&[1.0, 3.0]));
    let [first, second] = [0, 1].map(|i| count(&pixels, palette(i)));
    assert!(first > 10_000 && second > 2 * first, "{first} {second}");
    assert_eq!(
        ["DEMC", "SEMC", "0", "2.5"].map(|word| says(&svg, word)),
        [1; 4]
    );
    let (svg, _, pixels) = written(&figure(&[0.95, 0.91]));
    assert_eq!(
        ["0", "0.2", "0.92", "0.94"].map(|word| says(&svg, word)),
        [0, 0, 1, 1]
    );
    let [first, second] = [0, 1].map(|i| count(&pixels, palette(i)));
    assert!(
        first > 500 && second.abs_diff(first) < first / 5,
        "lines: {first} {second}"
    );
    let (svg, _, _) = written(&figure(&[f64::NAN, 3.0]));
    assert_eq!(says(&svg, "n/a"), 1);
}

#[test]
fn one_legend_names_each_series_once() {
    let line = |name| {
        panel(
            Scale::Linear,
            vec![series(name, 0, &[(0.0, 0.0), (1.0, 1.0)])],
        )
    };
    let panels = vec![line("a"), line("a"), line("b")];
    let (svg, _, _) = written(&Figure::Lines(panels));
    assert_eq!([says(&svg, "a"), says(&svg, "b")], [1, 1]);
    let names = [
        "a variant with a name that is long",
        "another, not a bit shorter",
    ];
    let (svg, _, _) = written(&Figure::Bars(vec![bars(&names, &[1.0, 2.0]); 3]));
    assert_eq!(names.map(|name| says(&svg, name)), [1, 1]);
    let names = ["DEMC", "SEMC"];
    let (svg, _, _) = written(&Figure::Bars(vec![bars(&names, &[1.0, 2.0]); 3]));
    assert_eq!(names.map(|name| says(&svg, name)), [3, 3], "below each bar");
}

#[test]
fn single_points_are_seen_and_none_is_said() {
    let points = |points: &[_]| panel(Scale::Log, vec![series("a", 0, points)]);
    let (svg, _, pixels) = written(&Figure::Lines(vec![points(&[(5.0, 0.2)])]));
    // The legend's line is 44 x 5 pixels.
    assert!(says(&svg, "no data") == 0 && count(&pixels, palette(0)) > 220 + 100);
    let none = points(&[(1.0, 0.0), (2.0, f64::NAN)]);
    for figure in [
        Figure::Lines(vec![]),
        Figure::Bars(vec![bars(&[], &[])]),
        Figure::Lines(vec![none]),
    ] {
        assert_eq!(says(&written(&figure).0, "no data"), 1);
    }
}

#[test]
fn stem_that_cannot_be_written_is_named_and_leaves_nothing() {
    let figure = Figure::Lines(vec![]);
    let error = figure.write(Path::new("no/such/dir/chart")).unwrap_err();
    assert!(
        format!("{error:#}").contains("no/such/dir/chart.svg"),
        "{error:#}"
    );
    let dir = tempfile::tempdir().unwrap();
    let error = figure.write(&dir.path().join("")).unwrap_err().to_string();
    assert!(error.contains("names no file"), "{error}");
    assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 0);
}
