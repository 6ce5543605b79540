//! What a chart is made of before it is drawn: lines, rectangles, dots and words at places in pixels.

use super::paint::Font;

/// Red, green, blue.
pub(super) type Rgb = [u8; 3];
/// Across and down, in pixels of the PNG.
pub(super) type At = (f64, f64);

/// The colours of Okabe and Ito (2008), which the colour-blind tell apart; yellow, hard to see on white, comes last.
pub(super) const PALETTE: [Rgb; 8] = [
    [0x00, 0x72, 0xB2],
    [0xD5, 0x5E, 0x00],
    [0x00, 0x9E, 0x73],
    [0xCC, 0x79, 0xA7],
    [0xE6, 0x9F, 0x00],
    [0x56, 0xB4, 0xE9],
    [0x00, 0x00, 0x00],
    [0xF0, 0xE4, 0x42],
];
/// Background.
pub(super) const WHITE: Rgb = [255; 3];
/// Words and intervals.
pub(super) const INK: Rgb = [0x22; 3];
/// Axes and what is less important than words.
pub(super) const GREY: Rgb = [0x77; 3];
/// Pixels of a dash and of the gap after it.
const DASH: [f64; 2] = [14.0, 9.0];

/// The colour of a place in the palette, which begins again after its last.
pub(super) fn palette(color: usize) -> Rgb {
    PALETTE[color % PALETTE.len()]
}

/// `share` of a colour on white.
pub(super) fn pale(color: Rgb, share: f64) -> Rgb {
    color.map(|x| (255.0 - share * (255.0 - f64::from(x))).round() as u8)
}

/// A rectangle in pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Area {
    pub(super) left: f64,
    pub(super) top: f64,
    pub(super) right: f64,
    pub(super) bottom: f64,
}

impl Area {
    /// The place at these shares of the width, from the left, and of the height, from the bottom.
    pub(super) fn at(&self, x: f64, y: f64) -> At {
        (
            self.left + x * self.width(),
            self.bottom - y * (self.bottom - self.top),
        )
    }

    pub(super) fn width(&self) -> f64 {
        self.right - self.left
    }

    pub(super) fn middle(&self) -> At {
        self.at(0.5, 0.5)
    }
}

/// Which end of a text is at its place.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Align {
    Left,
    Center,
    Right,
}

/// One thing to draw.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Shape {
    /// A line through points.
    Line {
        points: Vec<At>,
        width: u32,
        color: Rgb,
    },
    /// A filled rectangle.
    Box { area: Area, color: Rgb },
    /// A disc.
    Dot { at: At, radius: u32, color: Rgb },
    /// Words, centred vertically on their place; `upright` reads from bottom to top.
    Text {
        at: At,
        text: String,
        size: f64,
        align: Align,
        color: Rgb,
        upright: bool,
    },
}

/// Shapes in the order of drawing.
#[derive(Debug)]
pub(super) struct Drawing {
    pub(super) width: u32,
    pub(super) height: u32,
    pub(super) shapes: Vec<Shape>,
    font: Font,
}

impl Drawing {
    pub(super) fn new(width: f64, height: f64, font: Font) -> Self {
        Drawing {
            width: width.ceil() as u32,
            height: height.ceil() as u32,
            shapes: Vec::new(),
            font,
        }
    }

    pub(super) fn line(&mut self, points: Vec<At>, width: u32, color: Rgb) {
        self.shapes.push(Shape::Line {
            points,
            width,
            color,
        });
    }

    /// A line in dashes.
    pub(super) fn dashed(&mut self, points: &[At], width: u32, color: Rgb) {
        for dash in dashes(points) {
            self.line(dash, width, color);
        }
    }

    pub(super) fn fill(&mut self, area: Area, color: Rgb) {
        self.shapes.push(Shape::Box { area, color });
    }

    pub(super) fn dot(&mut self, at: At, radius: u32, color: Rgb) {
        self.shapes.push(Shape::Dot { at, radius, color });
    }

