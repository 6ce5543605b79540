//! Expands input arguments into files: files, directories, glob patterns, frame sequences.

use std::collections::HashSet;
use std::ffi::{OsStr, OsString};
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
    /// Says which directories, patterns, and sequences have no images.
    pub empty: Vec<String>,
}

/// A frame sequence.
#[derive(Debug)]
pub struct Sequence {
    /// Its chosen frames.
    pub files: Vec<PathBuf>,
    /// All its frames by number: the same for every choice of frames.
    pub frames: Vec<(u64, PathBuf)>,
    /// Names the missing frames, if there are any.
    pub missing: Option<String>,
    /// Says how many chosen frames are after the last one, if there are any.
    pub after: Option<String>,
}

impl Inputs {
    /// Expands `arguments`.
    ///
    /// - A file stands for itself, a directory for its `*.exr` without hidden ones, links without a target
    ///   included. A file that stands for several arguments counts once.
    /// - `shot.####.exr` and `shot.%04d.exr` stand for the frames of a sequence.
    /// - Names with `*`, `?` or `[..]` are glob patterns if no such file exists.
    ///
    /// # Errors
    /// A directory that cannot be read; a pattern that cannot be understood; `frames` without a sequence.
    pub fn expand(arguments: &[PathBuf], frames: Option<&Frames>) -> Result<Self, UsageError> {
        let mut files = Vec::new();
        let mut several = arguments.len() > 1;
        let (mut sequences, mut empty) = (Vec::new(), Vec::new());
        for argument in arguments {
            let found = if argument.is_file() {
                vec![argument.clone()]
            } else if argument.is_dir() {
                several = true;
                directory(argument)?
            } else if let Some(field) = padded_with_spaces(argument) {
                return Err(UsageError(format!(
                    "{}: {field} pads numbers with spaces; write %0{}",
                    argument.display(),
                    &field[1..]
                )));
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
                empty.push(format!(
                    "{}: no images found{}",
                    argument.display(),
                    hint(argument)
                ));
            }
            files.extend(found);
        }
        let mut seen = HashSet::new();
        files.retain(|file| seen.insert(place(file)));
        if frames.is_some() && sequences.is_empty() {
            let message = "--frames needs a sequence among the inputs, such as shot.####.exr";
            return Err(UsageError(message.into()));
        }
        Ok(Self {
            files,
            several,
            sequences,
            empty,
        })
    }

    /// Reports arguments without images and missing frames of sequences, and notes those after their ends.
    /// Returns the number of such arguments.
    pub fn report_missing(&self) -> usize {
        for empty in &self.empty {
            message::say(format_args!("error: {empty}"));
        }
        let after = self.sequences.iter();
        for after in after.filter_map(|sequence| sequence.after.as_ref()) {
            message::say(format_args!("note: {after}"));
        }
        let lacking = self
            .sequences
            .iter()
            .filter_map(|sequence| sequence.missing.as_ref())
            .inspect(|missing| message::say(format_args!("error: {missing}")))
            .count();
        lacking + self.empty.len()
    }
}

/// Where a file is: its directory without links, and its name. Two links to one file have two places.
fn place(file: &Path) -> (PathBuf, OsString) {
    let parent = match file.parent() {
        Some(parent) if parent != Path::new("") => parent,
        _ => Path::new("."),
    };
    let directory = fs::canonicalize(parent).unwrap_or_else(|_| parent.to_owned());
    (directory, file.file_name().unwrap_or_default().to_owned())
}

/// What may help with a directory that has no images but directories.
fn hint(argument: &Path) -> String {
    let entries = entries(argument).unwrap_or_default();
    match entries.iter().filter(|path| path.is_dir()).count() {
        0 => String::new(),
        count => {
            let pattern = argument.join("*").join("*.exr");
            format!(
                " in it; it has {count} directories: try '{}'",
                pattern.display()
            )
        }
    }
}

fn directory(path: &Path) -> Result<Vec<PathBuf>, UsageError> {
    let mut files: Vec<PathBuf> = entries(path)?
        .into_iter()
        // Reading anything but a file gives the best error.
        .filter(|file| is_exr(file) && !is_hidden(file) && !file.is_dir())
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

fn is_hidden(path: &Path) -> bool {
    let name = path.file_name().map(OsStr::as_encoded_bytes);
    name.is_some_and(|name| name.starts_with(b"."))
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
    let options = glob::MatchOptions {
        // As in a shell.
        require_literal_leading_dot: true,
        ..glob::MatchOptions::new()
    };
    let found = glob::glob_with(text, options).map_err(|source| error(&source))?;
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
        let all_found = found.clone();
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
            frames: all_found,
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

/// A field such as `%4d` in a file name, which is a number padded with spaces.
fn padded_with_spaces(argument: &Path) -> Option<String> {
    let name = argument.file_name()?.to_str()?;
    let field = percent(name)?.place;
    let is_padded = field.len() > 2;
    (is_padded && !name[field.start + 1..].starts_with('0')).then(|| name[field].to_owned())
}

/// `%d` or `%04d`.
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
            let path = dir.path().join(name);
            fs::create_dir_all(path.parent().expect("a directory")).expect("a directory");
            fs::write(path, "").expect("a file");
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
    fn arguments_without_images_are_named_and_others_go_on() {
        let dir = directory_of(&["a.txt", ".hidden.exr", "sub/b.exr"]);
        let file = dir.path().join("sub/b.exr");
        for argument in ["*.exr", "s.####.exr"] {
            let found = Inputs::expand(&[dir.path().join(argument), file.clone()], None);
            let found = found.expect("one file");
            assert_eq!(found.files, std::slice::from_ref(&file));
            assert!(
                found.empty[0].ends_with("no images found"),
                "{:?}",
                found.empty
            );
        }
        let found = Inputs::expand(&[dir.path().to_owned()], None).expect("no file");
        let hint = format!(
            "it has 1 directories: try '{}/*/*.exr'",
            dir.path().display()
        );
        assert!(found.empty[0].ends_with(&hint), "{:?}", found.empty);
        let absent = dir.path().join("absent.exr");
        let found = Inputs::expand(std::slice::from_ref(&absent), None).expect("as it is");
        assert_eq!((found.files, found.several), (vec![absent], false));
        let twice = [dir.path().join("sub"), dir.path().join("sub/../sub/b.exr")];
        let found = Inputs::expand(&twice, None).expect("as it is");
        assert_eq!(found.files, [file]);
        let frames = "1-2".parse().ok();
        let error = Inputs::expand(&["a.exr".into()], frames.as_ref()).expect_err("no sequence");
        assert!(error.to_string().starts_with("--frames needs"), "{error}");
    }

    #[test]
    fn a_number_padded_with_spaces_is_refused() {
        let error = Inputs::expand(&["shot.%4d.exr".into()], None).expect_err("spaces");
        let why = "shot.%4d.exr: %4d pads numbers with spaces; write %04d";
        assert_eq!(error.to_string(), why);
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
