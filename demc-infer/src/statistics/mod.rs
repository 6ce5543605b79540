//! Paired comparisons of variants over seeds and test images.
//!
//! Differences are paired by image and seed: both variants denoise the same image, and they trained
//! from the same seed on the same batches. Errors are compared by their ratio, other metrics by
//! their difference ([`Scale`]). Views of one base scene are alike. Their mean therefore counts as
//! one value, and base scenes are resampled.
//!
//! | question | answer | file |
//! |---|---|---|
//! | where is the true mean? | crossed bootstrap over seeds and base scenes, BCa interval, at least as wide as a t interval | `bootstrap` |
//! | can chance explain the mean? | sign-flip test over base scenes | `sign_flip` |
//! | is a difference claimed? | if both agree at 5 %, after Holm's correction over the comparisons | `estimate` |
//! | what would have been found? | smallest detectable change: 80 % power, 5 % two-sided | `bootstrap` |

mod bootstrap;
mod distribution;
mod estimate;
mod paired;
mod sign_flip;
#[cfg(test)]
mod tests;

pub use estimate::{Average, Decisive, Estimate, FEWEST_BASES, RESAMPLES, Scale, holm};
