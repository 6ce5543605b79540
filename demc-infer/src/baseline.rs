//! Baselines: other programs' images of a data set, one EXR file per scene with the scene's file
//! name.

use std::ffi::OsStr;
use std::path::PathBuf;
use std::str::FromStr;

use demc_data::{Rgb, Scene, read_rgb};

/// Names with another meaning in a report.
const RESERVED: [&str; 5] = ["noisy", "black", "denoised", "reference", "mean"];

/// A directory of images to compare with.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Baseline {
    /// Its name in reports.
    pub name: String,
    /// The directory with its images.
    pub dir: PathBuf,
}

/// Why a baseline cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[allow(missing_docs, reason = "the messages explain the fields")]
pub enum BaselineError {
    /// Not `NAME=DIR`.
    #[error("{0:?} is not NAME=DIR")]
    Form(String),
    /// A reserved name, or one that is used twice.
    #[error("{0}: the name is reserved or used twice")]
    Taken(String),
    /// Missing images.
    #[error("baseline {name}: missing {}", paths.join(", "))]
    Missing { name: String, paths: Vec<String> },
    /// An image of another size.
    #[error("{}: is {found}, but the scene is {expected}", path.display())]
    Size {
        path: PathBuf,
        /// Its size, as `WxH`.
        found: String,
        expected: String,
    },
    /// An image cannot be read, or holds NaN or infinite values.
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
    /// The file with the image of `scene`.
    pub fn path(&self, scene: &Scene) -> PathBuf {
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
        if size == (scene.width, scene.height) {
            Ok(image)
        } else {
            Err(BaselineError::Size {
                path,
                found: format!("{}x{}", size.0, size.1),
                expected: format!("{}x{}", scene.width, scene.height),
            })
        }
    }
}

/// Checks that names are unique and not reserved, and that every image exists.
///
/// # Errors
/// [`BaselineError::Taken`], or [`BaselineError::Missing`] with all missing images of the first
/// such baseline.
pub fn check(baselines: &[Baseline], scenes: &[Scene]) -> Result<(), BaselineError> {
    for (i, baseline) in baselines.iter().enumerate() {
        let name = &baseline.name;
        let twice = baselines[..i].iter().any(|other| other.name == *name);
        if twice || RESERVED.contains(&name.as_str()) {
            return Err(BaselineError::Taken(name.clone()));
        }
    }
    for baseline in baselines {
        let paths: Vec<_> = scenes
            .iter()
            .map(|scene| baseline.path(scene))
            .filter(|path| !path.is_file())
            .map(|path| path.display().to_string())
            .collect();
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
    fn reserved_and_repeated_names_are_refused() {
        let baseline = |name: &str| format!("{name}=dir").parse::<Baseline>().expect("form");
        for names in [vec!["noisy"], vec!["a", "a"]] {
            let list: Vec<_> = names.into_iter().map(baseline).collect();
            assert!(matches!(check(&list, &[]), Err(BaselineError::Taken(_))));
        }
        assert!(check(&[baseline("a"), baseline("b")], &[]).is_ok());
    }
}
