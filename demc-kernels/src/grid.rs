//! The pixels of a batch of maps, and the way between channels first and channels last.

/// How many images of which size. A map on it has `pixels() * channels` values, channels last.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Grid {
    /// Images.
    pub batch: usize,
    /// Rows of an image, px.
    pub height: usize,
    /// Columns of an image, px.
    pub width: usize,
}

impl Grid {
    /// Pixels of all images together.
    pub fn pixels(self) -> usize {
        self.batch * self.height * self.width
    }

    /// The grid after a 2x2 pooling (odd rows and columns at the end are dropped).
    pub fn halved(self) -> Self {
        Grid { height: self.height / 2, width: self.width / 2, ..self }
    }

    /// The grid after a deconvolution with stride 2.
    pub fn doubled(self) -> Self {
        Grid { height: self.height * 2, width: self.width * 2, ..self }
    }

    /// Channels of a map of `len` values.
    ///
    /// # Panics
    /// Where `len` is no multiple of the pixels.
    pub fn channels(self, len: usize) -> usize {
        let pixels = self.pixels();
        assert!(
            pixels > 0 && len % pixels == 0,
            "{len} values are no map on {self:?}"
        );
        len / pixels
    }
}

/// Channels last from channels first.
///
/// # Panics
/// Where the lengths do not fit.
pub fn nhwc_from_nchw(grid: Grid, x: &[f32], y: &mut [f32]) {
    assert_eq!(x.len(), y.len(), "maps of one size");
    let (channels, plane) = (grid.channels(x.len()), grid.height * grid.width);
    for (x, y) in x.chunks(plane * channels).zip(y.chunks_mut(plane * channels)) {
        for (c, x) in x.chunks(plane).enumerate() {
            for (x, y) in x.iter().zip(y[c..].iter_mut().step_by(channels)) {
                *y = *x;
            }
        }
    }
}

/// Channels first from channels last.
///
/// # Panics
/// Where the lengths do not fit.
pub fn nchw_from_nhwc(grid: Grid, x: &[f32], y: &mut [f32]) {
    assert_eq!(x.len(), y.len(), "maps of one size");
    let (channels, plane) = (grid.channels(x.len()), grid.height * grid.width);
    for (x, y) in x.chunks(plane * channels).zip(y.chunks_mut(plane * channels)) {
        for (c, y) in y.chunks_mut(plane).enumerate() {
            for (x, y) in x[c..].iter().step_by(channels).zip(y) {
                *y = *x;
            }
        }
    }
}
