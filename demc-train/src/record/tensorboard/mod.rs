//! Event files for TensorBoard: scalars, pictures and text of a run. No maintained crate writes
//! them.
//!
//! A run has one directory, with one file per session. Readers process the files in the order of
//! their names. No session writes into an older file, and readers skip an incomplete record at the
//! end of a file, so a crash loses at most one record.
//!
//! A resumed run repeats steps. Every file starts with a `SessionLog` START at the first step of
//! its session: TensorBoard then drops its data of that step and later ones.
//!
//! - The first file has a START too, because it may follow a run that never wrote a checkpoint.
//!   TensorBoard takes only later STARTs for restarts (`plugin_event_accumulator.py`).
//! - The data server of the fast loading path ignores START. It replaces a series from the step of
//!   its next value.
//! - `event_accumulator.py` never drops text.
//!
//! `tests/suite/tensorboard.rs` reads these files with the `tensorboard` package.

mod proto;
mod record;

use std::fs::{self, File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use anyhow::Context;

use proto::{
    Event, EventContent, EventSummary, Message, SessionLog, SessionStatus, StringTensor,
    SummaryKind, SummaryValue,
};

/// Start of the names of event files; the time in seconds follows.
const PREFIX: &str = "events.out.tfevents.";
/// From version 2 on, readers process the START of a session.
const VERSION: &str = "brain.Event:2";

/// An event file, open to append.
///
/// Every call writes one complete record without a buffer. After an error the file may end with an
/// incomplete record; readers ignore everything after it.
#[derive(Debug)]
pub struct EventFile {
    file: File,
    path: PathBuf,
}

impl EventFile {
    /// Creates an event file in `dir`, which is created if missing, for the steps after `step`.
    ///
    /// Readers drop the data of later steps from existing files. The name
    /// `events.out.tfevents.<second>.demc.<process>.<number>` sorts after those of all existing
    /// files.
    ///
    /// # Errors
    /// A directory that cannot be created or read; a file that cannot be written.
    pub fn open(dir: &Path, step: u64) -> anyhow::Result<Self> {
        fs::create_dir_all(dir).with_context(|| format!("cannot create {}", dir.display()))?;
        let name = next_name(dir).with_context(|| dir.display().to_string())?;
        let path = dir.join(name);
        let file = OpenOptions::new()
            .create_new(true)
            .append(true)
            .open(&path)
            .with_context(|| path.display().to_string())?;
        let mut events = EventFile { file, path };
        events.write(0, EventContent::FileVersion(VERSION.to_string()))?;
        let status = SessionStatus::Start.into();
        events.write(step + 1, EventContent::SessionLog(SessionLog { status }))?;
        Ok(events)
    }

    /// Writes scalars of one step in single precision, NaN and infinity included.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn scalars(&mut self, step: u64, values: &[(&str, f64)]) -> anyhow::Result<()> {
        let value = |&(tag, value): &(&str, f64)| SummaryValue {
            tag: tag.to_string(),
            metadata: None,
            kind: Some(SummaryKind::SimpleValue(value as f32)),
        };
        let value = values.iter().map(value).collect();
        self.write(step, EventContent::Summary(EventSummary { value }))
    }

    /// Writes an RGB image of `width` x `height` pixels in PNG format.
    ///
    /// # Errors
    /// A side of 2^31 pixels or more; a file that cannot be written.
    pub fn image(
        &mut self,
        step: u64,
        tag: &str,
        width: usize,
        height: usize,
        png: &[u8],
    ) -> anyhow::Result<()> {
        let pixels = |side: usize| {
            i32::try_from(side).with_context(|| {
                format!(
                    "{}: {tag}: expected a side below 2^31 pixels, found {side}",
                    self.path.display()
                )
            })
        };
        let image = proto::EncodedImage {
            height: pixels(height)?,
            width: pixels(width)?,
            colorspace: proto::RGB,
            encoded_image_string: png.to_vec(),
        };
        let value = vec![SummaryValue {
            tag: tag.to_string(),
            metadata: None,
            kind: Some(SummaryKind::Image(image)),
        }];
        self.write(step, EventContent::Summary(EventSummary { value }))
    }

    /// Writes Markdown for TensorBoard's text plugin: the configuration of the run.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn text(&mut self, step: u64, tag: &str, markdown: &str) -> anyhow::Result<()> {
        let plugin_data = Some(proto::PluginData {
            plugin_name: "text".to_string(),
        });
        let text = StringTensor {
            dtype: proto::DT_STRING,
            tensor_shape: Some(proto::TensorShape {}),
            string_val: vec![markdown.as_bytes().to_vec()],
        };
        let value = vec![SummaryValue {
            tag: tag.to_string(),
            metadata: Some(proto::SummaryMetadata { plugin_data }),
            kind: Some(SummaryKind::Tensor(text)),
        }];
        self.write(step, EventContent::Summary(EventSummary { value }))
    }

    /// Appends a record with a single write.
    fn write(&mut self, step: u64, content: EventContent) -> anyhow::Result<()> {
        let name = || self.path.display().to_string();
        let event = Event {
            wall_time: wall_time(),
            step: i64::try_from(step).with_context(|| format!("{}: step {step}", name()))?,
            what: Some(content),
        };
        self.file
            .write_all(&record::framed(&event.encode_to_vec()))
            .with_context(name)
    }
}

