//! The laboratory: emulated networks, scripted hands, sessions on one machine, and the analysis of their
//! recordings.
//!
//! No other crate imports this one. It has no logic of tissue, hands or the wire, and joins only its own
//! sessions: it starts the real programs and analyses their output.
//!
//! | task | modules |
//! | --- | --- |
//! | emulate a bad network, for state machines or for programs | `network`, `relay` |
//! | find locations to press and cut on any model, and write scripts for them | `tool_location`, `scripts` |
//! | use a hand with a known continuous motion | `hand` |
//! | run a server and clients as processes | `program`, `session`, `stress` |
//! | compute the forces without a network | `reference` |
//! | simulate a whole session in virtual time: links, server, participants | `simulated_session` |
//! | simulate the time compensation of two sites | `alignment` |
//! | load a server with all its seats | `load_test` |
//! | attack a server beside an honest session | `attack` |
//! | compare recordings | `disagreement`, `force_error`, `dropout`, `stalls`, `delay_figures`, `cpu`, `memory` |
//! | judge a session | `criteria` |
//! | measure the solver | `bench` |
//! | compare rendered and converged forces of a tool | `scenario`, `experiments` |
//! | inject faults into the haptic chain | `haptic_faults` |
//! | test and fuzz the decoders | `decoders` |
//! | run all of it at once | `demo`, `report`, `plots` |

// Only the program and the tests of this package use the library; a document says what a name does not.
#![allow(missing_docs, unreachable_pub)]
// Names of fields are those of the JSON, with their units.
#![allow(clippy::struct_field_names)]
#![cfg_attr(test, allow(clippy::unwrap_used))]

pub mod alignment;
pub mod attack;
mod bench;
mod chart;
pub mod cli;
mod cpu;
mod criteria;
pub mod decoders;
mod delay_figures;
mod demo;
mod disagreement;
mod dropout;
mod experiments;
mod force_error;
mod hand;
mod haptic_faults;
mod headless_page;
mod histogram;
mod input_file;
mod insertions;
mod load_test;
mod memory;
mod name_suggestion;
pub mod network;
mod plots;
pub mod program;
mod progress;
mod reference;
mod relay;
pub mod report;
mod scenario;
pub mod scripts;
pub mod session;
pub mod simulated_session;
mod stalls;
mod stress;
pub mod test_model;
pub mod tool_location;

pub use bench::wound;
