//! Available memory, measured before an image is denoised.
//!
//! On Linux, it is the least that the machine, each control group of this process (containers,
//! batch systems), and the process's own limits (`ulimit -v`, `ulimit -d`) leave. Memory that this
//! process keeps for its next image counts as available. On other systems it is unknown, and no
//! image is refused.

use std::fs;
use std::path::{Path, PathBuf};

use burn::tensor::Device;
use demc_model::inference::reusable_bytes;

/// The smallest tile of an image does not fit into memory.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "{width}x{height} pixels do not fit into memory: the smallest tile, at most {tile} x {tile}, needs {needed} MiB in addition to the network; {available} MiB are available"
)]
pub struct TooLarge {
    /// The image's width in pixels, padded.
    pub width: usize,
    /// The image's height in pixels, padded.
    pub height: usize,
    /// Longest side of the smallest tile with its halo, pixels.
    pub tile: usize,
    /// Its required memory, MiB.
    pub needed: u64,
    /// Available memory, MiB.
    pub available: u64,
}

/// Assumed bytes for a pass on a device that does not report its memory (ours: half of a small
/// graphics card).
const ASSUMED_BUDGET: u64 = 4 << 30;

/// Bytes that a pass on `device` may use; `None` if unknown.
pub fn budget(device: &Device) -> Option<u64> {
    if *device == Device::flex() {
        available()
    } else {
        Some(ASSUMED_BUDGET)
    }
}

/// Bytes that this process can still allocate without swapping; `None` if the system does not
/// report it.
pub fn available() -> Option<u64> {
    available_below(Path::new("/")).map(|bytes| bytes + reusable_bytes())
}

fn available_below(root: &Path) -> Option<u64> {
    let machine = value(&root.join("proc/meminfo"), "MemAvailable:")? << 10;
    let groups = control_groups(root).into_iter();
    groups
        .filter_map(|group| group.available())
        .chain(own_limits(root))
        .chain([machine])
        .min()
}

/// Bytes that the limits of this process (`ulimit -v`, `ulimit -d`) leave; `None` without limits.
pub fn below_own_limits() -> Option<u64> {
    own_limits(Path::new("/")).into_iter().min()
}

/// Address space beside buffers that a limited process needs, in bytes: threads, and the ends of
/// large pages (ours).
const SPARE: u64 = 64 << 20;

/// What the limits of this process leave; nothing without limits.
fn own_limits(root: &Path) -> Vec<u64> {
    let process = root.join("proc/self");
    let limits = fs::read_to_string(process.join("limits")).unwrap_or_default();
    let left = |(limit, used): (&str, &str)| {
        // Without a limit, the line has `unlimited`.
        let line = limits.lines().find_map(|line| line.strip_prefix(limit))?;
        let limit: u64 = line.split_whitespace().next()?.parse().ok()?;
        let used = value(&process.join("status"), used)? << 10;
        Some(limit.saturating_sub(used + SPARE))
    };
    let both = [
        ("Max address space", "VmSize:"),
        ("Max data size", "VmData:"),
    ];
    both.into_iter().filter_map(left).collect()
}

/// A control group of version 1 or 2.
struct ControlGroup {
    folder: PathBuf,
    /// Names of the files with limit and usage, and of the entry with reclaimable file caches.
    names: [&'static str; 3],
}

impl ControlGroup {
    /// Available bytes below its limit; `None` without a limit.
    fn available(&self) -> Option<u64> {
        let [limit_name, usage_name, caches_name] = self.names;
        let number = |name| {
            fs::read_to_string(self.folder.join(name))
                .ok()?
                .trim()
                .parse()
                .ok()
        };
        // Without a limit, the file holds `max`.
        let limit: u64 = number(limit_name)?;
        let used: u64 = number(usage_name)?;
        let caches = value(&self.folder.join("memory.stat"), caches_name).unwrap_or(0);
        Some(limit.saturating_sub(used.saturating_sub(caches)))
    }
}

/// The control groups of this process and their ancestors; each may have a limit.
fn control_groups(root: &Path) -> Vec<ControlGroup> {
    const VERSION_1: [&str; 3] = [
        "memory.limit_in_bytes",
        "memory.usage_in_bytes",
        "total_inactive_file",
    ];
    const VERSION_2: [&str; 3] = ["memory.max", "memory.current", "inactive_file"];
    let lines = fs::read_to_string(root.join("proc/self/cgroup")).unwrap_or_default();
    let mut groups = Vec::new();
    for line in lines.lines() {
        // Fields: hierarchy, controllers, path. Version 2 has no controllers.
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
        groups.extend(above.map(|path| ControlGroup {
            folder: root.join(folder).join(path),
            names,
        }));
    }
    groups
}

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
    fn available_memory_is_the_minimum_of_machine_and_groups() {
        let available = |files: &[(&str, &str)]| available_below(system(files).path());
        assert_eq!(available(&[]), None);
        assert_eq!(available(&[MACHINE]), Some(4000 << 10));
        // Version 2: only the parent group has a limit; caches are reclaimable.
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
        // Version 1 in a container whose path is not mounted.
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
    fn limits_of_the_process_count() {
        let available = |space: &str, data: &str| {
            let limits = format!(
                "Limit  Soft Limit  Hard Limit  Units\n\
                 Max data size             {data}            unlimited            bytes     \n\
                 Max address space         {space}           unlimited            bytes     \n"
            );
            let root = system(&[
                ("proc/meminfo", "MemAvailable: 4000000 kB\n"),
                ("proc/self/limits", &limits),
                (
                    "proc/self/status",
                    "Name: demc\nVmSize:  1000 kB\nVmData:  500 kB\n",
                ),
            ]);
            available_below(root.path())
        };
        let bytes = |used: u64| Some((1 << 30) - (used << 10) - SPARE);
        assert_eq!(available("unlimited", "unlimited"), Some(4_000_000 << 10));
        assert_eq!(available("1073741824", "unlimited"), bytes(1000));
        assert_eq!(available("unlimited", "1073741824"), bytes(500));
        assert_eq!(available("1", "unlimited"), Some(0));
    }

    #[test]
    #[cfg(target_os = "linux")]
    fn this_machine_reports_its_memory() {
        assert!(available().is_some_and(|bytes| bytes > 1 << 20));
    }
}
