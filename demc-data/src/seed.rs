//! Where all randomness of this crate comes from: ChaCha8, seeded by what it is for and by numbers that a
//! resumed run knows, never by a clock or a thread.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

/// What a stream of random numbers is for; each use has streams of its own.
#[derive(Clone, Copy)]
pub(crate) enum Use {
    Validation = 1,
    Shuffle = 2,
    Augment = 3,
}

/// The generator of one use at (`seed`, `epoch`, `position`).
pub(crate) fn generator(of: Use, seed: u64, epoch: u64, position: u64) -> ChaCha8Rng {
    let mut bytes = [0; 32];
    for (part, value) in bytes
        .chunks_exact_mut(8)
        .zip([of as u64, seed, epoch, position])
    {
        part.copy_from_slice(&value.to_le_bytes());
    }
    ChaCha8Rng::from_seed(bytes)
}
