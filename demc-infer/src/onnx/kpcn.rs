//! KPCN (`demc_model::kpcn`) as a graph, between the inputs and the output of the network.

use demc_model::config::{COLOR_CHANNELS, FEATURE_CHANNELS};
use demc_model::kpcn::{KernelNetwork, Kpcn, SURFACE, VARIANCES};

use super::graph::{AttributeValue, GraphBuilder, Value};
use super::network::{COLOR, FEATURES, OUTPUT};

/// Side of a kernel, in pixels.
const SIDE: usize = 21;

impl GraphBuilder {
    pub(super) fn kpcn(&mut self, networks: &Kpcn) {
        let features = Value(FEATURES.into());
        let mut surface = Vec::new();
        let mut first = 0;
        for (index, channels) in SURFACE.into_iter().enumerate() {
            let name = format!("surface.{index}");
            let planes = self.channels(&name, &features, first..first + channels);
            surface.extend(self.with_differences(&planes));
            surface.push(self.variance(2 + index));
            first += channels;
        }
        let neighbours = self.neighbours(SIDE);
        let parts = [
            ("diffuse", &networks.diffuse),
            ("specular", &networks.specular),
        ];
        let mut filtered = Vec::new();
        for (part, (name, network)) in parts.into_iter().enumerate() {
            let range = part * COLOR_CHANNELS..(part + 1) * COLOR_CHANNELS;
            let light = self.channels(&format!("{name}.light"), &Value(COLOR.into()), range);
            let mut inputs = self.with_differences(&light).to_vec();
            inputs.push(self.variance(part));
            inputs.extend(surface.iter().cloned());
            let inputs: Vec<&Value> = inputs.iter().collect();
            let inputs = self.concat(&format!("{name}.inputs"), &inputs);
            let logits = self.logits(&inputs, network);
            filtered.push(self.filtered(name, &light, &logits, &neighbours));
        }
        let filtered: Vec<&Value> = filtered.iter().collect();
        self.concat(OUTPUT, &filtered);
    }

    fn logits(&mut self, inputs: &Value, network: &KernelNetwork) -> Value {
        let mut maps = inputs.clone();
        for (layer, conv) in network.layers.iter().enumerate() {
            maps = self.conv(&maps, conv, None);
            if layer + 1 < network.layers.len() {
                maps = self.relu(&maps);
            }
        }
        maps
    }

    /// The variance of diffuse or specular light, normal, albedo, or depth.
    fn variance(&mut self, index: usize) -> Value {
        let first = VARIANCES + index;
        assert!(first < FEATURE_CHANNELS, "there are five variances");
        let features = Value(FEATURES.into());
        self.channels(&format!("variance.{index}"), &features, first..first + 1)
    }

    /// The planes, and their differences to the pixel on the left and to the one above.
    fn with_differences(&mut self, planes: &Value) -> [Value; 3] {
        let mut difference = |what: &str, axis: i64| {
            let name = |step: &str| format!("{}.{what}.{step}", planes.0);
            let mut slice = |step: &str, range: [i64; 2]| {
                let bounds = [
                    self.integers(&name(&format!("{step}.start")), &[range[0]]),
                    self.integers(&name(&format!("{step}.end")), &[range[1]]),
                    self.integers(&name(&format!("{step}.axis")), &[axis]),
                ];
                let [start, end, axis] = &bounds;
                self.node("Slice", &name(step), &[planes, start, end, axis], &[])
            };
            let first = slice("first", [0, 1]);
            let before = slice("before", [0, -1]);
            let along = [("axis", AttributeValue::Int(axis))];
            let shifted = self.node("Concat", &name("shifted"), &[&first, &before], &along);
            self.node("Sub", &name("difference"), &[planes, &shifted], &[])
        };
        [
            planes.clone(),
            difference("across", 3),
            difference("down", 2),
        ]
    }
}
