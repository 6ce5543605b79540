//! Imports weights that were trained in another program.

use std::collections::BTreeMap;
use std::path::Path;

use demc_model::{ModelConfig, Role, Weight, WeightSpec};
use demc_program::message::printable;
use safetensors::SafeTensors;
use safetensors::tensor::{Dtype, TensorView};

use super::error::BundleError;
use super::file::{BundleFile, damaged, parse_meta, read};
use super::names::{Names, Precision};
use super::network::PREFIX;
use super::tensors::values;

/// Invalid tensors by kind of problem.
#[derive(Default)]
struct TensorProblems {
    missing: Vec<String>,
    unknown: Vec<String>,
    misshaped: Vec<String>,
    unusable: Vec<String>,
    negative: Vec<String>,
}

impl TensorProblems {
    /// All problems in one line; `None` without problems.
    fn line(self) -> Option<String> {
        let lists = [
            ("missing", self.missing),
            ("not part of this network", self.unknown),
            ("wrong shape", self.misshaped),
            ("unusable", self.unusable),
            ("negative variance", self.negative),
        ];
        let parts: Vec<String> = lists
            .into_iter()
            .filter(|(_, tensors)| !tensors.is_empty())
            .map(|(what, tensors)| format!("{what}: {}", tensors.join(", ")))
            .collect();
        (!parts.is_empty()).then(|| parts.join("; "))
    }
}

/// The tensors of a file that no network has taken yet, and what is wrong with those taken.
struct Tensors<'a> {
    found: BTreeMap<String, TensorView<'a>>,
    problems: TensorProblems,
    precision: Precision,
}

impl Tensors<'_> {
    /// Takes the tensors of `model`, whose names have `prefix`.
    fn take(&mut self, prefix: &str, model: &ModelConfig) -> Vec<Weight> {
        let problems = &mut self.problems;
        let mut weights = Vec::new();
        for spec in model.weight_specs() {
            let called = format!("{prefix}{}", Names::Torch.in_file(&spec));
            let found = &mut self.found;
            let view = found
                .remove(&called)
                .or_else(|| found.remove(&format!("{prefix}{}", spec.name)));
            let WeightSpec {
                name, shape, role, ..
            } = spec;
            let Some(view) = view else {
                problems.missing.push(called);
                continue;
            };
            if view.shape() != shape {
                problems
                    .misshaped
                    .push(format!("{called} {:?} instead of {shape:?}", view.shape()));
                continue;
            }
            if view.dtype() == Dtype::F16 {
                self.precision = Precision::F16;
            }
            match values(&view) {
                Err(detail) => problems.unusable.push(format!("{called} ({detail})")),
                Ok(data) if role == Role::RunningVariance && data.iter().any(|x| *x < 0.0) => {
                    problems.negative.push(called);
                }
                Ok(data) => weights.push(Weight { name, shape, data }),
            }
        }
        weights
    }
}

