//! The laboratory: emulated networks, scripted hands, a session on one machine, and what its
//! recordings say.
//!
//! This crate is imported by nobody, decides nothing about tissue, hands or the wire, and takes no
//! part in a session that is not its own: it starts the real programs and looks at what they leave.
//!
//! | to | look in |
//! | --- | --- |
//! | make a network bad, for pure machines or for programs | [`network`], [`relay`] |
//! | find where to press and cut on any model, and make scripts of it | [`place`], [`scripts`] |
//! | have a hand whose motion is known at every moment | [`hand`] |
//! | run a server and clients as processes | [`program`], [`session`], [`stress`] |
//! | know what would be felt without a network | [`mod@reference`] |
//! | run a whole session in virtual time | [`simulated_session`] |
//! | fill all seats of a server and see what it costs | [`load_test`] |
//! | compare | [`disagreement`], [`force_error`], [`dropout`], [`delay_figures`], [`cpu`] |
//! | judge a session | [`criteria`] |
//! | measure the equilibrium | [`mod@bench`] |
//! | know what a hand feels of a tool, and what is true | [`trial`], [`experiments`] |
//! | break what a hand depends on, and see that it is not jerked | [`haptic_faults`] |
//! | know that no bytes of others break a reader | [`decoders`] |
//! | see all of it at once | [`demo`], [`report`], [`plots`] |

#![cfg_attr(test, allow(clippy::unwrap_used))]

pub mod alignment;
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
mod nearest;
pub mod network;
pub mod place;
pub mod plots;
pub mod program;
pub mod progress;
pub mod reference;
pub mod relay;
pub mod report;
pub mod scripts;
pub mod session;
pub mod simulated_session;
pub mod stress;
pub mod subject;
pub mod trial;
