//! The forward pass of a network, operation by operation or by [`crate::inference`].

use std::ops::ControlFlow;

use burn::tensor::{Device, Tensor};

use crate::config::FEATURE_CHANNELS;
use crate::denoiser::{Body, Denoiser};
use crate::inference::{self, Cancelled, Observer};

impl Denoiser {
    /// Denoises colour with features: gamma-compressed colour with Z-scored features, or the inputs of
    /// [`Kpcn::forward`](crate::kpcn::Kpcn::forward) and [`Unet::forward`](crate::unet::Unet::forward).
    ///
    /// A device with autodiff normalises by the statistics of the batch, a device without by the
    /// running ones.
    ///
    /// # Shapes
    /// `color` `[B, 3, H, W]`, for KPCN `[B, 6, H, W]`; `features` `[B, 12, H, W]`; H and W multiples of
    /// 32, for a U-Net of 16. Returns the shape of `color`, in its space; not negative except for KPCN.
    ///
    /// # Panics
    /// If the tensors have other shapes.
    pub fn forward(&self, color: Tensor<4>, features: Tensor<4>) -> Tensor<4> {
        let done = self.forward_observed(color, features, None, &mut never_cancelled);
        done.expect("nobody cancels").0
    }

    /// As [`forward`](Self::forward), for one image without autodiff. The kernels of a kernel head
    /// also filter `layers`, which are divided by the albedo as the colour is, but stay linear.
    ///
    /// # Shapes
    /// `color` `[1, 3, H, W]`, `features` `[1, 12, H, W]`, `layers` `[L, 3, H, W]` in linear
    /// light, of either sign. Returns the denoised `color` and `layers`.
    ///
    /// # Panics
    /// If the tensors have other shapes, or the network has no kernel head.
    pub fn forward_with_layers(
        &self,
        color: Tensor<4>,
        features: Tensor<4>,
        layers: Tensor<4>,
    ) -> (Tensor<4>, Tensor<4>) {
        let layers = Some(layers);
        let done = self.forward_observed(color, features, layers, &mut never_cancelled);
        let (color, layers) = done.expect("nobody cancels");
        (color, layers.expect("kernels filter layers"))
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
        color: Tensor<4>,
        features: Tensor<4>,
        layers: Option<Tensor<4>>,
        observer: &mut Observer,
    ) -> Result<(Tensor<4>, Option<Tensor<4>>), Cancelled> {
        let colors = self.config().variant.spec().color_channels;
        let unit = 1 << self.config().variant.spec().halvings;
        assert_shapes(colors, unit, color.dims(), features.dims());
        if let Some(layers) = &layers {
            self.assert_layers(color.dims(), layers.dims());
        }
        match &self.body {
            Body::DualEncoder(network) if self.infers_on(&network.device(), &color.device()) => {
                inference::forward(network, [color, features], layers, observer)
            }
            Body::DualEncoder(network) => {
                Ok(network.forward([color, features], layers, self.ops()))
            }
            Body::Kpcn(networks) => Ok((networks.forward(color, features, self.ops()), None)),
            Body::Unet(network) if self.infers_on(&network.device(), &color.device()) => {
                let out = inference::forward_unet(network, color, features, observer)?;
                Ok((out, None))
            }
            Body::Unet(network) => Ok((network.forward(color, features, self.ops()), None)),
        }
    }

    fn assert_layers(&self, color: [usize; 4], layers: [usize; 4]) {
        assert!(self.filters_layers(), "layers need kernels");
        let [batch, colors, height, width] = color;
        let [count, ..] = layers;
        assert!(batch == 1 && count > 0, "layers of one image");
        assert_eq!(
            layers,
            [count, colors, height, width],
            "layers have the channels and the size of color"
        );
    }

    /// The detail map (Fig. 2 e) of Z-scored features, or `None` for a variant without fusion.
    ///
    /// # Shapes
    /// `[B, 12, H, W]` to `[B, 3, H, W]`, not negative.
    pub fn detail_map(&self, features_z: Tensor<4>) -> Option<Tensor<4>> {
        match &self.body {
            Body::DualEncoder(network) => network.detail_map(features_z, self.ops()),
            Body::Unet(network) => network.detail_map(features_z, self.ops()),
            Body::Kpcn(_) => None,
        }
    }

    /// Whether a network with its weights on `weights` denoises an image on `device` by
    /// [`inference`]: the kernels run and nothing is differentiated.
    fn infers_on(&self, weights: &Device, device: &Device) -> bool {
        let differentiates = device.is_autodiff() || weights.is_autodiff();
        self.ops().on(device).has_fast_inference() && !differentiates
    }
}

/// An observer that lets a pass finish.
fn never_cancelled(_: f64) -> ControlFlow<()> {
    ControlFlow::Continue(())
}

fn assert_shapes(
    colors: usize,
    unit: usize,
    [batch, found, height, width]: [usize; 4],
    features: [usize; 4],
) {
    assert_eq!(found, colors, "color has {colors} channels");
    assert_eq!(
        features,
        [batch, FEATURE_CHANNELS, height, width],
        "features has {FEATURE_CHANNELS} channels and the size of color"
    );
    assert!(
        height > 0 && width > 0 && height % unit == 0 && width % unit == 0,
        "{height} x {width}: height and width are multiples of {unit}"
    );
}
