//! Event files for TensorBoard: scalars, pictures and text of a run, written by hand because no crate that does it is
//! maintained.
//!
//! A directory is a run and holds one file a session; readers take them in the order of their names. A session opens a
//! file of its own and nobody writes into an older one: a crash that tears the last record harms nothing, because
//! readers leave a torn record out and go on with the next file.
//!
//! A resumed run takes steps again. Every file begins with `SessionLog` START at the first step that its session takes,
//! upon which TensorBoard forgets what it has of that step and later ones. The first file has it as well: it could be
//! the third attempt of a run that never came to a checkpoint, and TensorBoard takes the first START of a directory for
//! the beginning and only those after it for restarts (`plugin_event_accumulator.py`). Two readers do less: the data
//! server of the fast loading path knows no START and replaces a series from the step at which its next value arrives,
//! and `event_accumulator.py` never forgets text.
//!
//! `tests/tensorboard.rs` reads what is written here with the `tensorboard` package.

mod proto;
mod record;

use std::fs::{self, File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use anyhow::Context;

use proto::{Event, Kind, Message, SessionLog, SessionStatus, Summary, Tensor, Value, What};

/// How the names of event files begin; the second of their opening follows.
const PREFIX: &str = "events.out.tfevents.";
/// From version 2 on readers heed the START of a session.
const VERSION: &str = "brain.Event:2";

/// One event file of a run, open for more.
///
/// Every call writes one whole record and keeps nothing back. After an error the file may end in a part of a record,
/// behind which readers find nothing.
#[derive(Debug)]
pub struct Events {
    file: File,
    path: PathBuf,
}

impl Events {
    /// Begins a new event file in `dir` (made if missing) for a session whose first new step is the one after `step`.
    ///
    /// Readers forget what the files that are already there say of steps after `step`. The name
    /// `events.out.tfevents.<second>.demc.<process>.<files before>` sorts after those of all files that are there.
    ///
    /// # Errors
    /// A directory that cannot be made or read, a file that cannot be written.
    pub fn open(dir: &Path, step: u64) -> anyhow::Result<Self> {
        fs::create_dir_all(dir).with_context(|| format!("cannot make {}", dir.display()))?;
        let name = next_name(dir).with_context(|| dir.display().to_string())?;
        let path = dir.join(name);
        let file = OpenOptions::new().create_new(true).append(true).open(&path);
        let file = file.with_context(|| path.display().to_string())?;
        let mut events = Events { file, path };
        events.write(0, What::FileVersion(VERSION.to_string()))?;
        let status = SessionStatus::Start.into();
        events.write(step + 1, What::SessionLog(SessionLog { status }))?;
        Ok(events)
    }

    /// Scalars of one step, rounded to single precision; NaN and infinity are written as they are.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn scalars(&mut self, step: u64, values: &[(&str, f64)]) -> anyhow::Result<()> {
        let value = |&(tag, value): &(&str, f64)| Value {
            tag: tag.to_string(),
            metadata: None,
            kind: Some(Kind::SimpleValue(value as f32)),
        };
        let value = values.iter().map(value).collect();
        self.write(step, What::Summary(Summary { value }))
    }

    /// A PNG of `width` x `height` pixels, RGB.
    ///
    /// # Errors
    /// A size beyond 2^31 pixels a side; a file that cannot be written.
    pub fn image(
        &mut self,
        step: u64,
        tag: &str,
        width: usize,
        height: usize,
        png: &[u8],
    ) -> anyhow::Result<()> {
        let pixels = |side: usize| {
            i32::try_from(side)
                .with_context(|| format!("{}: {tag} is {side} pixels long", self.path.display()))
        };
        let image = proto::Image {
            height: pixels(height)?,
            width: pixels(width)?,
            colorspace: proto::RGB,
            encoded_image_string: png.to_vec(),
        };
        let value = vec![Value {
            tag: tag.to_string(),
            metadata: None,
            kind: Some(Kind::Image(image)),
        }];
        self.write(step, What::Summary(Summary { value }))
    }

    /// Text shown as Markdown (the run's configuration), TensorBoard's text plugin.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn text(&mut self, step: u64, tag: &str, markdown: &str) -> anyhow::Result<()> {
        let plugin_data = Some(proto::PluginData {
            plugin_name: "text".to_string(),
        });
        let text = Tensor {
            dtype: proto::DT_STRING,
            tensor_shape: Some(proto::TensorShape {}),
            string_val: vec![markdown.as_bytes().to_vec()],
        };
        let value = vec![Value {
            tag: tag.to_string(),
            metadata: Some(proto::SummaryMetadata { plugin_data }),
            kind: Some(Kind::Tensor(text)),
        }];
        self.write(step, What::Summary(Summary { value }))
    }

    /// Appends a record with one write, so that a reader finds all of it or, for a moment, a part that it waits for.
    fn write(&mut self, step: u64, what: What) -> anyhow::Result<()> {
        let name = || self.path.display().to_string();
        let event = Event {
            wall_time: wall_time(),
            step: i64::try_from(step).with_context(|| format!("{}: step {step}", name()))?,
            what: Some(what),
        };
        self.file
            .write_all(&record::framed(&event.encode_to_vec()))
            .with_context(name)
    }
}

