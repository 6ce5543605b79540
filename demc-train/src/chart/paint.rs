//! From shapes to the bytes of an SVG and of a PNG file. The only file that knows `plotters`.
//!
//! Both have the same pixels; the SVG asks to be shown at half of them, and the PNG is drawn larger and averaged,
//! because `plotters` does not smooth the edges of wide lines.

use anyhow::{Context, anyhow};
use plotters::backend::{BitMapBackend, DrawingBackend, SVGBackend};
use plotters::style::text_anchor::{HPos, Pos, VPos};
use plotters::style::{
    Color, FontDesc, FontFamily, FontStyle, FontTransform, RGBColor, ShapeStyle, TextStyle,
    register_font,
};

use super::shape::{Align, Drawing, Rgb, Shape, WHITE};

/// Pixels drawn for a pixel of the PNG, each way.
const FINER: u32 = 3;
/// The PNG has this many pixels for one that the SVG asks for: text stays sharp on dense displays.
const DENSITY: u32 = 2;
/// Browsers' fonts for `sans-serif` are up to this much wider than the embedded one.
const OTHER_FONTS: f64 = 1.12;
/// How much lower than `plotters` puts it a text is centred, as a share of its size: in bitmaps, in SVG.
const LOWER: [f64; 2] = [0.2, 0.08];

/// The embedded font, Ubuntu Light, under the name of the generic family that the SVG asks for.
#[derive(Clone, Copy, Debug)]
pub(super) struct Font;

impl Font {
    /// Makes the font known to `plotters`.
    ///
    /// # Errors
    /// A font file that `plotters` cannot read.
    pub(super) fn embedded() -> anyhow::Result<Self> {
        let (family, style) = (FontFamily::SansSerif, FontStyle::Normal);
        register_font(family.as_str(), style, epaint_default_fonts::UBUNTU_LIGHT)
            .map_err(|_| anyhow!("the embedded font cannot be read"))?;
        Ok(Font)
    }

    /// Pixels that a text is wide, in the widest of the usual fonts.
    pub(super) fn width(&self, text: &str, size: f64) -> f64 {
        let found = FontDesc::new(FontFamily::SansSerif, size, FontStyle::Normal).box_size(text);
        let (width, _) = found.expect("a `Font` exists only where one is registered");
        OTHER_FONTS * f64::from(width)
    }
}

/// The text of an SVG file.
///
/// # Errors
/// What `plotters` reports.
pub(super) fn svg(drawing: &Drawing) -> anyhow::Result<String> {
    let mut text = String::new();
    let size = (drawing.width, drawing.height);
    {
        let mut backend = SVGBackend::with_string(&mut text, size);
        let corner = (size.0 as i32, size.1 as i32);
        backend.draw_rect((0, 0), corner, &rgb(WHITE), true)?;
        for shape in &drawing.shapes {
            match shape {
                Shape::Line {
                    points,
                    width,
                    color,
                } => {
                    let mut points: Vec<_> = points.iter().map(|at| pixel(*at, 1)).collect();
                    points.dedup();
                    backend.draw_path(points, &stroke(*color, *width))?;
                }
                other => paint(&mut backend, other, 1, LOWER[1])?,
            }
        }
        backend.present()?;
    }
    let sides = |width, height| format!("width=\"{width}\" height=\"{height}\"");
    let shown = sides(size.0 / DENSITY, size.1 / DENSITY);
    Ok(text.replacen(&sides(size.0, size.1), &shown, 1))
}

/// The bytes of a PNG file.
///
/// # Errors
/// What `plotters` or the encoder reports.
pub(super) fn png(drawing: &Drawing) -> anyhow::Result<Vec<u8>> {
    let (width, height) = (drawing.width, drawing.height);
    let size = (width * FINER, height * FINER);
    let mut fine = vec![255; size.0 as usize * size.1 as usize * 3];
    {
        let mut backend = BitMapBackend::with_buffer(&mut fine, size);
        for shape in &drawing.shapes {
            match shape {
                Shape::Line {
                    points,
                    width,
                    color,
                } => {
                    let points: Vec<_> = points.iter().map(|at| pixel(*at, FINER)).collect();
                    let width = width * FINER;
                    for pair in points.windows(2).filter(|pair| pair[0] != pair[1]) {
                        backend.draw_path(pair.iter().copied(), &stroke(*color, width))?;
                    }
                    // Round joints: as one path, `plotters` fills the inside of sharp angles wrongly.
                    for at in points.iter().skip(1).take(points.len().saturating_sub(2)) {
                        backend.draw_circle(*at, width / 2, &rgb(*color).filled(), true)?;
                    }
                }
                other => paint(&mut backend, other, FINER, LOWER[0])?,
            }
        }
        backend.present()?;
    }
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, width, height);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    let mut writer = encoder.write_header().context("PNG header")?;
    writer.write_image_data(&averaged(&fine, width as usize, height as usize))?;
    writer.finish()?;
    Ok(bytes)
}

