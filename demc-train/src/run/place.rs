//! Where a session computes: its device, and the processes that share the work.

use burn::tensor::Device;

use crate::ranks::Reduce;

/// Where a session computes.
#[derive(Clone)]
pub struct SessionPlace {
    /// Device without autodiff.
    pub device: Device,
    /// Its name, for the record.
    pub device_name: String,
    /// The processes that train the run together.
    pub reduce: Reduce,
}