/// A name that sorts after those of the event files in `dir`. The second decides alone: process ids of unequal length
/// sort in no useful order, and the clock may have been set back. So it is the present one or the one after the latest.
fn next_name(dir: &Path) -> std::io::Result<String> {
    let mut second = wall_time() as u64;
    let mut files = 0;
    for entry in fs::read_dir(dir)? {
        if let Some(there) = second_of(&entry?.file_name().to_string_lossy()) {
            second = second.max(there.saturating_add(1));
            files += 1;
        }
    }
    let process = std::process::id();
    Ok(format!("{PREFIX}{second:010}.demc.{process}.{files}"))
}

/// The second in the name of an event file.
fn second_of(name: &str) -> Option<u64> {
    let (second, _) = name.strip_prefix(PREFIX)?.split_once('.')?;
    second.parse().ok()
}

/// Seconds since 1970.
fn wall_time() -> f64 {
    let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
    since.unwrap_or_default().as_secs_f64()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(path: &Path) -> Vec<Event> {
        let records = record::unframed(&fs::read(path).unwrap());
        let event = |data: &Vec<u8>| Event::decode(&data[..]).unwrap();
        records.iter().map(event).collect()
    }

    #[test]
    fn every_file_begins_with_version_and_start_at_the_first_step_to_come() {
        let dir = tempfile::tempdir().unwrap();
        for step in [0, 4] {
            let events = Events::open(dir.path(), step).unwrap();
            let [version, start] = &read(&events.path)[..] else {
                panic!("two events");
            };
            assert_eq!(version.what, Some(What::FileVersion(VERSION.to_string())));
            assert_eq!(start.step, step as i64 + 1);
            let status = SessionStatus::Start as i32;
            assert_eq!(start.what, Some(What::SessionLog(SessionLog { status })));
        }
    }

    #[test]
    fn later_file_sorts_after_earlier_ones_in_the_same_second_and_with_a_clock_set_back() {
        let parent = tempfile::tempdir().unwrap();
        let dir = parent.path().join("made");
        let opened: Vec<PathBuf> = (0..12)
            .map(|_| Events::open(&dir, 0).unwrap().path)
            .collect();
        assert!(opened.is_sorted_by(|a, b| a < b), "{opened:?}");

        let ahead = dir.join("events.out.tfevents.4000000000.zebra.99.0.v2");
        fs::write(&ahead, "").unwrap();
        let last = Events::open(&dir, 0).unwrap().path;
        assert!(ahead < last, "{last:?}");
        assert_eq!(fs::read_dir(&dir).unwrap().count(), 14);
    }

    #[test]
    fn record_is_in_the_file_when_the_call_returns() {
        let dir = tempfile::tempdir().unwrap();
        let mut events = Events::open(dir.path(), 0).unwrap();
        events.scalars(3, &[("a", 0.0), ("b", f64::NAN)]).unwrap();
        let read = read(&events.path);
        let Some(What::Summary(summary)) = &read[2].what else {
            panic!("scalars");
        };
        assert_eq!((read.len(), read[2].step), (3, 3));
        assert_eq!(summary.value[0].kind, Some(Kind::SimpleValue(0.0)));
        assert!(matches!(summary.value[1].kind, Some(Kind::SimpleValue(b)) if b.is_nan()));
    }

    #[test]
    fn error_names_the_path() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("file");
        fs::write(&file, "").unwrap();
        let error = format!("{:#}", Events::open(&file, 0).unwrap_err());
        assert!(error.contains(file.to_str().unwrap()), "{error}");
        let mut events = Events::open(dir.path(), 0).unwrap();
        let error = format!("{:#}", events.scalars(u64::MAX, &[]).unwrap_err());
        assert!(error.contains(events.path.to_str().unwrap()), "{error}");
    }
}
