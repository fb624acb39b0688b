//! One run, from the join link to the summary.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use palpate_device::backend::sim::ScriptStart;
use palpate_device::script::ToolKind;
use palpate_haptics::{Chain, ChainConfig};
use palpate_protocol::handshake::{Hello, Subscription, Welcome};
use palpate_protocol::permission::Permission;
use palpate_protocol::{JoinLink, name};
use palpate_site::{ConnectionStatus, Reach, Site};
use palpate_tissue::file::{Staged, decode_model};
use palpate_transport::threads::{ThreadClass, cpu_time, join, leave, without_real_time};
use palpate_view::ViewListener;

use super::status::{Status, fetch_progress, retry_lines};
use super::supervision::Supervision;
use crate::devices::{self, DeviceSelection, Guide, Opened, tool_description};
use crate::network::{Joining, MotionThread, Network, SeatFile};
use crate::page::LocalPage;
use crate::realtime::{HapticHandle, RealtimeConfig, monotonic_now, spawn};
use crate::recording::{HAPTIC_POINTS_MAX, Recording};
use crate::replica::{Hand, Inputs, ReplicaThread, record_every};
use crate::{ClientError, JoinOptions, Summary};

/// Joins a session and stays until it ends, the duration has passed or `stop` is set. If the server was restarted, or the seat
/// has expired, it joins again as a new participant, unless a recording would be overwritten. The summary is of the last
/// stay.
pub fn run(options: &JoinOptions) -> Result<Summary, ClientError> {
    let mut options = options.clone();
    loop {
        let began = monotonic_now();
        match stay(&options) {
            Err(ClientError::SeatGone { .. }) if may_join_again(&options) => {}
            ended => return ended,
        }
        let stayed = Duration::from_micros((monotonic_now() - began).as_micros().unsigned_abs());
        options.duration = options.duration.map(|d| d.saturating_sub(stayed));
        Status::new(options.status, began)
            .print("the server was restarted, or your seat has expired; joining again");
    }
}

fn may_join_again(options: &JoinOptions) -> bool {
    options.record.is_none() && !options.stop.load(Ordering::Acquire)
}

/// One stay in a session.
fn stay(options: &JoinOptions) -> Result<Summary, ClientError> {
    let link: JoinLink = options.link.parse()?;
    let is_thin = options.subscription == Subscription::Thin;
    if is_thin && !link.role.may(Permission::WatchThin) {
        return Err(ClientError::ThinTool(link.role));
    }
    if let Some(path) = &options.record {
        Staged::check(path).map_err(ClientError::RecordPlace)?;
    }
    let guide = Guide::load(options, link.role)?;
    let mut held = None;
    if let Some(guide) = &guide {
        // Device errors appear before the server is contacted.
        let mut opened = open(options, guide, ScriptStart::not_yet())?;
        if guide.is_opened_once() {
            held = Some(opened);
        } else {
            opened.device.close();
        }
    }
    // A port that is taken appears before the server is contacted, too.
    let listener = options.view.map(ViewListener::bind).transpose()?;
    let hello = Hello {
        name: name::normalise(&options.name)?,
        role: link.role,
        grant: link.grant,
        tool: guide.as_ref().map(|g| tool_description(&g.tool)),
        subscription: options.subscription,
        resume: None,
    };
    let mut status = Status::new(options.status, monotonic_now());
    status.print(&format!(
        "joining {}:{} as {}",
        link.host, link.port, link.role
    ));
    let seat = options
        .state
        .as_deref()
        .and_then(|folder| SeatFile::open(folder, &link, &hello));
    let joining = Joining {
        link,
        hello,
        seat,
        reconnect: options.reconnect,
        report: retry_lines(options.status),
        stop: Arc::clone(&options.stop),
        catch_signals: options.catch_signals,
    };
    if !options.realtime {
        without_real_time();
    }
    let network = Network::open(joining, fetch_progress(options.status))?;
    let threads = match Threads::start(options, &network, guide, held, listener) {
        Ok(threads) => threads,
        Err(error) => {
            network.leave();
            return Err(error);
        }
    };
    let mut supervision = Supervision {
        options,
        network,
        threads,
        status,
        connection: ConnectionStatus::default(),
        is_loss_told: false,
        began: monotonic_now(),
        cpu_began: cpu_time(),
        received: (0, monotonic_now()),
    };
    supervision.report_joined();
    let ending = supervision.supervise();
    supervision.finish(ending)
}

/// Opens the requested device.
fn open(options: &JoinOptions, guide: &Guide, start: ScriptStart) -> Result<Opened, ClientError> {
    let choice = DeviceSelection {
        kind: options.device,
        which: options.device_id.clone(),
    };
    Ok(devices::open(&choice, guide, start, &options.sources)?)
}

/// The threads of a session, except the network's.
pub(super) struct Threads {
    pub(super) haptics: Option<HapticHandle>,
    pub(super) motion: Option<MotionThread>,
    pub(super) replica: ReplicaThread,
    pub(super) page: Option<LocalPage>,
    /// Name reported by the device.
    pub(super) device: String,
}

