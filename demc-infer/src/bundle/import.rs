//! Weights that another program has trained, back into a bundle.

use std::collections::BTreeMap;
use std::path::Path;

use demc_model::Weight;
use safetensors::SafeTensors;
use safetensors::tensor::Dtype;

use super::file::{damaged, parse_meta, read};
use super::tensors::{one_line, values};
use super::{BundleError, BundleFile, BundleMeta, Names, Precision};

/// The tensors that are wrong, a list a kind.
#[derive(Default)]
struct Problems {
    missing: Vec<String>,
    unknown: Vec<String>,
    misshaped: Vec<String>,
    useless: Vec<String>,
    negative: Vec<String>,
}

impl Problems {
    /// All of them in a line; `None` where there are none.
    fn line(self) -> Option<String> {
        let lists = [
            ("missing", self.missing),
            ("not of this network", self.unknown),
            ("of another shape", self.misshaped),
            ("of no use", self.useless),
            ("negative variance in", self.negative),
        ];
        let parts: Vec<String> = lists
            .into_iter()
            .filter(|(_, tensors)| !tensors.is_empty())
            .map(|(what, tensors)| format!("{what}: {}", tensors.join(", ")))
            .collect();
        (!parts.is_empty()).then(|| parts.join("; "))
    }
}

impl BundleFile {
    /// Reads tensors with PyTorch's names (or Burn's) from the safetensors file `path`, and says with `like` what network they
    /// are of; without it, the file must have a header of ours.
    ///
    /// # Errors
    /// A file that cannot be read or is no safetensors file; [`BundleError::Foreign`] where nothing says what the weights are;
    /// [`BundleError::Import`] with every tensor that is missing, unknown, of another shape, of another type than f32 and f16,
    /// or not finite.
    pub fn import(path: &Path, like: Option<BundleMeta>) -> Result<Self, BundleError> {
        let bytes = read(path)?;
        let meta = match like {
            Some(meta) => meta,
            None => parse_meta(path, &bytes)?.0,
        };
        let file = SafeTensors::deserialize(&bytes).map_err(|error| damaged(path, &error))?;
        let mut found: BTreeMap<String, _> = file
            .iter()
            .map(|(name, view)| (Names::Torch.to_burn(&one_line(name)), view))
            .collect();
        let mut problems = Problems::default();
        let mut precision = Precision::F32;
        let mut weights = Vec::with_capacity(found.len());
        for (name, shape) in meta.model.weight_shapes() {
            let called = Names::Torch.from_burn(&name);
            let Some(view) = found.remove(&name) else {
                problems.missing.push(called);
                continue;
            };
            if view.shape() != shape {
                problems
                    .misshaped
                    .push(format!("{called} {:?} for {shape:?}", view.shape()));
                continue;
            }
            if view.dtype() == Dtype::F16 {
                precision = Precision::F16;
            }
            match values(&view) {
                Err(detail) => problems.useless.push(format!("{called} ({detail})")),
                Ok(data) if name.ends_with(".running_var") && data.iter().any(|x| *x < 0.0) => {
                    problems.negative.push(called);
                }
                Ok(data) => weights.push(Weight { name, shape, data }),
            }
        }
        for name in found.into_keys() {
            problems.unknown.push(Names::Torch.from_burn(&name));
        }
        match problems.line() {
            Some(problems) => Err(BundleError::Import {
                path: path.into(),
                problems,
            }),
            None => Ok(Self {
                path: path.into(),
                meta,
                names: Names::Torch,
                precision,
                weights,
            }),
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
    use safetensors::tensor::TensorView;

    /// A file with PyTorch's names and no header, as `safetensors.torch.save_file` writes it.
    fn saved(bundle: &Bundle, change: impl FnOnce(&mut Vec<Weight>)) -> tempfile::TempPath {
        let mut weights = bundle.model.weights();
        for weight in &mut weights {
            weight.name = Names::Torch.from_burn(&weight.name);
        }
        change(&mut weights);
        let path = tempfile::NamedTempFile::new()
            .expect("file")
            .into_temp_path();
        std::fs::write(&path, tensors::to_bytes(&weights).expect("bytes")).expect("written");
        path
    }

    fn error(path: &Path, bundle: &Bundle) -> String {
        let error = BundleFile::import(path, Some(bundle.meta.clone())).expect_err("refused");
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
            assert_eq!(
                bytes(&back(&plain, Some(bundle.meta.clone()))),
                bytes(&bundle)
            );
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
    fn what_the_model_says_replaces_the_files_own_header() {
        let theirs = bundle(Variant::Demc);
        let path = tempfile::NamedTempFile::new()
            .expect("file")
            .into_temp_path();
        theirs
            .save(&path, Names::Torch, Precision::F16)
            .expect("saved");
        let mut like = theirs.meta.clone();
        like.step = 999;
        like.normalizer.features.mean[0] = 7.0;
        let file = BundleFile::import(&path, Some(like.clone())).expect("imported");
        assert_eq!((file.meta, file.precision), (like, Precision::F16));
    }

    #[test]
    fn everything_that_is_wrong_is_listed_at_once() {
        let bundle = bundle(Variant::Demc);
        let at = |weights: &mut [Weight], name: &str| {
            weights.iter().position(|w| w.name == name).expect("there")
        };
        let path = saved(&bundle, |weights| {
            for name in ["latent.norm.weight", "decoder.head.bias"] {
                let i = at(weights, name);
                weights.remove(i);
            }
            let i = at(weights, "latent.conv.bias");
            weights[i].shape = vec![16, 1];
            let i = at(weights, "fusion.blocks.0.conv.bias");
            weights[i].data[1] = f32::NAN;
            let i = at(weights, "latent.norm.running_var");
            weights[i].data[0] = -1.0;
            weights[0].name.insert_str(0, "module.");
        });
        assert_eq!(
            error(&path, &bundle),
            "missing: fusion.blocks.0.conv.weight, latent.norm.weight, decoder.head.bias; not of this network: \
             module.fusion.blocks.0.conv.weight; of another shape: latent.conv.bias [16, 1] for [16]; of no use: \
             fusion.blocks.0.conv.bias (NaN among its values); negative variance in: latent.norm.running_var"
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
            text.contains("of another shape: encoders.0.levels.0.convs.0.weight"),
            "{text}"
        );

        let view = TensorView::new(Dtype::I64, vec![3], &[0; 24]).expect("view");
        let bytes = safetensors::serialize([("decoder.head.bias", view)], None).expect("bytes");
        let path = tempfile::NamedTempFile::new()
            .expect("file")
            .into_temp_path();
        std::fs::write(&path, bytes).expect("written");
        let text = error(&path, &ours);
        let end = "of no use: decoder.head.bias (type I64; expected F32 or F16)";
        assert!(text.ends_with(end), "{text}");
    }
}
