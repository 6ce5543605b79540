//! Denoises the images of a filter.

use std::cell::Cell;
use std::ops::ControlFlow;

use demc_infer::buffers::{BufferError, Buffers, View};
use demc_infer::denoise::{DenoiseOptions, DenoiseProgress, Layer};
use demc_infer::{Bundle, Tiling};

use crate::error::Failure;
use crate::image::{Image, LAYER, OUTPUT_LAYER};
use crate::model::Model;
use crate::settings::Settings;

/// The frame's name in messages.
const NAME: &str = "image";

thread_local! {
    /// Whether a function of the caller runs on this thread.
    static IN_CALLBACK: Cell<bool> = const { Cell::new(false) };
}

/// Runs a function of the caller.
fn callback<T>(function: impl FnOnce() -> T) -> T {
    let outer = IN_CALLBACK.replace(true);
    let result = function();
    IN_CALLBACK.set(outer);
    result
}

/// Denoises the images on the device's threads. The outputs are written last.
///
/// # Errors
/// As `demcExecuteFilter`.
pub(crate) fn execute(model: &Model, settings: &Settings) -> Result<(), Failure> {
    // It would wait for the execution that waits for it.
    if IN_CALLBACK.get() {
        return Err(Failure::operation(
            "a progress or warning function must not execute a filter",
        ));
    }
    let images = Images::new(settings)?;
    let device = &model.device;
    device.execute(|| images.denoise(&model.bundle, settings))
}

/// The images of an execution, which belong together.
struct Images<'a> {
    settings: &'a Settings,
    color: Image,
    output: Image,
    /// Alpha with its output.
    alpha: Option<(Image, Image)>,
    layers: Vec<NamedLayer<'a>>,
}

/// A layer with its output.
struct NamedLayer<'a> {
    name: &'a str,
    input: Image,
    output: Image,
}

impl<'a> Images<'a> {
    /// # Errors
    /// A required image is not set; an output has another size, or samples that share memory.
    fn new(settings: &'a Settings) -> Result<Self, Failure> {
        let missing = |name: &str| Failure::operation(format!("the image {name} is not set"));
        let get = |name: &str| settings.images.get(name).copied();
        let required = |name: &str| get(name).ok_or_else(|| missing(name));
        let paired = |input: &str, output: &str| match (get(input), get(output)) {
            (Some(input), Some(output)) => Ok(Some((input, output))),
            (None, None) => Ok(None),
            (Some(_), None) => Err(missing(output)),
            (None, Some(_)) => Err(missing(input)),
        };
        let mut names: Vec<&str> = Vec::new();
        for name in settings.images.keys() {
            let layer = name
                .strip_prefix(LAYER)
                .or_else(|| name.strip_prefix(OUTPUT_LAYER));
            names.extend(layer.filter(|layer| !names.contains(layer)));
        }
        let mut layers = Vec::new();
        for name in names {
            let pair = paired(&format!("{LAYER}{name}"), &format!("{OUTPUT_LAYER}{name}"))?;
            let layer = pair.map(|(input, output)| NamedLayer {
                name,
                input,
                output,
            });
            layers.extend(layer);
        }
        let images = Self {
            settings,
            color: required("color")?,
            output: required("output")?,
            alpha: paired("alpha", "outputAlpha")?,
            layers,
        };
        images.check_outputs()?;
        Ok(images)
    }

    /// Outputs fail before the work, not after it.
    fn check_outputs(&self) -> Result<(), Failure> {
        let [_, height, width] = self.color.shape();
        let check = |name: &str, image: &Image, channels| {
            let [own_channels, own_height, own_width] = image.shape();
            if own_channels != channels {
                return Err(BufferError::Channels {
                    buffer: name.to_owned(),
                    found: own_channels,
                    expected: channels,
                });
            }
            if [own_height, own_width] != [height, width] {
                return Err(BufferError::Size {
                    buffer: name.to_owned(),
                    found: [own_height, own_width],
                    expected: [height, width],
                });
            }
            // SAFETY: the output is the caller's, and nobody else uses it during an execution.
            unsafe { image.view_mut() }.map(|_| ())
        };
        check("output", &self.output, 3)?;
        if let Some((_, output)) = &self.alpha {
            check("outputAlpha", output, 1)?;
        }
        for NamedLayer {
            name,
            input,
            output,
        } in &self.layers
        {
            let name = format!("{OUTPUT_LAYER}{name}");
            check(&name, output, input.shape()[0])?;
        }
        Ok(())
    }

