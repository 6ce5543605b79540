//! Frames from files.

use std::io::{Read, Seek};
use std::path::Path;

use demc_program::parallel;

use super::buffers::{Frame, FramePlanes, Presence};
use super::channels::FrameChannels;
use super::light::{LIGHT, normalise_depth};
use crate::error::Error;
use crate::image::channel::Window;
use crate::image::exr::ExrFile;
use crate::image::layout::ChannelLayout;
use crate::image::plane::{NonFiniteSamples, Plane, clear_infinite};

/// Reads and checks an image. Reference and mask are read if present.
///
/// # Errors
/// [`Error::File`] and [`Error::Exr`] for a file that cannot be decoded.
/// [`Error::MissingChannels`], [`Error::Sizes`] and [`Error::NonFinite`] for unusable buffers.
pub fn read_frame(path: &Path, layout: &ChannelLayout) -> Result<Frame, Error> {
    decode(&mut ExrFile::open(path)?, layout, Presence::IfPresent)
}

/// As [`read_frame`], without the reference: the input of denoising.
///
/// # Errors
/// As [`read_frame`].
pub fn read_input(path: &Path, layout: &ChannelLayout) -> Result<Frame, Error> {
    decode_input(&mut ExrFile::open(path)?, layout)
}

/// As [`read_input`], for an open file.
///
/// # Errors
/// As [`read_frame`].
pub fn decode_input<R: Read + Seek>(
    file: &mut ExrFile<R>,
    layout: &ChannelLayout,
) -> Result<Frame, Error> {
    decode(file, layout, Presence::Skip)
}

/// As [`decode_input`], but NaN, infinite and negative samples are replaced by the median of their
/// neighbours ([`Plane::repair`]; negative ones in the colour only). Also returns their number.
///
/// # Errors
/// As [`read_frame`], with [`Error::Unrepairable`] instead of [`Error::NonFinite`].
pub fn decode_repaired<R: Read + Seek>(
    file: &mut ExrFile<R>,
    layout: &ChannelLayout,
) -> Result<(Frame, usize), Error> {
    let (planes, repaired) =
        FramePlanes::decode_with(file, layout, Presence::Skip, Presence::IfPresent, true)?;
    Ok((frame_of(planes, file.path())?, repaired))
}

/// Reads a frame with its reference, and with the mask that the layout names. NaN, infinite, and negative samples are replaced as by
/// [`decode_repaired`] if `repair` is set, and are otherwise an error.
///
/// # Errors
/// As [`read_frame`]. A layout with a reference and a file without it do not fit.
pub(crate) fn read_pair(path: &Path, layout: &ChannelLayout, repair: bool) -> Result<Frame, Error> {
    let mut file = ExrFile::open(path)?.on_threads(1);
    let needed = Presence::Required;
    let planes = FramePlanes::decode_with(&mut file, layout, needed, needed, repair)?;
    frame_of(planes.0, path)
}

fn decode<R: Read + Seek>(
    file: &mut ExrFile<R>,
    layout: &ChannelLayout,
    reference: Presence,
) -> Result<Frame, Error> {
    let planes = FramePlanes::decode(file, layout, reference, Presence::IfPresent)?;
    frame_of(planes, file.path())
}

pub(crate) fn frame_of(planes: FramePlanes, path: &Path) -> Result<Frame, Error> {
    let name = path
        .file_stem()
        .unwrap_or_default()
        .to_string_lossy()
        .into_owned();
    let planar = |planes: Vec<Plane>| {
        planar(&planes).map_err(|needed| Error::Memory {
            path: path.to_owned(),
            needed,
        })
    };
    let plane = |plane: Option<Plane>| plane.map(|plane| planar(vec![plane])).transpose();
    Ok(Frame {
        name,
        width: planes.width,
        height: planes.height,
        color: planar(planes.color)?,
        features: planar(planes.features)?,
        reference: planes.reference.map(planar).transpose()?,
        mask: plane(planes.mask)?,
        alpha: plane(planes.alpha)?,
        passes: planes.passes.map(planar).transpose()?,
        clamped: planes.clamped,
    })
}

impl FramePlanes {
    /// Reads and checks an image on the calling thread alone; callers that read many images have
    /// their own threads.
    ///
    /// # Errors
    /// As [`read_frame`].
    pub fn read(
        path: &Path,
        layout: &ChannelLayout,
        reference: Presence,
        mask: Presence,
    ) -> Result<Self, Error> {
        let mut file = ExrFile::open(path)?.on_threads(1);
        Self::decode(&mut file, layout, reference, mask)
    }

    /// Decodes and checks an image of an open file.
    ///
    /// # Errors
    /// As [`read_frame`].
    pub fn decode<R: Read + Seek>(
        file: &mut ExrFile<R>,
        layout: &ChannelLayout,
        reference: Presence,
        mask: Presence,
    ) -> Result<Self, Error> {
        Self::decode_with(file, layout, reference, mask, false).map(|(planes, _)| planes)
    }

