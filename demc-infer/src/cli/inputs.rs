//! Expands input arguments into files: files, directories, glob patterns, frame sequences.

use std::collections::HashSet;
use std::ffi::{OsStr, OsString};
use std::fs;
use std::ops::Range;
use std::path::{Path, PathBuf};

use demc_program::exit::UsageError;
use demc_program::message;
use demc_program::output::Outputs;

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
    /// Says which directories, patterns, and sequences have no images, or cannot be read.
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
    /// A pattern that cannot be understood; `frames` without a sequence.
    pub fn expand(arguments: &[PathBuf], frames: Option<&Frames>) -> Result<Self, UsageError> {
        let mut files = Vec::new();
        let mut several = arguments.len() > 1;
        let (mut sequences, mut empty) = (Vec::new(), Vec::new());
        for argument in arguments {
            let mut unreadable = Vec::new();
            let found = if argument.is_file() {
                vec![argument.clone()]
            } else if argument.is_dir() {
                several = true;
                readable(directory(argument), &mut unreadable)
            } else if let Some(field) = padded_with_spaces(argument) {
                return Err(UsageError(format!(
                    "{}: {field} pads numbers with spaces; write %0{}",
                    argument.display(),
                    &field[1..]
                )));
            } else if let Some(pattern) = SequencePattern::parse(argument) {
                several = true;
                match pattern.expand(frames)? {
                    Ok(sequence) => {
                        let files = sequence.files.clone();
                        sequences.push(sequence);
                        files
                    }
                    Err(error) => readable(Err(error), &mut unreadable),
                }
            } else if is_pattern(argument) {
                several = true;
                pattern(argument, &mut unreadable)?
            } else {
                // Reading the file gives the best error.
                vec![argument.clone()]
            };
            if !unreadable.is_empty() {
                empty.append(&mut unreadable);
            } else if found.is_empty() {
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

    /// Protects all images, also those that other shards or frames are made of, from being replaced.
    pub fn protect(&self, outputs: &mut Outputs) {
        let frames = self.sequences.iter().flat_map(|sequence| &sequence.frames);
        let frames = frames.map(|(_, file)| file);
        for file in self.files.iter().chain(frames) {
            outputs.protect(file, &format!("the input {}", file.display()));
        }
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
pub type Place = (PathBuf, OsString);

/// The place of a file.
pub fn place(file: &Path) -> Place {
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

/// The files, or none and the error in `unreadable`.
fn readable(found: Result<Vec<PathBuf>, String>, unreadable: &mut Vec<String>) -> Vec<PathBuf> {
    found.unwrap_or_else(|error| {
        unreadable.push(error);
        Vec::new()
    })
}

fn directory(path: &Path) -> Result<Vec<PathBuf>, String> {
    let mut files: Vec<PathBuf> = entries(path)?
        .into_iter()
        // Reading anything but a file gives the best error.
        .filter(|file| is_exr(file) && !is_hidden(file) && !file.is_dir())
        .collect();
    files.sort();
    Ok(files)
}

fn entries(path: &Path) -> Result<Vec<PathBuf>, String> {
    let error = |error| format!("{}: {error}", path.display());
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

/// The files that match; directories that cannot be read go to `unreadable`.
fn pattern(argument: &Path, unreadable: &mut Vec<String>) -> Result<Vec<PathBuf>, UsageError> {
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
        let path = match path {
            Ok(path) => path,
            Err(source) => {
                unreadable.push(format!("{}: {}", source.path().display(), source.error()));
                continue;
            }
        };
        if !path.is_dir() && !has_hidden(&path, argument) {
            files.push(path);
        }
    }
    Ok(files)
}

/// Whether a path has a hidden component that no component of the pattern asks for by its first dot. As in
/// a shell; the crate's own option panics at names that are not UTF-8.
fn has_hidden(path: &Path, pattern: &Path) -> bool {
    let dotted = |path: &Path| {
        let names = path.components().map(|part| part.as_os_str().to_owned());
        let hidden = names.filter(|name| name.as_encoded_bytes().starts_with(b"."));
        let hidden = hidden.filter(|name| name != "." && name != "..");
        hidden.collect::<Vec<OsString>>()
    };
    let asked: Vec<glob::Pattern> = dotted(pattern)
        .iter()
        .filter_map(|name| glob::Pattern::new(name.to_str()?).ok())
        .collect();
    dotted(path).iter().any(|name| {
        let name = name.to_string_lossy();
        !asked.iter().any(|pattern| pattern.matches(&name))
    })
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

    /// The sequence, or why its directory cannot be read.
    ///
    /// # Errors
    /// None of the chosen frames exists.
    fn expand(&self, frames: Option<&Frames>) -> Result<Result<Sequence, String>, UsageError> {
        let parent = match self.argument.parent() {
            Some(parent) if parent != Path::new("") => parent,
            _ => Path::new("."),
        };
        let files = match entries(parent) {
            Ok(files) => files,
            Err(error) => return Ok(Err(error)),
        };
        let mut found: Vec<(u64, PathBuf)> = files
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
        Ok(Ok(Sequence {
            files: found.into_iter().map(|(_, path)| path).collect(),
            frames: all_found,
            missing,
            after,
        }))
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
mod tests;
