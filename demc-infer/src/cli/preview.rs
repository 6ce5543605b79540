//! Previews: PNG files beside outputs, made from the files that they show.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use demc_data::ChannelLayout;
use demc_data::image::exr::ExrFile;

use crate::Picture;

/// Keyword of the PNG text with the exposure in stops, by which a preview is known.
const EXPOSURE: &str = "demc.exposure";

/// The exposure of the preview at `path`, as text; `None` if another program wrote the file.
pub fn exposure_of(path: &Path) -> Option<String> {
    let file = BufReader::new(File::open(path).ok()?);
    let reader = png::Decoder::new(file).read_info().ok()?;
    let mut texts = reader.info().uncompressed_latin1_text.iter();
    let text = texts.find(|text| text.keyword == EXPOSURE)?;
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
    let names = layout.color.each_ref().map(String::as_str);
    let planes = file.read(&names)?;
    let window = file.channel(names[0]).map(|channel| channel.window);
    let (height, width) = window.map_or((0, 0), |window| (window.height, window.width));
    let exposed: Vec<f32> = planes
        .iter()
        .flat_map(|plane| plane.to_f32())
        .map(|x| x * exposure.exp2())
        .collect();
    let picture = Picture::from_hdr(&exposed, height, width);
    picture.write_png_with(path, &[(EXPOSURE, &exposure.to_string())])?;
    Ok(())
}