    /// As [`decode`](Self::decode), if wanted with repaired samples. Also returns their number.
    fn decode_with<R: Read + Seek>(
        file: &mut ExrFile<R>,
        layout: &ChannelLayout,
        reference: Presence,
        mask: Presence,
        repair: bool,
    ) -> Result<(Self, usize), Error> {
        let path = &file.path().to_owned();
        let layout = &*layout.in_file(file, None)?;
        let wanted = FrameChannels::new(file, layout, reference, mask)?;
        let window = wanted.window(path, file)?;
        let names = wanted.names();
        let mut all = file.read(&names)?;
        if let Some(first) = wanted.first_position() {
            // LuxCore's positions where a camera ray hits nothing.
            clear_infinite(&mut all[first..first + 3]);
        }
        let mut repaired = 0;
        if repair {
            let colors = wanted.color.len();
            let size = (window.height, window.width);
            for (i, (plane, name)) in all.iter_mut().zip(&names).enumerate() {
                repaired += repair_plane(path, name, plane, size, i < colors)?;
            }
        }
        let mut decoded = names
            .iter()
            .copied()
            .zip(all)
            .map(|(name, plane)| finite(path, name, window.width, plane));
        let mut take = |slots: &[Option<&str>]| -> Result<Vec<Plane>, Error> {
            let zeros = || Ok(Plane::zeros(window.width * window.height));
            slots
                .iter()
                .map(|slot| slot.and_then(|_| decoded.next()).unwrap_or_else(zeros))
                .collect()
        };
        let mut planes = Self {
            width: window.width,
            height: window.height,
            color: take(&wanted.color)?,
            features: take(&wanted.features)?,
            reference: wanted.reference.as_deref().map(&mut take).transpose()?,
            mask: take(&wanted.mask)?.pop(),
            alpha: take(&wanted.alpha)?.pop(),
            passes: all_of(&mut decoded, wanted.passes.len())?,
            reference_passes: all_of(&mut decoded, wanted.reference_passes.len())?,
            clamped: 0,
            exposure_scale: 1.0,
        };
        let passes = planes.passes.iter_mut().flatten();
        let radiance = planes
            .color
            .iter_mut()
            .chain(planes.reference.iter_mut().flatten())
            .chain(passes.take(LIGHT))
            .chain(planes.reference_passes.iter_mut().flatten());
        planes.clamped = radiance.map(Plane::clamp_negative).sum();
        if let Some(passes) = &mut planes.passes {
            normalise_depth(passes);
        }
        Ok((planes, repaired))
    }
}

/// The next `count` planes; `None` for none.
fn all_of(
    planes: &mut impl Iterator<Item = Result<Plane, Error>>,
    count: usize,
) -> Result<Option<Vec<Plane>>, Error> {
    let planes: Vec<Plane> = planes.take(count).collect::<Result<_, _>>()?;
    Ok((!planes.is_empty()).then_some(planes))
}

/// Checks a file's header: it has the channels of the layout and `reference`, in buffers of one
/// size. Decodes no pixels.
///
/// # Errors
/// As [`read_frame`], except for pixel data.
pub fn check_header(
    path: &Path,
    layout: &ChannelLayout,
    reference: Presence,
) -> Result<Window, Error> {
    check_open_header(&ExrFile::open(path)?, layout, reference)
}

/// As [`check_header`], for an open file.
///
/// # Errors
/// As [`check_header`].
pub fn check_open_header<R: Read + Seek>(
    file: &ExrFile<R>,
    layout: &ChannelLayout,
    reference: Presence,
) -> Result<Window, Error> {
    let layout = &*layout.in_file(file, None)?;
    FrameChannels::new(file, layout, reference, Presence::IfPresent)?.window(file.path(), file)
}

/// Largest share of a channel that is repaired, in percent (ours: a channel of NaN is a mistake, and would
/// become black or flat).
const MOST_REPAIRED: u32 = 10;

/// Repairs a channel as [`Plane::repair`].
///
/// # Errors
/// [`Error::Unrepairable`].
pub(super) fn repair_plane(
    path: &Path,
    name: &str,
    plane: &mut Plane,
    size: (usize, usize),
    negative: bool,
) -> Result<usize, Error> {
    let (samples, count) = (
        plane.len(),
        plane.non_finite().map_or(0, |found| found.count),
    );
    if 100 * count > MOST_REPAIRED as usize * samples {
        return Err(Error::Unrepairable {
            path: path.to_owned(),
            channel: name.to_owned(),
            count,
            samples,
            percent: MOST_REPAIRED,
        });
    }
    Ok(plane.repair(size, negative))
}

/// The plane, if no sample is NaN or infinite.
pub(super) fn finite(path: &Path, name: &str, width: usize, plane: Plane) -> Result<Plane, Error> {
    match plane.non_finite() {
        None => Ok(plane),
        Some(NonFiniteSamples {
            index,
            value,
            count,
        }) => Err(Error::NonFinite {
            path: path.to_owned(),
            channel: name.to_owned(),
            value,
            x: index % width,
            y: index / width,
            count,
        }),
    }
}

/// The samples of all planes. The error is the size of the memory that is missing, in MiB.
fn planar(planes: &[Plane]) -> Result<Vec<f32>, usize> {
    let pixels = planes.first().map_or(0, Plane::len);
    let count = planes.len() * pixels;
    let mut samples: Vec<f32> = Vec::new();
    let reserved = samples.try_reserve_exact(count);
    reserved.map_err(|_| (count * size_of::<f32>()).div_ceil(1 << 20))?;
    samples.resize(count, 0.0);
    let parts = samples.chunks_exact_mut(pixels.max(1)).zip(planes);
    parallel::map(
        parallel::threads().count,
        parts.collect(),
        |(part, plane)| plane.copy_to(0, part),
    );
    Ok(samples)
}
