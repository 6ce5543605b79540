//! Builds a graph: nodes and constants, connected by the names of their values.

use burn::module::ParamId;
use demc_model::WeightSpec;
use half::f16;
use half::slice::HalfFloatSliceExt;

use super::proto::{
    AttributeProto, FLOAT, FLOAT16, GraphProto, INT, INT64, INTS, NodeProto, STRING, TensorProto,
};
use crate::Precision;
use crate::bundle::tensors::f32_bytes;

/// A value in the graph, by its name.
#[derive(Clone, Debug)]
pub(super) struct Value(pub(super) String);

pub(super) type Attributes<'a> = &'a [(&'a str, AttributeValue<'a>)];

pub(super) enum AttributeValue<'a> {
    Int(i64),
    Ints(&'a [usize]),
    Text(&'a str),
}

pub(super) struct GraphBuilder {
    precision: Precision,
    /// The network's tensors in the order of their ids, which start at 1.
    specs: Vec<WeightSpec>,
    nodes: Vec<NodeProto>,
    constants: Vec<TensorProto>,
}

impl GraphBuilder {
    pub(super) fn new(precision: Precision, specs: Vec<WeightSpec>) -> Self {
        GraphBuilder {
            precision,
            specs,
            nodes: Vec::new(),
            constants: Vec::new(),
        }
    }

    pub(super) fn precision(&self) -> Precision {
        self.precision
    }

    pub(super) fn spec(&self, id: ParamId) -> WeightSpec {
        self.specs[id.val() as usize - 1].clone()
    }

    /// Adds a node. Its name is also the name of its value.
    pub(super) fn node(
        &mut self,
        op: &str,
        name: &str,
        inputs: &[&Value],
        attributes: Attributes,
    ) -> Value {
        let attribute = attributes.iter().map(|(name, value)| {
            let mut attribute = AttributeProto {
                name: name.to_string(),
                ..AttributeProto::default()
            };
            attribute.r#type = match value {
                AttributeValue::Int(i) => {
                    attribute.i = Some(*i);
                    INT
                }
                AttributeValue::Ints(ints) => {
                    attribute.ints = ints.iter().map(|&i| i as i64).collect();
                    INTS
                }
                AttributeValue::Text(text) => {
                    attribute.s = text.as_bytes().to_vec();
                    STRING
                }
            };
            attribute
        });
        self.nodes.push(NodeProto {
            input: inputs.iter().map(|value| value.0.clone()).collect(),
            output: vec![name.into()],
            name: name.into(),
            op_type: op.into(),
            attribute: attribute.collect(),
        });
        Value(name.into())
    }

    pub(super) fn constant(&mut self, name: &str, shape: &[usize], values: &[f32]) -> Value {
        self.store(name, shape, FLOAT, f32_bytes(values))
    }

    pub(super) fn integers(&mut self, name: &str, values: &[i64]) -> Value {
        let bytes = values.iter().flat_map(|value| value.to_le_bytes());
        self.store(name, &[values.len()], INT64, bytes.collect())
    }

    /// Adds a kernel in the stored precision and returns it as f32. Values must be exact in that
    /// precision.
    pub(super) fn kernel(&mut self, name: &str, shape: &[usize], values: &[f32]) -> Value {
        if self.precision == Precision::F32 {
            return self.constant(name, shape, values);
        }
        let mut halves = vec![f16::ZERO; values.len()];
        halves.convert_from_f32_slice(values);
        let bytes = halves.iter().flat_map(|half| half.to_le_bytes()).collect();
        let stored = self.store(name, shape, FLOAT16, bytes);
        let target = [("to", AttributeValue::Int(i64::from(FLOAT)))];
        self.node("Cast", &format!("{name}.f32"), &[&stored], &target)
    }

    fn store(&mut self, name: &str, shape: &[usize], data_type: i32, raw_data: Vec<u8>) -> Value {
        self.constants.push(TensorProto {
            dims: shape.iter().map(|&length| length as i64).collect(),
            data_type,
            name: name.into(),
            raw_data,
        });
        Value(name.into())
    }

    pub(super) fn finish(self) -> GraphProto {
        GraphProto {
            node: self.nodes,
            initializer: self.constants,
            ..GraphProto::default()
        }
    }
}
