//! The server program: builds models from surfaces and serves sessions.
//!
//! This crate handles the command line, clocks, files and messages. Cuts and forces are decided by the tissue and
//! room crates.

#![cfg_attr(test, allow(clippy::unwrap_used))]

pub mod build;
pub mod cli;
pub mod cut;
mod error;
mod export;
pub mod host;
mod inspect;
mod load;
mod memory;
mod output;
pub mod picture;
mod sample;

pub use error::ServerError;
