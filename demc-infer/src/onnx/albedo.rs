//! Puts the albedo filter in front of the network: albedo of the first hit -> clip -> filter -> clip ->
//! back into the features.
//!
//! As in [`crate::denoise`], an image of constant albedo keeps it.

use demc_data::image::frame::MAX_ALBEDO;
use demc_data::image::frame::{FEATURES as FEATURE_CHANNELS, TEXTURES};
use demc_model::config::COLOR_CHANNELS;

use super::graph::{AttributeValue, GraphBuilder, Value};
use super::network::{COLOR, FEATURES, OUTPUT};
use super::proto::GraphProto;
use crate::Precision;
use crate::bundle::PREFIX;

/// The graph of a network whose features come from the graph of its filter. The filter's values get
/// the prefix `albedo_filter.`.
pub(super) fn with_filter(
    mut network: GraphProto,
    mut filter: GraphProto,
    precision: Precision,
) -> GraphProto {
    let features = Value(FEATURES.into());
    let mut before = GraphBuilder::new(precision, Vec::new());
    let end = TEXTURES + COLOR_CHANNELS;
    let albedo = before.channels(&named("albedo"), &features, TEXTURES..end);
    let [low, high] = &[("lowest", 0.0), ("highest", MAX_ALBEDO)]
        .map(|(name, value)| before.constant(&named(name), &[], &[value]));
    before.node("Clip", &named(COLOR), &[&albedo, low, high], &[]);
    let before = before.finish();

    let mut after = GraphBuilder::new(precision, Vec::new());
    let output = Value(named(OUTPUT));
    let clipped = after.node("Clip", &named("clipped"), &[&output, low, high], &[]);
    let over = |axes: &'static [usize]| [("axes", AttributeValue::Ints(axes))];
    // Pixels with albedo 0, which have no surface, keep it.
    let brightest = after.node("ReduceMax", &named("brightest"), &[&albedo], &over(&[1]));
    let surface = after.node("Greater", &named("surface"), &[&brightest, low], &[]);
    let kept = after.node("Where", &named("kept"), &[&surface, &clipped, low], &[]);
    // Whether any channel varies over the image.
    let most = after.node("ReduceMax", &named("most"), &[&albedo], &over(&[2, 3]));
    let least = after.node("ReduceMin", &named("least"), &[&albedo], &over(&[2, 3]));
    let span = after.node("Sub", &named("span"), &[&most, &least], &[]);
    let widest = after.node("ReduceMax", &named("widest"), &[&span], &over(&[1]));
    let varies = after.node("Greater", &named("varies"), &[&widest, low], &[]);
    let chosen = after.node("Where", &named("chosen"), &[&varies, &kept, &albedo], &[]);
    let geometry = after.channels(&named("geometry"), &features, 0..TEXTURES);
    let second = after.channels(&named("albedo2"), &features, end..FEATURE_CHANNELS);
    let parts = [&geometry, &chosen, &second];
    let axis = [("axis", AttributeValue::Int(1))];
    let whole = after.node("Concat", &named(FEATURES), &parts, &axis);
    let after = after.finish();

    rename(&mut filter, |name| match name {
        FEATURES => FEATURES.into(),
        _ => named(name),
    });
    rename(&mut network, |name| match name {
        FEATURES => whole.0.clone(),
        _ => name.into(),
    });
    let (node, initializer) = [before, filter, after, network]
        .into_iter()
        .map(|graph| (graph.node, graph.initializer))
        .unzip::<_, _, Vec<_>, Vec<_>>();
    GraphProto {
        node: node.concat(),
        initializer: initializer.concat(),
        ..GraphProto::default()
    }
}

fn named(name: &str) -> String {
    format!("{PREFIX}{name}")
}

/// Renames the nodes, values and constants of a graph.
fn rename(graph: &mut GraphProto, name: impl Fn(&str) -> String) {
    for node in &mut graph.node {
        // An optional input that is absent has an empty name.
        node.input
            .iter_mut()
            .chain(&mut node.output)
            .chain([&mut node.name])
            .filter(|value| !value.is_empty())
            .for_each(|value| *value = name(value));
    }
    for constant in &mut graph.initializer {
        constant.name = name(&constant.name);
    }
}

impl GraphBuilder {
    /// These channels of `x`.
    pub(super) fn channels(
        &mut self,
        name: &str,
        x: &Value,
        range: std::ops::Range<usize>,
    ) -> Value {
        let mut integer =
            |what: &str, value: usize| self.integers(&format!("{name}.{what}"), &[value as i64]);
        let bounds = [
            integer("start", range.start),
            integer("end", range.end),
            integer("axis", 1),
        ];
        let [start, end, axis] = &bounds;
        self.node("Slice", name, &[x, start, end, axis], &[])
    }
}
