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
use palpate_protocol::{ClientTime, OperationId, ParticipantId, Role, Span, TopologyHash};
use palpate_tissue::{Budget, Model};

use super::endpoint::Endpoint;
use super::host::{GRANT, Host};
use super::mishap::Mishap;
use super::simulation::Participant;
use super::site_clock::SiteClock;

/// Period of the force loop.
const TICK: Span = Span::from_millis(1);

/// Force loop ticks per contact model, as in the client.
const HAPTIC_EVERY: u64 = 4;

/// Solver iterations per view, as in the client.
const VIEW_ITERATIONS: usize = 2;

/// A trainee.
pub(super) struct Trainee {
    pub(super) endpoint: Endpoint,
    model: Arc<Model>,
    script: ScriptStart,
    blade_length_m: Option<f64>,
    /// Whether it solves its own tissue; otherwise it moves only, renders no force, and its views are unused.
    pub(super) solves: bool,
    hand: HandLoop,
    contact: ContactModel,
    hello: Hello,
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
}

impl Trainee {
    /// A trainee that follows a script and requests to join.
    pub(super) fn new(
        seat: usize,
        model: Arc<Model>,
        script: &Script,
        clock: SiteClock,
    ) -> Result<Self, String> {
        let name = format!("trainee-{}", seat + 1);
        let tool = tool_description(&script.tool());
        let hello = Hello {
            name: name.clone(),
            role: Role::Trainee,
            grant: GRANT,
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
            endpoint: Endpoint::new(seat, hello.clone(), clock)?,
            model,
            blade_length_m: (script.tool().length_m > 0.0).then_some(script.tool().length_m),
            script: start,
            solves: true,
            hand,
            contact: ContactModel::free_at(now, 0),
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
                name,
                role: Role::Trainee.word().to_owned(),
                ..Recording::default()
            },
        })
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
            self.endpoint.session.send_motion(sample);
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

    /// The work of the client's replica thread every 4 ms, without the haptic step.
    fn live(&mut self, now: ClientTime, at_us: i64) {
        let Some(site) = &mut self.site else { return };
        self.endpoint.check(site.advance(now));
        if let Some(at) = site.script_start()
            && self.script.get().is_none_or(|t| t > device_time(now))
        {
            self.script.set(device_time(at));
            self.recording.script_started_us = Some(self.endpoint.clock.true_us(at));
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
        let stands = self.endpoint.session.participant().is_some();
        while let Some(request) = site.poll_request().filter(|_| stands) {
            let request = self.requests.number(request);
            let sent = self.endpoint.session.send_request(request);
            self.endpoint.check(sent);
        }
        while let Some(mut operation) = site.poll_applied() {
            operation.applied_us = at_us;
            self.recording.operations.push(operation);
        }
        while site.poll_notice().is_some() {}
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

impl Participant for Trainee {
    fn endpoint(&mut self) -> &mut Endpoint {
        &mut self.endpoint
    }

    /// Reconnects to its seat and requests the whole operation log.
    fn reconnect(&mut self, at_us: i64) -> bool {
        if !std::mem::take(&mut self.wants_connection) {
            return false;
        }
        let hello = Hello {
            resume: self.resume.map(|resume| Resume {
                next_operation: OperationId(0),
                topology_version: 0,
                topology_hash: TopologyHash(0),
                ..resume
            }),
            ..self.hello.clone()
        };
        let session = ClientSession::new(hello, self.endpoint.clock.at(at_us));
        let session = session.map(|session| self.endpoint.session = session);
        self.endpoint.check(session);
        true
    }

    fn take_events(&mut self, at_us: i64) {
        let now = self.endpoint.clock.at(at_us);
        while let Some(mut event) = self.endpoint.session.poll_event() {
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
                        let sent = self.endpoint.session.send_request(request);
                        self.endpoint.check(sent);
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
                    self.endpoint.check(Err(reason));
                }
                _ => {}
            }
            let since = self.first_view.map(|first| now - first);
            for mishap in &mut self.mishaps {
                mishap.spoil(&mut event, since);
            }
            if let Some(site) = &mut self.site {
                self.endpoint.check(site.handle_event(event, now));
            }
        }
    }

    fn turn(&mut self, at_us: i64, _host: &Host) {
        let now = self.endpoint.clock.at(at_us);
        self.feel(now, at_us);
        self.endpoint.handle_timeout(at_us);
        self.take_events(at_us);
        if self.ticks.is_multiple_of(HAPTIC_EVERY) {
            self.live(now, at_us);
        }
        self.ticks += 1;
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
