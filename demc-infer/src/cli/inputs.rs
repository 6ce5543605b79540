//! Expands input arguments into files: files, directories, glob patterns, frame sequences.

use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use demc_data::message;

use super::UsageError;

/// Range of frame numbers: `7` or `1-240`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Frames {
    first: u64,
    last: u64,
}

impl FromStr for Frames {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (first, last) = text.split_once('-').unwrap_or((text, text));
        let number = |text: &str| text.parse().map_err(|_| "not N or FIRST-LAST".to_owned());
        let (first, last) = (number(first)?, number(last)?);
        match first <= last {
            true => Ok(Self { first, last }),
            false => Err(format!("{first} is after {last}")),
        }
    }
}

/// The input images of a command line.
#[derive(Debug)]
pub struct Inputs {
    /// The files in the given order.
    pub files: Vec<PathBuf>,
    /// Whether the arguments can stand for several files.
    pub several: bool,
    /// The frame sequences among the arguments.
    pub sequences: Vec<Sequence>,
}

/// A frame sequence.
#[derive(Debug)]
pub struct Sequence {
    /// Its chosen frames.
    pub files: Vec<PathBuf>,
    /// Up to [`SAMPLES`] of all its frames, evenly spaced: the same for every choice of frames.
    pub samples: Vec<PathBuf>,
    /// Names the missing frames, if there are any.
    pub missing: Option<String>,
}

/// Number of frames from which the exposure of a sequence is measured.
const SAMPLES: usize = 8;

/// Largest number of gaps that a message names.
const MAX_GAPS: usize = 20;

impl Inputs {
    /// Expands `arguments`.
    ///
    /// - A file stands for itself, a directory for its `*.exr`, links without a target included.
    /// - `shot.####.exr` and `shot.%04d.exr` stand for the frames of a sequence.
    /// - Names with `*`, `?` or `[..]` are glob patterns if no such file exists.
    ///
    /// # Errors
    /// A directory, pattern or sequence without files; `frames` without a sequence.
    pub fn expand(arguments: &[PathBuf], frames: Option<Frames>) -> Result<Self, UsageError> {
        let mut files = Vec::new();
        let mut several = arguments.len() > 1;
        let mut sequences = Vec::new();
        for argument in arguments {
            let found = if argument.is_file() {
                vec![argument.clone()]
            } else if argument.is_dir() {
                several = true;
                directory(argument)?
            } else if let Some(pattern) = SequencePattern::parse(argument) {
                several = true;
                let sequence = pattern.expand(frames)?;
                let files = sequence.files.clone();
                sequences.push(sequence);
                files
            } else if is_pattern(argument) {
                several = true;
                pattern(argument)?
            } else {
                // Reading the file gives the best error.
                vec![argument.clone()]
            };
            if found.is_empty() {
                return Err(UsageError(format!(
                    "{}: no images found",
                    argument.display()
                )));
            }
            files.extend(found);
        }
        if frames.is_some() && sequences.is_empty() {
            let message = "--frames needs a sequence among the inputs, such as shot.####.exr";
            return Err(UsageError(message.into()));
        }
        Ok(Self {
            files,
            several,
            sequences,
        })
    }

    /// Reports missing frames of sequences. Returns the number of sequences that have any.
    pub fn report_missing(&self) -> usize {
        let missing = self.sequences.iter();
        let missing = missing.filter_map(|sequence| sequence.missing.as_ref());
        missing
            .inspect(|missing| message::say(format_args!("error: {missing}")))
            .count()
    }
}

fn directory(path: &Path) -> Result<Vec<PathBuf>, UsageError> {
    let mut files: Vec<PathBuf> = entries(path)?
        .into_iter()
        // Reading anything but a file gives the best error.
        .filter(|file| is_exr(file) && !file.is_dir())
        .collect();
    files.sort();
    Ok(files)
}

fn entries(path: &Path) -> Result<Vec<PathBuf>, UsageError> {
    let error = |error| UsageError(format!("{}: {error}", path.display()));
    let entries = fs::read_dir(path).map_err(error)?;
    let paths = entries.map(|entry| entry.map(|entry| entry.path()));
    paths.collect::<Result<_, _>>().map_err(error)
}

fn is_exr(path: &Path) -> bool {
    let extension = path.extension().and_then(OsStr::to_str);
    extension.is_some_and(|extension| extension.eq_ignore_ascii_case("exr"))
}

