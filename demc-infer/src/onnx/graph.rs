//! A graph under construction: nodes, constants, and the names that tie them together.

use half::f16;
use half::slice::HalfFloatSliceExt;

use super::proto::{self, Attribute, FLOAT, FLOAT16, INT, INT64, INTS, Node, Tensor};
use crate::Precision;
use crate::bundle::tensors::f32_bytes;

/// A value in the graph, by its name.
#[derive(Clone, Debug)]
pub(super) struct Value(pub(super) String);

/// The settings of an operator.
pub(super) type Attributes<'a> = &'a [(&'a str, Setting<'a>)];

/// One of them.
pub(super) enum Setting<'a> {
    Int(i64),
    Ints(&'a [usize]),
}

/// Nodes and constants so far.
pub(super) struct Graph {
    precision: Precision,
    nodes: Vec<Node>,
    constants: Vec<Tensor>,
}

impl Graph {
    /// An empty one whose kernels will be stored with this precision.
    pub(super) fn new(precision: Precision) -> Self {
        Graph {
            precision,
            nodes: Vec::new(),
            constants: Vec::new(),
        }
    }

    /// How kernels are stored.
    pub(super) fn precision(&self) -> Precision {
        self.precision
    }

    /// Adds a node called `name`, which is also what its value is called.
    pub(super) fn node(
        &mut self,
        op: &str,
        name: &str,
        inputs: &[&Value],
        attributes: Attributes,
    ) -> Value {
        let attribute = attributes.iter().map(|(name, setting)| {
            let (i, ints, r#type) = match setting {
                Setting::Int(i) => (Some(*i), Vec::new(), INT),
                Setting::Ints(ints) => (None, ints.iter().map(|&i| i as i64).collect(), INTS),
            };
            let name = name.to_string();
            Attribute {
                name,
                i,
                ints,
                r#type,
            }
        });
        self.nodes.push(Node {
            input: inputs.iter().map(|value| value.0.clone()).collect(),
            output: vec![name.into()],
            name: name.into(),
            op_type: op.into(),
            attribute: attribute.collect(),
        });
        Value(name.into())
    }

    /// Adds an f32 constant.
    pub(super) fn constant(&mut self, name: &str, shape: &[usize], values: &[f32]) -> Value {
        self.store(name, shape, FLOAT, f32_bytes(values))
    }

    /// Adds a list of integers.
    pub(super) fn integers(&mut self, name: &str, values: &[i64]) -> Value {
        let bytes = values.iter().flat_map(|value| value.to_le_bytes());
        self.store(name, &[values.len()], INT64, bytes.collect())
    }

    /// Adds a kernel, stored as the precision says, and gives it as f32. Values must be exact in that precision.
    pub(super) fn kernel(&mut self, name: &str, shape: &[usize], values: &[f32]) -> Value {
        if self.precision == Precision::F32 {
            return self.constant(name, shape, values);
        }
        let mut halves = vec![f16::ZERO; values.len()];
        halves.convert_from_f32_slice(values);
        let bytes = halves.iter().flat_map(|half| half.to_le_bytes()).collect();
        let stored = self.store(name, shape, FLOAT16, bytes);
        let to = [("to", Setting::Int(i64::from(FLOAT)))];
        self.node("Cast", &format!("{name}.f32"), &[&stored], &to)
    }

    fn store(&mut self, name: &str, shape: &[usize], data_type: i32, raw_data: Vec<u8>) -> Value {
        self.constants.push(Tensor {
            dims: shape.iter().map(|&length| length as i64).collect(),
            data_type,
            name: name.into(),
            raw_data,
        });
        Value(name.into())
    }

    /// The graph's message, still without inputs, outputs and texts.
    pub(super) fn finish(self) -> proto::Graph {
        proto::Graph {
            node: self.nodes,
            initializer: self.constants,
            ..proto::Graph::default()
        }
    }
}
