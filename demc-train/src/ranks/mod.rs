//! Ranks: the processes that train one run together. [`Reduce`] is all that the rest of the crate knows
//! of them.
//!
//! A build without the feature `mpi` has one rank and contains nothing of MPI. With it, `mpirun` and
//! `srun` start the ranks. Each rank computes a contiguous share of a step's micro-batches. Then all
//! ranks exchange gradients, losses, and statistics, and take the same optimizer step. Everything that
//! depends on an order is done in the order of the micro-batches, so the number of ranks changes no
//! bit.

pub mod cluster;
pub mod gradients;
#[cfg(feature = "mpi")]
mod group;
#[cfg(not(feature = "mpi"))]
#[path = "no_group.rs"]
mod group;
pub mod groups;
pub mod launch;
mod placement;
mod sum;
pub mod tree;

use std::cell::Cell;
use std::ops::Range;
use std::rc::Rc;
use std::time::{Duration, Instant};

use anyhow::Context;
use demc_program::checksum::sha256_of;
use demc_program::exit::{FAILURE, UsageError};
use serde::Serialize;
use serde::de::DeserializeOwned;

use group::Group;
pub use placement::NodeShare;
use placement::{ALONE, Place, Placement};

/// The exchange between the ranks of one run; by default a single rank. Clones share it.
///
/// Every rank must call its methods in the same order, unless a method says otherwise.
#[derive(Clone)]
pub struct Reduce {
    /// `None` for a single rank.
    group: Option<Rc<Group>>,
    /// Time spent in exchanges, the wait for slower ranks included.
    spent: Rc<Cell<Duration>>,
    exit_code: ExitCode,
}

/// The exit code that a program has for an error.
pub type ExitCode = fn(&anyhow::Error) -> u8;

/// An error that all ranks know of. Rank 0 prints it.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{text}")]
pub struct SharedError {
    /// The message, with the rank and the node if not all ranks failed alike.
    text: String,
    /// The exit code of the first rank that failed.
    pub code: u8,
}

/// What a rank sends: its value or its error.
type Sent<T> = Result<T, (String, u8)>;

impl Default for Reduce {
    fn default() -> Self {
        Reduce::of(None, |_| FAILURE)
    }
}

impl Reduce {
    fn of(group: Option<Group>, exit_code: ExitCode) -> Self {
        Reduce {
            group: group.map(Rc::new),
            spent: Rc::default(),
            exit_code,
        }
    }

    /// All ranks that were started together. Call it on the thread that trains.
    pub fn world(exit_code: ExitCode) -> Self {
        Reduce::of(Group::world(), exit_code)
    }

    /// Splits the ranks into groups of `size` and returns this rank's group and its number. The last
    /// group is smaller if `size` does not divide the number of ranks. Every rank must call it.
    pub fn split(&self, size: usize) -> (Self, usize) {
        let number = self.rank() / size;
        let group = self.group.as_ref().and_then(|group| group.split(number));
        (Reduce::of(group, self.exit_code), number)
    }

    /// This rank, from 0.
    pub fn rank(&self) -> usize {
        self.group.as_ref().map_or(0, |group| group.rank())
    }

    /// The number of ranks, at least 1.
    pub fn count(&self) -> usize {
        self.group.as_ref().map_or(1, |group| group.count())
    }

    /// This process among those of its node.
    pub fn on_node(&self) -> NodeShare {
        self.group.as_ref().map_or(ALONE, |group| group.on_node())
    }

    /// Whether this rank is rank 0, which alone writes and prints.
    pub fn is_first(&self) -> bool {
        self.rank() == 0
    }

    /// The share of rank `rank` in `items` items: contiguous, and of sizes that differ by at most 1.
    pub fn share_of(&self, rank: usize, items: usize) -> Range<usize> {
        let start = |rank: usize| rank * items / self.count();
        start(rank)..start(rank + 1)
    }

    /// This rank's share in `items` items.
    pub fn share(&self, items: usize) -> Range<usize> {
        self.share_of(self.rank(), items)
    }

    /// The time spent in exchanges since the last call.
    pub fn take_time(&self) -> Duration {
        self.spent.take()
    }

