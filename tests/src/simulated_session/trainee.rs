//! A participant of a simulated session: hand, force loop, protocol session and site, with its own clock.

use std::sync::Arc;

use palpate_client::convert::{local_sample, tool_description};
use palpate_client::realtime::{HandLoop, Wishes, device_time};
use palpate_client::recording::{HapticPoint, Recording, ToolRecord, ViewRecord, choose_nodes};
use palpate_client::replica::hand_budget;
use palpate_client::requests::Requests;
use palpate_client::site::{Site, SiteCounters, ViewFrame};
use palpate_client::view::VIEW_TOLERANCE;
use palpate_device::backend::sim::{ScriptStart, SimHand};
use palpate_device::{HapticDevice, Script};
use palpate_haptics::{Chain, ChainConfig, ContactModel};
use palpate_protocol::handshake::{Hello, Resume, Subscription};
use palpate_protocol::session::{ClientEvent, ClientSession};
use palpate_protocol::{ClientTime, Grant, OperationId, ParticipantId, Role, Span, TopologyHash};
use palpate_tissue::{Budget, Model};

use super::clock::SiteClock;
use super::mishap::Mishap;
use super::wires::Wires;
use crate::network::Direction;

/// Period of the force loop.
const TICK: Span = Span::from_millis(1);

/// Force loop ticks per contact model, as in the client.
const HAPTIC_EVERY: u64 = 4;

/// Solver iterations per view, as in the client.
const VIEW_ITERATIONS: usize = 2;

/// Error message of a participant that cannot continue.
pub(super) type Trouble = String;

/// A trainee.
pub(super) struct Trainee {
    seat: usize,
    clock: SiteClock,
    model: Arc<Model>,
    script: ScriptStart,
    blade_length_m: Option<f64>,
    /// Whether it solves its own tissue.
    solves: bool,
    hand: HandLoop,
    contact: ContactModel,
    hello: Hello,
    session: ClientSession,
    requests: Requests,
    /// Seat and position in the operation log, for a reconnect.
    resume: Option<Resume>,
    wants_connection: bool,
    site: Option<Site>,
    pub(super) mishaps: Vec<Mishap>,
    first_view: Option<ClientTime>,
    ticks: u64,
    link_lost: bool,
    /// Views and forces of the trainee, in true time.
    pub(super) recording: Recording,
    pub(super) trouble: Option<Trouble>,
}

impl Trainee {
    /// A trainee that follows a script and requests to join.
    pub(super) fn new(
        seat: usize,
        name: &str,
        grant: Grant,
        model: Arc<Model>,
        script: &Script,
        clock: SiteClock,
    ) -> Result<Self, Trouble> {
        let tool = tool_description(&script.tool());
        let hello = Hello {
            name: name.to_owned(),
            role: Role::Trainee,
            grant,
            tool: Some(tool),
            subscription: Subscription::Full,
            resume: None,
        };
        let start = ScriptStart::not_yet();
        let device = SimHand::new(script.clone(), start.clone());
        let chain = Chain::new(ChainConfig::default(), device.caps());
        let now = clock.at(0);
        let mut hand = HandLoop::new(Box::new(device), chain, TICK, now);
        hand.begin();
        Ok(Self {
            seat,
            model,
            blade_length_m: (script.tool().length_m > 0.0).then_some(script.tool().length_m),
            script: start,
            solves: true,
            hand,
            contact: ContactModel::free_at(now, 0),
            session: ClientSession::new(hello.clone(), now).map_err(|e| e.to_string())?,
            hello,
            requests: Requests::new(ParticipantId::SERVER),
            resume: None,
            wants_connection: false,
            site: None,
            mishaps: Vec::new(),
            first_view: None,
            ticks: 0,
            link_lost: false,
            recording: Recording {
                name: name.to_owned(),
                role: Role::Trainee.word().to_owned(),
                ..Recording::default()
            },
            trouble: None,
            clock,
        })
    }

    /// Makes the trainee move only: it solves no tissue and renders no force, and its views are unused.
    pub(super) fn only_moving(self) -> Self {
        Self {
            solves: false,
            ..self
        }
    }

    /// Receives bytes of the operations stream at a true time.
    pub(super) fn handle_stream(&mut self, bytes: &[u8], at_us: i64) {
        self.session.handle_stream(bytes, self.clock.at(at_us));
        self.take_events(at_us);
    }

    /// Receives a datagram at a true time.
    pub(super) fn handle_datagram(&mut self, bytes: &[u8], at_us: i64) {
        self.session.handle_datagram(bytes, self.clock.at(at_us));
        self.take_events(at_us);
    }

    /// Simulates one millisecond.
    pub(super) fn turn(&mut self, at_us: i64, wires: &mut Wires) {
        let now = self.clock.at(at_us);
        self.feel(now, at_us);
        if self.session.poll_timeout().is_some_and(|due| due <= now) {
            self.session.handle_timeout(now);
        }
        self.take_events(at_us);
        if self.ticks.is_multiple_of(HAPTIC_EVERY) {
            self.live(now, at_us);
        }
        self.ticks += 1;
        while let Some(bytes) = self.session.poll_stream() {
            wires.send_stream(self.seat, Direction::Up, &bytes, at_us.unsigned_abs());
        }
        while let Some(bytes) = self.session.poll_datagram(now) {
            wires.send_datagram(self.seat, Direction::Up, bytes, at_us.unsigned_abs());
        }
    }

