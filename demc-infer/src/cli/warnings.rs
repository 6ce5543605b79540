//! Warnings about several images: each kind is shown in full once, then its images are listed.

use std::cell::RefCell;
use std::path::Path;

use crate::guard::Warning;

/// Largest number of images in a list.
const MAX_NAMES: usize = 20;

/// The warnings of a command line.
#[derive(Default)]
pub struct Warnings {
    kinds: RefCell<Vec<Kind>>,
}

struct Kind {
    what: String,
    cause: &'static str,
    /// The images after the first one.
    more: Vec<String>,
}

impl Warnings {
    /// The line for a warning about `image`, if it is the first of its kind.
    pub fn first(&self, image: &Path, warning: &Warning) -> Option<String> {
        let mut kinds = self.kinds.borrow_mut();
        let same = |kind: &&mut Kind| kind.what == warning.what && kind.cause == warning.cause;
        if let Some(kind) = kinds.iter_mut().find(same) {
            let name = image.file_name().unwrap_or(image.as_os_str());
            kind.more.push(name.to_string_lossy().into_owned());
            return None;
        }
        kinds.push(Kind {
            what: warning.what.clone(),
            cause: warning.cause,
            more: Vec::new(),
        });
        Some(format!("{}: {warning}", image.display()))
    }

    /// One line for each kind that several images have.
    pub fn rest(self) -> Vec<String> {
        let kinds = self.kinds.into_inner().into_iter();
        let repeated = kinds.filter(|kind| !kind.more.is_empty());
        let line = |Kind { what, cause, more }: Kind| {
            let count = more.len();
            let dots = if count > MAX_NAMES { ", ..." } else { "" };
            let names = more[..count.min(MAX_NAMES)].join(", ");
            format!("{what} ({cause}): the same in {count} more images: {names}{dots}")
        };
        repeated.map(line).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_kind_is_shown_once_and_its_other_images_are_listed() {
        let warning = |what: &str, found: &str| Warning {
            what: what.into(),
            found: found.into(),
            cause: "is it another buffer?",
        };
        let warnings = Warnings::default();
        let first = |image: &str, warning| warnings.first(Path::new(image), &warning);
        assert_eq!(
            first("s/1.exr", warning("normal", "its length is 2")).as_deref(),
            Some("s/1.exr: normal: its length is 2; is it another buffer?")
        );
        assert_eq!(first("s/2.exr", warning("normal", "its length is 3")), None);
        assert!(first("s/2.exr", warning("texture1", "its mean is 9")).is_some());
        assert_eq!(first("s/3.exr", warning("normal", "its length is 2")), None);
        assert_eq!(
            warnings.rest(),
            ["normal (is it another buffer?): the same in 2 more images: 2.exr, 3.exr"]
        );
    }
}
