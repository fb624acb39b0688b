//! A participant of a simulated session: hand, force loop, protocol session and site, with its own clock.

use std::sync::Arc;

use palpate_client::realtime::{HandLoop, Horizon, LoopCommands, device_time, local_sample};
use palpate_client::recording::{HapticPoint, Recording, ViewRecord};
use palpate_client::tool_description;
use palpate_device::backend::sim::{ScriptStart, SimHand};
use palpate_device::{HapticDevice, Script};
use palpate_haptics::{Chain, ChainConfig, ContactModel};
use palpate_protocol::compensation::DelaySchedule;
use palpate_protocol::handshake::{Hello, Subscription, Welcome};
use palpate_protocol::session::{ClientEvent, ClientSession, CloseReason};
use palpate_protocol::{ClientTime, Role, Span};
use palpate_site::{
    Action, Reconnector, Site, SiteCounters, VIEW_ITERATIONS, VIEW_TOLERANCE, hand_budget,
};
use palpate_tissue::{Budget, Model};

use super::endpoint::Endpoint;
use super::host::{GRANT, Host};
use super::mishap::SessionFault;
use super::simulation::Participant;
use super::site_clock::SiteClock;

/// Period of the force loop.
const TICK: Span = Span::from_millis(1);

/// Force loop ticks per contact model, as in the client.
const HAPTIC_EVERY: u64 = 4;

/// How long a trainee tries to reconnect, as in the client.
const PATIENCE: Span = Span::from_millis(60_000);

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
    /// The seat; `None` before the join.
    reconnector: Option<Reconnector>,
    /// The connection to open next.
    next_connection: Option<(Box<Hello>, DelaySchedule)>,
    site: Option<Site>,
    pub(super) session_faults: Vec<SessionFault>,
    first_view: Option<ClientTime>,
    ticks: u64,
    link_lost: bool,
    /// Views and forces of the trainee, in true time.
    pub(super) recording: Recording,
}

impl Trainee {
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
            reconnector: None,
            next_connection: None,
            site: None,
            session_faults: Vec::new(),
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
        let loop_commands = LoopCommands {
            // During a resync the replica is wrong, so its force is treated as lost.
            link_lost: self.link_lost || self.site.as_ref().is_some_and(Site::is_resyncing),
            stop: false,
        };
        let turned = self.hand.turn(now, loop_commands, &self.contact);
        let frame = turned.frame;
        let (pose, buttons) = (&frame.sample.pose, frame.sample.buttons);
        let held = self.recording.haptic.last().map(|p| p.buttons);
        let is_changed = held.is_some_and(|held| held != buttons.bits());
        if self.ticks.is_multiple_of(HAPTIC_EVERY) || is_changed {
            let point = HapticPoint::new(at_us, pose, buttons, frame.wrench.force);
            self.recording.haptic.push(point);
        }
        if turned.is_good && self.site.is_some() {
            let sample = local_sample(&frame);
            if self.endpoint.is_open {
                self.endpoint.session.send_motion(sample);
            }
            if let Some(site) = &mut self.site {
                site.handle_own(&sample);
            }
        }
        if self.ticks.is_multiple_of(HAPTIC_EVERY)
            && let Some(site) = &mut self.site
        {
            let buttons = frame.tool_buttons();
            // The solve ends by iterations and residual instead of time, so a seed reproduces it.
            let mut never = || false;
            let budget = hand_budget(&mut never);
            let pose = Horizon::default().hand_pose(&frame);
            if let Some(model) = site.haptic_step(now, pose, buttons, budget) {
                self.contact = model;
            }
        }
    }

    fn join(&mut self, welcome: &Welcome) {
        self.recording.participant = welcome.participant.0;
        let new = if self.solves { Site::new } else { Site::thin };
        self.site = Some(new(welcome, Arc::clone(&self.model), self.blade_length_m));
        let hello = self.hello.clone();
        let seed = self.endpoint.seat as u64;
        self.reconnector = Some(Reconnector::new(hello, welcome, PATIENCE, 0, seed));
    }

    fn act(&mut self, now: ClientTime) {
        while let Some(action) = self.reconnector.as_mut().and_then(Reconnector::poll_action) {
            match action {
                Action::Deliver(event) => self.deliver(event, now),
                Action::Send(request) => {
                    if self.endpoint.is_open {
                        let sent = self.endpoint.session.send_request(request);
                        self.endpoint.check(sent);
                    }
                }
                Action::Disconnect => self.endpoint.is_open = false,
                Action::Connect(hello, delay) => self.next_connection = Some((hello, delay)),
                Action::End(_) => {}
            }
        }
    }

    /// Delivers an event to the site, with the faults of this trainee.
    fn deliver(&mut self, mut event: ClientEvent, now: ClientTime) {
        match &event {
            ClientEvent::LinkLost => self.link_lost = true,
            ClientEvent::LinkRestored => self.link_lost = false,
            ClientEvent::Closed(reason) => self.endpoint.check(Err(reason)),
            _ => {}
        }
        let since = self.first_view.map(|first| now - first);
        for mishap in &mut self.session_faults {
            mishap.spoil(&mut event, since);
        }
        if let Some(site) = &mut self.site {
            self.endpoint.check(site.handle_event(event, now));
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
            let shown = ClientTime::from_micros(at_us);
            let view = site.seen();
            let view = view.map(|(shape, version)| ViewRecord::new(&frame, shape, version, shown));
            self.recording.views.extend(view);
        }
        if let Some(reconnector) = &mut self.reconnector {
            if let Some(why) = site.poll_resync() {
                reconnector.handle_resync(why, now);
            }
            while let Some(request) = site.poll_request() {
                reconnector.handle_request(request, true);
            }
        }
        while let Some(mut operation) = site.poll_applied() {
            operation.applied_us = at_us;
            self.recording.operations.push(operation);
        }
        while site.poll_notice().is_some() {}
        self.act(now);
    }

    pub(super) fn counters(&self) -> SiteCounters {
        self.site.as_ref().map(Site::counters).unwrap_or_default()
    }

    pub(super) fn topology(&self) -> Option<(u32, u64)> {
        let topology = self.site.as_ref()?.replica().topology();
        Some((topology.version(), topology.hash().0))
    }
}