/// A name that sorts after those of the event files in `dir`.
///
/// Its second is the present one, or the one after the latest file: the clock may have been set
/// back, and process ids sort in no useful order.
fn next_name(dir: &Path) -> std::io::Result<String> {
    let mut second = wall_time() as u64;
    let mut files = 0;
    for entry in fs::read_dir(dir)? {
        if let Some(latest) = second_of(&entry?.file_name().to_string_lossy()) {
            second = second.max(latest.saturating_add(1));
            files += 1;
        }
    }
    let process = std::process::id();
    Ok(format!("{PREFIX}{second:010}.demc.{process}.{files}"))
}

fn second_of(name: &str) -> Option<u64> {
    let (second, _) = name.strip_prefix(PREFIX)?.split_once('.')?;
    second.parse().ok()
}

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
    fn every_file_starts_with_version_and_start_at_its_first_step() {
        let dir = tempfile::tempdir().unwrap();
        for step in [0, 4] {
            let events = EventFile::open(dir.path(), step).unwrap();
            let [version, start] = &read(&events.path)[..] else {
                panic!("two events");
            };
            assert_eq!(
                version.what,
                Some(EventContent::FileVersion(VERSION.to_string()))
            );
            assert_eq!(start.step, step as i64 + 1);
            let status = SessionStatus::Start as i32;
            assert_eq!(
                start.what,
                Some(EventContent::SessionLog(SessionLog { status }))
            );
        }
    }

    #[test]
    fn a_later_file_sorts_last_in_the_same_second_and_after_a_clock_change() {
        let parent = tempfile::tempdir().unwrap();
        let dir = parent.path().join("made");
        let opened: Vec<PathBuf> = (0..12)
            .map(|_| EventFile::open(&dir, 0).unwrap().path)
            .collect();
        assert!(opened.is_sorted_by(|a, b| a < b), "{opened:?}");

        let ahead = dir.join("events.out.tfevents.4000000000.zebra.99.0.v2");
        fs::write(&ahead, "").unwrap();
        let last = EventFile::open(&dir, 0).unwrap().path;
        assert!(ahead < last, "{last:?}");
        assert_eq!(fs::read_dir(&dir).unwrap().count(), 14);
    }

    #[test]
    fn a_record_is_written_when_the_call_returns() {
        let dir = tempfile::tempdir().unwrap();
        let mut events = EventFile::open(dir.path(), 0).unwrap();
        events.scalars(3, &[("a", 0.0), ("b", f64::NAN)]).unwrap();
        let read = read(&events.path);
        let Some(EventContent::Summary(summary)) = &read[2].what else {
            panic!("scalars");
        };
        assert_eq!((read.len(), read[2].step), (3, 3));
        assert_eq!(summary.value[0].kind, Some(SummaryKind::SimpleValue(0.0)));
        assert!(matches!(summary.value[1].kind, Some(SummaryKind::SimpleValue(b)) if b.is_nan()));
    }

    #[test]
    fn errors_name_the_path() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("file");
        fs::write(&file, "").unwrap();
        let error = format!("{:#}", EventFile::open(&file, 0).unwrap_err());
        assert!(error.contains(file.to_str().unwrap()), "{error}");
        let mut events = EventFile::open(dir.path(), 0).unwrap();
        let error = format!("{:#}", events.scalars(u64::MAX, &[]).unwrap_err());
        assert!(error.contains(events.path.to_str().unwrap()), "{error}");
    }
}
