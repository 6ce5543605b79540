//! The albedo filter: a second network in the same file, which denoises the first hit's albedo
//! before the main network sees it ([`crate::denoise`]).

use demc_data::PositionSpace;
use demc_model::Variant;

use super::{Bundle, BundleError, BundleMeta, Names};

/// Prefix of the filter's tensors in a file, and of its values in an ONNX graph.
pub(crate) const PREFIX: &str = "albedo_filter.";
/// Key of the filter's metadata in the header entry.
pub(super) const FILTER_KEY: &str = "albedo_filter";

impl BundleMeta {
    /// Why this network cannot be the albedo filter of one that takes such positions; `None` if it
    /// can. Both get the same positions: in ONNX and Python the caller maps them once.
    pub fn filter_problem(&self, position: PositionSpace) -> Option<String> {
        // The variant without features takes no positions.
        let same = self.normalizer.position == position || self.model.variant == Variant::ColorOnly;
        let name = |space: PositionSpace| match space {
            PositionSpace::Scene => "scene",
            PositionSpace::Image => "image",
        };
        (!same).then(|| {
            let [own, theirs] = [self.normalizer.position, position].map(name);
            format!(
                "the albedo filter was trained with data.position = \"{own}\", the network with \
                 \"{theirs}\"; train the filter with \"{theirs}\""
            )
        })
    }
}

impl Bundle {
    /// Replaces the albedo filter by `model`, or by the filter of `model` if it has one.
    ///
    /// # Errors
    /// [`BundleError::AlbedoFilter`]: the filter takes other positions than this network.
    pub fn set_albedo_filter(&mut self, mut model: Bundle) -> Result<(), BundleError> {
        let filter = match model.albedo_filter.take() {
            Some(filter) => filter,
            None => Box::new(model),
        };
        if let Some(detail) = filter.meta.filter_problem(self.meta.normalizer.position) {
            return Err(BundleError::AlbedoFilter(detail));
        }
        self.albedo_filter = Some(filter);
        Ok(())
    }

    /// Name in a file and shape of every tensor, with those of the albedo filter.
    pub fn tensors(&self, names: Names) -> Vec<(String, Vec<usize>)> {
        let networks = self.networks().zip(["", PREFIX]);
        let specs = networks.flat_map(|(bundle, prefix)| {
            let specs = bundle.meta.model.weight_specs().into_iter();
            specs.map(move |spec| (format!("{prefix}{}", names.in_file(&spec)), spec.shape))
        });
        specs.collect()
    }

    /// The network and its albedo filter, if it has one.
    pub fn networks(&self) -> impl Iterator<Item = &Bundle> {
        std::iter::once(self).chain(self.albedo_filter.as_deref())
    }
}