    fn denoise(&self, bundle: &Bundle, settings: &Settings) -> Result<(), Failure> {
        let frame = bundle.frame(NAME, &self.buffers()?)?;
        if settings.wants_warnings() {
            if frame.clamped > 0 {
                let count = frame.clamped;
                callback(|| settings.warn(&format!("color has {count} negative sample(s)")));
            }
            for warning in bundle.warnings(&frame)? {
                callback(|| settings.warn(&warning.to_string()));
            }
        }
        let options = DenoiseOptions {
            tiling: Tiling {
                memory: settings.memory,
                ..Tiling::default()
            },
            input_scale: settings.input_scale,
            restore_light: settings.restore_light,
            layers: self.read_layers()?,
            ..DenoiseOptions::default()
        };
        let observer = |done: DenoiseProgress| {
            if callback(|| settings.report(done.share)) {
                ControlFlow::Continue(())
            } else {
                ControlFlow::Break(())
            }
        };
        let denoised = bundle.denoise_with(&frame, &options, observer)?;
        self.write("output", &self.output, &denoised.color_hdr)?;
        if let Some((_, output)) = &self.alpha {
            // Alpha of one value is its own result.
            let alpha = denoised.alpha.as_ref().or(frame.alpha.as_ref());
            self.write("outputAlpha", output, alpha.map_or(&[], Vec::as_slice))?;
        }
        let mut planes = denoised.layers.as_slice();
        for NamedLayer { name, output, .. } in &self.layers {
            let (own, others) = planes.split_at(output.shape().iter().product());
            self.write(&format!("{OUTPUT_LAYER}{name}"), output, own)?;
            planes = others;
        }
        Ok(())
    }

    fn buffers(&self) -> Result<Buffers<'_>, BufferError> {
        let read = |name: &str| -> Result<Option<View<'_>>, BufferError> {
            let image = self.settings.images.get(name);
            // SAFETY: the image is the caller's, and nobody writes to it during an execution.
            image.map(|image| unsafe { image.view() }).transpose()
        };
        // SAFETY: as above.
        let mut buffers = Buffers::new(unsafe { self.color.view()? });
        buffers.normal = read("normal")?;
        buffers.position = read("position")?;
        buffers.albedo = read("albedo")?;
        buffers.albedo2 = read("albedo2")?;
        buffers.alpha = read("alpha")?;
        Ok(buffers)
    }

    /// The layers, one per channel.
    fn read_layers(&self) -> Result<Vec<Layer>, BufferError> {
        let [_, height, width] = self.color.shape();
        let mut layers = Vec::new();
        for NamedLayer { name, input, .. } in &self.layers {
            let names = match input.shape()[0] {
                1 => vec![(*name).to_owned()],
                _ => ["R", "G", "B"]
                    .map(|color| format!("{name}.{color}"))
                    .into(),
            };
            for (channel, name) in names.iter().enumerate() {
                // SAFETY: the image is the caller's, and nobody writes to it during an execution.
                let view = unsafe { input.channel(channel).view()? };
                layers.push(Layer::copied(name, &view, [height, width])?);
            }
        }
        Ok(layers)
    }

    /// Writes planar samples to an output.
    fn write(&self, name: &str, image: &Image, planar: &[f32]) -> Result<(), BufferError> {
        // SAFETY: the output is the caller's, and nobody else uses it during an execution.
        let limited = unsafe { image.view_mut()? }.write(planar)?;
        if limited > 0 && self.settings.wants_warnings() {
            let message = format!("{name} has {limited} sample(s) above 65504, the largest half");
            callback(|| self.settings.warn(&message));
        }
        Ok(())
    }
}
