//! The CPU operations of the DEMC networks, forward and backward: slices in, slices out.
//!
//! Every operation works on *maps*: a batch of images with their channels last, `[batch, height, width, channels]`,
//! described by a [`Grid`] (batch, height, width) and a slice whose length tells the channels. Channels last makes every
//! product of the network the same one, `pixels x channels` times `channels x channels`, with rows that vectors load as
//! they lie. Weights come and go in the layouts of weight files: convolutions `[out, in, h, w]`, deconvolutions
//! `[in, out, h, w]`.
//!
//! The first argument of every operation is the instruction set ([`Isa`]) to run on; results are the same bits
//! whatever the number of threads. Lengths that do not fit are a bug of the caller and panic with the shapes.

pub mod adam;
pub mod average;
pub mod batch_norm;
pub mod conv1x1;
pub mod conv3x3;
pub mod deconv4x4;
pub mod grid;
pub mod isa;
pub mod memory;
pub mod pool;
mod product;
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
pub use tasks::within_pool;
