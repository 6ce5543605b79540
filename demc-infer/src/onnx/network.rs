//! The network as a graph: a walk over its modules, as `Denoiser::forward` makes it. What differs between variants and
//! readings is in the modules and in the table of inputs; there is no branch on either here.

use burn::nn::BatchNorm;
use burn::nn::conv::{Conv2d, ConvTranspose2d};
use demc_data::Normalizer;
use demc_data::frame::TEXTURES;
use demc_model::Denoiser;
use demc_model::config::{COLOR_CHANNELS, FEATURE_CHANNELS, Input};
use demc_model::decoder::DecoderLevel;
use demc_model::encoder::EncoderLevel;
use demc_model::inference::{Layer, scale_of};
use demc_model::layers::ConvBlock;

use super::graph::{Graph, Setting, Value};
use super::{COLOR, FEATURES, OUTPUT};
use crate::Precision;

impl Graph {
    /// From the graph's inputs to its output, both linear HDR.
    pub(super) fn denoise(&mut self, model: &Denoiser, normalizer: &Normalizer) {
        let modulation = self.modulation(normalizer);
        let color_gamma = self.color_gamma(normalizer.gamma, modulation.as_ref());
        let features_z = self.features_z(normalizer);
        let detail = model.fusion.as_ref().map(|fusion| {
            let blocks = fusion.blocks.iter().enumerate();
            blocks.fold(features_z.clone(), |x, (i, block)| {
                self.block(&format!("fusion.blocks.{i}"), &x, block)
            })
        });
        let image = |input: &Input| match input {
            Input::Color => &color_gamma,
            Input::Features => &features_z,
            Input::DetailMap => detail.as_ref().expect("a variant that eats it makes it"),
        };
        // One list an encoder, from the full resolution down.
        let mut skips: Vec<Vec<Value>> = Vec::new();
        let mut bottom = None;
        let inputs = model.config().variant.spec().encoders;
        for (e, (encoder, inputs)) in model.encoders.iter().zip(inputs).enumerate() {
            let path = format!("encoders.{e}");
            let inputs: Vec<&Value> = inputs.iter().map(image).collect();
            let mut x = Some(self.concat(&format!("{path}.input"), &inputs));
            skips.push(Vec::new());
            for (i, level) in encoder.levels.iter().enumerate() {
                let input = x.take().expect("only the last level has nothing below it");
                let (skip, below) = self.descend(&format!("{path}.levels.{i}"), &input, level);
                skips[e].push(skip);
                x = below;
            }
            bottom = x;
        }
        let bottom = bottom.expect("the last encoder feeds the latent");
        let mut x = self.block("latent", &bottom, &model.latent);
        for (k, level) in model.decoder.levels.iter().enumerate() {
            let skips = skips.iter_mut().filter_map(Vec::pop).collect();
            x = self.ascend(&format!("decoder.levels.{k}"), &x, skips, level);
        }
        let image = self.conv("decoder.head", &x, &model.decoder.head, None);
        let mut image = self.node("Relu", "output_gamma", &[&image], &[]);
        if let Some(modulation) = &modulation {
            image = self.node("Mul", "output_modulated", &[&image, modulation], &[]);
        }
        let gamma = self.constant("gamma", &[], &[normalizer.gamma]);
        self.node("Pow", OUTPUT, &[&image, &gamma], &[]);
    }

    /// `(max(t, 0) + demodulate)^(1/gamma)`, t the first texture ([`Normalizer::modulation`]).
    fn modulation(&mut self, normalizer: &Normalizer) -> Option<Value> {
        if normalizer.demodulate == 0.0 {
            return None;
        }
        let first = TEXTURES as i64;
        let bounds = [
            self.integers("texture_start", &[first]),
            self.integers("texture_end", &[first + COLOR_CHANNELS as i64]),
            self.integers("texture_axis", &[1]),
        ];
        let [start, end, axis] = &bounds;
        let raw = Value(FEATURES.into());
        let texture = self.node("Slice", "texture", &[&raw, start, end, axis], &[]);
        let positive = self.node("Relu", "texture_positive", &[&texture], &[]);
        let offset = self.constant("demodulate", &[], &[normalizer.demodulate]);
        let divisor = self.node("Add", "modulation_hdr", &[&positive, &offset], &[]);
        let exponent = self.constant("inverse_gamma_texture", &[], &[1.0 / normalizer.gamma]);
        Some(self.node("Pow", "modulation", &[&divisor, &exponent], &[]))
    }

    /// `max(x, 0)^(1/gamma)` (Eq. 4), divided by the modulation.
    fn color_gamma(&mut self, gamma: f32, modulation: Option<&Value>) -> Value {
        let exponent = self.constant("inverse_gamma", &[], &[1.0 / gamma]);
        let positive = self.node("Relu", "color_positive", &[&Value(COLOR.into())], &[]);
        let color = self.node("Pow", "color_gamma", &[&positive, &exponent], &[]);
        match modulation {
            Some(by) => self.node("Div", "color_demodulated", &[&color, by], &[]),
            None => color,
        }
    }

    /// `(x - mean) / std`, channel by channel.
    fn features_z(&mut self, normalizer: &Normalizer) -> Value {
        let shape = [1, FEATURE_CHANNELS, 1, 1];
        let mean = self.constant("features_mean", &shape, &normalizer.features.mean);
        let std = self.constant("features_std", &shape, &normalizer.features.std);
        let raw = Value(FEATURES.into());
        let centred = self.node("Sub", "features_centred", &[&raw, &mean], &[]);
        self.node("Div", "features_z", &[&centred, &std], &[])
    }