impl Participant for Trainee {
    fn endpoint(&mut self) -> &mut Endpoint {
        &mut self.endpoint
    }

    fn reconnect(&mut self, at_us: i64) -> bool {
        let Some((hello, delay)) = self.next_connection.take() else {
            return false;
        };
        match ClientSession::new(*hello, self.endpoint.clock.at(at_us)) {
            Ok(mut session) => {
                session.resume_schedule(delay);
                self.endpoint.connect(session);
            }
            Err(error) => self.endpoint.check(Err(error)),
        }
        true
    }

    fn take_events(&mut self, at_us: i64) {
        let now = self.endpoint.clock.at(at_us);
        while let Some(event) = self.endpoint.poll_event() {
            match (event, &mut self.reconnector) {
                (ClientEvent::Welcomed(welcome), None) => self.join(&welcome),
                (ClientEvent::Welcomed(welcome), Some(reconnector)) => {
                    reconnector.handle_welcome(welcome, now);
                }
                (ClientEvent::Closed(reason), None) => self.endpoint.check(Err(reason)),
                (ClientEvent::Closed(CloseReason::Refused(refusal)), Some(reconnector)) => {
                    reconnector.handle_refusal(refusal, now);
                }
                (ClientEvent::Closed(reason), Some(reconnector)) if !reconnector.is_connected() => {
                    reconnector.handle_failure(reason.to_string(), now);
                }
                (event, Some(reconnector)) => reconnector.handle_event(event, now),
                (_, None) => {}
            }
            self.act(now);
        }
    }

    fn turn(&mut self, at_us: i64, _host: &Host) {
        let now = self.endpoint.clock.at(at_us);
        self.feel(now, at_us);
        self.endpoint.handle_timeout(at_us);
        self.take_events(at_us);
        if let Some(reconnector) = &mut self.reconnector {
            reconnector.handle_timeout(now);
            self.act(now);
        }
        if self.ticks.is_multiple_of(HAPTIC_EVERY) {
            self.live(now, at_us);
        }
        self.ticks += 1;
    }
}