impl Threads {
    fn start(
        options: &JoinOptions,
        network: &Network,
        mut guide: Option<Guide>,
        held: Option<Opened>,
        listener: Option<ViewListener>,
    ) -> Result<Self, ClientError> {
        let session = &network.session;
        let welcome = &session.welcome;
        let model = Arc::new(decode_model(&session.model)?);
        let blade = guide
            .as_ref()
            .map(|guide| guide.tool)
            .filter(|tool| tool.kind == ToolKind::Blade)
            .map(|tool| tool.length_m);
        if let Some(guide) = &mut guide {
            guide.place_workspace(&model);
        }
        let reach = guide
            .as_ref()
            .map(|guide| Reach::new(tool_description(&guide.tool)));
        let shown = Arc::clone(&model);
        let site = in_background(|| match options.subscription {
            Subscription::Full => Site::new(welcome, model, blade),
            Subscription::Thin => Site::thin(welcome, model, None),
        });
        let start = ScriptStart::not_yet();
        let (mut haptics, mut motion, mut hand, mut pointer) = (None, None, None, None);
        let mut name = "none".to_owned();
        if let Some(guide) = guide.filter(|_| welcome.role.has_tool()) {
            let opened = match held {
                Some(held) => Opened {
                    device: guide.placed(held.device),
                    ..held
                },
                None => open(options, &guide, start.clone())?,
            };
            pointer = opened.pointer;
            let device = opened.device;
            name.clone_from(&device.caps().name);
            let chain = Chain::new(ChainConfig::default(), device.caps());
            let (handle, ports) =
                spawn(device, chain, loop_config(options)).map_err(ClientError::Haptics)?;
            let (thread, own) = MotionThread::spawn(ports.frames, session.commands.clone())?;
            haptics = Some(handle);
            motion = Some(thread);
            hand = Some(Hand {
                models: ports.models,
                newest: ports.newest,
                own,
            });
        }
        let page = listener.map(|listener| {
            let commands = session.commands.clone();
            let link = options.link.parse()?;
            LocalPage::start(listener, link, welcome, &shown, commands, pointer)
        });
        let mut page = page.transpose()?;
        let replica = ReplicaThread::spawn(Inputs {
            site,
            inbox: Arc::clone(&session.inbox),
            commands: session.commands.clone(),
            resync: session.resync.clone(),
            script: hand.is_some().then_some((start, options.start_at)),
            reach: hand.is_some().then_some(reach).flatten(),
            hand,
            record_every: options
                .record
                .as_ref()
                .map(|_| record_every(welcome.tick_hz)),
            recording: new_recording(options, welcome),
            page: page.as_mut().and_then(LocalPage::take_window),
        })?;
        Ok(Self {
            haptics,
            motion,
            replica,
            page,
            device: name,
        })
    }
}

/// Runs `work` on all processors at background priority, so that sessions on this machine are not delayed.
fn in_background<T: Send>(work: impl FnOnce() -> T + Send) -> T {
    let pool = rayon::ThreadPoolBuilder::new()
        .start_handler(|_| join(ThreadClass::Background))
        .exit_handler(|_| leave());
    match pool.build() {
        Ok(pool) => pool.install(work),
        Err(_) => work(),
    }
}

fn loop_config(options: &JoinOptions) -> RealtimeConfig {
    let default = RealtimeConfig::default();
    let recorded = options.record.is_some();
    RealtimeConfig {
        real_time: options.realtime,
        trace_every: if recorded { default.trace_every } else { 0 },
        trace_points_max: HAPTIC_POINTS_MAX,
        ..default
    }
}

fn new_recording(options: &JoinOptions, welcome: &Welcome) -> Recording {
    Recording {
        name: options.name.clone(),
        participant: welcome.participant.0,
        role: welcome.role.word().to_owned(),
        ..Recording::default()
    }
}

#[cfg(test)]
mod tests {
    use palpate_protocol::Grant;
    use palpate_protocol::handshake::Role;
    use palpate_protocol::link::CertificateHash;

    use super::*;

    #[test]
    fn invalid_recording_path_is_rejected_before_joining() {
        let dir = tempfile::tempdir().unwrap();
        let link = JoinLink {
            host: "127.0.0.1".into(),
            // No server listens on this port.
            port: 9,
            role: Role::Spectator,
            certificate: CertificateHash([0; 32]),
            grant: Grant([0; 16]),
        };
        for place in [dir.path().to_owned(), dir.path().join("absent/run.json")] {
            let mut options = JoinOptions::new(link.to_string(), "Ada".to_owned());
            options.record = Some(place.clone());
            let error = run(&options).unwrap_err();
            assert_eq!(error.exit_code(), 2);
            let said = error.to_string();
            assert!(said.contains(&place.display().to_string()), "{said}");
        }
    }
}
