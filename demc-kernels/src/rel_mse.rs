//! NAIVE stand-in.
use crate::Isa;
/// Loss.
pub fn loss(_isa: Isa, out_gamma: &[f32], ref_hdr: &[f32], pixels: usize, gamma: f32, epsilon: f32, mut dout: Option<&mut [f32]>) -> f64 {
    let mut sum = 0.0;
    for (i, (o, r)) in out_gamma.iter().zip(ref_hdr).enumerate() {
        let (o, r, g) = (f64::from(*o), f64::from(*r), f64::from(gamma));
        let d = o.powf(g) - r; let w = 1.0 / (r * r + f64::from(epsilon)) / pixels as f64;
        sum += d * d * w;
        if let Some(dout) = &mut dout { dout[i] = (2.0 * d * w * g * o.powf(g - 1.0)) as f32; }
    }
    sum
}
