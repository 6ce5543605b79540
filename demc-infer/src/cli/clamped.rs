//! Negative radiance samples.

use demc_program::message;

/// Counts negative radiance samples, which are reported once for all images.
#[derive(Default)]
pub struct Clamped {
    samples: usize,
    images: usize,
}

impl Clamped {
    /// Counts those of an image.
    pub fn count(&mut self, samples: usize) {
        self.samples += samples;
        self.images += usize::from(samples > 0);
    }

    /// Prints their number, if there are any.
    pub fn report(self) {
        let Self { samples, images } = self;
        if samples > 0 {
            message::say(format_args!(
                "note: {samples} negative radiance sample(s) in {images} image(s) set to 0"
            ));
        }
    }
}
