//! The host: builds models from surfaces, and serves sessions over them.
//!
//! This crate never decides what a cut does or what is felt: the tissue and the room do. It reads
//! the command line, the clock and the files, and moves messages.

#![cfg_attr(test, allow(clippy::unwrap_used))]

pub mod build;
pub mod cli;
mod error;
mod export;
pub mod host;
mod inspect;
mod load;
mod memory;
mod picture;
mod sample;
mod say;

pub use error::ServerError;
