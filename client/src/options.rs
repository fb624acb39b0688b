//! What a participant asks for.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use palpate_protocol::handshake::{SEAT_KEPT, Subscription};

use crate::{DeviceKind, Sources};

/// Where the progress of a run is shown.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum StatusKind {
    /// Nowhere: for programs that link this library.
    #[default]
    Quiet,
    /// On standard output, rewritten in place on a terminal.
    Stdout,
    /// On standard error, because standard output carries the summary as JSON.
    Stderr,
}

/// The moment at which a script, or a replayed motion, starts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, clap::ValueEnum)]
pub enum StartAt {
    /// As soon as this participant has joined and has the tissue.
    #[default]
    Joining,
    /// With the session: at the same moment for every participant, once the tools that the host waits for are there.
    Session,
}

/// All that [`run`](crate::run) has to know.
#[derive(Debug, Clone)]
pub struct JoinOptions {
    /// The join link as the server printed it.
    pub link: String,
    /// The name that others see.
    pub name: String,
    /// Whether this machine computes the tissue, or is sent where its surface is.
    pub subscription: Subscription,
    /// The device to hold, for roles with a tool.
    pub device: DeviceKind,
    /// Which of several devices of a kind, as `devices` lists it.
    pub device_id: Option<String>,
    /// Where makers' services and libraries are.
    pub sources: Sources,
    /// What a simulated hand does, with or without a simulated device.
    pub script: Option<PathBuf>,
    /// A recorded motion for a device that replays it; the tool is the script's then, or a ball of 8 mm.
    pub motion: Option<PathBuf>,
    /// When the script or the motion starts.
    pub start_at: StartAt,
    /// Leave after this time; without it stay until the session ends.
    pub duration: Option<Duration>,
    /// For how long to try to come back when the connection is lost; the server keeps the seat for
    /// [`SEAT_KEPT`].
    pub reconnect: Duration,
    /// The folder where the seat is kept while the run lasts, so that a run that follows a crash takes it again at once.
    /// `None` keeps nothing.
    pub state: Option<PathBuf>,
    /// Where to write the [`Recording`](crate::Recording) at the end.
    pub record: Option<PathBuf>,
    /// Whether to ask for real-time priority.
    pub realtime: bool,
    /// Whether SIGINT and SIGTERM end the run politely. Off for programs with signals of their own.
    pub catch_signals: bool,
    /// Where the progress goes.
    pub status: StatusKind,
    /// Set it from another thread to leave politely.
    pub stop: Arc<AtomicBool>,
}

impl JoinOptions {
    /// Joins with a link and a name; the rest as a program that links this library wants it.
    pub fn new(link: impl Into<String>, name: impl Into<String>) -> Self {
        Self {
            link: link.into(),
            name: name.into(),
            subscription: Subscription::Full,
            device: DeviceKind::Auto,
            device_id: None,
            sources: Sources::default(),
            script: None,
            motion: None,
            start_at: StartAt::default(),
            duration: None,
            reconnect: Duration::from_micros(SEAT_KEPT.as_micros().unsigned_abs()),
            state: None,
            record: None,
            realtime: true,
            catch_signals: false,
            status: StatusKind::Quiet,
            stop: Arc::default(),
        }
    }
}