    fn feel(&mut self, now: ClientTime, at_us: i64) {
        let wishes = Wishes {
            // During a resync the replica is wrong, so its force is treated as lost.
            link_lost: self.link_lost || self.site.as_ref().is_some_and(Site::is_resyncing),
            stop: false,
        };
        let turned = self.hand.turn(now, wishes, &self.contact);
        let frame = turned.frame;
        if self.ticks.is_multiple_of(HAPTIC_EVERY) {
            let (pose, buttons) = (&frame.sample.pose, frame.sample.buttons);
            let point = HapticPoint::new(at_us, pose, buttons, frame.wrench.force);
            self.recording.haptic.push(point);
        }
        if turned.is_good && self.site.is_some() {
            let sample = local_sample(&frame);
            self.session.send_motion(sample);
            if let Some(site) = &mut self.site {
                site.handle_own(&sample);
            }
        }
        if self.ticks.is_multiple_of(HAPTIC_EVERY)
            && let Some(site) = &mut self.site
        {
            let buttons = (frame.sample.buttons.bits() & 0xff) as u8;
            // The solve ends by iterations and residual instead of time, so a seed reproduces it.
            let mut never = || false;
            let budget = hand_budget(&mut never);
            if let Some(model) = site.haptic_step(now, frame.sample.pose, buttons, budget) {
                self.contact = model;
            }
        }
    }

    fn take_events(&mut self, at_us: i64) {
        let now = self.clock.at(at_us);
        while let Some(mut event) = self.session.poll_event() {
            self.requests.handle_event(&event);
            match &event {
                ClientEvent::Welcomed(welcome) => {
                    self.recording.participant = welcome.participant.0;
                    self.resume = Some(Resume::after_welcome(welcome, self.resume));
                    if self.site.is_none() {
                        let model = Arc::clone(&self.model);
                        self.requests = Requests::new(welcome.participant);
                        let new = if self.solves { Site::new } else { Site::thin };
                        self.site = Some(new(welcome, model, self.blade_length_m));
                        continue;
                    }
                    for request in self.requests.unanswered() {
                        if let Err(error) = self.session.send_request(request) {
                            self.trouble.get_or_insert(error.to_string());
                        }
                    }
                }
                ClientEvent::Operation(operation) => {
                    if let Some(resume) = &mut self.resume {
                        resume.note(operation);
                    }
                }
                ClientEvent::LinkLost => self.link_lost = true,
                ClientEvent::LinkRestored => self.link_lost = false,
                ClientEvent::Closed(reason) => {
                    self.trouble.get_or_insert(reason.to_string());
                }
                _ => {}
            }
            let since = self.first_view.map(|first| now - first);
            for mishap in &mut self.mishaps {
                mishap.spoil(&mut event, since);
            }
            if let Some(site) = &mut self.site
                && let Err(error) = site.handle_event(event, now)
            {
                self.trouble.get_or_insert(error.to_string());
            }
        }
    }

    /// The work of the client's replica thread every 4 ms, without the haptic step.
    fn live(&mut self, now: ClientTime, at_us: i64) {
        let Some(site) = &mut self.site else { return };
        if let Err(error) = site.advance(now) {
            self.trouble.get_or_insert(error.to_string());
        }
        if let Some(at) = site.script_start()
            && self.script.get().is_none_or(|t| t > device_time(now))
        {
            self.script.set(device_time(at));
            self.recording.script_started_us = Some(self.clock.true_us(at));
        }
        let budget = Budget {
            near: false,
            iterations: VIEW_ITERATIONS,
            tolerance: VIEW_TOLERANCE,
            stop: None,
        };
        if let Some(frame) = site.view_step(now, budget) {
            self.first_view.get_or_insert(now);
            let view = record(site, &frame, at_us);
            self.recording.views.extend(view);
        }
        self.wants_connection |= site.poll_rejoin().is_some();
        let stands = self.session.participant().is_some();
        while let Some(request) = site.poll_request().filter(|_| stands) {
            let request = self.requests.number(request);
            if let Err(error) = self.session.send_request(request) {
                self.trouble.get_or_insert(error.to_string());
            }
        }
        while let Some(mut operation) = site.poll_applied() {
            operation.applied_us = at_us;
            self.recording.operations.push(operation);
        }
        while site.poll_notice().is_some() {}
    }

    /// Whether the site requests a new connection.
    pub(super) fn wants_connection(&self) -> bool {
        self.wants_connection
    }

    /// Reconnects to its seat and requests the whole operation log.
    pub(super) fn come_back(&mut self, at_us: i64) {
        self.wants_connection = false;
        let hello = Hello {
            resume: self.resume.map(|resume| Resume {
                next_operation: OperationId(0),
                topology_version: 0,
                topology_hash: TopologyHash(0),
                ..resume
            }),
            ..self.hello.clone()
        };
        match ClientSession::new(hello, self.clock.at(at_us)) {
            Ok(session) => self.session = session,
            Err(error) => {
                self.trouble.get_or_insert(error.to_string());
            }
        }
    }

    /// Counters of the site.
    pub(super) fn counters(&self) -> SiteCounters {
        self.site.as_ref().map(Site::counters).unwrap_or_default()
    }

    /// Version and hash of its topology; `None` before the join.
    pub(super) fn topology(&self) -> Option<(u32, u64)> {
        let topology = self.site.as_ref()?.replica().topology();
        Some((topology.version(), topology.hash().0))
    }
}

fn record(site: &mut Site, frame: &ViewFrame, at_us: i64) -> Option<ViewRecord> {
    let (shape, version) = site.seen()?;
    let moved = shape.displacement.iter().enumerate();
    Some(ViewRecord {
        s_us: frame.s.as_micros(),
        shown_us: at_us,
        delay_us: frame.delay.as_micros(),
        tools: frame
            .tools
            .iter()
            .map(|t| ToolRecord {
                participant: t.participant.0,
                position_m: t.position.into(),
                stale: t.stale,
            })
            .collect(),
        nodes: choose_nodes(moved.map(|(n, u)| (n as u32, (*u).into()))),
        topology_version: version,
    })
}
