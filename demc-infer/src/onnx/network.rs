//! Turns the network into a graph by visiting its modules in the order of `Denoiser::forward`.
//!
//! The variants with encoders and readings differ in the modules and in the table of inputs, so this file has no
//! branch on either. Names, shapes and roles of the weights come from
//! [`weight_specs`](demc_model::ModelConfig::weight_specs).

use burn::nn::BatchNorm;
use burn::nn::conv::{Conv2d, ConvTranspose2d};
use demc_data::image::frame::{MAX_ALBEDO, POSITIONS, TEXTURES};
use demc_data::{Normalizer, Transfer};
use demc_model::config::{COLOR_CHANNELS, FEATURE_CHANNELS, Input};
use demc_model::decoder::DecoderLevel;
use demc_model::denoiser::Body;
use demc_model::dual_encoder::DualEncoder;
use demc_model::encoder::EncoderLevel;
use demc_model::fusion::Fusion;
use demc_model::inference::{FoldedConv, norm_scale};
use demc_model::layers::ConvBlock;
use demc_model::{Denoiser, Role, WeightSpec};

use super::graph::{AttributeValue, GraphBuilder, Value};
use crate::Precision;

/// Name of the input with the noisy colour.
pub const COLOR: &str = "color";
/// Name of the input with the features.
pub const FEATURES: &str = "features";
/// Name of the output.
pub const OUTPUT: &str = "output";

impl GraphBuilder {
    pub(super) fn denoise(&mut self, model: &Denoiser, normalizer: &Normalizer) {
        match &model.body {
            Body::DualEncoder(network) => self.dual_encoder(network, normalizer),
            Body::Kpcn(networks) => self.kpcn(networks),
            Body::Unet(network) => self.unet(network, normalizer),
        }
    }

    fn dual_encoder(&mut self, model: &DualEncoder, normalizer: &Normalizer) {
        let features = self.clamped_features(normalizer);
        let modulation = self.modulation(normalizer, &features);
        let color_gamma = self.compressed(normalizer, modulation.as_ref());
        let features_z = self.features_z(normalizer, &features);
        let fusion = model.fusion.as_ref();
        let detail = fusion.map(|fusion| self.detail_map(&features_z, fusion));
        let image = |input: &Input| match input {
            Input::Color => &color_gamma,
            Input::Features => &features_z,
            Input::DetailMap => detail
                .as_ref()
                .expect("variants with this input compute it"),
        };
        // One list per encoder, from the full resolution down.
        let mut skips: Vec<Vec<Value>> = Vec::new();
        let mut bottom = None;
        let inputs = model.config().variant.spec().encoders;
        for (e, (encoder, inputs)) in model.encoders.iter().zip(inputs).enumerate() {
            let inputs: Vec<&Value> = inputs.iter().map(image).collect();
            let mut x = Some(self.concat(&format!("encoders.{e}.input"), &inputs));
            skips.push(Vec::new());
            for level in &encoder.levels {
                let input = x.take().expect("all levels but the last are pooled");
                let (skip, below) = self.descend(&input, level);
                skips[e].push(skip);
                x = below;
            }
            bottom = x;
        }
        let bottom = bottom.expect("the last encoder feeds the latent");
        let mut x = self.block(&bottom, &model.latent);
        let mut decoded = Vec::new();
        for level in &model.decoder.levels {
            let skips = skips.iter_mut().filter_map(Vec::pop).collect();
            x = self.ascend(&x, skips, level);
            decoded.push(x.clone());
        }
        let mut image = match &model.decoder.head {
            Some(head) => {
                let image = self.conv(&x, head, None);
                self.node("Relu", "output_gamma", &[&image], &[])
            }
            None => self.kernel_head(&model.decoder.kernels, &decoded, &color_gamma),
        };
        if let Some(modulation) = &modulation {
            image = self.node("Mul", "output_modulated", &[&image, modulation], &[]);
        }
        self.expanded(normalizer, &image);
    }

