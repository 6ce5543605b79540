//! A network ready to denoise, and its albedo filter. The filter is a second network in the same file;
//! it denoises the first hit's albedo before the main network sees it ([`crate::denoise`]).

use std::iter;

use demc_data::image::layout::{Missing, MissingPolicies};
use demc_model::Denoiser;
use demc_model::config::COLOR_CHANNELS;

use super::error::BundleError;
use super::meta::BundleMeta;
use super::names::Names;

/// Prefix of the filter's tensors in a file, and of its values in an ONNX graph.
pub(crate) const PREFIX: &str = "albedo_filter.";
/// Key of the filter's metadata in the header entry.
pub(super) const FILTER_KEY: &str = "albedo_filter";

/// A network ready to denoise, with its metadata.
///
/// The model must be on a device without autodiff. With autodiff, batch normalisation would use the
/// current image's statistics.
#[derive(Debug, Clone)]
pub struct Bundle {
    /// Everything about the network except its weights.
    pub meta: BundleMeta,
    /// The network.
    pub model: Denoiser,
    /// A second network, which denoises the first hit's albedo before this one sees it. It has no
    /// filter of its own.
    pub albedo_filter: Option<Box<Bundle>>,
}

impl Bundle {
    /// A network without an albedo filter.
    pub fn new(meta: BundleMeta, model: Denoiser) -> Self {
        Self {
            meta,
            model,
            albedo_filter: None,
        }
    }

    /// The feature buffers that a file may lack, and what replaces them. The policies are those of
    /// the training's layout. Without one, zeros replace what no network takes; texture1 replaces texture2
    /// and zeros the position. With the bundled models these two changed the error by less than 3 %.
    pub fn missing(&self) -> MissingPolicies {
        let policies = self.meta.layout.missing.or(self.without_effect());
        policies.or(MissingPolicies {
            position: Missing::Zeros,
            texture2: Missing::CopyTexture1,
            ..MissingPolicies::default()
        })
    }

    /// Zeros for the feature buffers that neither the network nor its albedo filter takes.
    pub(crate) fn without_effect(&self) -> MissingPolicies {
        let takes = |first: usize| {
            let mut networks = iter::once(self).chain(self.albedo_filter.as_deref());
            networks.any(|network| network.meta.model.takes_feature(first))
        };
        let policy = |buffer: usize| {
            if takes(COLOR_CHANNELS * buffer) {
                Missing::Error
            } else {
                Missing::Zeros
            }
        };
        let [normal, position, texture1, texture2] = [0, 1, 2, 3].map(policy);
        MissingPolicies {
            normal,
            position,
            texture1,
            texture2,
        }
    }

    /// Replaces the albedo filter by `model`, or by the filter of `model` if it has one.
    ///
    /// # Errors
    /// [`BundleError::AlbedoFilter`]: the filter takes other positions than this network.
    pub fn set_albedo_filter(&mut self, mut model: Bundle) -> Result<(), BundleError> {
        let filter = match model.albedo_filter.take() {
            Some(filter) => filter,
            None => Box::new(model),
        };
        if let Some(detail) = filter
            .meta
            .filter_problem(self.meta.layout.inputs, self.meta.normalizer.position)
        {
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

#[cfg(test)]
mod tests {
    use demc_model::Variant;
    use demc_model::unet::Guides;

    use super::*;
    use crate::bundle::testing::{bundle, filtered};

    #[test]
    fn a_file_may_lack_what_no_network_takes() {
        let mut unet = bundle(Variant::Unet);
        unet.meta.model.guides = Guides::Albedo;
        let expected = [
            Missing::Zeros,
            Missing::Zeros,
            Missing::Error,
            Missing::Zeros,
        ];
        assert_eq!(unet.missing().in_order(), expected);
        let control = bundle(Variant::ColorOnly);
        assert_eq!(control.missing().in_order(), [Missing::Zeros; 4]);
        for takes_all in [
            bundle(Variant::Semc),
            bundle(Variant::Kpcn),
            filtered(Variant::ColorOnly, Variant::Demc),
        ] {
            assert_eq!(takes_all.without_effect().in_order(), [Missing::Error; 4]);
        }
    }
}
