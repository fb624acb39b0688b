//! The laboratory: emulated networks, scripted hands, sessions on one machine, and the analysis of their
//! recordings.
//!
//! No other crate imports this one. It has no logic of tissue, hands or the wire, and joins only its own
//! sessions: it starts the real programs and analyses their output.
//!
//! | task | modules |
//! | --- | --- |
//! | emulate a bad network, for state machines or for programs | [`network`], [`relay`] |
//! | find locations to press and cut on any model, and write scripts for them | [`tool_location`], [`scripts`] |
//! | use a hand with a known continuous motion | [`hand`] |
//! | run a server and clients as processes | [`program`], [`session`], [`stress`] |
//! | compute the forces without a network | [`mod@reference`] |
//! | simulate a whole session in virtual time: links, server, participants | [`simulated_session`] |
//! | simulate the time compensation of two sites | [`alignment`] |
//! | load a server with all its seats | [`load_test`] |
//! | attack a server beside an honest session | [`attack`] |
//! | compare recordings | [`disagreement`], [`force_error`], [`dropout`], [`delay_figures`], [`cpu`], [`memory`] |
//! | judge a session | [`criteria`] |
//! | measure the solver | [`mod@bench`] |
//! | compare rendered and converged forces of a tool | [`scenario`], [`experiments`] |
//! | inject faults into the haptic chain | [`haptic_faults`] |
//! | test and fuzz the decoders | [`decoders`] |
//! | run all of it at once | [`demo`], [`report`], [`plots`] |

#![cfg_attr(test, allow(clippy::unwrap_used))]

pub mod alignment;
pub mod attack;
pub mod bench;
pub mod chart;
pub mod cli;
pub mod cpu;
pub mod criteria;
pub mod decoders;
pub mod delay_figures;
pub mod demo;
pub mod disagreement;
pub mod dropout;
pub mod experiments;
pub mod force_error;
pub mod hand;
pub mod haptic_faults;
pub mod load_test;
pub mod memory;
mod name_suggestion;
pub mod network;
pub mod plots;
pub mod program;
pub mod progress;
pub mod reference;
pub mod relay;
pub mod report;
pub mod scenario;
pub mod scripts;
pub mod session;
pub mod simulated_session;
pub mod stress;
pub mod test_model;
pub mod tool_location;