    /// The features in the range of [`Normalizer::features_z_from_raw`].
    pub(super) fn clamped_features(&mut self, normalizer: &Normalizer) -> Value {
        let mut limits = [f32::MAX; FEATURE_CHANNELS];
        limits[TEXTURES..].fill(MAX_ALBEDO);
        if normalizer.transfer == Transfer::Pu {
            limits[..POSITIONS].fill(1.0);
        }
        let most = self.constant("features_max", &[1, FEATURE_CHANNELS, 1, 1], &limits);
        let raw = Value(FEATURES.into());
        if normalizer.transfer == Transfer::Gamma {
            return self.node("Min", "features_clamped", &[&raw, &most], &[]);
        }
        let mut least = [f32::MIN; FEATURE_CHANNELS];
        least[..POSITIONS].fill(-1.0);
        least[TEXTURES..].fill(0.0);
        let least = self.constant("features_min", &[1, FEATURE_CHANNELS, 1, 1], &least);
        let below = self.node("Min", "features_below", &[&raw, &most], &[]);
        self.node("Max", "features_clamped", &[&below, &least], &[])
    }

    /// `(clamp(albedo, 0, 1) + epsilon)^(1/gamma)` with the albedo of the first hit
    /// ([`Normalizer::modulation`]).
    fn modulation(&mut self, normalizer: &Normalizer, features: &Value) -> Option<Value> {
        let epsilon = normalizer.albedo_demodulation_epsilon?;
        let first = TEXTURES as i64;
        let bounds = [
            self.integers("texture_start", &[first]),
            self.integers("texture_end", &[first + COLOR_CHANNELS as i64]),
            self.integers("texture_axis", &[1]),
        ];
        let [start, end, axis] = &bounds;
        let texture = self.node("Slice", "texture", &[features, start, end, axis], &[]);
        let positive = self.node("Relu", "texture_positive", &[&texture], &[]);
        let offset = self.constant("demodulate", &[], &[epsilon]);
        let divisor = self.node("Add", "modulation_hdr", &[&positive, &offset], &[]);
        let exponent = self.constant("inverse_gamma_texture", &[], &[1.0 / normalizer.gamma]);
        Some(self.node("Pow", "modulation", &[&divisor, &exponent], &[]))
    }

    /// `(x - mean) / std`, channel by channel.
    pub(super) fn features_z(&mut self, normalizer: &Normalizer, features: &Value) -> Value {
        let shape = [1, FEATURE_CHANNELS, 1, 1];
        let mean = self.constant("features_mean", &shape, &normalizer.features.mean);
        let std = self.constant("features_std", &shape, &normalizer.features.std);
        let centred = self.node("Sub", "features_centred", &[features, &mean], &[]);
        self.node("Div", "features_z", &[&centred, &std], &[])
    }

    pub(super) fn detail_map(&mut self, features: &Value, fusion: &Fusion) -> Value {
        let blocks = fusion.blocks.iter();
        blocks.fold(features.clone(), |x, block| self.block(&x, block))
    }

    fn block(&mut self, x: &Value, block: &ConvBlock) -> Value {
        let y = self.conv(x, &block.conv, block.norm.as_ref());
        self.relu(&y)
    }

    pub(super) fn relu(&mut self, x: &Value) -> Value {
        self.node("Relu", &format!("{}.relu", x.0), &[x], &[])
    }

    /// Adds a level of an encoder. Returns its skip and the input of the next level.
    fn descend(&mut self, x: &Value, level: &EncoderLevel) -> (Value, Option<Value>) {
        let mut x = x.clone();
        let mut skip = None;
        for (j, conv) in level.convs.iter().enumerate() {
            let y = self.conv(&x, conv, None);
            x = self.relu(&y);
            if j + 1 == level.skip_after {
                skip = Some(x.clone());
            }
        }
        let below = level.pooled.then(|| self.pooled(&x));
        (skip.expect("a level has a skip"), below)
    }

