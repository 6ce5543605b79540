//! The tests of this crate, one program: each further one would link Burn again.

mod lengths;
mod threads;
