//! Whether an image fits into the memory that is there, asked before it is denoised.
//!
//! What a pass takes is known beforehand ([`demc_model::inference::peak_bytes`]); what is there, on Linux, is the least of
//! what the machine has left and what the limits of this process's control groups leave (containers, batch systems).
//! Memory that this process keeps for its next image counts as left. Elsewhere nothing is known and nothing refused.

use std::fs;
use std::path::{Path, PathBuf};

use demc_model::inference::{peak_bytes, reusable_bytes};
use demc_model::{DOWNSAMPLING, ModelConfig};

/// An image that needs more memory than there is.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{width}x{height} pixels need {needed} MiB of memory beside the network, {available} MiB are available; {advice}", advice = advice(*.tile))]
pub struct TooLarge {
    /// The image's width in pixels, padded.
    pub width: usize,
    /// The image's height in pixels, padded.
    pub height: usize,
    /// What it needs, MiB.
    pub needed: u64,
    /// What is there, MiB.
    pub available: u64,
    /// Side of the largest square tile that would fit, pixels, a multiple of [`DOWNSAMPLING`]; none if not even the
    /// smallest does.
    pub tile: Option<usize>,
}

fn advice(tile: Option<usize>) -> String {
    match tile {
        Some(side) => format!("cut it into tiles of at most {side} x {side}"),
        None => "not even the smallest tile would fit".into(),
    }
}

/// Refuses an image of `height` x `width` pixels, multiples of [`DOWNSAMPLING`], that does not fit into `available` bytes.
///
/// # Errors
/// Then.
pub fn check(
    config: &ModelConfig,
    height: usize,
    width: usize,
    available: u64,
) -> Result<(), TooLarge> {
    let needed = peak_bytes(config, height, width);
    if needed <= available {
        return Ok(());
    }
    let sides = (1..=height.max(width) / DOWNSAMPLING).map(|count| count * DOWNSAMPLING);
    let tile = sides
        .rev()
        .find(|side| peak_bytes(config, *side, *side) <= available);
    Err(TooLarge {
        width,
        height,
        needed: needed.div_ceil(1 << 20),
        available: available >> 20,
        tile,
    })
}

/// Bytes that this process can still take without swapping; none where the system does not tell.
pub fn available() -> Option<u64> {
    available_below(Path::new("/")).map(|bytes| bytes + reusable_bytes())
}

/// The same by the files below `root`.
fn available_below(root: &Path) -> Option<u64> {
    let machine = value(&root.join("proc/meminfo"), "MemAvailable:")? << 10;
    let groups = control_groups(root).into_iter();
    groups
        .filter_map(|group| group.left())
        .chain([machine])
        .min()
}

