//! Tests across crates, one program: each further one would link Burn again.

mod backends;
mod fixture;
mod live;
mod metrics;
mod oidn_live;
mod onnx_live;
mod parity;
mod parity_live;
mod python_live;
mod tensors;
