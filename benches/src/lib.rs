//! Shared by the benches: a [`case`] (weights and inputs for every contender), this project's
//! [`contender`], and a [`stopwatch`] that compares in turns.

pub mod case;
pub mod contender;
pub mod stopwatch;