impl BundleFile {
    /// Reads the weights of a network from the safetensors file `path`, with PyTorch's or Burn's
    /// names.
    ///
    /// `like` describes the network. Without it, the file's own header must. A file without the
    /// tensors of an albedo filter gets the filter of `like`. The checksum in the header is not
    /// compared, because imported weights were usually changed on purpose.
    ///
    /// # Errors
    /// - The file cannot be read or is no safetensors file.
    /// - [`BundleError::Foreign`]: neither `like` nor the header describes the network.
    /// - [`BundleError::Import`]: lists every tensor that is missing, unknown, misshaped, of a type
    ///   other than f32 and f16, or not finite.
    pub fn import(path: &Path, like: Option<BundleFile>) -> Result<Self, BundleError> {
        let bytes = read(path)?;
        let (meta, filter_meta, mut filter) = match like {
            Some(like) => {
                let filter = like.albedo_filter;
                let meta = filter.as_ref().map(|filter| filter.meta.clone());
                (like.meta, meta, filter)
            }
            None => {
                let header = parse_meta(path, &bytes)?;
                (header.meta, header.albedo_filter, None)
            }
        };
        let file = SafeTensors::deserialize(&bytes).map_err(|error| damaged(path, &error))?;
        let mut tensors = Tensors {
            found: file
                .iter()
                .map(|(name, view)| (printable(name), view))
                .collect(),
            problems: TensorProblems::default(),
            precision: Precision::F32,
        };
        let has_filter = tensors.found.keys().any(|name| name.starts_with(PREFIX));
        let weights = tensors.take("", &meta.model);
        let imported = |meta, weights, albedo_filter, precision| Self {
            path: path.into(),
            meta,
            names: Names::Torch,
            precision,
            weights,
            albedo_filter,
        };
        if let Some(meta) = filter_meta
            && (has_filter || filter.is_none())
        {
            let weights = tensors.take(PREFIX, &meta.model);
            filter = Some(Box::new(imported(meta, weights, None, tensors.precision)));
        }
        let Tensors {
            found,
            mut problems,
            precision,
        } = tensors;
        problems.unknown.extend(found.into_keys());
        match problems.line() {
            Some(problems) => Err(BundleError::Import {
                path: path.into(),
                problems,
            }),
            None => Ok(imported(meta, weights, filter, precision)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::bundle;
    use super::super::{Bundle, tensors};
    use super::*;
    use burn::tensor::Device;
    use demc_model::Variant;

    /// A file with PyTorch's names and no header, as `safetensors.torch.save_file` writes it.
    fn saved(bundle: &Bundle, change: impl FnOnce(&mut Vec<Weight>)) -> tempfile::TempPath {
        let mut weights = bundle.model.weights();
        for (weight, spec) in weights.iter_mut().zip(bundle.meta.model.weight_specs()) {
            weight.name = Names::Torch.in_file(&spec);
        }
        change(&mut weights);
        let path = tempfile::NamedTempFile::new()
            .expect("file")
            .into_temp_path();
        std::fs::write(&path, tensors::to_bytes(&weights).expect("bytes")).expect("written");
        path
    }

    /// The bundle as a file that was read.
    fn like(bundle: &Bundle) -> Option<BundleFile> {
        let bytes = bundle.to_bytes(Names::Burn, Precision::F32).expect("bytes");
        Some(BundleFile::parse("like".into(), &bytes).expect("a bundle"))
    }

    fn error(path: &Path, bundle: &Bundle) -> String {
        let error = BundleFile::import(path, like(bundle)).expect_err("refused");
        let text = error.to_string();
        let start = format!("{}: ", path.display());
        text.strip_prefix(&start).expect("path first").to_string()
    }

    #[test]
    fn an_export_comes_back_bit_for_bit_with_and_without_its_header() {
        for variant in Variant::ALL {
            let bundle = bundle(variant);
            let bytes = |bundle: &Bundle| bundle.to_bytes(Names::Burn, Precision::F32).expect("ok");
            let back = |path: &Path, like| {
                let file = BundleFile::import(path, like).expect("imported");
                file.into_bundle(&Device::flex()).expect("fits")
            };
            let plain = saved(&bundle, |_| ());
            assert_eq!(bytes(&back(&plain, like(&bundle))), bytes(&bundle));
            let error = BundleFile::import(&plain, None).expect_err("no header");
            assert!(matches!(error, BundleError::Foreign { .. }), "{error}");

            let whole = tempfile::NamedTempFile::new()
                .expect("file")
                .into_temp_path();
            bundle
                .save(&whole, Names::Torch, Precision::F32)
                .expect("saved");
            assert_eq!(bytes(&back(&whole, None)), bytes(&bundle));
        }
    }

    #[test]
    fn the_given_model_replaces_the_files_own_header() {
        let theirs = bundle(Variant::Demc);
        let path = tempfile::NamedTempFile::new()
            .expect("file")
            .into_temp_path();
        theirs
            .save(&path, Names::Torch, Precision::F16)
            .expect("saved");
        let mut other = theirs.clone();
        other.meta.step = 999;
        other.meta.normalizer.features.mean[0] = 7.0;
        let file = BundleFile::import(&path, like(&other)).expect("imported");
        assert_eq!((file.meta, file.precision), (other.meta, Precision::F16));
    }

    #[test]
    fn all_problems_are_listed_at_once() {
        let bundle = bundle(Variant::Demc);
        let index_of = |weights: &mut [Weight], name: &str| {
            weights.iter().position(|w| w.name == name).expect(name)
        };
        let path = saved(&bundle, |weights| {
            for name in ["latent.norm.weight", "decoder.head.bias"] {
                let i = index_of(weights, name);
                weights.remove(i);
            }
            let i = index_of(weights, "latent.conv.bias");
            weights[i].shape = vec![16, 1];
            let i = index_of(weights, "fusion.blocks.0.conv.bias");
            weights[i].data[1] = f32::NAN;
            let i = index_of(weights, "latent.norm.running_var");
            weights[i].data[0] = -1.0;
            weights[0].name.insert_str(0, "module.");
        });
        assert_eq!(
            error(&path, &bundle),
            "missing: fusion.blocks.0.conv.weight, latent.norm.weight, decoder.head.bias; \
             not part of this network: module.fusion.blocks.0.conv.weight; \
             wrong shape: latent.conv.bias [16, 1] instead of [16]; \
             unusable: fusion.blocks.0.conv.bias (NaN among its values); \
             negative variance: latent.norm.running_var"
        );
    }

    #[test]
    fn weights_of_another_network_or_type_are_refused() {
        let ours = bundle(Variant::Demc);
        let theirs = saved(&bundle(Variant::DemcNosn), |_| ());
        let text = error(&theirs, &ours);
        assert!(
            text.starts_with("missing: fusion.blocks.0.conv.weight, "),
            "{text}"
        );
        assert!(
            text.contains("wrong shape: encoders.0.levels.0.convs.0.weight"),
            "{text}"
        );

        let view = TensorView::new(Dtype::I64, vec![3], &[0; 24]).expect("view");
        let bytes = safetensors::serialize([("decoder.head.bias", view)], None).expect("bytes");
        let path = tempfile::NamedTempFile::new()
            .expect("file")
            .into_temp_path();
        std::fs::write(&path, bytes).expect("written");
        let text = error(&path, &ours);
        let end = "unusable: decoder.head.bias (type I64; expected F32 or F16)";
        assert!(text.ends_with(end), "{text}");
    }
}
