//! What benches share: a [`case`] (weights and inputs that every contender reads), the [`contender`] that runs it with
//! this project, and a [`stopwatch`] that compares in turns.

pub mod case;
pub mod contender;
pub mod stopwatch;