fn is_pattern(path: &Path) -> bool {
    let bytes = path.as_os_str().as_encoded_bytes();
    bytes.iter().any(|byte| b"*?[".contains(byte))
}

fn pattern(argument: &Path) -> Result<Vec<PathBuf>, UsageError> {
    let error =
        |error: &dyn std::fmt::Display| UsageError(format!("{}: {error}", argument.display()));
    let Some(text) = argument.to_str() else {
        return Err(error(
            &"a pattern must be UTF-8; name the directory instead",
        ));
    };
    let found = glob::glob(text).map_err(|source| error(&source))?;
    let mut files = Vec::new();
    for path in found {
        let path = path.map_err(|source| error(&source))?;
        if !path.is_dir() {
            files.push(path);
        }
    }
    Ok(files)
}

/// The name of a frame sequence: `directory/PREFIX####SUFFIX`.
struct SequencePattern<'a> {
    argument: &'a Path,
    prefix: String,
    /// Number of digits of a frame number with leading zeros.
    digits: usize,
    suffix: String,
}

impl<'a> SequencePattern<'a> {
    fn parse(argument: &'a Path) -> Option<Self> {
        let name = argument.file_name()?.to_str()?;
        let (start, end, digits) = hashes(name).or_else(|| percent(name))?;
        Some(Self {
            argument,
            prefix: name[..start].to_owned(),
            digits,
            suffix: name[end..].to_owned(),
        })
    }

    fn expand(&self, frames: Option<Frames>) -> Result<Sequence, UsageError> {
        let parent = match self.argument.parent() {
            Some(parent) if parent != Path::new("") => parent,
            _ => Path::new("."),
        };
        let mut found: Vec<(u64, PathBuf)> = entries(parent)?
            .into_iter()
            .filter_map(|path| Some((self.number(path.file_name()?.to_str()?)?, path)))
            .collect();
        found.sort();
        let samples = found.iter().step_by(found.len().div_ceil(SAMPLES).max(1));
        let samples = samples.map(|(_, path)| path.clone()).collect();
        if let Some(frames) = frames {
            found.retain(|(number, _)| (frames.first..=frames.last).contains(number));
        }
        let missing = missing(&found, frames);
        Ok(Sequence {
            missing: missing.map(|frames| format!("{}: {frames}", self.argument.display())),
            files: found.into_iter().map(|(_, path)| path).collect(),
            samples,
        })
    }

    /// The frame number in a file name: exactly `digits` digits, or more without a leading zero.
    fn number(&self, name: &str) -> Option<u64> {
        let digits = name
            .strip_prefix(&self.prefix)?
            .strip_suffix(&self.suffix)?;
        let fits =
            digits.len() == self.digits || digits.len() > self.digits && !digits.starts_with('0');
        let all_digits = digits.bytes().all(|byte| byte.is_ascii_digit());
        (fits && all_digits).then(|| digits.parse().ok()).flatten()
    }
}

/// The first run of `#`: start, end, length.
fn hashes(name: &str) -> Option<(usize, usize, usize)> {
    let start = name.find('#')?;
    let digits = name[start..]
        .bytes()
        .take_while(|byte| *byte == b'#')
        .count();
    Some((start, start + digits, digits))
}

/// `%d`, `%4d` or `%04d`: start, end, digits.
fn percent(name: &str) -> Option<(usize, usize, usize)> {
    let start = name.find('%')?;
    let length = name[start + 1..].find(|c: char| !c.is_ascii_digit())?;
    let width = &name[start + 1..][..length];
    let end = start + 1 + length + 1;
    (name[..end].ends_with('d')).then(|| (start, end, width.parse().unwrap_or(1)))
}

