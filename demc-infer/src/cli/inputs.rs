//! Expands input arguments into files: files, directories, glob patterns, frame sequences.

use std::ffi::OsStr;
use std::fs;
use std::ops::Range;
use std::path::{Path, PathBuf};

use demc_program::exit::UsageError;
use demc_program::message;

use super::frames::Frames;

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
    /// Says how many chosen frames are after the last one, if there are any.
    pub after: Option<String>,
}

/// Number of frames from which the exposure of a sequence is measured.
const SAMPLES: usize = 8;

impl Inputs {
    /// Expands `arguments`.
    ///
    /// - A file stands for itself, a directory for its `*.exr`, links without a target included.
    /// - `shot.####.exr` and `shot.%04d.exr` stand for the frames of a sequence.
    /// - Names with `*`, `?` or `[..]` are glob patterns if no such file exists.
    ///
    /// # Errors
    /// A directory, pattern or sequence without files; `frames` without a sequence.
    pub fn expand(arguments: &[PathBuf], frames: Option<&Frames>) -> Result<Self, UsageError> {
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

    /// Reports missing frames of sequences, and notes those after their ends. Returns the number of
    /// sequences with missing frames.
    pub fn report_missing(&self) -> usize {
        let after = self.sequences.iter();
        for after in after.filter_map(|sequence| sequence.after.as_ref()) {
            message::say(format_args!("note: {after}"));
        }
        self.sequences
            .iter()
            .filter_map(|sequence| sequence.missing.as_ref())
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
        let NumberField { place, digits } = hashes(name).or_else(|| percent(name))?;
        Some(Self {
            argument,
            prefix: name[..place.start].to_owned(),
            digits,
            suffix: name[place.end..].to_owned(),
        })
    }

    fn expand(&self, frames: Option<&Frames>) -> Result<Sequence, UsageError> {
        let parent = match self.argument.parent() {
            Some(parent) if parent != Path::new("") => parent,
            _ => Path::new("."),
        };
        let mut found: Vec<(u64, PathBuf)> = entries(parent)?
            .into_iter()
            .filter_map(|path| Some((self.number(path.file_name()?.to_str()?)?, path)))
            .collect();
        found.sort();
        let samples = found
            .iter()
            .step_by(found.len().div_ceil(SAMPLES).max(1))
            .map(|(_, path)| path.clone())
            .collect();
        let numbers: Vec<u64> = found.iter().map(|(number, _)| *number).collect();
        let (mut missing, mut after) = (None, None);
        if let (Some(&first), Some(&last)) = (numbers.first(), numbers.last()) {
            let all = Frames::between(first, last);
            let chosen = frames.unwrap_or(&all);
            found.retain(|(number, _)| chosen.contains(*number));
            if found.is_empty() {
                return Err(UsageError(format!(
                    "{}: none of the chosen frames exists; the sequence has {} from {first} to {last}",
                    self.argument.display(),
                    numbers.len()
                )));
            }
            let argument = self.argument.display();
            let until = chosen.up_to(last);
            let gaps = until.without(&numbers);
            missing = (gaps.count() > 0).then(|| {
                let (gaps, count, all) = (gaps.describe(), gaps.count(), until.count());
                format!("{argument}: {count} of {all} frames are missing: {gaps}")
            });
            let beyond = chosen.count() - until.count();
            after = (beyond > 0).then(|| {
                let all = chosen.count();
                format!(
                    "{argument}: {beyond} of {all} chosen frames are after its last one, {last}"
                )
            });
        }
        Ok(Sequence {
            files: found.into_iter().map(|(_, path)| path).collect(),
            samples,
            missing,
            after,
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

/// Where a file name has the number of a frame.
struct NumberField {
    /// Bytes of the name.
    place: Range<usize>,
    /// Number of digits.
    digits: usize,
}

/// The first run of `#`.
fn hashes(name: &str) -> Option<NumberField> {
    let start = name.find('#')?;
    let digits = name[start..]
        .bytes()
        .take_while(|byte| *byte == b'#')
        .count();
    let place = start..start + digits;
    Some(NumberField { place, digits })
}

/// `%d`, `%4d` or `%04d`.
fn percent(name: &str) -> Option<NumberField> {
    let start = name.find('%')?;
    let length = name[start + 1..].find(|c: char| !c.is_ascii_digit())?;
    let width = &name[start + 1..][..length];
    let end = start + 1 + length + 1;
    name[..end].ends_with('d').then(|| NumberField {
        place: start..end,
        digits: width.parse().unwrap_or(1),
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
        let found = Inputs::expand(&[dir.path().join(argument)], frames.as_ref()).expect("files");
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
        let frames = "1-2".parse().ok();
        let error = Inputs::expand(&["a.exr".into()], frames.as_ref()).expect_err("no sequence");
        assert!(error.to_string().starts_with("--frames needs"), "{error}");
    }

    #[test]
    fn missing_frames_are_named_and_frames_after_the_last_are_noted() {
        let dir = directory_of(&["s.03.exr", "s.04.exr", "s.07.exr"]);
        let told = |frames: Option<&str>| {
            let frames = frames.map(|text| text.parse::<Frames>().expect("frames"));
            let found = Inputs::expand(&[dir.path().join("s.##.exr")], frames.as_ref());
            let sequence = found.expect("frames").sequences.remove(0);
            let end = |text: Option<String>| Some(text?.split_once(": ")?.1.to_owned());
            (end(sequence.missing), end(sequence.after))
        };
        let missing = |text: &str| Some(format!("{text} frames are missing: 5-6"));
        let after = |count: &str| Some(format!("{count} chosen frames are after its last one, 7"));
        assert_eq!(told(None), (missing("2 of 5"), None));
        assert_eq!(told(Some("3-10")), (missing("2 of 5"), after("3 of 8")));
        assert_eq!(told(Some("4,7-9x2")), (None, after("1 of 3")));
        assert_eq!(told(Some("7")), (None, None));
    }
}
