//! Other programs' images of a data set: a directory with an EXR file for each scene, named as the scene's.

use std::ffi::OsStr;
use std::path::PathBuf;
use std::str::FromStr;

use demc_data::{Rgb, Scene, read_rgb};

/// Names that mean something else in a report.
const TAKEN: [&str; 5] = ["noisy", "black", "denoised", "reference", "mean"];

/// A directory of images to compare with.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Baseline {
    /// What reports call it.
    pub name: String,
    /// Where its images are.
    pub dir: PathBuf,
}

/// Why a baseline cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum BaselineError {
    /// Not `NAME=DIR`.
    #[error("{0:?} is not NAME=DIR")]
    Form(String),
    /// A name that a report uses for something else, or twice.
    #[error("{0}: the name of something else in the report")]
    Taken(String),
    /// Images that are not there.
    #[error("baseline {name}: no {}", paths.join(", "))]
    Missing {
        /// The baseline.
        name: String,
        /// All files that are missing.
        paths: Vec<String>,
    },
    /// An image of another size.
    #[error("{}: is {found}, but the scene is {expected}", path.display())]
    Size {
        /// The image.
        path: PathBuf,
        /// Its size, as `WxH`.
        found: String,
        /// The scene's.
        expected: String,
    },
    /// An image that cannot be read, or holds NaN or infinite values.
    #[error(transparent)]
    Read(#[from] demc_data::Error),
}

impl FromStr for Baseline {
    type Err = BaselineError;

    fn from_str(text: &str) -> Result<Self, BaselineError> {
        match text.split_once('=') {
            Some((name, dir)) if !name.trim().is_empty() && !dir.is_empty() => Ok(Self {
                name: name.trim().to_owned(),
                dir: dir.into(),
            }),
            _ => Err(BaselineError::Form(text.to_owned())),
        }
    }
}

impl Baseline {
    /// The image of `scene`.
    fn path(&self, scene: &Scene) -> PathBuf {
        let stem = scene.path.file_stem().unwrap_or(OsStr::new(&scene.name));
        let mut file = stem.to_owned();
        file.push(".exr");
        self.dir.join(file)
    }

    /// Reads the image of `scene`.
    ///
    /// # Errors
    /// [`BaselineError::Size`], and as [`read_rgb`].
    pub fn read(&self, scene: &Scene) -> Result<Rgb, BaselineError> {
        let path = self.path(scene);
        let image = read_rgb(&path)?;
        let size = (image.width, image.height);
        match size == (scene.width, scene.height) {
            true => Ok(image),
            false => Err(BaselineError::Size {
                path,
                found: format!("{}x{}", size.0, size.1),
                expected: format!("{}x{}", scene.width, scene.height),
            }),
        }
    }
}

/// Checks before anything is computed that names are free and every image is there.
///
/// # Errors
/// [`BaselineError::Taken`], or [`BaselineError::Missing`] with all images that the first such baseline lacks.
pub fn check(baselines: &[Baseline], scenes: &[Scene]) -> Result<(), BaselineError> {
    for (i, baseline) in baselines.iter().enumerate() {
        let name = &baseline.name;
        let twice = baselines[..i].iter().any(|other| other.name == *name);
        if twice || TAKEN.contains(&name.as_str()) {
            return Err(BaselineError::Taken(name.clone()));
        }
    }
    for baseline in baselines {
        let paths = scenes.iter().map(|scene| baseline.path(scene));
        let missing = paths.filter(|path| !path.is_file());
        let paths: Vec<_> = missing.map(|path| path.display().to_string()).collect();
        if !paths.is_empty() {
            return Err(BaselineError::Missing {
                name: baseline.name.clone(),
                paths,
            });
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_ends_at_the_first_equals_sign() {
        let found: Baseline = "oidn=a=b/c".parse().expect("NAME=DIR");
        assert_eq!(
            (found.name.as_str(), found.dir.to_str()),
            ("oidn", Some("a=b/c"))
        );
        for text in ["", "oidn", "=dir", "oidn="] {
            assert!(text.parse::<Baseline>().is_err(), "{text}");
        }
    }

    #[test]
    fn names_of_the_report_are_taken() {
        let baseline = |name: &str| format!("{name}=dir").parse::<Baseline>().expect("form");
        for names in [vec!["noisy"], vec!["a", "a"]] {
            let list: Vec<_> = names.into_iter().map(baseline).collect();
            assert!(matches!(check(&list, &[]), Err(BaselineError::Taken(_))));
        }
        assert!(check(&[baseline("a"), baseline("b")], &[]).is_ok());
    }
}
