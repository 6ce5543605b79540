//! The NL-means filter: a weighted mean over a window.

use multiversion::multiversion;
use rayon::prelude::*;

use super::planes::{Planes, TILE, Tile, tiles};
use super::weights::{Guide, Scratch, TILE_PIXELS, inside, shifts, weights};

/// Filters each channel of `image` with the weights of `guide`, in windows of this radius.
pub(super) fn nl_means(image: &Planes, guide: &Guide, radius: usize, bandwidth: f32) -> Planes {
    let tiles = tiles(image.height, image.width);
    let filtered: Vec<Vec<f32>> = tiles
        .par_iter()
        .map_init(Scratch::new, |scratch, tile| {
            filter(image, guide, radius, bandwidth, *tile, scratch)
        })
        .collect();
    let mut out = Planes::zeros(image.channels(), image.height, image.width);
    let pixels = out.pixels();
    for (tile, filtered) in tiles.iter().zip(&filtered) {
        let columns = TILE.min(image.width - tile.x);
        for (channel, filtered) in filtered.chunks_exact(TILE_PIXELS).enumerate() {
            for y in 0..TILE.min(image.height - tile.y) {
                let start = channel * pixels + (tile.y + y) * image.width + tile.x;
                out.samples[start..start + columns]
                    .copy_from_slice(&filtered[y * TILE..][..columns]);
            }
        }
    }
    out
}

/// The filtered channels of a tile, `[C, TILE, TILE]`.
fn filter(
    image: &Planes,
    guide: &Guide,
    radius: usize,
    bandwidth: f32,
    tile: Tile,
    scratch: &mut Scratch,
) -> Vec<f32> {
    let mut sums = vec![0.0; image.channels() * TILE_PIXELS];
    let mut total = vec![0.0; TILE_PIXELS];
    let (mut distances, mut found) = (vec![0.0; TILE_PIXELS], vec![0.0; TILE_PIXELS]);
    for shift in shifts(radius) {
        guide.distances(tile, shift, scratch, &mut distances);
        weights(bandwidth, &distances, &mut found);
        let rows = inside(tile.y, 0, shift.dy, image.height);
        let columns = inside(tile.x, 0, shift.dx, image.width);
        let count = (columns.end - columns.start) as usize;
        if count == 0 {
            continue;
        }
        for y in rows {
            let start = (y as usize - tile.y) * TILE + columns.start as usize - tile.x;
            let weights = &found[start..start + count];
            add(&mut total[start..start + count], weights);
            for channel in 0..image.channels() {
                let (y, x) = (y + shift.dy, columns.start + shift.dx);
                let row = &image.row(channel, y as usize, x as usize)[..count];
                let start = channel * TILE_PIXELS + start;
                add_weighted(&mut sums[start..start + count], weights, row);
            }
        }
    }
    for sums in sums.chunks_exact_mut(TILE_PIXELS) {
        // Beyond the image, both are 0.
        for (sum, total) in sums.iter_mut().zip(&total) {
            *sum /= total;
        }
    }
    sums
}

#[multiversion(targets("x86_64+avx512f", "x86_64+avx2"))]
fn add(sums: &mut [f32], values: &[f32]) {
    for (sum, value) in sums.iter_mut().zip(values) {
        *sum += value;
    }
}

#[multiversion(targets("x86_64+avx512f", "x86_64+avx2"))]
fn add_weighted(sums: &mut [f32], weights: &[f32], values: &[f32]) {
    for ((sum, weight), value) in sums.iter_mut().zip(weights).zip(values) {
        *sum += weight * value;
    }
}
