//! Between `flex` tensors and the slices that the kernels take.

use burn::backend::flex::FlexTensor;
use burn::tensor::TensorData;
use demc_kernels::Grid;

/// The same values row by row in a buffer of their own size: the tensor itself where it is so already, as all maps and
/// weights are, else a copy.
pub(in crate::ops) fn contiguous(tensor: FlexTensor) -> FlexTensor {
    // Clones no more than a reference, which is gone when this returns.
    tensor.to_contiguous()
}

/// The values of a [`contiguous`] tensor.
pub(in crate::ops) fn values(tensor: &FlexTensor) -> &[f32] {
    tensor.storage::<f32>()
}

/// A buffer to write `len` values into.
pub(super) fn buffer(len: usize) -> Vec<f32> {
    demc_kernels::memory::buffer(len)
}

/// The tensor of these values.
pub(super) fn tensor<const D: usize>(values: Vec<f32>, shape: [usize; D]) -> FlexTensor {
    FlexTensor::from_data(TensorData::new(values, shape))
}

/// The axes of a tensor.
pub(super) fn dims<const D: usize>(tensor: &FlexTensor) -> [usize; D] {
    tensor.layout().shape().dims()
}

/// The pixels of `[B, H, W, C]`, and the channels.
pub(super) fn grid(maps: &FlexTensor) -> (Grid, usize) {
    let [batch, height, width, channels] = dims(maps);
    let grid = Grid {
        batch,
        height,
        width,
    };
    (grid, channels)
}

/// The tensor of these maps on `grid`.
pub(super) fn maps(grid: Grid, values: Vec<f32>) -> FlexTensor {
    let channels = grid.channels(values.len());
    tensor(values, [grid.batch, grid.height, grid.width, channels])
}
