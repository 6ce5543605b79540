//! The class `Bundle`: a network that denoises arrays.

use std::ops::ControlFlow;
use std::path::PathBuf;

use demc_data::Frame;
use demc_data::image::layout::Missing;
use demc_infer::buffers::{BufferError, Buffers, View};
use demc_infer::denoise::{DenoiseOptions, DenoiseProgress, Denoised, Layer};
use demc_infer::guard::EnergyBias;
use demc_infer::{Bundle, BundleFile, Ensemble, Tiling, device};
use pyo3::prelude::*;

use crate::arrays::Array;
use crate::error::{DemcError, exception};
use crate::work::{self, Caller};

/// The names of the feature arrays, in the network's order.
const FEATURES: [&str; 4] = ["normal", "position", "albedo", "albedo2"];

/// A network ready to denoise on the CPU.
#[pyclass(name = "Bundle", module = "demc._native", frozen)]
pub struct PyBundle(pub Bundle);

/// A NumPy array, or what else has a buffer, `[channels, height, width]`.
type Object<'py> = Bound<'py, PyAny>;

/// The arrays of an image: colour, features, alpha, and layers with their names.
type Images<'py> = (
    Object<'py>,
    [Option<Object<'py>>; 4],
    Option<Object<'py>>,
    Vec<(String, Object<'py>)>,
);

/// The arrays that take the result: colour, alpha, layers.
type Outputs<'py> = (Object<'py>, Option<Object<'py>>, Vec<Object<'py>>);

/// How to denoise: number of passes, factor on the colour, whether light is restored, MiB of memory.
type Options = (String, Option<f32>, Option<bool>, Option<u64>);

#[pymethods]
impl PyBundle {
    /// Loads a bundled model (`quality` or `fast`), a run directory, a checkpoint directory, or a file.
    #[new]
    fn new(py: Python<'_>, path: PathBuf) -> PyResult<Self> {
        let load = |_: Caller<()>| -> anyhow::Result<Bundle> {
            Ok(BundleFile::read(&path)?.into_bundle(&device::parse("flex")?)?)
        };
        let bundle = work::run(py, load, work::UNHEARD)?;
        bundle.map(Self).map_err(exception)
    }

    /// Everything about the network except its weights, as JSON.
    fn metadata(&self) -> PyResult<String> {
        serde_json::to_string(&self.0.meta).map_err(exception)
    }

    /// The feature arrays that the network needs.
    fn required(&self) -> Vec<&'static str> {
        let policies = FEATURES.into_iter().zip(self.0.missing().in_order());
        let needed = policies.filter(|(_, missing)| *missing == Missing::Error);
        needed.map(|(name, _)| name).collect()
    }

    /// Whether the network can denoise layers.
    fn takes_layers(&self) -> bool {
        self.0.check_layers(Ensemble::One).is_ok()
    }

    /// The factor on a colour `[3, height, width]` before the network.
    fn input_scale(&self, py: Python<'_>, color: &Bound<'_, PyAny>) -> PyResult<f32> {
        let color = Array::new("color", color)?;
        let measure = |_: Caller<()>| -> Result<Option<f64>, BufferError> {
            let view = color.view()?;
            let (height, width) = view.size();
            let planes = view.to_planar()?;
            let is_finite = planes.iter().all(|sample| sample.is_finite());
            Ok(is_finite.then(|| self.0.exposure(&planes, height, width)))
        };
        let exposure = work::run(py, measure, work::UNHEARD)?.map_err(exception)?;
        let exposure =
            exposure.ok_or_else(|| DemcError::new_err("color has NaN or infinite samples"))?;
        Ok(self.0.input_scale(exposure))
    }

    /// Denoises an image into the arrays of `outputs`. `on_progress` gets the finished share. Returns
    /// warnings.
    fn denoise(
        &self,
        py: Python<'_>,
        images: Images<'_>,
        outputs: Outputs<'_>,
        options: Options,
        on_progress: Option<Py<PyAny>>,
    ) -> PyResult<Vec<String>> {
        let inputs = Inputs::new(&images)?;
        let mut targets = Targets::new(&outputs)?;
        let options = read_options(options)?;
        let hear = on_progress.map(|on_progress| {
            move |py: Python<'_>, share: f64| on_progress.call1(py, (share,)).map(|_| ())
        });
        let bundle = &self.0;
        let denoise = |caller: Caller<f64>| -> anyhow::Result<Vec<String>> {
            let (frame, layers) = inputs.read(bundle)?;
            let options = DenoiseOptions { layers, ..options };
            let mut warnings = Vec::new();
            for warning in bundle.warnings(&frame)? {
                warnings.push(warning.to_string());
            }
            let observer =
                |progress: DenoiseProgress| -> ControlFlow<()> { caller.call(progress.share) };
            let denoised = bundle.denoise_with(&frame, &options, observer)?;
            let bias = EnergyBias::of(&frame, &denoised.color_hdr).warning();
            warnings.extend(bias.iter().map(ToString::to_string));
            let limited = targets.write(&frame, &denoised)?;
            if limited > 0 {
                warnings.push(format!(
                    "{limited} samples above 65504, the maximum of float16, are written as 65504"
                ));
            }
            Ok(warnings)
        };
        work::run(py, denoise, hear)?.map_err(exception)
    }
}

