//! MPI: the start of the ranks, and the exchanges that a training needs.

use mpi::Threading;
use mpi::datatype::{Partition, PartitionMut};
use mpi::environment::{Universe, processor_name};
use mpi::topology::{Color, SimpleCommunicator};
use mpi::traits::{Communicator, CommunicatorCollectives};

use super::placement::NodeShare;

/// A group of ranks.
pub(super) struct Group {
    communicator: SimpleCommunicator,
    /// The node of each rank.
    nodes: Vec<String>,
    on_node: NodeShare,
}

/// The start of MPI. Dropping it ends MPI.
pub struct Launch {
    _universe: Universe,
    on_node: NodeShare,
}

impl Launch {
    /// Starts MPI. Without `mpirun` or `srun` there is one rank.
    ///
    /// # Errors
    /// MPI was started before.
    pub fn start() -> Result<Self, String> {
        // Any thread may end all ranks, so MPI must expect several.
        let (universe, _) =
            mpi::initialize_with_threading(Threading::Multiple).ok_or("MPI was started before")?;
        Ok(Launch {
            on_node: on_node(&universe.world()),
            _universe: universe,
        })
    }

    /// This rank and its node, for messages; `None` for a single rank.
    pub fn name(&self) -> Option<String> {
        let world = SimpleCommunicator::world();
        (world.size() > 1).then(|| format!("rank {} on {}", world.rank(), node()))
    }

    /// Whether this rank prints.
    pub fn is_first(&self) -> bool {
        SimpleCommunicator::world().rank() == 0
    }

    /// This rank among those of its node.
    pub fn on_node(&self) -> NodeShare {
        self.on_node
    }
}

fn on_node(communicator: &SimpleCommunicator) -> NodeShare {
    let local = communicator.split_shared(communicator.rank());
    NodeShare {
        index: as_usize(local.rank()),
        count: as_usize(local.size()),
    }
}

/// Ends all ranks with this exit code. A single rank only returns.
pub fn abort(code: u8) {
    let world = SimpleCommunicator::world();
    if world.size() > 1 {
        world.abort(i32::from(code));
    }
}

fn node() -> String {
    processor_name().unwrap_or_else(|_| "an unnamed node".into())
}

/// MPI counts are not negative.
fn as_usize(count: i32) -> usize {
    usize::try_from(count).unwrap_or(0)
}

/// MPI counts in 32 bits: enough for 2 billion values, which no network here has.
fn as_count(count: usize) -> i32 {
    i32::try_from(count).expect("at most 2 billion values in an exchange")
}

/// Counts and start positions of consecutive parts.
fn parts(counts: &[usize]) -> (Vec<i32>, Vec<i32>) {
    let starts = counts
        .iter()
        .scan(0, |end, count| {
            let start = *end;
            *end += count;
            Some(as_count(start))
        })
        .collect();
    (
        counts.iter().map(|count| as_count(*count)).collect(),
        starts,
    )
}

impl Group {
    pub(super) fn world() -> Option<Self> {
        Self::of(SimpleCommunicator::world())
    }

    /// The ranks that call it with the same number. `None` if there is one.
    pub(super) fn split(&self, number: usize) -> Option<Self> {
        let color = Color::with_value(as_count(number));
        Self::of(self.communicator.split_by_color(color)?)
    }

    fn of(communicator: SimpleCommunicator) -> Option<Self> {
        if communicator.size() < 2 {
            return None;
        }
        let mut group = Group {
            on_node: on_node(&communicator),
            communicator,
            nodes: Vec::new(),
        };
        let names = group.gather_bytes(node().as_bytes());
        let nodes = names.iter().map(|name| String::from_utf8_lossy(name));
        group.nodes = nodes.map(|name| name.into_owned()).collect();
        Some(group)
    }

    pub(super) fn rank(&self) -> usize {
        as_usize(self.communicator.rank())
    }

    pub(super) fn count(&self) -> usize {
        as_usize(self.communicator.size())
    }

    pub(super) fn on_node(&self) -> NodeShare {
        self.on_node
    }

    /// The node of a rank.
    pub(super) fn node(&self, rank: usize) -> String {
        self.nodes.get(rank).cloned().unwrap_or_default()
    }

    /// The bytes of all ranks, in order.
    pub(super) fn gather_bytes(&self, own: &[u8]) -> Vec<Vec<u8>> {
        let mut lengths = vec![0i32; self.count()];
        self.communicator
            .all_gather_into(&as_count(own.len()), lengths.as_mut_slice());
        let lengths: Vec<usize> = lengths.into_iter().map(as_usize).collect();
        let mut all = vec![0u8; lengths.iter().sum()];
        let (counts, starts) = parts(&lengths);
        let mut received = PartitionMut::new(all.as_mut_slice(), counts, starts);
        self.communicator
            .all_gather_varcount_into(own, &mut received);
        let mut rest = all.as_slice();
        let split = lengths.into_iter().map(|length| {
            let (own, after) = rest.split_at(length);
            rest = after;
            own.to_vec()
        });
        split.collect()
    }

    /// The values of all ranks in one vector. Rank r has `counts[r]` values.
    pub(super) fn gather_floats(&self, own: &[f32], counts: &[usize]) -> Vec<f32> {
        let mut all = vec![0.0; counts.iter().sum()];
        let (counts, starts) = parts(counts);
        let mut received = PartitionMut::new(all.as_mut_slice(), counts, starts);
        self.communicator
            .all_gather_varcount_into(own, &mut received);
        all
    }

    /// Sends `to[r]` values to each rank r, one rank's after the other's, and receives `from[r]`.
    pub(super) fn all_to_all(&self, sent: &[f32], to: &[usize], from: &[usize]) -> Vec<f32> {
        let mut all = vec![0.0; from.iter().sum()];
        let (counts, starts) = parts(to);
        let sent = Partition::new(sent, counts, starts);
        let (counts, starts) = parts(from);
        let mut received = PartitionMut::new(all.as_mut_slice(), counts, starts);
        self.communicator
            .all_to_all_varcount_into(&sent, &mut received);
        all
    }
}
