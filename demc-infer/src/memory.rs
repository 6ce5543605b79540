//! How much memory a pass takes and how much is there, asked before an image is denoised.
//!
//! What a pass takes is known beforehand ([`demc_model::inference::peak_bytes`]); what is there, on Linux, is the least of
//! what the machine has left and what the limits of this process's control groups leave (containers, batch systems).
//! Memory that this process keeps for its next image counts as left. Elsewhere nothing is known and nothing refused.

use std::fs;
use std::path::{Path, PathBuf};

use burn::tensor::Device;
use demc_model::inference::{peak_bytes, reusable_bytes};
use demc_model::{ModelConfig, Ops};

/// An image of which not even the smallest tile fits into memory.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "{width}x{height} pixels do not fit into memory: a tile of at most {tile} x {tile} takes {needed} MiB beside the network, {available} MiB are available"
)]
pub struct TooLarge {
    /// The image's width in pixels, padded.
    pub width: usize,
    /// The image's height in pixels, padded.
    pub height: usize,
    /// Longest side of the smallest tile with its halo, pixels.
    pub tile: usize,
    /// What it needs, MiB.
    pub needed: u64,
    /// What is there, MiB.
    pub available: u64,
}

/// Values that Burn's own operations hold at a time, for each value of the largest map; 7 to 8 were measured (`--ops burn` on `flex`, width 16, the paper's
/// levels, 256x256 to 1280x720).
const STOCK_VALUES: u64 = 10;

/// What a pass may take on a device that does not tell its memory, bytes (ours: half of a small graphics card).
const UNTOLD: u64 = 4 << 30;

/// Bytes that a pass over `height` x `width` pixels, multiples of 32, takes beside the network where `ops` compute.
pub fn pass_bytes(ops: Ops, config: &ModelConfig, height: usize, width: usize) -> u64 {
    match ops {
        Ops::Kernels => peak_bytes(config, height, width),
        Ops::Burn => {
            // Of the fusion sub-network and of each level, a quarter of the pixels from one to the next.
            let levels = config.level_channels().into_iter().enumerate();
            let maps = levels.map(|(level, channels)| (channels * height * width) >> (2 * level));
            let largest = maps.fold(config.width * height * width, usize::max);
            STOCK_VALUES * largest as u64 * size_of::<f32>() as u64
        }
    }
}

/// What a pass on `device` may take, bytes; none where nothing is known.
pub fn budget(device: &Device) -> Option<u64> {
    match *device == Device::flex() {
        true => available(),
        false => Some(UNTOLD),
    }
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