    pub(super) fn text(&mut self, at: At, text: &str, size: f64, align: Align, color: Rgb) {
        self.words(at, text, size, align, color, false);
    }

    /// Centred words that hide what is behind them.
    pub(super) fn text_on_white(&mut self, at: At, text: &str, size: f64) {
        let (half, up) = (self.text_width(text, size) / 2.0, 0.45 * size);
        let area = Area {
            left: at.0 - half,
            top: at.1 - up,
            right: at.0 + half,
            bottom: at.1 + up,
        };
        self.fill(area, WHITE);
        self.text(at, text, size, Align::Center, INK);
    }

    /// Centred words that read from bottom to top.
    pub(super) fn upright_text(&mut self, at: At, text: &str, size: f64, color: Rgb) {
        self.words(at, text, size, Align::Center, color, true);
    }

    fn words(&mut self, at: At, text: &str, size: f64, align: Align, color: Rgb, upright: bool) {
        if !text.is_empty() {
            self.shapes.push(Shape::Text {
                at,
                text: text.to_string(),
                size,
                align,
                color,
                upright,
            });
        }
    }

    /// Pixels that a text is wide.
    pub(super) fn text_width(&self, text: &str, size: f64) -> f64 {
        self.font.width(text, size)
    }

    /// `text`, or its ends with an ellipsis between them if it is wider than `width`.
    pub(super) fn fitted(&self, text: &str, size: f64, width: f64) -> String {
        let chars: Vec<char> = text.chars().collect();
        let shortened = |kept: usize| -> String {
            let (head, tail) = (kept / 2, kept - kept / 2);
            let head = chars[..head].iter();
            let tail = chars[chars.len() - tail..].iter();
            head.chain(&['…']).chain(tail).collect()
        };
        if self.text_width(text, size) <= width {
            return text.to_string();
        }
        (0..chars.len())
            .rev()
            .map(shortened)
            .find(|text| self.text_width(text, size) <= width)
            .unwrap_or_default()
    }
}

/// The dashes of a line.
fn dashes(points: &[At]) -> Vec<Vec<At>> {
    let mut dashes = Vec::new();
    let mut dash: Vec<At> = points.first().copied().into_iter().collect();
    let (mut drawing, mut left) = (true, DASH[0]);
    for pair in points.windows(2) {
        let (mut from, to) = (pair[0], pair[1]);
        loop {
            let (dx, dy) = (to.0 - from.0, to.1 - from.1);
            let length = dx.hypot(dy);
            if length < left {
                left -= length;
                if drawing {
                    dash.push(to);
                }
                break;
            }
            from = (from.0 + dx * left / length, from.1 + dy * left / length);
            if drawing {
                dash.push(from);
                dashes.push(std::mem::take(&mut dash));
            } else {
                dash = vec![from];
            }
            drawing = !drawing;
            left = DASH[usize::from(!drawing)];
        }
    }
    if dash.len() > 1 {
        dashes.push(dash);
    }
    dashes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dashes_follow_the_line_and_leave_gaps() {
        let [on, off] = DASH;
        let corner = [(0.0, 0.0), (on + off + 4.0, 0.0), (on + off + 4.0, 100.0)];
        let dashes = dashes(&corner);
        assert_eq!(dashes[0], [(0.0, 0.0), (on, 0.0)]);
        let start = on + off;
        assert_eq!(
            dashes[1],
            [(start, 0.0), (start + 4.0, 0.0), (start + 4.0, on - 4.0)]
        );
    }

    #[test]
    fn long_names_lose_their_middle() {
        let drawing = Drawing::new(10.0, 10.0, Font::embedded().unwrap());
        assert_eq!(drawing.fitted("abc", 20.0, 500.0), "abc");
        let name = "beginning-of-a-name-that-is-much-too-long-and-its-end";
        let short = drawing.fitted(name, 20.0, 200.0);
        assert!(drawing.text_width(&short, 20.0) <= 200.0);
        assert!(
            short.starts_with("begin") && short.ends_with("its-end"),
            "{short}"
        );
        assert!(short.contains('…'));
    }
}