/// A control group that may limit memory, of either version.
struct Group {
    folder: PathBuf,
    /// Names of the files with limit and usage, and of the entry of file caches that are given up on demand.
    names: [&'static str; 3],
}

impl Group {
    /// Bytes below its limit; none where it has no limit.
    fn left(&self) -> Option<u64> {
        let [limit, usage, caches] = self.names;
        let number = |name| {
            fs::read_to_string(self.folder.join(name))
                .ok()?
                .trim()
                .parse()
                .ok()
        };
        // `max`, where there is no limit, is no number.
        let limit: u64 = number(limit)?;
        let used: u64 = number(usage)?;
        let caches = value(&self.folder.join("memory.stat"), caches).unwrap_or(0);
        Some(limit.saturating_sub(used.saturating_sub(caches)))
    }
}

/// The control groups that this process is in, and all above them: each may have a limit.
fn control_groups(root: &Path) -> Vec<Group> {
    const VERSION_1: [&str; 3] = [
        "memory.limit_in_bytes",
        "memory.usage_in_bytes",
        "total_inactive_file",
    ];
    const VERSION_2: [&str; 3] = ["memory.max", "memory.current", "inactive_file"];
    let lines = fs::read_to_string(root.join("proc/self/cgroup")).unwrap_or_default();
    let mut groups = Vec::new();
    for line in lines.lines() {
        // Hierarchy, controllers, path; version 2 names no controllers.
        let mut fields = line.splitn(3, ':').skip(1);
        let (Some(controllers), Some(path)) = (fields.next(), fields.next()) else {
            continue;
        };
        let (folder, names) = match controllers {
            "" => ("sys/fs/cgroup", VERSION_2),
            controllers if controllers.split(',').any(|name| name == "memory") => {
                ("sys/fs/cgroup/memory", VERSION_1)
            }
            _ => continue,
        };
        let above = Path::new(path.trim_start_matches('/')).ancestors();
        groups.extend(above.map(|path| Group {
            folder: root.join(folder).join(path),
            names,
        }));
    }
    groups
}

/// The number after `name` at the beginning of a line.
fn value(file: &Path, name: &str) -> Option<u64> {
    let text = fs::read_to_string(file).ok()?;
    let mut fields = text
        .lines()
        .map(str::split_whitespace)
        .find(|fields| fields.clone().next() == Some(name))?;
    fields.nth(1)?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_image_that_does_not_fit_is_refused_with_a_tile_that_does() {
        let config = ModelConfig::default();
        let needed = peak_bytes(&config, 2176, 3840);
        assert_eq!(check(&config, 2176, 3840, needed), Ok(()));
        let available = 1 << 30;
        let error = check(&config, 2176, 3840, available).expect_err("a GiB is not enough");
        let side = error.tile.expect("a tile");
        assert!(side.is_multiple_of(DOWNSAMPLING) && peak_bytes(&config, side, side) <= available);
        let next = side + DOWNSAMPLING;
        assert!(peak_bytes(&config, next, next) > available);
        let needed = needed.div_ceil(1 << 20);
        assert_eq!(
            error.to_string(),
            format!(
                "3840x2176 pixels need {needed} MiB of memory beside the network, 1024 MiB are available; cut it into \
                 tiles of at most {side} x {side}"
            )
        );
        let error = check(&config, 32, 32, 1000).expect_err("a thousand bytes");
        assert!(
            error
                .to_string()
                .ends_with("not even the smallest tile would fit"),
            "{error}"
        );
    }

    /// Files below a root of their own.
    fn system(files: &[(&str, &str)]) -> tempfile::TempDir {
        let root = tempfile::tempdir().expect("a directory");
        for (path, text) in files {
            let path = root.path().join(path);
            fs::create_dir_all(path.parent().expect("a folder")).expect("a folder");
            fs::write(path, text).expect("a file");
        }
        root
    }

    const MACHINE: (&str, &str) = (
        "proc/meminfo",
        "MemTotal: 9000 kB\nMemAvailable:    4000 kB\n",
    );

    #[test]
    fn the_least_of_machine_and_groups_counts() {
        let available = |files: &[(&str, &str)]| available_below(system(files).path());
        assert_eq!(available(&[]), None);
        assert_eq!(available(&[MACHINE]), Some(4000 << 10));
        // Version 2: the group has no limit, the one above it has; caches are given up.
        let unlimited = ("sys/fs/cgroup/job/step/memory.max", "max\n");
        let files = [
            MACHINE,
            ("proc/self/cgroup", "0::/job/step\n"),
            unlimited,
            ("sys/fs/cgroup/job/memory.max", "1000000\n"),
            ("sys/fs/cgroup/job/memory.current", "700000\n"),
            (
                "sys/fs/cgroup/job/memory.stat",
                "anon 1\ninactive_file 200000\n",
            ),
        ];
        assert_eq!(available(&files), Some(500_000));
        assert_eq!(available(&files[..3]), Some(4000 << 10));
        // Version 1, in a container whose own path is not mounted.
        let files = [
            MACHINE,
            (
                "proc/self/cgroup",
                "5:cpu,memory:/docker/1\n4:pids:/\n0::/\n",
            ),
            ("sys/fs/cgroup/memory/memory.limit_in_bytes", "2000000\n"),
            ("sys/fs/cgroup/memory/memory.usage_in_bytes", "1500000\n"),
        ];
        assert_eq!(available(&files), Some(500_000));
    }

    #[test]
    #[cfg(target_os = "linux")]
    fn this_machine_tells() {
        assert!(available().is_some_and(|bytes| bytes > 1 << 20));
    }
}
