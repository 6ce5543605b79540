//! What programs print: text that is safe for a terminal, and output that never ends a program.
//!
//! The libraries print nothing. The programs print with these functions alone; the standard
//! library's macros panic if a stream is closed or full.

use std::fmt::Display;
use std::io::{self, ErrorKind, Write};
use std::sync::atomic::{AtomicBool, Ordering};

use serde::Serialize;

/// Maximum length of a message in characters (ours: a screen).
const LONGEST: usize = 4000;

/// Maximum number of names in a list.
const MOST_NAMES: usize = 20;

/// The same in a short list.
const FEW_NAMES: usize = 5;

/// Whether a terminal would obey the character instead of showing it: control characters, line
/// separators, and marks that change the direction of text.
fn is_hidden(c: char) -> bool {
    let marks =
        matches!(c, '\u{200e}' | '\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}');
    c.is_control() || marks
}

/// Text from a file, a name or an argument, safe to print in one line: control characters are
/// escaped, such as `\n` and `\u{1b}`.
pub fn printable(text: &str) -> String {
    escaped(text, is_hidden, |c| c.escape_default().collect())
}

/// As [`printable`], for text of several lines: line breaks stay.
fn printable_lines(text: &str) -> String {
    escaped(text, is_hidden_in_lines, |c| c.escape_default().collect())
}

/// As [`is_hidden`], for text of several lines.
fn is_hidden_in_lines(c: char) -> bool {
    is_hidden(c) && c != '\n'
}

fn escaped(text: &str, hidden: impl Fn(char) -> bool, escape: impl Fn(char) -> String) -> String {
    let mut safe = String::with_capacity(text.len());
    for c in text.chars() {
        if hidden(c) {
            safe += &escape(c);
        } else {
            safe.push(c);
        }
    }
    safe
}

/// The first 20 names, and the number of the others: `a, b and 7 more`.
pub fn list<S: AsRef<str>>(names: &[S]) -> String {
    first_names(names, MOST_NAMES)
}

/// As [`list`], with 5 names.
pub fn short_list<S: AsRef<str>>(names: &[S]) -> String {
    first_names(names, FEW_NAMES)
}

fn first_names<S: AsRef<str>>(names: &[S], most: usize) -> String {
    let shown = names
        .iter()
        .take(most)
        .map(AsRef::as_ref)
        .collect::<Vec<&str>>()
        .join(", ");
    match names.len().saturating_sub(most) {
        0 => shown,
        more => format!("{shown} and {more} more"),
    }
}

/// Pretty JSON. Control characters in strings are escaped, including those that JSON permits.
///
/// # Errors
/// Those of [`serde_json::to_string_pretty`].
pub fn json(value: &impl Serialize) -> serde_json::Result<String> {
    let text = serde_json::to_string_pretty(value)?;
    // They occur only within strings, and have at most 16 bits.
    let escape = |c| format!("\\u{:04x}", u32::from(c));
    Ok(escaped(&text, is_hidden_in_lines, escape))
}

/// Whether this process prints nothing.
static SILENT: AtomicBool = AtomicBool::new(false);

/// Makes this process print nothing, or print again. Of several processes with one task, one prints.
pub fn silence(silent: bool) {
    SILENT.store(silent, Ordering::Relaxed);
}

/// Whether this process prints nothing.
pub fn is_silent() -> bool {
    SILENT.load(Ordering::Relaxed)
}

/// Prints a message as one line on standard error. Very long messages are cut. A closed or full
/// stream is ignored.
pub fn say(message: impl Display) {
    if SILENT.load(Ordering::Relaxed) {
        return;
    }
    let message = printable(&message.to_string());
    let line = match message.char_indices().nth(LONGEST) {
        Some((end, _)) => {
            let more = message[end..].chars().count();
            format!("{} ... ({more} more characters)\n", &message[..end])
        }
        None => message + "\n",
    };
    // One write, so that lines of several threads do not mix.
    let _ = io::stderr().write_all(line.as_bytes());
}

/// Prints progress or a status on standard output, and a line break. A closed or full stream is
/// ignored.
pub fn status(text: impl Display) {
    let _ = write_lines(&text.to_string());
}

/// Prints a result on standard output, and a line break. A closed pipe (`| head`) is no failure.
///
/// # Errors
/// Standard output cannot be written, for example because a disk is full.
pub fn result(text: &str) -> io::Result<()> {
    match write_lines(text) {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => Err(io::Error::new(
            error.kind(),
            format!("cannot write to standard output: {error}"),
        )),
        _ => Ok(()),
    }
}

fn write_lines(text: &str) -> io::Result<()> {
    if SILENT.load(Ordering::Relaxed) {
        return Ok(());
    }
    let mut out = io::stdout().lock();
    out.write_all((printable_lines(text) + "\n").as_bytes())?;
    out.flush()
}

/// A duration in seconds as `3 days 4 h`, `2 h 5 min`, `3 min 20 s`, `4.2 s`, `250 ms`: at most two units.
pub fn duration(duration: f64) -> String {
    let seconds = duration as u64;
    let (days, hours, minutes) = (seconds / 86_400, seconds / 3600 % 24, seconds / 60 % 60);
    match (days, hours, minutes) {
        (0, 0, 0) if duration < 1.0 => format!("{:.0} ms", 1000.0 * duration),
        (0, 0, 0) => format!("{duration:.1} s"),
        (0, 0, _) => format!("{minutes} min {} s", seconds % 60),
        (0, _, _) => format!("{hours} h {minutes} min"),
        _ => format!("{days} days {hours} h"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_text_controls_a_terminal() {
        let hostile = "a\u{1b}[2J\u{9b}31m\u{7f}\r\n\u{202e}b";
        let safe = r"a\u{1b}[2J\u{9b}31m\u{7f}\r\n\u{202e}b";
        assert_eq!(printable(hostile), safe);
        assert_eq!(printable(safe), safe);
        assert_eq!(printable_lines("a\nb\tc"), "a\nb\\tc");
        assert_eq!(printable("größe 日本"), "größe 日本");
        let text = json(&[hostile]).expect("JSON");
        assert!(!text.contains(is_hidden_in_lines), "{text:?}");
        let back: Vec<String> = serde_json::from_str(&text).expect("still JSON");
        assert_eq!(back, [hostile]);
    }

    #[test]
    fn a_long_list_is_counted() {
        let names = |count: usize| (0..count).map(|i| i.to_string()).collect::<Vec<_>>();
        assert_eq!(list(&names(3)), "0, 1, 2");
        assert_eq!(short_list(&names(6)), "0, 1, 2, 3, 4 and 1 more");
        assert!(list(&names(100)).ends_with("18, 19 and 80 more"));
    }

    #[test]
    fn durations_have_at_most_two_units() {
        assert_eq!(duration(0.25), "250 ms");
        assert_eq!(duration(4.24), "4.2 s");
        assert_eq!(duration(200.0), "3 min 20 s");
        assert_eq!(duration(7500.0), "2 h 5 min");
        assert_eq!(duration(273_700.0), "3 days 4 h");
    }
}
