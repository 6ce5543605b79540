//! The CPU operations of the DEMC networks and their gradients, on slices.
//!
//! Every operation works on *maps*: a batch of images with their channels last, `[batch, height,
//! width, channels]`. A [`Grid`] states batch, height and width; the length of the slice gives the
//! channels. With channels last, every product of the network is `pixels x channels` times
//! `channels x channels`, with rows that load as vectors. Weights have the layouts of weight files:
//! convolutions `[out, in, h, w]`, deconvolutions `[in, out, h, w]`.
//!
//! The first argument of every operation is the instruction set ([`Isa`]). Results have the same
//! bits for any number of threads. A wrong length is a bug of the caller; the operation panics and
//! names the shapes.

pub mod adam;
pub mod average;
pub mod batch_norm;
pub mod blend;
pub mod conv1x1;
pub mod conv3x3;
pub mod conv5x5;
pub mod deconv4x4;
pub mod double;
pub mod filter;
pub mod grid;
pub mod isa;
pub mod memory;
mod operands;
pub mod pool;
pub mod power;
mod product;
pub mod pu;
pub mod reduce;
pub mod reference;
pub mod rel_mse;
mod rows;
mod scratch;
mod simd;
mod tasks;
#[cfg(test)]
mod testing;

pub use grid::Grid;
pub use isa::Isa;
pub use operands::{Convolution, GradientSource, GradientTarget};
pub use tasks::{start_threads, within_pool};