/// Draws a shape that is not a line.
fn paint<B: DrawingBackend>(
    backend: &mut B,
    shape: &Shape,
    finer: u32,
    lower: f64,
) -> anyhow::Result<()>
where
    B::ErrorType: 'static,
{
    match shape {
        Shape::Line { .. } => {}
        Shape::Box { area, color } => {
            let from = pixel((area.left, area.top), finer);
            let to = pixel((area.right, area.bottom), finer);
            backend.draw_rect(from, to, &rgb(*color).filled(), true)?;
        }
        Shape::Dot { at, radius, color } => {
            let fill = rgb(*color).filled();
            backend.draw_circle(pixel(*at, finer), radius * finer, &fill, true)?;
        }
        Shape::Text {
            at,
            text,
            size,
            align,
            color,
            upright,
        } => {
            let lower = lower * size;
            let at = match upright {
                true => (at.0 + lower, at.1),
                false => (at.0, at.1 + lower),
            };
            let style = words(size * f64::from(finer), *align, *color, *upright);
            backend.draw_text(text, &style, pixel(at, finer))?;
        }
    }
    Ok(())
}

fn words(size: f64, align: Align, color: Rgb, upright: bool) -> TextStyle<'static> {
    let horizontal = match align {
        Align::Left => HPos::Left,
        Align::Center => HPos::Center,
        Align::Right => HPos::Right,
    };
    let turn = match upright {
        true => FontTransform::Rotate270,
        false => FontTransform::None,
    };
    let font = FontDesc::new(FontFamily::SansSerif, size, FontStyle::Normal).transform(turn);
    let style = font.color(&rgb(color));
    style.pos(Pos::new(horizontal, VPos::Center))
}

fn rgb([red, green, blue]: Rgb) -> RGBColor {
    RGBColor(red, green, blue)
}

fn stroke(color: Rgb, width: u32) -> ShapeStyle {
    rgb(color).stroke_width(width)
}

fn pixel((x, y): (f64, f64), finer: u32) -> (i32, i32) {
    let finer = f64::from(finer);
    ((x * finer).round() as i32, (y * finer).round() as i32)
}

/// Means of `FINER x FINER` pixels.
fn averaged(fine: &[u8], width: usize, height: usize) -> Vec<u8> {
    let finer = FINER as usize;
    let row = width * finer * 3;
    let mut means = Vec::with_capacity(width * height * 3);
    let mut sums = vec![0u32; width * 3];
    for rows in fine.chunks_exact(row * finer) {
        sums.fill(0);
        for (i, value) in rows.iter().enumerate() {
            let (x, channel) = (i % row / 3, i % 3);
            sums[x / finer * 3 + channel] += u32::from(*value);
        }
        let count = FINER * FINER;
        means.extend(sums.iter().map(|sum| ((sum + count / 2) / count) as u8));
    }
    means
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fine_pixels_are_averaged_in_their_own_square() {
        let (width, finer) = (2, FINER as usize);
        let mut fine = vec![0; 3 * width * finer * finer];
        // One pixel of the second square is red.
        fine[3 * finer] = 255;
        let expected = (255.0 / (FINER * FINER) as f64).round() as u8;
        assert_eq!(averaged(&fine, width, 1), [0, 0, 0, expected, 0, 0]);
    }

    #[test]
    fn font_knows_that_more_words_are_wider() {
        let font = Font::embedded().unwrap();
        let [one, two] = ["m", "mm"].map(|text| font.width(text, 100.0));
        assert!(one > 50.0 && (two / one - 2.0).abs() < 0.1, "{one} {two}");
    }
}
