//! Compares scenes with each other: the manifest's entries, exposures, and images.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::fs;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::PathBuf;

use super::finding::Finding;
use super::reference::correlation;
use crate::dataset::Scene;
use crate::image::frame::{Frame, POSITIONS};
use crate::input::ranges::{LUMINANCE, exposure};

/// Largest distance of a scene's exposure from the median in stops (renders: 3.2).
const MAX_STOPS: f64 = 4.0;
/// Smallest correlation of two images of one view (renders: other views reach 0.83).
const SAME_IMAGE: f64 = 0.95;
/// Number of hashes of a sketch.
const SKETCH: usize = 1024;
/// Smallest share of equal positions of two images of one view (renders: other views share none).
const SAME_PLACES: f64 = 0.3;
/// Smallest number of hashes that tells that share.
const FEWEST_PLACES: usize = 32;
/// Width and height of the small images that are compared.
const SIDE: usize = 32;
/// Luminance that is added before a logarithm, in exposures.
const DARK: f64 = 0.05;

/// What scenes are compared by.
pub(super) struct Image {
    /// Of the reference, or of the noisy image without one.
    exposure: f64,
    /// Log luminance of the reference at 32x32 pixels; empty for a smaller or black image.
    small: Vec<f64>,
    /// Hash of all buffers.
    hash: u64,
    /// The smallest hashes of the positions that the image shows, in order: a sketch (Broder 1997).
    places: Vec<u64>,
}

impl Image {
    pub(super) fn of(frame: &Frame) -> Self {
        let image = frame.reference.as_deref().unwrap_or(&frame.color);
        let exposure = exposure(image);
        let mut hasher = DefaultHasher::new();
        for sample in frame.color.iter().chain(&frame.features).chain(image) {
            sample.to_bits().hash(&mut hasher);
        }
        Self {
            exposure,
            small: if exposure > 0.0 && frame.width.min(frame.height) >= SIDE {
                small(image, frame, DARK * exposure)
            } else {
                Vec::new()
            },
            hash: hasher.finish(),
            places: places(frame),
        }
    }

    /// Whether both show the same view, and how that was found.
    fn shows_view_of(&self, other: &Self) -> Option<String> {
        let names = [
            (correlation_of(&self.small, &other.small), "correlates"),
            (
                correlation_of(&mirrored(&self.small), &other.small),
                "correlates, mirrored,",
            ),
        ];
        let similar = names.into_iter().find_map(|(correlation, words)| {
            let same = correlation.filter(|c| *c > SAME_IMAGE)?;
            Some((words, format!("by {same:.3}")))
        });
        if let Some((words, value)) = similar {
            return Some(format!("{words} with {{other}} {value}"));
        }
        let share = shared_places(&self.places, &other.places)?;
        (share > SAME_PLACES).then(|| {
            let percent = 100.0 * share;
            format!(
                "shares {percent:.0} % of its positions with {{other}}: a crop or a mirrored copy"
            )
        })
    }
}

/// The smallest [`SKETCH`] hashes of the positions of pixels that hit a surface.
fn places(frame: &Frame) -> Vec<u64> {
    let pixels = frame.width * frame.height;
    let position = |i: usize| [0, 1, 2].map(|c| frame.features[(POSITIONS + c) * pixels + i]);
    let hits = (0..pixels).map(position).filter(|place| *place != [0.0; 3]);
    let mut hashes: Vec<u64> = hits
        .map(|place| {
            let mut hasher = DefaultHasher::new();
            place.map(f32::to_bits).hash(&mut hasher);
            hasher.finish()
        })
        .collect();
    hashes.sort_unstable();
    hashes.dedup();
    hashes.truncate(SKETCH);
    hashes
}

/// Share of the positions of one image that the other one shows, too; `None` if the sketches are too small to
/// tell.
fn shared_places(a: &[u64], b: &[u64]) -> Option<f64> {
    // Both sketches are complete up to here.
    let end = *a.last()?.min(b.last()?);
    let [a, b] = [a, b].map(|hashes| &hashes[..hashes.partition_point(|hash| *hash <= end)]);
    let shared = a
        .iter()
        .filter(|hash| b.binary_search(hash).is_ok())
        .count();
    let fewest = a.len().min(b.len());
    (fewest >= FEWEST_PLACES).then(|| shared as f64 / fewest as f64)
}

/// A small image mirrored left to right.
fn mirrored(small: &[f64]) -> Vec<f64> {
    let rows = small.chunks_exact(SIDE);
    rows.flat_map(|row| row.iter().rev().copied()).collect()
}