/// Names the missing frames: `2 of 5 frames are missing: 5-6`.
fn missing(found: &[(u64, PathBuf)], frames: Option<Frames>) -> Option<String> {
    let first = frames.map_or(found.first()?.0, |frames| frames.first);
    let last = frames.map_or(found.last()?.0, |frames| frames.last);
    let mut gaps = Vec::new();
    let mut missing = 0;
    let mut next = first;
    let end = [last.saturating_add(1)];
    for number in found.iter().map(|(number, _)| *number).chain(end) {
        if number > next {
            missing += number - next;
            gaps.push(match number - next {
                1 => format!("{next}"),
                _ => format!("{next}-{}", number - 1),
            });
        }
        next = number.saturating_add(1);
    }
    let frames = last - first;
    (missing > 0).then(|| {
        let hidden = gaps.len().saturating_sub(MAX_GAPS);
        gaps.truncate(MAX_GAPS);
        let more = if hidden > 0 { ", ..." } else { "" };
        let gaps = gaps.join(", ");
        format!(
            "{missing} of {} frames are missing: {gaps}{more}",
            frames.saturating_add(1)
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn directory_of(names: &[&str]) -> tempfile::TempDir {
        let dir = tempfile::tempdir().expect("a directory");
        for name in names {
            fs::write(dir.path().join(name), "").expect("a file");
        }
        dir
    }

    fn names(dir: &tempfile::TempDir, argument: &str, frames: Option<&str>) -> Vec<String> {
        let frames = frames.map(|text| text.parse().expect("frames"));
        let found = Inputs::expand(&[dir.path().join(argument)], frames).expect("files");
        let name = |path: &PathBuf| path.file_name().map(|name| name.to_string_lossy().into());
        found.files.iter().filter_map(name).collect()
    }

    #[test]
    fn a_directory_stands_for_its_images_by_name() {
        let dir = directory_of(&["b.exr", "a.EXR", "c.txt"]);
        fs::create_dir(dir.path().join("d.exr")).expect("a directory");
        assert_eq!(names(&dir, "", None), ["a.EXR", "b.exr"]);
    }

    #[test]
    fn a_sequence_stands_for_its_frames_by_number() {
        let dir = directory_of(&[
            "s.0009.exr",
            "s.0010.exr",
            "s.12345.exr",
            "s.010.exr",
            "s.00011.exr",
            "s.abcd.exr",
            "t.0001.exr",
        ]);
        for pattern in ["s.####.exr", "s.%04d.exr"] {
            let all = names(&dir, pattern, None);
            assert_eq!(all, ["s.0009.exr", "s.0010.exr", "s.12345.exr"]);
            assert_eq!(names(&dir, pattern, Some("10-99")), ["s.0010.exr"]);
        }
        assert_eq!(names(&dir, "s.%d.exr", None), ["s.12345.exr"]);
    }

    #[test]
    fn a_pattern_finds_files_and_a_file_may_have_such_a_name() {
        let dir = directory_of(&["a1.exr", "a2.exr", "b.exr"]);
        assert_eq!(names(&dir, "a*.exr", None), ["a1.exr", "a2.exr"]);
        assert_eq!(names(&dir, "[ab]?.exr", None), ["a1.exr", "a2.exr"]);
        let odd = directory_of(&["x[1].exr", "x1.exr", "shot#1.exr"]);
        assert_eq!(names(&odd, "x[1].exr", None), ["x[1].exr"]);
        assert_eq!(names(&odd, "shot#1.exr", None), ["shot#1.exr"]);
    }

    #[test]
    fn nothing_found_is_an_error_and_a_missing_file_is_not() {
        let dir = directory_of(&["a.txt"]);
        for argument in ["", "*.exr", "s.####.exr"] {
            let error = Inputs::expand(&[dir.path().join(argument)], None).expect_err("nothing");
            assert!(error.to_string().ends_with("no images found"), "{error}");
        }
        let absent = dir.path().join("absent.exr");
        let found = Inputs::expand(std::slice::from_ref(&absent), None).expect("as it is");
        assert_eq!((found.files, found.several), (vec![absent], false));
        let error = Inputs::expand(&["a.exr".into()], "1-2".parse().ok()).expect_err("no sequence");
        assert!(error.to_string().starts_with("--frames needs"), "{error}");
    }

    #[test]
    fn frames_are_a_number_or_two() {
        let frames = |text: &str| text.parse::<Frames>();
        assert_eq!(frames("7"), frames("7-7"));
        for wrong in ["", "a", "5-", "9-3", "1-2-3", "-4"] {
            assert!(frames(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn gaps_are_counted() {
        let found: Vec<_> = [3, 4, 7].map(|n| (n, PathBuf::new())).into();
        let message = missing(&found, None).expect("a gap");
        assert_eq!(message, "2 of 5 frames are missing: 5-6");
        let message = missing(&found, "1-9".parse().ok()).expect("gaps");
        assert_eq!(message, "6 of 9 frames are missing: 1-2, 5-6, 8-9");
        assert_eq!(missing(&found[..2], None), None);
    }
}
