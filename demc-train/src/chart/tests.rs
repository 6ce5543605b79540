//! Figures as files, read back.

use std::fs;

use super::shape::{PALETTE, Rgb};
use super::*;

fn series(name: &str, color: usize, points: &[(f64, f64)]) -> Series {
    Series {
        name: name.to_string(),
        points: points.to_vec(),
        faint: false,
        color,
    }
}

fn panel(series: Vec<Series>) -> Panel {
    Panel {
        title: "loss & <more>".to_string(),
        x_label: "step".to_string(),
        y_label: "loss".to_string(),
        x: Scale::Linear,
        y: Scale::Linear,
        series,
        marks: vec![(1.5, "chosen".to_string())],
    }
}

fn bars(names: &[&str]) -> BarPanel {
    let bar = |value: f64| Bar {
        value,
        interval: Some((value - 0.5, value + 0.5)),
        points: vec![value],
    };
    BarPanel {
        title: "RelMSE".to_string(),
        y_label: String::new(),
        names: names.iter().map(|name| name.to_string()).collect(),
        bars: (1..=names.len()).map(|i| bar(i as f64)).collect(),
        y: Scale::Linear,
    }
}

/// Writes a figure and returns the SVG's text and the PNG's size and pixels.
fn written(figure: &Figure) -> (String, (u32, u32), Vec<Rgb>) {
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
    let pixels = pixels.chunks_exact(3).map(|p| [p[0], p[1], p[2]]).collect();
    (fs::read_to_string(svg).unwrap(), size, pixels)
}

fn count(pixels: &[Rgb], color: Rgb) -> usize {
    pixels.iter().filter(|pixel| **pixel == color).count()
}

/// The points of the polylines in a colour.
fn polylines(svg: &str, color: &str) -> Vec<Vec<(i32, i32)>> {
    let lines = svg
        .lines()
        .filter(|line| line.contains("<polyline") && line.contains(color));
    let of = |line: &str| {
        let points = line.split("points=\"").nth(1).unwrap();
        let points = points.split('"').next().unwrap().split_whitespace();
        points
            .map(|point| {
                let (x, y) = point.split_once(',').unwrap();
                (x.parse().unwrap(), y.parse().unwrap())
            })
            .collect()
    };
    lines.map(of).collect()
}

#[test]
fn lines_are_where_their_points_are_in_both_files() {
    let rising = series(
        "up <1>",
        0,
        &[(0.0, 0.0), (1.0, 1.0), (2.0, 2.0), (3.0, 3.0)],
    );
    let falling = series("down", 1, &[(0.0, 3.0), (3.0, 0.0)]);
    let (svg, size, pixels) = written(&Figure::Lines(vec![panel(vec![rising, falling])]));
    let [up, down] = ["#0072B2", "#D55E00"].map(|color| polylines(&svg, color).remove(0));
    let (x, y): (Vec<_>, Vec<_>) = up.iter().copied().unzip();
    assert!(x.is_sorted() && y.is_sorted_by(|a, b| a > b), "{up:?}");
    assert!(
        (x[3] - x[2] - (x[1] - x[0])).abs() <= 1 && x[1] - x[0] > 300,
        "{up:?}"
    );
    assert!(
        (y[0] - y[1] - (y[2] - y[3])).abs() <= 1 && y[0] - y[1] > 100,
        "{up:?}"
    );
    assert_eq!(down, [(x[0], y[3]), (x[3], y[0])]);
    assert!(svg.contains("up &lt;1&gt;") && svg.contains("loss &amp; &lt;more&gt;"));
    assert!(svg.contains("\ndown\n") && svg.contains("\nchosen\n") && svg.contains("sans-serif"));
    let shown = format!("width=\"{}\" height=\"{}\"", size.0 / 2, size.1 / 2);
    assert!(
        svg.contains(&shown) && svg.contains(&format!("viewBox=\"0 0 {} {}\"", size.0, size.1))
    );
    assert!(size.0 >= 1600 && size.1 > 800);
    // A point of the line that is neither an end nor at a crossing has its colour in the PNG.
    let at = |(x, y): (i32, i32)| pixels[y as usize * size.0 as usize + x as usize];
    assert_eq!([at(up[1]), at(up[2])], [PALETTE[0]; 2]);
    assert!(count(&pixels, PALETTE[1]) > 1000);
    assert_eq!(count(&pixels, PALETTE[2]), 0);
    assert!(count(&pixels, [255; 3]) > pixels.len() / 2);
}

#[test]
fn faint_series_are_pale_and_not_in_the_legend() {
    let mut raw = series("raw", 2, &[(0.0, 0.0), (1.0, 5.0), (2.0, 1.0)]);
    raw.faint = true;
    let smooth = series("smooth", 2, &[(0.0, 1.0), (1.0, 2.0), (2.0, 1.5)]);
    let (svg, _, pixels) = written(&Figure::Lines(vec![panel(vec![smooth, raw])]));
    assert!(svg.contains("\nsmooth\n") && !svg.contains("\nraw\n"));
    let pale = svg.find("#A6DDCE").expect("35 % of the colour on white");
    assert!(
        pale < svg.find("#009E73").unwrap(),
        "the pale line is underneath"
    );
    assert!(count(&pixels, PALETTE[2]) > 1000);
}

#[test]
fn bars_have_their_colours_and_names() {
    let names = ["DEMC", "SEMC"];
    let (svg, size, pixels) = written(&Figure::Bars(vec![bars(&names), bars(&names)]));
    assert!(size.0 >= 1600);
    let [first, second] = [0, 1].map(|i| count(&pixels, PALETTE[i]));
    assert!(first > 10_000 && second > 3 * first / 2, "{first} {second}");
    assert_eq!(svg.matches("\nSEMC\n").count(), 2, "below each bar");
    let long = [
        "a variant with a name that is long",
        "another one, not a bit shorter",
    ];
    let (svg, _, _) = written(&Figure::Bars(vec![bars(&long), bars(&long)]));
    assert_eq!(
        svg.matches(&format!("\n{}\n", long[0])).count(),
        1,
        "one legend"
    );
}

#[test]
fn panels_whose_colours_differ_in_meaning_have_legends_of_their_own() {
    let points = [(0.0, 0.0), (1.0, 1.0)];
    let panels = |other| {
        vec![
            panel(vec![series("a", 0, &points)]),
            panel(vec![series(other, 0, &points)]),
        ]
    };
    let (svg, _, _) = written(&Figure::Lines(panels("a")));
    assert_eq!(svg.matches("\na\n").count(), 1);
    let (svg, _, _) = written(&Figure::Lines(panels("b")));
    assert!(svg.contains("\na\n") && svg.contains("\nb\n"));
}

#[test]
fn empty_figures_say_no_data() {
    for figure in [
        Figure::Lines(vec![]),
        Figure::Bars(vec![bars(&[])]),
        Figure::Lines(vec![
            panel(vec![]),
            panel(vec![series("nan", 0, &[(f64::NAN, 1.0)])]),
        ]),
    ] {
        let (svg, _, _) = written(&figure);
        assert!(svg.contains("\nno data\n"));
    }
}

#[test]
fn stem_that_cannot_be_written_is_named_and_leaves_nothing() {
    let figure = Figure::Lines(vec![]);
    let error = format!(
        "{:#}",
        figure.write(Path::new("no/such/dir/chart")).unwrap_err()
    );
    assert!(error.contains("no/such/dir/chart.svg"), "{error}");
    let dir = tempfile::tempdir().unwrap();
    let error = figure.write(&dir.path().join("")).unwrap_err().to_string();
    assert!(error.contains("names no file"), "{error}");
    assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 0);
}