    /// The values of all ranks, in order.
    ///
    /// # Errors
    /// On every rank, if one rank has an error.
    pub fn gather<T: Serialize + DeserializeOwned>(
        &self,
        own: anyhow::Result<T>,
    ) -> anyhow::Result<Vec<T>> {
        let Some(group) = &self.group else {
            return Ok(vec![own?]);
        };
        let own: Sent<T> = own.map_err(|error| (format!("{error:#}"), (self.exit_code)(&error)));
        // CBOR keeps all bits of a number, infinite and NaN included.
        let mut sent = Vec::new();
        ciborium::into_writer(&own, &mut sent).context("a message between ranks")?;
        let received = self.timed(|| group.gather_bytes(&sent));
        let mut values = Vec::with_capacity(received.len());
        let mut errors = Vec::new();
        for (rank, message) in received.iter().enumerate() {
            let value: Sent<T> =
                ciborium::from_reader(&message[..]).context("a message between ranks")?;
            match value {
                Ok(value) => values.push(value),
                Err((text, code)) => errors.push((rank, text, code)),
            }
        }
        let Some((rank, text, code)) = errors.first().cloned() else {
            return Ok(values);
        };
        let alike = errors.len() == received.len() && errors.iter().all(|other| other.1 == text);
        let text = if alike {
            text
        } else {
            format!("rank {rank} on {}: {text}", group.node(rank))
        };
        Err(SharedError { text, code }.into())
    }

    /// The items of all ranks, in order.
    ///
    /// # Errors
    /// On every rank, if one rank has an error.
    pub fn concat<T: Serialize + DeserializeOwned>(
        &self,
        own: anyhow::Result<Vec<T>>,
    ) -> anyhow::Result<Vec<T>> {
        Ok(self.gather(own)?.into_iter().flatten().collect())
    }

    /// The results of `work` on all items, in order. The ranks deal out the items among themselves.
    ///
    /// # Errors
    /// On every rank, the first error of a rank.
    pub fn deal<I, T: Serialize + DeserializeOwned>(
        &self,
        items: &[I],
        mut work: impl FnMut(usize, &I) -> anyhow::Result<T>,
    ) -> anyhow::Result<Vec<T>> {
        let own: anyhow::Result<Vec<T>> = items
            .iter()
            .enumerate()
            .skip(self.rank())
            .step_by(self.count())
            .map(|(index, item)| work(index, item))
            .collect();
        let mut dealt: Vec<_> = self.gather(own)?.into_iter().map(Vec::into_iter).collect();
        Ok((0..items.len())
            .filter_map(|index| dealt[index % self.count()].next())
            .collect())
    }

    /// This rank's value, if no rank has an error.
    ///
    /// # Errors
    /// On every rank, if one rank has an error.
    pub fn agree<T>(&self, own: anyhow::Result<T>) -> anyhow::Result<T> {
        if self.group.is_none() {
            return own;
        }
        let (value, own) = match own {
            Ok(value) => (Some(value), Ok(())),
            Err(error) => (None, Err(error)),
        };
        self.gather(own)?;
        value.context("a rank without an error has a value")
    }

    /// Rank 0 makes a value with `first` and sends `tell` of it. The others make theirs from what was
    /// sent, with `join`.
    ///
    /// # Errors
    /// On every rank, if one rank has an error.
    pub fn broadcast<T, M: Serialize + DeserializeOwned>(
        &self,
        first: impl FnOnce() -> anyhow::Result<T>,
        tell: impl FnOnce(&T) -> M,
        join: impl FnOnce(M) -> anyhow::Result<T>,
    ) -> anyhow::Result<T> {
        if self.group.is_none() {
            return first();
        }
        let mut own = None;
        let message = self.from_first(|| {
            let value = first()?;
            let message = tell(&value);
            own = Some(value);
            Ok(message)
        })?;
        self.agree(own.map_or_else(|| join(message), Ok))
    }

    /// Rank 0's value on every rank. The others do not call `make`.
    ///
    /// # Errors
    /// On every rank, if rank 0 has an error.
    pub fn from_first<T: Serialize + DeserializeOwned>(
        &self,
        make: impl FnOnce() -> anyhow::Result<T>,
    ) -> anyhow::Result<T> {
        if self.group.is_none() {
            return make();
        }
        let own = self.is_first().then(make).transpose();
        // A list, because `Some(())` and `None` are the same in a message.
        let first = self.concat(own.map(Vec::from_iter))?.into_iter().next();
        first.context("rank 0 has a value")
    }

