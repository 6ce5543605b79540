//! The activation after an operation.

use burn::tensor::{Tensor, activation};

/// The activation after an operation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Activation {
    /// The identity.
    None,
    /// `max(x, 0)`, fused into the operation by the kernels.
    Relu,
}

impl Activation {
    pub(super) fn is_relu(self) -> bool {
        self == Activation::Relu
    }

    pub(super) fn apply(self, x: Tensor<4>) -> Tensor<4> {
        match self {
            Activation::None => x,
            Activation::Relu => activation::relu(x),
        }
    }
}
