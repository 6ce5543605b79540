//! Checks of the passes of the paper's comparison: half buffers, variances, and parts of the colour.
//! Limits were set on 40 views of `tools/render --passes paper`; see the tests for what they find.

use std::path::Path;

use super::finding::{Finding, short};
use crate::error::Error;
use crate::image::exr::ExrFile;
use crate::image::layout::{ChannelLayout, NamedBuffer};

/// Largest difference of a sum from its buffer, as a share of the buffer's mean (half floats: 0.0005).
const SUM_TOLERANCE: f64 = 0.02;
/// Smallest and largest mean variance, in units of that of the half buffers (renders: 0.9 to 1.1).
const VARIANCE: [f64; 2] = [0.5, 2.0];

/// Largest factor by which the variances of the parts may miss the bounds of that of the colour.
const PARTS_TOLERANCE: f64 = 1.2;

/// The findings of a scene's passes; none for a file without passes.
pub(super) fn findings(name: &str, path: &Path, layout: &ChannelLayout) -> Vec<Finding> {
    let problem = |error: &Error| {
        let cause = "render them again";
        vec![Finding::new(
            "passes cannot be read",
            cause,
            name,
            short(error),
        )]
    };
    match read(path, layout) {
        Ok(None) => Vec::new(),
        Ok(Some(Contents::Lacking(names))) => {
            let cause = "render them again, or rename those that the layout does not mean";
            let lacking = names.join(", ");
            vec![Finding::new("passes are incomplete", cause, name, lacking)]
        }
        Ok(Some(Contents::Whole(passes))) => passes.findings(name),
        Err(error) => problem(&error),
    }
}

/// What a file has of the passes.
enum Contents {
    Lacking(Vec<String>),
    Whole(PassPlanes),
}

/// Buffers as decoded: content, and `[C * H * W]` samples.
struct PassPlanes(Vec<(String, Vec<f32>)>);

fn read(path: &Path, layout: &ChannelLayout) -> Result<Option<Contents>, Error> {
    let mut file = ExrFile::open(path)?.on_threads(1);
    let mut layout = layout.in_file(&file, None)?.into_owned();
    layout.passes.forget_absent(&file);
    if layout.passes.is_empty() {
        return Ok(None);
    }
    let is_present = |buffer: &NamedBuffer| {
        let mut names = buffer.channels.iter();
        names.any(|name| file.channel(name).is_some())
    };
    let optional = ["reference", "mask", "alpha"];
    let buffers: Vec<NamedBuffer> = layout
        .buffers()
        .into_iter()
        .filter(|buffer| is_present(buffer) || !optional.contains(&buffer.content.as_str()))
        .collect();
    let names: Vec<&str> = buffers
        .iter()
        .flat_map(|buffer| &buffer.channels)
        .map(String::as_str)
        .collect();
    let lacking: Vec<String> = names
        .iter()
        .filter(|name| file.channel(name).is_none())
        .map(|name| (*name).to_owned())
        .collect();
    if !lacking.is_empty() {
        return Ok(Some(Contents::Lacking(lacking)));
    }
    let mut planes = file.read(&names)?.into_iter();
    let decoded = buffers.iter().map(|buffer| {
        let own = planes.by_ref().take(buffer.channels.len());
        let samples = own.flat_map(|plane| plane.to_f32()).collect();
        (buffer.content.clone(), samples)
    });
    Ok(Some(Contents::Whole(PassPlanes(decoded.collect()))))
}

impl PassPlanes {
    fn get(&self, content: &str) -> Option<&[f32]> {
        let found = self.0.iter().find(|(name, _)| name == content);
        found.map(|(_, samples)| &samples[..])
    }

    fn findings(&self, scene: &str) -> Vec<Finding> {
        let mut findings = Vec::new();
        let mut add = |problem: String, cause: &str, detail: String| {
            findings.push(Finding::new(&problem, cause, scene, detail));
        };
        for (content, samples) in &self.0 {
            let is_pass = !self.is_of_the_network(content);
            let invalid = samples.iter().filter(|sample| !sample.is_finite()).count();
            if is_pass && invalid > 0 {
                let cause = "a bug of the renderer or of its materials";
                add(
                    format!("{content}: NaN or infinite samples"),
                    cause,
                    invalid.to_string(),
                );
            }
            if content.starts_with("variance") && samples.iter().any(|sample| *sample < 0.0) {
                let cause = "a variance is at least 0; is it another buffer?";
                add(format!("{content} is negative"), cause, String::new());
            }
        }
        findings.extend(
            ["color", "normal", "texture1", "depth"]
                .into_iter()
                .filter_map(|buffer| self.misfit_of_halves(scene, buffer)),
        );
        let mut add = |problem: String, cause: &str, detail: String| {
            findings.push(Finding::new(&problem, cause, scene, detail));
        };
        let color_fits = !self.has_other_variance("color");
        if let Some(detail) = self.misfit_of_parts().filter(|_| color_fits) {
            let cause = "each must be that of the mean: of the samples, divided by their number";
            let problem = "variances of diffuse and specular do not fit that of color";
            add(problem.to_owned(), cause, detail);
        }
        for (whole, parts, cause) in [
            (
                "color",
                ["diffuse", "specular"],
                "does one of them lack emission?",
            ),
            (
                "reference",
                ["reference_diffuse", "reference_specular"],
                "was the reference cleaned, or rendered apart from its parts?",
            ),
        ] {
            let [a, b] = parts.map(|part| self.get(part));
            if let (Some(whole_samples), Some(a), Some(b)) = (self.get(whole), a, b)
                && deviation(whole_samples, a, b, 1.0) > SUM_TOLERANCE
            {
                let away = 100.0 * deviation(whole_samples, a, b, 1.0);
                let problem = format!("{whole} is not the sum of its diffuse and specular part");
                add(problem, cause, format!("off by {away:.0} %"));
            }
        }
        findings
    }

