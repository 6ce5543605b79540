//! Previews: PNG files beside outputs, made from the files that they show.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use demc_data::ChannelLayout;
use demc_data::image::exr::ExrFile;
use demc_program::checksum::sha256_of;
use demc_program::file::{FileError, open_regular};

use crate::Picture;

/// Keyword of the PNG text with the exposure in stops, by which a preview is known.
const EXPOSURE: &str = "demc.exposure";
/// Keyword of the PNG text with the checksum of the image that a preview shows.
const IMAGE: &str = "demc.image";

/// What a preview shows.
#[derive(Debug, PartialEq)]
pub struct Shown {
    /// The exposure in stops.
    exposure: String,
    /// The checksum of the image.
    image: String,
}

impl Shown {
    /// A preview of the image at `output`.
    ///
    /// # Errors
    /// The image cannot be read.
    pub fn now(output: &Path, exposure: f32) -> Result<Self, FileError> {
        Ok(Self {
            exposure: exposure.to_string(),
            image: sha256_of(output)?,
        })
    }
}

/// Whether this program wrote the file at `path`.
pub fn is_own(path: &Path) -> bool {
    opened(path).is_some_and(|reader| text(reader.info(), EXPOSURE).is_some())
}

/// What the preview at `path` shows; `None` if it is not whole, or of another program.
pub fn shown(path: &Path) -> Option<Shown> {
    let mut reader = opened(path)?;
    let shown = Shown {
        exposure: text(reader.info(), EXPOSURE)?,
        image: text(reader.info(), IMAGE)?,
    };
    let mut pixels = vec![0; reader.output_buffer_size()?];
    reader.next_frame(&mut pixels).ok()?;
    reader.finish().ok()?;
    Some(shown)
}

fn opened(path: &Path) -> Option<png::Reader<BufReader<File>>> {
    let file = BufReader::new(open_regular(path).ok()?);
    png::Decoder::new(file).read_info().ok()
}

fn text(info: &png::Info, keyword: &str) -> Option<String> {
    let mut texts = info.uncompressed_latin1_text.iter();
    let text = texts.find(|text| text.keyword == keyword)?;
    Some(text.text.clone())
}

/// Writes a preview of the image at `output`: `clip(2^exposure x, 0, 1)^(1/2.2)`.
pub fn write(
    path: &Path,
    output: &Path,
    layout: &ChannelLayout,
    exposure: f32,
) -> anyhow::Result<()> {
    let mut file = ExrFile::open(output)?;
    // A file of one part has its channels without the part's name.
    let names = layout.color.each_ref().map(|name| {
        let ends = name.match_indices('.').map(|(dot, _)| &name[dot + 1..]);
        let mut names = std::iter::once(name.as_str()).chain(ends);
        let found = names.find(|name| file.channel(name).is_some());
        found.unwrap_or(name)
    });
    let planes = file.read(&names)?;
    let window = file.channel(names[0]).map(|channel| channel.window);
    let (height, width) = window.map_or((0, 0), |window| (window.height, window.width));
    let exposed: Vec<f32> = planes
        .iter()
        .flat_map(|plane| plane.to_f32())
        .map(|x| x * exposure.exp2())
        .collect();
    let picture = Picture::from_hdr(&exposed, height, width);
    let Shown { exposure, image } = Shown::now(output, exposure)?;
    picture.write_png_with(path, &[(EXPOSURE, &exposure), (IMAGE, &image)])?;
    Ok(())
}