    fn block(&mut self, path: &str, x: &Value, block: &ConvBlock) -> Value {
        let y = self.conv(&format!("{path}.conv"), x, &block.conv, block.norm.as_ref());
        self.node("Relu", &format!("{path}.relu"), &[&y], &[])
    }

    /// A level of an encoder: its skip, and what the level below gets.
    fn descend(&mut self, path: &str, x: &Value, level: &EncoderLevel) -> (Value, Option<Value>) {
        let mut x = x.clone();
        let mut skip = None;
        for (j, conv) in level.convs.iter().enumerate() {
            let y = self.conv(&format!("{path}.convs.{j}"), &x, conv, None);
            x = self.node("Relu", &format!("{path}.relus.{j}"), &[&y], &[]);
            if j + 1 == level.skip_after {
                skip = Some(x.clone());
            }
        }
        let settings = [
            ("kernel_shape", Setting::Ints(&[2, 2])),
            ("strides", Setting::Ints(&[2, 2])),
        ];
        let below = level
            .pooled
            .then(|| self.node("MaxPool", &format!("{path}.pool"), &[&x], &settings));
        (skip.expect("a level has a skip"), below)
    }

    /// A level of the decoder: `[decoder | skips]`, fused (Eq. 2).
    fn ascend(&mut self, path: &str, x: &Value, skips: Vec<Value>, level: &DecoderLevel) -> Value {
        let name = format!("{path}.deconv");
        let decoded = self.deconv(&name, x, &level.deconv, level.norm.as_ref());
        let decoded = self.node("Relu", &format!("{path}.relu"), &[&decoded], &[]);
        let parts: Vec<&Value> = std::iter::once(&decoded).chain(&skips).collect();
        let all = self.concat(&format!("{path}.concat"), &parts);
        let fused = self.conv(&format!("{path}.fuse"), &all, &level.fuse, None);
        match level.activated_fusion {
            true => self.node("Relu", &format!("{path}.fuse_relu"), &[&fused], &[]),
            false => fused,
        }
    }

    /// Several values side by side; one is itself.
    fn concat(&mut self, name: &str, parts: &[&Value]) -> Value {
        match parts {
            [one] => (*one).clone(),
            _ => self.node("Concat", name, parts, &[("axis", Setting::Int(1))]),
        }
    }

    fn conv(&mut self, path: &str, x: &Value, conv: &Conv2d, norm: Option<&BatchNorm>) -> Value {
        let [rows, columns] = conv.kernel_size;
        let [outputs, inputs, ..] = conv.weight.val().dims();
        let shape = [outputs, inputs, rows, columns];
        let layers = [None, norm].map(|norm| Layer::conv(conv, norm));
        let [weight, bias] = self.layer(path, shape, [outputs, 1, 1, 1], layers, norm);
        // As `layers` of demc-model says: the size stays.
        let [y, x_] = conv.kernel_size.map(|length| length / 2);
        let settings = [
            ("kernel_shape", Setting::Ints(&conv.kernel_size)),
            ("pads", Setting::Ints(&[y, x_, y, x_])),
        ];
        self.node("Conv", path, &[x, &weight, &bias], &settings)
    }

    fn deconv(
        &mut self,
        path: &str,
        x: &Value,
        deconv: &ConvTranspose2d,
        norm: Option<&BatchNorm>,
    ) -> Value {
        let [inputs, outputs] = deconv.channels;
        let [rows, columns] = deconv.kernel_size;
        let shape = [inputs, outputs, rows, columns];
        let layers = [None, norm].map(|norm| Layer::deconv(deconv, norm));
        let [weight, bias] = self.layer(path, shape, [1, outputs, 1, 1], layers, norm);
        let [y, x_] = deconv.padding;
        let settings = [
            ("kernel_shape", Setting::Ints(&deconv.kernel_size)),
            ("pads", Setting::Ints(&[y, x_, y, x_])),
            ("strides", Setting::Ints(&deconv.stride)),
        ];
        self.node("ConvTranspose", path, &[x, &weight, &bias], &settings)
    }

    /// Weight and bias of a layer whose normalisation is folded into them; `layers` are the plain and the folded one.
    ///
    /// In f16 the plain weights are stored, which a rounded bundle has, too, and what the normalisation multiplies them by
    /// beside them: rounding folded ones would be another network. Runtimes multiply once, when they load the file.
    fn layer(
        &mut self,
        path: &str,
        shape: [usize; 4],
        by_output: [usize; 4],
        layers: [Layer; 2],
        norm: Option<&BatchNorm>,
    ) -> [Value; 2] {
        let [plain, folded] = layers;
        let name = format!("{path}.weight");
        let weight = match (self.precision(), norm) {
            (Precision::F16, Some(norm)) => {
                let plain = self.kernel(&name, &shape, plain.weight());
                let scale = self.constant(&format!("{path}.scale"), &by_output, &scale_of(norm));
                self.node("Mul", &format!("{name}.scaled"), &[&plain, &scale], &[])
            }
            _ => self.kernel(&name, &shape, folded.weight()),
        };
        let bias = self.constant(&format!("{path}.bias"), &[folded.outputs()], folded.bias());
        [weight, bias]
    }
}