/// The options without layers.
fn read_options(options: Options) -> PyResult<DenoiseOptions> {
    let (passes, input_scale, restore_light, memory) = options;
    if input_scale.is_some_and(|scale| !(scale.is_finite() && scale > 0.0)) {
        return Err(DemcError::new_err(
            "input_scale must be positive and finite",
        ));
    }
    let memory = memory.map(|mib| mib.saturating_mul(1 << 20));
    Ok(DenoiseOptions {
        tiling: Tiling {
            memory,
            ..Tiling::default()
        },
        ensemble: passes.parse::<Ensemble>().map_err(exception)?,
        input_scale,
        restore_light,
        layers: Vec::new(),
    })
}

/// The buffers of [`Images`].
struct Inputs {
    color: Array,
    features: Vec<Option<Array>>,
    alpha: Option<Array>,
    layers: Vec<(String, Array)>,
}

impl Inputs {
    fn new((color, features, alpha, layers): &Images<'_>) -> PyResult<Self> {
        let optional = |name: &str, array: &Option<Object<'_>>| {
            let array = array.as_ref();
            array.map(|array| Array::new(name, array)).transpose()
        };
        let features = FEATURES
            .into_iter()
            .zip(features)
            .map(|(name, array)| optional(name, array));
        let layers = layers
            .iter()
            .map(|(name, array)| Ok((name.clone(), Array::new(name, array)?)));
        Ok(Self {
            color: Array::new("color", color)?,
            features: features.collect::<PyResult<_>>()?,
            alpha: optional("alpha", alpha)?,
            layers: layers.collect::<PyResult<_>>()?,
        })
    }

    /// Copies the arrays.
    fn read(&self, bundle: &Bundle) -> Result<(Frame, Vec<Layer>), BufferError> {
        let mut buffers = Buffers::new(self.color.view()?);
        buffers.normal = optional_view(&self.features[0])?;
        buffers.position = optional_view(&self.features[1])?;
        buffers.albedo = optional_view(&self.features[2])?;
        buffers.albedo2 = optional_view(&self.features[3])?;
        buffers.alpha = optional_view(&self.alpha)?;
        let frame = bundle.frame("image", &buffers)?;
        let size = [frame.height, frame.width];
        let layers = self
            .layers
            .iter()
            .map(|(name, array)| Layer::copied(name, &array.view()?, size))
            .collect::<Result<_, _>>()?;
        Ok((frame, layers))
    }
}

fn optional_view(array: &Option<Array>) -> Result<Option<View<'_>>, BufferError> {
    array.as_ref().map(Array::view).transpose()
}

/// The buffers of [`Outputs`].
struct Targets {
    color: Array,
    alpha: Option<Array>,
    layers: Vec<Array>,
}

impl Targets {
    fn new((color, alpha, layers): &Outputs<'_>) -> PyResult<Self> {
        let target = |name: &str, array: &Object<'_>| {
            let mut array = Array::new(name, array)?;
            array.check_writable(name)?;
            Ok(array)
        };
        let alpha = alpha.as_ref().map(|array| target("alpha", array));
        let layers = layers.iter().map(|array| target("a layer", array));
        Ok(Self {
            color: target("out", color)?,
            alpha: alpha.transpose()?,
            layers: layers.collect::<PyResult<_>>()?,
        })
    }

    /// Writes the result. Returns the number of samples that are too large for half.
    fn write(&mut self, frame: &Frame, denoised: &Denoised) -> Result<usize, BufferError> {
        let mut limited = self.color.view_mut()?.write(&denoised.color_hdr)?;
        // A constant alpha stays as it is.
        let alpha = denoised.alpha.as_ref().or(frame.alpha.as_ref());
        if let (Some(array), Some(alpha)) = (&mut self.alpha, alpha) {
            limited += array.view_mut()?.write(alpha)?;
        }
        let planes = denoised.layers.chunks(frame.width * frame.height);
        for (array, plane) in self.layers.iter_mut().zip(planes) {
            limited += array.view_mut()?.write(plane)?;
        }
        Ok(limited)
    }
}
