//! The source of all randomness in this crate: ChaCha8, seeded by a purpose and by numbers that a
//! resumed run knows, never by a clock or a thread.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

#[derive(Clone, Copy)]
pub(crate) enum RandomStream {
    Validation = 1,
    Shuffle = 2,
    Augment = 3,
    Dropout = 4,
}

pub(crate) fn generator(purpose: RandomStream, seed: u64, epoch: u64, position: u64) -> ChaCha8Rng {
    let mut bytes = [0; 32];
    for (part, value) in bytes
        .chunks_exact_mut(8)
        .zip([purpose as u64, seed, epoch, position])
    {
        part.copy_from_slice(&value.to_le_bytes());
    }
    ChaCha8Rng::from_seed(bytes)
}
