//! Peak performance of the machine: its fastest matrix product and copy.

use burn::tensor::{Device, Distribution, Tensor};
use demc_bench::stopwatch::turn;
use rayon::prelude::*;

/// Peak performance, and the operands target measure it again.
pub struct Peak {
    pub side: usize,
    pub flops: f64,
    pub bytes: f64,
    a: Tensor<2>,
    b: Tensor<2>,
    from: Vec<f32>,
    target: Vec<f32>,
}

impl Peak {
    pub fn measure() -> Self {
        let device = Device::flex();
        let square = |side| Tensor::random([side, side], Distribution::Default, &device);
        let rate = |side: usize| {
            let (a, b) = (square(side), square(side));
            let mut product = || drop(std::hint::black_box(a.clone().matmul(b.clone())));
            product();
            let seconds = (0..5)
                .map(|_| turn(&mut product))
                .fold(f64::INFINITY, f64::min);
            (2.0 * (side as f64).powi(3) / seconds, side)
        };
        let (flops, side) = [512, 1024, 2048]
            .map(rate)
            .into_iter()
            .fold((0.0, 0), |a, b| if a.0 > b.0 { a } else { b });
        let (from, target) = (vec![1.0; 1 << 24], vec![0.0; 1 << 24]);
        let mut peak = Peak {
            side,
            flops,
            bytes: 0.0,
            a: square(side),
            b: square(side),
            from,
            target,
        };
        peak.copy();
        let seconds = (0..5)
            .map(|_| turn(&mut || peak.copy()))
            .fold(f64::INFINITY, f64::min);
        peak.bytes = peak.copied() / seconds;
        peak
    }

    pub fn product(&self) {
        drop(std::hint::black_box(self.a.clone().matmul(self.b.clone())));
    }

    /// Floating point operations of [`Self::product`].
    pub fn operations(&self) -> f64 {
        2.0 * (self.side as f64).powi(3)
    }

    pub fn copy(&mut self) {
        let chunk = 1 << 16;
        self.target
            .par_chunks_mut(chunk)
            .zip(self.from.par_chunks(chunk))
            .for_each(|(target, from)| target.copy_from_slice(from));
    }

    /// Bytes that [`Self::copy`] reads and writes.
    pub fn copied(&self) -> f64 {
        8.0 * self.from.len() as f64
    }
}
