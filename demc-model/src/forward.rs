//! The forward pass of the whole network (Fig. 3), operation by operation or by
//! [`crate::inference`].

use std::ops::ControlFlow;

use burn::tensor::{Device, Tensor};

use crate::config::{COLOR_CHANNELS, DOWNSAMPLING, FEATURE_CHANNELS, Input, LEVELS};
use crate::denoiser::Denoiser;
use crate::encoder::EncoderOutput;
use crate::inference::{self, Cancelled, Observer};
use crate::ops::Maps;

impl Denoiser {
    /// Denoises gamma-compressed colour with Z-scored features.
    ///
    /// A device with autodiff normalises by the statistics of the batch, a device without by the
    /// running ones.
    ///
    /// # Shapes
    /// `color_gamma` `[B, 3, H, W]`, `features_z` `[B, 12, H, W]`, H and W multiples of 32; returns
    /// `[B, 3, H, W]` in gamma space, not negative.
    ///
    /// # Panics
    /// If the tensors have other shapes.
    pub fn forward(&self, color_gamma: Tensor<4>, features_z: Tensor<4>) -> Tensor<4> {
        let done = self.forward_observed(color_gamma, features_z, None, &mut never_cancelled);
        done.expect("nobody cancels").0
    }

    /// As [`forward`](Self::forward), for one image without autodiff. The kernels of a kernel head
    /// also filter `layers`, which are divided by the albedo as the colour is, but stay linear.
    ///
    /// # Shapes
    /// `color_gamma` `[1, 3, H, W]`, `features_z` `[1, 12, H, W]`, `layers` `[L, 3, H, W]` in linear
    /// light, of either sign. Returns the denoised `color_gamma` and `layers`.
    ///
    /// # Panics
    /// If the tensors have other shapes, or the network has no kernel head.
    pub fn forward_with_layers(
        &self,
        color_gamma: Tensor<4>,
        features_z: Tensor<4>,
        layers: Tensor<4>,
    ) -> (Tensor<4>, Tensor<4>) {
        let layers = Some(layers);
        let done = self.forward_observed(color_gamma, features_z, layers, &mut never_cancelled);
        let (color, layers) = done.expect("nobody cancels");
        (color, layers.expect("a kernel head filters layers"))
    }

    /// As [`forward`](Self::forward) or [`forward_with_layers`](Self::forward_with_layers). On the
    /// CPU's kernels, `observer` hears of every band of rows; elsewhere of nothing.
    ///
    /// # Errors
    /// The observer stopped the pass.
    ///
    /// # Panics
    /// As these two.
    pub fn forward_observed(
        &self,
        color_gamma: Tensor<4>,
        features_z: Tensor<4>,
        layers: Option<Tensor<4>>,
        observer: &mut Observer,
    ) -> Result<(Tensor<4>, Option<Tensor<4>>), Cancelled> {
        assert_shapes(color_gamma.dims(), features_z.dims());
        if let Some(layers) = &layers {
            self.assert_layers(color_gamma.dims(), layers.dims());
        }
        if self.infers_on(&color_gamma.device()) {
            inference::forward(self, color_gamma, features_z, layers, observer)
        } else {
            Ok(self.run_modules(color_gamma, features_z, layers))
        }
    }

    fn assert_layers(&self, color_gamma: [usize; 4], layers: [usize; 4]) {
        assert!(self.decoder.head.is_none(), "layers need a kernel head");
        let [batch, colors, height, width] = color_gamma;
        let [count, ..] = layers;
        assert!(batch == 1 && count > 0, "layers of one image");
        assert_eq!(
            layers,
            [count, colors, height, width],
            "layers have the channels and the size of color_gamma"
        );
    }

    fn run_modules(
        &self,
        color_gamma: Tensor<4>,
        features_z: Tensor<4>,
        layers: Option<Tensor<4>>,
    ) -> (Tensor<4>, Option<Tensor<4>>) {
        let layers = layers.map(|layers| Maps::from_nchw(layers, self.ops()));
        let color_gamma = Maps::from_nchw(color_gamma, self.ops());
        let features_z = Maps::from_nchw(features_z, self.ops());
        let fusion = self.fusion.as_ref();
        let detail_map = fusion.map(|fusion| fusion.forward(features_z.clone()));
        let image = |input: &Input| match input {
            Input::Color => color_gamma.clone(),
            Input::Features => features_z.clone(),
            Input::DetailMap => detail_map
                .clone()
                .expect("a variant with a detail map has a fusion"),
        };
        let inputs = self.config().variant.spec().encoders;
        let mut encoded: Vec<EncoderOutput> = self
            .encoders
            .iter()
            .zip(inputs)
            .map(|(encoder, inputs)| encoder.forward(Maps::cat(inputs.iter().map(image).collect())))
            .collect();
        let bottom = encoded
            .last_mut()
            .and_then(|last| last.bottom.take())
            .expect("the last encoder feeds the latent");
        let (color, layers) = self.decoder.forward(
            self.latent.forward(bottom),
            skips_by_level(encoded),
            color_gamma,
            layers,
        );
        (color.into_nchw(), layers.map(Maps::into_nchw))
    }

    /// The detail map (Fig. 2 e) of Z-scored features, or `None` for a variant without fusion.
    ///
    /// # Shapes
    /// `[B, 12, H, W]` to `[B, 3, H, W]`, not negative.
    pub fn detail_map(&self, features_z: Tensor<4>) -> Option<Tensor<4>> {
        self.fusion.as_ref().map(|fusion| {
            fusion
                .forward(Maps::from_nchw(features_z, self.ops()))
                .into_nchw()
        })
    }

    /// Whether an image on `device` is denoised by [`inference`]: the kernels run and nothing is
    /// differentiated.
    fn infers_on(&self, device: &Device) -> bool {
        let weights = self.latent.conv.weight.val().device();
        let differentiates = device.is_autodiff() || weights.is_autodiff();
        self.ops().on(device).has_fast_inference() && !differentiates
    }
}

/// An observer that lets a pass finish.
fn never_cancelled(_: f64) -> ControlFlow<()> {
    ControlFlow::Continue(())
}

/// The skips by level for the decoder: one list per level, deepest first, with one entry per
/// encoder.
fn skips_by_level(encoded: Vec<EncoderOutput>) -> Vec<Vec<Maps>> {
    let mut encoders: Vec<_> = encoded
        .into_iter()
        .map(|e| e.skips.into_iter().rev())
        .collect();
    (0..LEVELS)
        .map(|_| encoders.iter_mut().filter_map(Iterator::next).collect())
        .collect()
}

fn assert_shapes([batch, colors, height, width]: [usize; 4], features: [usize; 4]) {
    assert_eq!(
        colors, COLOR_CHANNELS,
        "color_gamma has {COLOR_CHANNELS} channels"
    );
    assert_eq!(
        features,
        [batch, FEATURE_CHANNELS, height, width],
        "features_z has {FEATURE_CHANNELS} channels and the size of color_gamma"
    );
    assert!(
        height > 0 && width > 0 && height % DOWNSAMPLING == 0 && width % DOWNSAMPLING == 0,
        "{height} x {width}: height and width are multiples of {DOWNSAMPLING}"
    );
}