/// Log luminance, averaged to 32x32 pixels.
fn small(image: &[f32], frame: &Frame, dark: f64) -> Vec<f64> {
    let Frame { width, height, .. } = *frame;
    let mut sums = vec![(0.0, 0_u32); SIDE * SIDE];
    for y in 0..height {
        for x in 0..width {
            let channels = LUMINANCE.iter().enumerate();
            let samples = channels.map(|(c, weight)| weight * image[(c * height + y) * width + x]);
            let (sum, count) = &mut sums[y * SIDE / height * SIDE + x * SIDE / width];
            *sum += f64::from(samples.sum::<f32>());
            *count += 1;
        }
    }
    let means = sums.into_iter();
    means
        .map(|(sum, count)| (sum / f64::from(count) + dark).ln())
        .collect()
}

/// Problems of the manifest alone: names, files, and base scenes.
pub(super) fn of_manifest(scenes: &[Scene]) -> Vec<Finding> {
    let mut findings = Vec::new();
    let mut names = BTreeSet::new();
    let mut files: HashMap<PathBuf, &str> = HashMap::new();
    let mut splits: BTreeMap<&str, BTreeSet<_>> = BTreeMap::new();
    for scene in scenes {
        if !names.insert(&scene.name) {
            findings.push(Finding::new(
                "names that are listed twice",
                "each scene needs a name of its own; run demc-data index --overwrite",
                &scene.name,
                String::new(),
            ));
        }
        splits.entry(&scene.base).or_default().insert(scene.split);
        let file = fs::canonicalize(&scene.path).unwrap_or_else(|_| scene.path.clone());
        if let Some(other) = files.insert(file, &scene.name) {
            findings.push(Finding::new(
                "files that are listed twice",
                "remove one entry, or run demc-data index --overwrite",
                &scene.name,
                format!("the file of {other}"),
            ));
        }
    }
    let leaks = splits.iter().filter(|(_, splits)| splits.len() > 1);
    findings.extend(leaks.map(|(base, _)| {
        Finding::new(
            "base scenes in both splits",
            "move all views of a base scene to one split (demc-data index --test, --base)",
            base,
            String::new(),
        )
    }));
    findings
}

/// Problems between images.
pub(super) fn of_images(images: &[(&Scene, Image)]) -> Vec<Finding> {
    let mut findings = exposures(images);
    findings.extend(duplicates(images));
    findings
}

fn exposures(images: &[(&Scene, Image)]) -> Vec<Finding> {
    let lit = images.iter().filter(|(_, image)| image.exposure > 0.0);
    let mut stops: Vec<(f64, &Scene)> = lit
        .map(|(scene, image)| (image.exposure.log2(), *scene))
        .collect();
    stops.sort_by(|a, b| a.0.total_cmp(&b.0));
    let Some((median, _)) = stops.get(stops.len() / 2).copied() else {
        return Vec::new();
    };
    let range = stops[stops.len() - 1].0 - stops[0].0;
    let far = stops
        .iter()
        .filter(|(stops, _)| (stops - median).abs() > MAX_STOPS);
    far.map(|(stops, scene)| {
        Finding::new(
            &format!("exposures differ by {range:.1} stops across scenes"),
            "scale images and references to one exposure",
            &scene.name,
            format!("{:+.1} stops from the median", stops - median),
        )
    })
    .collect()
}

/// Copies anywhere, and one view in both splits. Views of one split may resemble each other, as the
/// frames of a sequence do.
fn duplicates(images: &[(&Scene, Image)]) -> Vec<Finding> {
    let mut findings = Vec::new();
    for (i, (scene, image)) in images.iter().enumerate() {
        for (other, earlier) in &images[..i] {
            // One file in two entries is reported already.
            if scene.path == other.path {
                continue;
            }
            if image.hash == earlier.hash {
                findings.push(Finding::new(
                    "copies of another scene",
                    "remove one of them",
                    &scene.name,
                    format!("equal to {}", other.name),
                ));
            } else if scene.split != other.split
                && let Some(how) = image.shows_view_of(earlier)
            {
                findings.push(Finding::new(
                    "views that are in both splits",
                    "test scores then favour what training saw; move both to one split",
                    &scene.name,
                    how.replace("{other}", &other.name),
                ));
            }
        }
    }
    findings
}

fn correlation_of(a: &[f64], b: &[f64]) -> Option<f64> {
    if a.len() == b.len() {
        correlation(a, b)
    } else {
        None
    }
}