    /// Refuses texts that are not the same on all ranks. `what` names them, such as
    /// `the configuration`. A single rank does not call `make`.
    ///
    /// # Errors
    /// On every rank: the first rank that differs from rank 0, and the first differing line.
    fn compare(
        &self,
        what: &str,
        make: impl FnOnce() -> anyhow::Result<String>,
    ) -> anyhow::Result<()> {
        let Some(group) = &self.group else {
            return Ok(());
        };
        let values = self.gather(make())?;
        let first = values.first().context("rank 0 has a value")?;
        let differs = values.iter().position(|value| value != first);
        let Some(rank) = differs else {
            return Ok(());
        };
        let lines = |text: &str| text.lines().map(str::to_owned).collect::<Vec<_>>();
        let (ours, theirs) = (lines(first), lines(&values[rank]));
        let line = (0..ours.len().max(theirs.len()))
            .find(|line| ours.get(*line) != theirs.get(*line))
            .unwrap_or(0);
        let shown = |lines: &[String]| lines.get(line).map_or("nothing", |text| text).to_owned();
        let text = format!(
            "{what} of rank {rank} on {} differs from that of rank 0: {} instead of {}",
            group.node(rank),
            shown(&theirs),
            shown(&ours)
        );
        Err(SharedError { text, code: 1 }.into())
    }

    /// Refuses ranks that differ in program or in `config`, the text of the configuration, and a number
    /// of ranks that does not divide the micro-batches of a step.
    ///
    /// # Errors
    /// What differs, or the numbers of ranks that would do.
    pub fn check(&self, config: &str, grad_accumulation: usize) -> anyhow::Result<()> {
        self.compare("the program", program)?;
        self.compare("the configuration", || Ok(config.to_owned()))?;
        self.agree(check_divides(self.count(), grad_accumulation))
    }

    /// One line on all ranks: their number, nodes, threads, devices, and the bytes that each sends for
    /// a gradient of `floats` values. `None` for a single rank.
    ///
    /// # Errors
    /// A failed exchange.
    pub fn describe(&self, device: &str, floats: u64) -> anyhow::Result<Option<String>> {
        let Some(group) = &self.group else {
            return Ok(None);
        };
        let places = self.gather(Ok(Place {
            node: group.node(group.rank()),
            threads: demc_program::parallel::threads().count,
            device: device.to_owned(),
        }))?;
        Ok(Some(Placement(&places, floats).to_string()))
    }

    fn timed<T>(&self, exchange: impl FnOnce() -> T) -> T {
        let started = Instant::now();
        let result = exchange();
        self.spent.set(self.spent.get() + started.elapsed());
        result
    }
}

/// Refuses a number of ranks that does not divide the number of micro-batches.
///
/// # Errors
/// The numbers of ranks that would do.
pub fn check_divides(count: usize, grad_accumulation: usize) -> anyhow::Result<()> {
    if grad_accumulation.is_multiple_of(count) {
        return Ok(());
    }
    let fits: Vec<String> = (1..=grad_accumulation.min(4096))
        .filter(|ranks| grad_accumulation.is_multiple_of(*ranks))
        .map(|ranks| ranks.to_string())
        .collect();
    Err(UsageError(format!(
        "{count} ranks: train.grad_accumulation = {grad_accumulation} must be a multiple of the number of ranks; \
         start {} ranks, or change the key",
        fits.join(", ")
    ))
    .into())
}

/// The version and checksum of this program, which must be the same on all ranks.
fn program() -> anyhow::Result<String> {
    let version = env!("CARGO_PKG_VERSION");
    let file = std::env::current_exe().context("the program's own file")?;
    Ok(format!("{version}, SHA-256 {}", sha256_of(&file)?))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_rank_has_everything() {
        let reduce = Reduce::default();
        assert_eq!(
            (reduce.rank(), reduce.count(), reduce.share(7)),
            (0, 1, 0..7)
        );
        assert_eq!(reduce.gather(Ok(3)).expect("its own"), [3]);
        let error = reduce.agree::<()>(Err(UsageError("no".into()).into()));
        assert!(error.expect_err("its own").is::<UsageError>());
        let doubled = reduce.deal(&[1, 2, 3], |index, item| Ok(index + 2 * item));
        assert_eq!(doubled.expect("its own"), [2, 5, 8]);
        let told = reduce.broadcast(|| Ok(4), |value| *value, |_: i32| unreachable!("no other"));
        assert_eq!(told.expect("its own"), 4);
    }
}
