//! Denoises a frame in memory, as a renderer would. The scene is a tiled floor and a wall under an
//! area lamp, rendered here at 4 samples per pixel.
//!
//! ```sh
//! cargo run --release -p demc-infer --example frame
//! ```

use demc_data::{FEATURES, Frame, SamplePrecision};
use demc_infer::{Bundle, Picture, device};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

const WIDTH: usize = 320;
const HEIGHT: usize = 180;
const SAMPLES: usize = 4;
type Vec3 = [f32; 3];
/// Position of the camera in metres. y is up, the floor is y = 0, the wall is z = 0.
const CAMERA: Vec3 = [0.4, 1.6, 4.0];
/// One corner of the lamp, which is horizontal and measures 1 m x 1 m.
const LAMP: Vec3 = [-0.5, 3.6, 0.9];
const LAMP_RADIANCE: f32 = 60.0;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let bundle = Bundle::load("quality".as_ref(), &device::parse("flex")?)?;
    let frame = render();
    for warning in bundle.warnings(&frame)? {
        eprintln!("warning: {warning}");
    }
    let denoised = bundle.denoise(&frame)?;
    let [noisy, clean] = [&frame.color, &denoised].map(|c| Picture::from_hdr(c, HEIGHT, WIDTH));
    Picture::beside(&[noisy, clean]).write_png("frame.png".as_ref())?;
    demc_data::write_rgb(
        "frame.exr".as_ref(),
        WIDTH,
        HEIGHT,
        &denoised,
        SamplePrecision::Half,
    )?;
    println!("frame.exr, and frame.png with the noisy and the denoised image");
    Ok(())
}

/// Renders the frame. Every buffer is the mean over a pixel's samples.
fn render() -> Frame {
    let pixels = WIDTH * HEIGHT;
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let mut random = || rng.next_u32() as f32 / u32::MAX as f32;
    let mut color = vec![0.0; 3 * pixels];
    let mut features = vec![0.0; FEATURES * pixels];
    for pixel in 0..pixels {
        for _ in 0..SAMPLES {
            let x = ((pixel % WIDTH) as f32 + random() - WIDTH as f32 / 2.0) / HEIGHT as f32;
            let y = ((pixel / WIDTH) as f32 + random() - HEIGHT as f32 / 2.0) / HEIGHT as f32;
            let Hit {
                position,
                normal,
                albedo,
            } = hit([x, -y, -1.0]);
            // A random point of the lamp, and its direct light.
            let to = [0.0f32, 0.0, 0.0].map(|_| random());
            let light = [LAMP[0] + to[0], LAMP[1], LAMP[2] + to[2]];
            let toward: Vec3 = std::array::from_fn(|i| light[i] - position[i]);
            let square = dot(toward, toward);
            let cosines = dot(toward, normal).max(0.0) * toward[1].max(0.0) / square;
            let irradiance = LAMP_RADIANCE * cosines / square;
            // The second hit is the lamp, which counts as white, or nothing.
            let second = [f32::from(irradiance > 0.0); 3];
            let planes = [normal, position, albedo, second];
            for channel in 0..3 {
                let share = 1.0 / SAMPLES as f32;
                let radiance = albedo[channel] / std::f32::consts::PI * irradiance;
                color[channel * pixels + pixel] += share * radiance;
                for (buffer, value) in planes.iter().enumerate() {
                    features[(3 * buffer + channel) * pixels + pixel] += share * value[channel];
                }
            }
        }
    }
    Frame::new("room", WIDTH, HEIGHT, color, features)
}

/// What a ray sees.
struct Hit {
    position: Vec3,
    normal: Vec3,
    albedo: Vec3,
}

/// The first hit of a ray from the camera.
fn hit(ray: Vec3) -> Hit {
    let wall = -CAMERA[2] / ray[2];
    let floor = if ray[1] < 0.0 {
        -CAMERA[1] / ray[1]
    } else {
        f32::INFINITY
    };
    let at = |distance: f32| std::array::from_fn(|i| CAMERA[i] + distance * ray[i]);
    if floor < wall {
        let position: Vec3 = at(floor);
        let dark = (position[0].floor() + position[2].floor()).rem_euclid(2.0) < 0.5;
        let albedo = if dark {
            [0.1, 0.12, 0.15]
        } else {
            [0.7, 0.6, 0.5]
        };
        Hit {
            position,
            normal: [0.0, 1.0, 0.0],
            albedo,
        }
    } else {
        Hit {
            position: at(wall),
            normal: [0.0, 0.0, 1.0],
            albedo: [0.5, 0.35, 0.3],
        }
    }
}

fn dot(a: Vec3, b: Vec3) -> f32 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}
