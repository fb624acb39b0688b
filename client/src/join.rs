//! A run from the join link to the summary.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use palpate_device::backend::sim::{ScriptStart, SimHand};
use palpate_device::script::ToolKind;
use palpate_device::{HapticDevice, Script};
use palpate_haptics::{Chain, ChainConfig};
use palpate_protocol::handshake::{Hello, Welcome};
use palpate_protocol::session::CloseReason;
use palpate_protocol::{ClientTime, JoinLink, Role, Span};
use palpate_tissue::decode_model;

use crate::convert::tool_description;
use crate::motion::MotionThread;
use crate::network::Network;
use crate::realtime::{
    HapticHandle, LoopSummary, Priority, RealtimeConfig, monotonic_now, sleep_until, spawn,
};
use crate::recording::{HAPTIC_POINTS_MAX, HapticPoint, Recording};
use crate::site::Site;
use crate::solve::{End, Hand, ReplicaThread, Solved, Work, record_every};
use crate::status::{Figures, HandFigures, Status, fetch_progress};
use crate::{ClientError, DeviceKind, JoinOptions, Summary};

/// How often the main thread looks around.
const LOOK_AROUND: Span = Span::from_millis(50);

/// A server from which nothing came for so long, after the link was lost, is given up.
const GIVE_UP: Span = Span::from_millis(2000);

/// Joins a session and stays until it ends, the duration is over or `stop` is set.
pub fn run(options: &JoinOptions) -> Result<Summary, ClientError> {
    let link: JoinLink = options.link.parse()?;
    let script = load_script(options, link.role)?;
    let hello = Hello {
        name: options.name.clone(),
        role: link.role,
        grant: link.grant,
        tool: script.as_ref().map(|s| tool_description(&s.tool())),
        resume: None,
    };
    let mut status = Status::new(options.status, monotonic_now());
    status.say(&format!(
        "joining {}:{} as {}",
        link.host, link.port, link.role
    ));
    let network = Network::open(
        link,
        hello,
        fetch_progress(options.status),
        Arc::clone(&options.stop),
        options.catch_signals,
    )?;
    let parts = match Parts::start(options, &network, script) {
        Ok(parts) => parts,
        Err(error) => {
            network.leave();
            return Err(error);
        }
    };
    let mut session = Session {
        options,
        network,
        parts,
        status,
        began: monotonic_now(),
    };
    session.greet();
    let ending = session.supervise();
    session.finish(ending)
}

/// The script of who holds a tool; `None` for who only looks.
fn load_script(options: &JoinOptions, role: Role) -> Result<Option<Script>, ClientError> {
    if !role.has_tool() {
        return Ok(None);
    }
    let path = options.script.clone().ok_or(ClientError::NoScript(role))?;
    match Script::load(&path) {
        Ok(script) => Ok(Some(script)),
        Err(source) => Err(ClientError::Script { path, source }),
    }
}

/// The threads of a session, beside the network's.
struct Parts {
    haptics: Option<HapticHandle>,
    motion: Option<MotionThread>,
    replica: ReplicaThread,
    device: String,
}

impl Parts {
    fn start(
        options: &JoinOptions,
        network: &Network,
        script: Option<Script>,
    ) -> Result<Self, ClientError> {
        let welcome = &network.welcome;
        let model = Arc::new(decode_model(&network.model)?);
        let blade = script
            .as_ref()
            .map(Script::tool)
            .filter(|tool| tool.kind == ToolKind::Blade)
            .map(|tool| tool.length_m);
        let site = Site::new(welcome, model, blade);
        let start = ScriptStart::not_yet();
        let (mut haptics, mut motion, mut hand) = (None, None, None);
        let mut name = "none".to_owned();
        if let Some(script) = script.filter(|_| welcome.role.has_tool()) {
            let device = open_device(options.device, script, start.clone());
            name.clone_from(&device.caps().name);
            let chain = Chain::new(ChainConfig::default(), device.caps());
            let (handle, ports) = spawn(device, chain, loop_config(options))?;
            let (thread, own) = MotionThread::spawn(ports.frames, network.commands.clone())?;
            haptics = Some(handle);
            motion = Some(thread);
            hand = Some(Hand {
                models: ports.models,
                newest: ports.newest,
                own,
            });
        }
        let replica = ReplicaThread::spawn(Work {
            site,
            inbox: Arc::clone(&network.inbox),
            commands: network.commands.clone(),
            script: hand.is_some().then_some(start),
            hand,
            record_every: options
                .record
                .as_ref()
                .map(|_| record_every(welcome.tick_hz)),
            recording: new_recording(options, welcome),
        })?;
        Ok(Self {
            haptics,
            motion,
            replica,
            device: name,
        })
    }
}