    /// The maximum of each 2x2 window.
    pub(super) fn pooled(&mut self, x: &Value) -> Value {
        let settings = [
            ("kernel_shape", AttributeValue::Ints(&[2, 2])),
            ("strides", AttributeValue::Ints(&[2, 2])),
        ];
        self.node("MaxPool", &format!("{}.pool", x.0), &[x], &settings)
    }

    /// Adds a level of the decoder: `[decoder | skips]`, fused (Eq. 2).
    fn ascend(&mut self, x: &Value, skips: Vec<Value>, level: &DecoderLevel) -> Value {
        let upsampled = self.deconv(x, &level.deconv, level.norm.as_ref());
        let decoded = self.relu(&upsampled);
        let parts: Vec<&Value> = std::iter::once(&decoded).chain(&skips).collect();
        let all = self.concat(&format!("{}.concat", decoded.0), &parts);
        let fused = self.conv(&all, &level.fuse, None);
        if level.activated_fusion {
            self.relu(&fused)
        } else {
            fused
        }
    }

    /// Concatenates values along the channels; a single value stays as it is.
    pub(super) fn concat(&mut self, name: &str, parts: &[&Value]) -> Value {
        match parts {
            [one] => (*one).clone(),
            _ => self.node("Concat", name, parts, &[("axis", AttributeValue::Int(1))]),
        }
    }

    pub(super) fn conv(&mut self, x: &Value, conv: &Conv2d, norm: Option<&BatchNorm>) -> Value {
        let spec = self.spec(conv.weight.id);
        let layers = [None, norm].map(|norm| FoldedConv::conv(conv, norm));
        let [weight, bias] = self.layer(&spec, layers, norm);
        // All convolutions of demc-model keep the size.
        let [top, left] = conv.kernel_size.map(|length| length / 2);
        let attributes = [
            ("kernel_shape", AttributeValue::Ints(&conv.kernel_size)),
            ("pads", AttributeValue::Ints(&[top, left, top, left])),
        ];
        self.node("Conv", spec.layer(), &[x, &weight, &bias], &attributes)
    }

    fn deconv(&mut self, x: &Value, deconv: &ConvTranspose2d, norm: Option<&BatchNorm>) -> Value {
        let spec = self.spec(deconv.weight.id);
        let layers = [None, norm].map(|norm| FoldedConv::deconv(deconv, norm));
        let [weight, bias] = self.layer(&spec, layers, norm);
        let [top, left] = deconv.padding;
        let attributes = [
            ("kernel_shape", AttributeValue::Ints(&deconv.kernel_size)),
            ("pads", AttributeValue::Ints(&[top, left, top, left])),
            ("strides", AttributeValue::Ints(&deconv.stride)),
        ];
        self.node(
            "ConvTranspose",
            spec.layer(),
            &[x, &weight, &bias],
            &attributes,
        )
    }

    /// Adds weight and bias of a layer, with the batch normalisation folded into them. `layers` are
    /// the layer without and with folding.
    ///
    /// In f16 the unfolded weights and the normalisation's scale are stored separately, and a node
    /// multiplies them. Rounding folded weights would give another network than the f16 bundle.
    /// Runtimes multiply once, when they load the file.
    fn layer(
        &mut self,
        spec: &WeightSpec,
        [plain, folded]: [FoldedConv; 2],
        norm: Option<&BatchNorm>,
    ) -> [Value; 2] {
        let (name, path) = (&spec.name, spec.layer());
        let weight = match (self.precision(), norm) {
            (Precision::F16, Some(norm)) => {
                let plain = self.kernel(name, &spec.shape, plain.weight());
                let factors = norm_scale(norm);
                let shape = match spec.role {
                    Role::Deconvolution => [1, factors.len(), 1, 1],
                    _ => [factors.len(), 1, 1, 1],
                };
                let scale = self.constant(&format!("{path}.scale"), &shape, &factors);
                self.node("Mul", &format!("{name}.scaled"), &[&plain, &scale], &[])
            }
            _ => self.kernel(name, &spec.shape, folded.weight()),
        };
        let bias = self.constant(&format!("{path}.bias"), &[folded.outputs()], folded.bias());
        [weight, bias]
    }
}
