//! The kernel head (`demc_model::kernel_head`) as a graph.
//!
//! ONNX has no operation that filters each pixel with its own kernel. A convolution with one-hot
//! kernels gathers the 25 neighbours of each pixel, 441 for KPCN; their products with the softmax are
//! summed.

use burn::nn::conv::Conv2d;
use demc_model::config::COLOR_CHANNELS;
use demc_model::kernel_head::{DARKEST, GAMMA, KERNEL_LEVELS, KERNEL_LOGITS, logits};

use super::graph::{AttributeValue, GraphBuilder, Value};

/// Side of a kernel, in pixels.
const SIDE: usize = 5;

/// The one-hot kernels that gather the neighbours of a pixel.
pub(super) struct Neighbours {
    side: usize,
    kernels: Value,
}

impl GraphBuilder {
    /// The denoised image in gamma space. `decoded` are the decoder's maps, deepest first, and
    /// `color_gamma` is the network's input colour.
    pub(super) fn kernel_head(
        &mut self,
        kernels: &[Conv2d],
        decoded: &[Value],
        color_gamma: &Value,
    ) -> Value {
        let gamma = self.constant("kernels.gamma", &[], &[GAMMA]);
        let image = self.node("Pow", "kernels.image", &[color_gamma, &gamma], &[]);
        let out = self.filtered_on_all_scales(kernels, decoded, image);
        let darkest = self.constant("kernels.darkest", &[], &[DARKEST]);
        let visible = self.node("Greater", "kernels.visible", &[&out, &darkest], &[]);
        let target = [("to", AttributeValue::Int(1))];
        let factor = self.node("Cast", "kernels.visible.f32", &[&visible], &target);
        let bright = self.node("Max", "kernels.bright", &[&out, &darkest], &[]);
        let exponent = self.constant("kernels.inverse_gamma", &[], &[1.0 / GAMMA]);
        let power = self.node("Pow", "kernels.power", &[&bright, &exponent], &[]);
        self.node("Mul", "output_gamma", &[&power, &factor], &[])
    }

    /// An image in linear light, filtered with predicted kernels. `decoded` are the decoder's maps, deepest
    /// first.
    fn filtered_on_all_scales(
        &mut self,
        kernels: &[Conv2d],
        decoded: &[Value],
        image: Value,
    ) -> Value {
        let mut scales = vec![image];
        for level in 1..KERNEL_LEVELS {
            let image = scales[level - 1].clone();
            scales.push(self.halved(&format!("kernels.image.{level}"), &image));
        }
        let neighbours = self.neighbours(SIDE);
        let decoded = &decoded[decoded.len() - kernels.len()..];
        let mut out: Option<Value> = None;
        for (k, (conv, decoded)) in kernels.iter().zip(decoded).enumerate() {
            let level = KERNEL_LEVELS - 1 - k;
            let all = self.conv(decoded, conv, None);
            let weights =
                self.channels(&format!("kernels.weights.{level}"), &all, 0..KERNEL_LOGITS);
            let filtered = self.filtered(&level.to_string(), &scales[level], &weights, &neighbours);
            out = Some(match out {
                None => filtered,
                Some(coarse) => {
                    let name = format!("kernels.blend.{level}");
                    let blend = self.channels(&name, &all, KERNEL_LOGITS..logits(level));
                    self.blended(level, &filtered, &coarse, &blend)
                }
            });
        }
        out.expect("a kernel head has levels")
    }

    /// One-hot kernels `[3 N, 1, side, side]`: the N neighbours of each channel.
    pub(super) fn neighbours(&mut self, side: usize) -> Neighbours {
        let taps = side * side;
        let mut values = vec![0.0; COLOR_CHANNELS * taps * taps];
        for (kernel, values) in values.chunks_mut(taps).enumerate() {
            values[kernel % taps] = 1.0;
        }
        let shape = [COLOR_CHANNELS * taps, 1, side, side];
        Neighbours {
            side,
            kernels: self.constant("kernels.neighbours", &shape, &values),
        }
    }

    /// An image `[B, 3, H, W]`, filtered with the softmax of `[B, N, H, W]`. Names of values end in `part`.
    pub(super) fn filtered(
        &mut self,
        part: &str,
        image: &Value,
        weights: &Value,
        neighbours: &Neighbours,
    ) -> Value {
        let side = neighbours.side;
        let name = |what: &str| format!("kernels.{what}.{part}");
        let axis = [("axis", AttributeValue::Int(1))];
        let shares = self.node("Softmax", &name("softmax"), &[weights], &axis);
        let reach = (side / 2) as i64;
        let pads = self.integers(&name("pads"), &[0, 0, reach, reach, 0, 0, reach, reach]);
        let edge = [("mode", AttributeValue::Text("edge"))];
        let padded = self.node("Pad", &name("padded"), &[image, &pads], &edge);
        let groups = [
            ("group", AttributeValue::Int(COLOR_CHANNELS as i64)),
            ("kernel_shape", AttributeValue::Ints(&[side, side])),
        ];
        let inputs = [&padded, &neighbours.kernels];
        let gathered = self.node("Conv", &name("gathered"), &inputs, &groups);
        let taps = (side * side) as i64;
        let [colors, one] = [("color_shape", COLOR_CHANNELS as i64), ("weight_shape", 1)]
            .map(|(what, first)| self.integers(&name(what), &[0, first, taps, -1]));
        let values = self.node("Reshape", &name("taps"), &[&gathered, &colors], &[]);
        let kernel = self.node("Reshape", &name("kernel"), &[&shares, &one], &[]);
        let products = self.node("Mul", &name("products"), &[&values, &kernel], &[]);
        let axes = self.integers(&name("axes"), &[2]);
        let flat = [("keepdims", AttributeValue::Int(0))];
        let sum = self.node("ReduceSum", &name("sum"), &[&products, &axes], &flat);
        let shape = self.node("Shape", &name("shape"), &[image], &[]);
        self.node("Reshape", &name("filtered"), &[&sum, &shape], &[])
    }

    /// `y + b U(coarse - D(y))`.
    fn blended(&mut self, level: usize, filtered: &Value, coarse: &Value, blend: &Value) -> Value {
        let name = |what: &str| format!("kernels.{what}.{level}");
        let mean = self.halved(&name("mean"), filtered);
        let correction = self.node("Sub", &name("correction"), &[coarse, &mean], &[]);
        let scales = self.constant(&name("scales"), &[4], &[1.0, 1.0, 2.0, 2.0]);
        let linear = [("mode", AttributeValue::Text("linear"))];
        let region = Value(String::new());
        let inputs = [&correction, &region, &scales];
        let doubled = self.node("Resize", &name("doubled"), &inputs, &linear);
        let share = self.node("Sigmoid", &name("share"), &[blend], &[]);
        let product = self.node("Mul", &name("corrected"), &[&doubled, &share], &[]);
        self.node("Add", &name("out"), &[filtered, &product], &[])
    }

    fn halved(&mut self, name: &str, image: &Value) -> Value {
        let settings = [
            ("kernel_shape", AttributeValue::Ints(&[2, 2])),
            ("strides", AttributeValue::Ints(&[2, 2])),
        ];
        self.node("AveragePool", name, &[image], &settings)
    }
}
