//! Options of a run.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use palpate_protocol::handshake::{SEAT_RETENTION, Subscription};

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

/// When a script or a replayed motion starts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, clap::ValueEnum)]
pub enum StartAt {
    /// As soon as this participant has joined and has the tissue.
    #[default]
    Joining,
    /// With the session: at the same time for all participants, once the host's required tools have joined.
    Session,
}

/// Options of [`run`](crate::run).
#[derive(Clone)]
pub struct JoinOptions {
    /// The join link as the server printed it.
    pub link: String,
    /// The name shown to other participants.
    pub name: String,
    /// Whether this machine computes the tissue or receives surface displacements.
    pub subscription: Subscription,
    /// The device to hold, for roles with a tool.
    pub device: DeviceKind,
    /// Device id as listed by `devices`.
    pub device_id: Option<String>,
    /// Vendor services and libraries.
    pub sources: Sources,
    /// Script of the simulated hand, used with or without a simulated device.
    pub script: Option<PathBuf>,
    /// A recorded motion to replay; the tool is the script's, or a ball of 8 mm radius.
    pub motion: Option<PathBuf>,
    /// Address of the browser view, whose mouse, touch and keys move the device pointer; `None` serves no view.
    pub view: Option<SocketAddr>,
    /// When the script or the motion starts.
    pub start_at: StartAt,
    /// Leave after this time; `None` stays until the session ends.
    pub duration: Option<Duration>,
    /// How long to try again when the server is busy or not reached, also after a lost connection; the server keeps the
    /// seat for [`SEAT_RETENTION`].
    pub reconnect: Duration,
    /// Folder of the seat file, with which a run after a crash resumes its seat. `None` keeps nothing.
    pub state: Option<PathBuf>,
    /// Path of the [`Recording`](crate::Recording), written at the end.
    pub record: Option<PathBuf>,
    /// Whether to ask for real-time priority.
    pub realtime: bool,
    /// Whether SIGINT and SIGTERM end the run cleanly. Off for programs that handle signals themselves.
    pub catch_signals: bool,
    /// Output of the progress.
    pub status: StatusKind,
    /// Set from another thread to leave cleanly.
    pub stop: Arc<AtomicBool>,
}

impl JoinOptions {
    /// Joins with a link and a name; the other options suit a program that links this library.
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
            view: None,
            start_at: StartAt::default(),
            duration: None,
            reconnect: Duration::from_micros(SEAT_RETENTION.as_micros().unsigned_abs()),
            state: None,
            record: None,
            realtime: true,
            catch_signals: false,
            status: StatusKind::Quiet,
            stop: Arc::default(),
        }
    }
}