    /// How a buffer, its half buffers, and its variance do not fit each other.
    fn misfit_of_halves(&self, scene: &str, buffer: &str) -> Option<Finding> {
        let found = |problem: String, cause: &str, detail: String| {
            Some(Finding::new(&problem, cause, scene, detail))
        };
        let [a, b] = self.halves(buffer)?;
        if a == b && a.iter().any(|sample| *sample != a[0]) {
            let problem = format!("the half buffers of {buffer} are equal");
            return found(problem, "render them with different seeds", String::new());
        }
        let away = deviation(self.get(buffer)?, a, b, 0.5);
        if away > SUM_TOLERANCE {
            let cause = "each must have one half of the samples of the image";
            let problem = format!("{buffer} is not the mean of its half buffers");
            return found(problem, cause, format!("off by {:.0} %", 100.0 * away));
        }
        if self.has_other_variance(buffer) {
            let cause = "it must be that of the mean: of the samples, divided by their number";
            let ratio = self.variance_ratio(buffer)?;
            let detail = format!("{ratio:.2} times that of its half buffers");
            return found(format!("variance of {buffer} does not fit"), cause, detail);
        }
        None
    }

    fn halves(&self, buffer: &str) -> Option<[&[f32]; 2]> {
        let half = |number| self.get(&format!("half buffer {number} of {buffer}"));
        Some([half(1)?, half(2)?])
    }

    /// The mean variance of a buffer, in units of that of its half buffers; NaN if both are 0.
    fn variance_ratio(&self, buffer: &str) -> Option<f64> {
        let variance = self.get(&format!("variance of {buffer}"))?;
        let [a, b] = self.halves(buffer)?;
        let pairs = a.iter().zip(b);
        let squares = pairs.map(|(a, b)| f64::from((a - b) / 2.0).powi(2));
        Some(mean(variance.iter().map(|x| f64::from(*x))) / mean(squares))
    }

    fn has_other_variance(&self, buffer: &str) -> bool {
        let ratio = self.variance_ratio(buffer);
        let is_other = |ratio: f64| !(VARIANCE[0]..=VARIANCE[1]).contains(&ratio);
        ratio.is_some_and(|ratio| !ratio.is_nan() && is_other(ratio))
    }

    /// By how much the variance of the colour is outside the bounds that its parts set. These are the squares
    /// of the sum and of the difference of their standard deviations (Cauchy and Schwarz).
    fn misfit_of_parts(&self) -> Option<String> {
        let get = |content: &str| self.get(&format!("variance of {content}"));
        let (whole, a, b) = (get("color")?, get("diffuse")?, get("specular")?);
        let deviations = || {
            let pairs = a.iter().zip(b);
            pairs.map(|(a, b)| [a, b].map(|x| f64::from(x.max(0.0)).sqrt()))
        };
        let found = mean(whole.iter().map(|x| f64::from(*x)));
        let most = mean(deviations().map(|[a, b]| (a + b).powi(2)));
        let least = mean(deviations().map(|[a, b]| (a - b).powi(2)));
        let fits = found <= PARTS_TOLERANCE * most && found * PARTS_TOLERANCE >= least;
        (!fits).then(|| format!("{found:.1e} instead of {least:.1e} to {most:.1e}"))
    }

    /// Buffers that the other checks examine.
    fn is_of_the_network(&self, content: &str) -> bool {
        let own = [
            "color",
            "normal",
            "position",
            "texture1",
            "texture2",
            "reference",
            "mask",
            "alpha",
        ];
        own.contains(&content)
    }
}

/// Mean distance of `factor * (a + b)` from `whole`, as a share of the mean of `|whole|`.
fn deviation(whole: &[f32], a: &[f32], b: &[f32], factor: f64) -> f64 {
    let parts = a.iter().zip(b);
    let away = whole.iter().zip(parts).map(|(whole, (a, b))| {
        (factor * (f64::from(*a) + f64::from(*b)) - f64::from(*whole)).abs()
    });
    mean(away) / mean(whole.iter().map(|x| f64::from(x.abs()))).max(f64::MIN_POSITIVE)
}

fn mean(values: impl ExactSizeIterator<Item = f64>) -> f64 {
    let count = values.len().max(1) as f64;
    values.sum::<f64>() / count
}
