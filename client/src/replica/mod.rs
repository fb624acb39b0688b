//! The threads of the replica: the [`Site`](palpate_site::Site) in real time, its cuts and its views.

mod cut_worker;
mod progress;
mod thread;
mod view_thread;

pub(crate) use progress::{Part, Progress};
pub(crate) use thread::{Hand, Inputs, ReplicaThread, record_every};
