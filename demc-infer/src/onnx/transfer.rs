//! The curve between linear radiance and the network's colour as a graph.

use demc_data::{Normalizer, Transfer};
use demc_kernels::pu::{self, A, B, C, D, E, F, G, PEAK, X0, X1, Y0, Y1};

use super::graph::{GraphBuilder, Value};
use super::network::{COLOR, OUTPUT};

impl GraphBuilder {
    /// The network's colour: radiance of at least 0, compressed, divided by the modulation.
    pub(super) fn compressed(
        &mut self,
        normalizer: &Normalizer,
        modulation: Option<&Value>,
    ) -> Value {
        let positive = self.node("Relu", "color_positive", &[&Value(COLOR.into())], &[]);
        let color = match normalizer.transfer {
            Transfer::Gamma => {
                let exponent = self.constant("inverse_gamma", &[], &[1.0 / normalizer.gamma]);
                self.node("Pow", "color_gamma", &[&positive, &exponent], &[])
            }
            Transfer::Pu => self.pu(&positive),
        };
        match modulation {
            Some(modulation) => self.node("Div", "color_demodulated", &[&color, modulation], &[]),
            None => color,
        }
    }

    /// The output: radiance of the network's image, which is not negative.
    pub(super) fn expanded(&mut self, normalizer: &Normalizer, image: &Value) {
        match normalizer.transfer {
            Transfer::Gamma => {
                let gamma = self.constant("gamma", &[], &[normalizer.gamma]);
                self.node("Pow", OUTPUT, &[image, &gamma], &[]);
            }
            Transfer::Pu => self.pu_inverse(image),
        }
    }

    /// `x op value`, as node and constant of this name.
    fn with(&mut self, op: &str, name: &str, x: &Value, value: f32) -> Value {
        let constant = self.constant(&format!("{name}.constant"), &[], &[value]);
        self.node(op, name, &[x, &constant], &[])
    }

    /// See [`pu::value`].
    fn pu(&mut self, y: &Value) -> Value {
        let dark = self.with("Mul", "pu.dark", y, A);
        let power = self.with("Pow", "pu.power", y, C);
        let scaled = self.with("Mul", "pu.scaled", &power, B);
        let middle = self.with("Add", "pu.middle", &scaled, D);
        let shifted = self.with("Add", "pu.shifted", y, F);
        let logarithm = self.node("Log", "pu.logarithm", &[&shifted], &[]);
        let steep = self.with("Mul", "pu.steep", &logarithm, E);
        let bright = self.with("Add", "pu.bright", &steep, G);
        let is_dark = self.with("LessOrEqual", "pu.is_dark", y, Y0);
        let is_middle = self.with("LessOrEqual", "pu.is_middle", y, Y1);
        let upper = [&is_middle, &middle, &bright];
        let upper = self.node("Where", "pu.upper", &upper, &[]);
        let value = self.node("Where", "pu.value", &[&is_dark, &dark, &upper], &[]);
        self.with("Div", "pu.color", &value, pu::value(PEAK))
    }

    /// See [`pu::inverse`].
    fn pu_inverse(&mut self, image: &Value) {
        let x = self.with("Mul", "pu.out.value", image, pu::value(PEAK));
        let dark = self.with("Div", "pu.out.dark", &x, A);
        let shifted = self.with("Sub", "pu.out.shifted", &x, D);
        // A power of a negative number is undefined, and a runtime computes both branches.
        let positive = self.node("Relu", "pu.out.positive", &[&shifted], &[]);
        let scaled = self.with("Div", "pu.out.scaled", &positive, B);
        let middle = self.with("Pow", "pu.out.middle", &scaled, 1.0 / C);
        let lowered = self.with("Sub", "pu.out.lowered", &x, G);
        let flat = self.with("Div", "pu.out.flat", &lowered, E);
        let exponential = self.node("Exp", "pu.out.exponential", &[&flat], &[]);
        let bright = self.with("Sub", "pu.out.bright", &exponential, F);
        let is_dark = self.with("LessOrEqual", "pu.out.is_dark", &x, X0);
        let is_middle = self.with("LessOrEqual", "pu.out.is_middle", &x, X1);
        let upper = self.node(
            "Where",
            "pu.out.upper",
            &[&is_middle, &middle, &bright],
            &[],
        );
        self.node("Where", OUTPUT, &[&is_dark, &dark, &upper], &[]);
    }
}