fn open_device(kind: DeviceKind, script: Script, start: ScriptStart) -> Box<dyn HapticDevice> {
    match kind {
        DeviceKind::Sim => Box::new(SimHand::new(script, start)),
    }
}

fn loop_config(options: &JoinOptions) -> RealtimeConfig {
    let default = RealtimeConfig::default();
    let recorded = options.record.is_some();
    RealtimeConfig {
        priority: default.priority.filter(|_| options.realtime),
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

/// Why the main thread stopped looking.
enum Ending {
    /// The participant wanted it so.
    Wish(String),
    /// The session is over.
    Closed(CloseReason),
    /// Nothing comes any more.
    Silence,
    /// The copy is not the server's.
    Diverged(String),
    /// One of our threads broke.
    Panicked(&'static str),
}

struct Session<'a> {
    options: &'a JoinOptions,
    network: Network,
    parts: Parts,
    status: Status,
    began: ClientTime,
}

impl Session<'_> {
    fn greet(&mut self) {
        let welcome = &self.network.welcome;
        let others = welcome.roster.len().saturating_sub(1);
        let sentence = format!(
            "joined as {} ({}), {others} others here, {} operations so far",
            self.options.name, welcome.role, welcome.operations_so_far
        );
        self.status.say(&sentence);
        let explanation = self
            .parts
            .haptics
            .as_ref()
            .and_then(|h| h.priority().explanation().map(str::to_owned));
        if let Some(explanation) = explanation {
            self.status.say(&explanation);
        }
    }

    /// Looks after everything until it is over.
    fn supervise(&mut self) -> Ending {
        let mut lost_since: Option<ClientTime> = None;
        loop {
            let now = monotonic_now();
            let progress = self.parts.replica.progress();
            if let Some(haptics) = &self.parts.haptics {
                haptics.set_link_lost(progress.link_lost);
                if !haptics.is_running() {
                    return Ending::Panicked("force loop");
                }
            }
            if let Some(sentence) = &progress.notice {
                self.status.say(sentence);
            }
            match progress.end {
                Some(End::Closed(reason)) => return Ending::Closed(reason),
                Some(End::Diverged(detail)) => return Ending::Diverged(detail),
                None => {}
            }
            if !self.parts.replica.is_running() {
                return Ending::Panicked("solver");
            }
            lost_since = progress.link_lost.then(|| lost_since.unwrap_or(now));
            if lost_since.is_some_and(|since| now - since > GIVE_UP) {
                return Ending::Silence;
            }
            if self.options.stop.load(Ordering::Acquire) {
                return Ending::Wish("you left".to_owned());
            }
            let stayed = now - self.began;
            if let Some(duration) = self.options.duration
                && stayed.as_secs_f64() >= duration.as_secs_f64()
            {
                let sentence = format!("you left after {} s, as asked", duration.as_secs_f64());
                return Ending::Wish(sentence);
            }
            if self.status.is_due(now) {
                let figures = self.figures(stayed, &progress);
                self.status.show(&figures, now);
            }
            sleep_until(now + LOOK_AROUND);
        }
    }

    fn figures(&mut self, stayed: Span, progress: &crate::solve::Progress) -> Figures {
        let hand = self.parts.haptics.as_mut().map(|haptics| {
            let stats = haptics.stats();
            HandFigures {
                rate_hz: stats.rate_hz,
                lateness_p99_us: stats.lateness_us.p99,
                force_n: stats.force_n,
            }
        });
        let link = self.network.stats.borrow().link;
        Figures {
            seconds: stayed.as_secs_f64(),
            hand,
            rtt_ms: link.rtt.map(Span::as_millis_f64),
            loss: link.loss_in(),
            delay_ms: progress.delay.as_millis_f64(),
            here: progress.here,
            topology_version: progress.topology_version,
            link_lost: progress.link_lost,
            is_catching_up: progress.is_catching_up,
        }
    }

    /// Takes the force away first, then ends everything, then adds up.
    fn finish(mut self, ending: Ending) -> Result<Summary, ClientError> {
        self.status.close();
        let progress = self.parts.replica.progress();
        let mut summary = Summary {
            name: self.options.name.clone(),
            role: self.network.welcome.role.word().to_owned(),
            participant: self.network.welcome.participant.0,
            device: self.parts.device,
            compensation_ms: progress.delay.as_millis_f64(),
            clock_error_bound_ms: progress.clock_error.map(Span::as_millis_f64),
            realtime: "no force loop".to_owned(),
            ..Summary::default()
        };
        let haptics = self.parts.haptics.map(HapticHandle::stop);
        if let Some(dropped) = self.parts.motion.map(MotionThread::stop) {
            summary.events.frames_dropped = dropped;
        }
        let solved = self.parts.replica.stop();
        let stats = self.network.leave();
        summary.rtt_ms = stats.link.rtt.map(Span::as_millis_f64);
        summary.loss = stats.link.loss_in();
        if let Some(haptics) = &haptics {
            summary.take_haptics(haptics);
        }
        let mut recording = None;
        if let Some(solved) = solved {
            summary.take_solved(&solved);
            recording = Some(solved.recording);
        }
        let outcome = conclude(ending, summary, haptics.as_ref());
        match (&self.options.record, recording) {
            (Some(path), Some(recording)) => {
                write_recording(path, recording, haptics.as_ref(), outcome)
            }
            _ => outcome,
        }
    }
}

/// What an ending means.
fn conclude(
    ending: Ending,
    mut summary: Summary,
    haptics: Option<&LoopSummary>,
) -> Result<Summary, ClientError> {
    let mut end = |sentence: String| {
        summary.ended = sentence;
        Box::new(std::mem::take(&mut summary))
    };
    if let Some(panic) = haptics.and_then(|h| h.panicked.as_ref()) {
        let detail = format!("the force loop failed and the force was taken away: {panic}");
        let summary = end(detail.clone());
        return Err(ClientError::Broken { detail, summary });
    }
    match ending {
        Ending::Wish(sentence) => Ok(*end(sentence)),
        Ending::Closed(reason @ (CloseReason::Left | CloseReason::Goodbye(_))) => {
            Ok(*end(reason.to_string()))
        }
        Ending::Closed(CloseReason::ConnectionLost(detail)) => {
            let summary = end(format!("the server is gone: {detail}"));
            Err(ClientError::ServerLost { detail, summary })
        }
        Ending::Silence => {
            let detail = "nothing was heard from it for 3 s".to_owned();
            let summary = end(format!("the server is gone: {detail}"));
            Err(ClientError::ServerLost { detail, summary })
        }
        Ending::Diverged(detail) => {
            let summary = end(format!("the copy of the tissue differs: {detail}"));
            Err(ClientError::Diverged { detail, summary })
        }
        Ending::Closed(reason) => {
            let detail = reason.to_string();
            let summary = end(detail.clone());
            Err(ClientError::Broken { detail, summary })
        }
        Ending::Panicked(which) => {
            let detail = format!("the {which} failed; this is a fault of the program");
            let summary = end(detail.clone());
            Err(ClientError::Broken { detail, summary })
        }
    }
}

impl Summary {
    fn take_haptics(&mut self, haptics: &LoopSummary) {
        let on_the_way = self.events.frames_dropped;
        self.take_loop(&haptics.stats);
        self.events.frames_dropped += on_the_way;
        self.realtime = match &haptics.priority {
            Priority::RealTime { priority } => format!("real-time priority {priority}"),
            Priority::Normal { explanation } => explanation.clone(),
        };
    }

    fn take_solved(&mut self, solved: &Solved) {
        self.topology_version = solved.topology_version;
        self.topology_hash.clone_from(&solved.topology_hash);
        self.operations = solved.counters.operations;
        self.cuts = solved.counters.cuts;
        self.cuts_refused = solved.counters.cuts_refused;
        self.views_skipped = solved.counters.views_skipped;
        self.corrected_nodes = solved.counters.corrected_nodes;
        self.drift_mm_max = solved.counters.drift_max_m * 1e3;
        self.haptic_solves = solved.haptic_solves;
        self.haptic_solve_ms = solved.haptic_solve_ms;
        self.view_solves = solved.view_solves;
        self.view_ms = solved.view_ms;
        self.seconds = solved.seconds;
    }
}

/// Writes the recording. An error of the run itself is more important than one of the file.
fn write_recording(
    path: &std::path::Path,
    mut recording: Recording,
    haptics: Option<&LoopSummary>,
    outcome: Result<Summary, ClientError>,
) -> Result<Summary, ClientError> {
    if let Some(haptics) = haptics {
        let point = |p: &crate::realtime::TracePoint| HapticPoint {
            t_us: p.time.as_micros(),
            position_m: p.position.into(),
            force_n: p.force.into(),
        };
        recording.haptic = haptics.trace.points().iter().map(point).collect();
        recording.dropped.haptic = haptics.trace.lost();
    }
    let written = std::fs::File::create(path).and_then(|file| {
        let mut file = std::io::BufWriter::new(file);
        serde_json::to_writer(&mut file, &recording)?;
        std::io::Write::flush(&mut file)
    });
    match (outcome, written) {
        (Ok(summary), Err(source)) => Err(ClientError::Record {
            path: path.to_owned(),
            source,
            summary: Box::new(summary),
        }),
        (outcome, _) => outcome,
    }
}
