//! Undo, redo and reset: server, full clients and thin clients have equal topologies.

#![allow(clippy::unwrap_used)]

use std::sync::Arc;

use palpate_protocol::clock::ClockMap;
use palpate_protocol::control::Control;
use palpate_protocol::handshake::{Hello, ModelInfo, Subscription, Welcome};
use palpate_protocol::operation::{BladePoint, CompensationMode, CompensationSettings};
use palpate_protocol::request::{CutRequest, Request, RequestKind, TimedBladePoint};
use palpate_protocol::session::{ClientEvent, PeerEvent, PeerMessage, PeerMotion};
use palpate_protocol::tool::ToolDescription;
use palpate_protocol::{
    ClientTime, Epoch, Grant, ModelHash, Pose, RequestId, ResumeToken, Role, ServerTime, Span,
    ToolSample,
};
use palpate_room::{Output, PeerKey, RoomConfig, SimulatedRoom};
use palpate_site::{Prefetch, Site, View, ViewUpdate, hand_budget};
use palpate_tissue::{Budget, Material, Model, TopologyHash, block};
use proptest::prelude::*;

const INSTRUCTOR: Grant = Grant([5; 16]);
const SPECTATOR: Grant = Grant([9; 16]);
const CELL: f64 = 4e-3;
const SIZE: [usize; 3] = [10, 8, 4];

/// A client without a network.
struct Client {
    peer: PeerKey,
    site: Option<Site>,
    helpers: Option<(Prefetch, View)>,
    is_thin: bool,
    /// Pieces of the snapshot that have arrived, and its size.
    snapshot: (Vec<u8>, usize),
}

impl Client {
    fn begin(&mut self, welcome: &Welcome, model: &Arc<Model>) {
        let model = Arc::clone(model);
        let mut site = if self.is_thin {
            Site::thin(welcome, model, None)
        } else {
            Site::new(welcome, model, None)
        };
        let size = welcome.snapshot.map_or(0, |s| s.bytes as usize);
        self.snapshot = (Vec::new(), size);
        let clock = ClientEvent::Clock(ClockMap::exact(Span::ZERO));
        site.handle_event(clock, ClientTime::ZERO).unwrap();
        self.site = Some(site);
    }

    /// Applies what is due; cuts are made at once by the cut worker, once it is detached.
    fn step(&mut self, now: ClientTime, is_detached: bool) {
        let site = self.site.as_mut().unwrap();
        if is_detached && self.helpers.is_none() {
            self.helpers = site.detach();
        }
        for _ in 0..8 {
            site.advance(now).unwrap();
            let mut stop = || false;
            let pose = palpate_device::Pose::default();
            site.haptic_step(now, pose, 0, hand_budget(&mut stop));
            let Some((prefetch, view)) = &mut self.helpers else {
                continue;
            };
            while let Some(order) = site.poll_cut_order() {
                prefetch.order(order);
            }
            while prefetch.can_work() {
                if let Some(event) = prefetch.work().unwrap() {
                    site.handle_cut(event);
                }
            }
            while let Some(update) = site.poll_view_update() {
                if let ViewUpdate::Cut(cut) = update {
                    view.take(*cut);
                }
            }
        }
        match &mut self.helpers {
            Some((_, view)) => {
                if let Some(frame) = site.next_view(now) {
                    view.step(frame.s, &frame.tools, Budget::new(1, 1e-2));
                }
            }
            None => drop(site.view_step(now, Budget::new(1, 1e-2))),
        }
    }

    fn topology(&self) -> (u32, u64) {
        let topology = self.site.as_ref().unwrap().replica().topology();
        if let Some((_, view)) = &self.helpers {
            assert_eq!(view.topology().hash(), topology.hash());
            assert_eq!(view.shape().displacement.len(), topology.node_count());
        }
        assert!(topology.boundary().is_closed());
        (topology.version(), topology.hash().0)
    }
}

struct Lesson {
    room: SimulatedRoom,
    model: Arc<Model>,
    clients: Vec<Client>,
    now_ms: i64,
    requests: u32,
}

impl Lesson {
    fn new() -> Self {
        let fat = Material::built_in("fat").unwrap();
        let model = Arc::new(block(SIZE, CELL, &fat, 1));
        let config = RoomConfig {
            epoch: Epoch(1),
            model: ModelInfo {
                hash: ModelHash(1),
                bytes: 1,
            },
            grants: vec![(Role::Instructor, INSTRUCTOR), (Role::Spectator, SPECTATOR)],
            seats: 8,
            spectators: 8,
            tick_hz: 50,
            compensation: CompensationSettings {
                mode: CompensationMode::Fixed,
                initial_delay_us: 20_000,
            },
            fresh_token: |who| ResumeToken([who.0 as u8; 16]),
            fresh_grant: |id| Grant((u128::MAX - u128::from(id)).to_le_bytes()),
            start_when_tools: 1,
        };
        let room = SimulatedRoom::new(Arc::clone(&model), config, ServerTime::ZERO);
        let mut lesson = Self {
            room,
            model,
            clients: Vec::new(),
            now_ms: 1000,
            requests: 0,
        };
        lesson.join("ann", Role::Instructor, false);
        lesson.join("bob", Role::Spectator, false);
        lesson.join("cid", Role::Spectator, true);
        lesson
    }

    fn now(&self) -> ServerTime {
        ServerTime::from_micros(1000 * self.now_ms)
    }

    fn join(&mut self, name: &str, role: Role, is_thin: bool) {
        let peer = PeerKey(self.clients.len() as u64 + 1);
        self.clients.push(Client {
            peer,
            site: None,
            helpers: None,
            is_thin,
            snapshot: (Vec::new(), 0),
        });
        let hello = Hello {
            name: name.to_owned(),
            role,
            grant: if role.has_tool() {
                INSTRUCTOR
            } else {
                SPECTATOR
            },
            tool: role
                .has_tool()
                .then_some(ToolDescription::scalpel(5e-4, 0.03)),
            subscription: if is_thin {
                Subscription::Thin
            } else {
                Subscription::Full
            },
            resume: None,
        };
        self.room
            .handle_event(peer, PeerEvent::Hello(hello), self.now());
        self.deliver();
    }

    fn deliver(&mut self) {
        let now = ClientTime::from_micros(1000 * self.now_ms);
        while let Some(output) = self.room.poll_output() {
            let Output::Message(to, message) = output else {
                continue;
            };
            let client = self.clients.iter_mut().find(|c| c.peer == to).unwrap();
            match message {
                PeerMessage::Welcome(welcome) => client.begin(&welcome, &self.model),
                PeerMessage::Snapshot(piece) => {
                    let (bytes, size) = &mut client.snapshot;
                    bytes.extend_from_slice(&piece);
                    if bytes.len() == *size {
                        let event = ClientEvent::Snapshot(std::mem::take(bytes));
                        let site = client.site.as_mut().unwrap();
                        site.handle_event(event, now).unwrap();
                    }
                }
                PeerMessage::Operation(operation) => {
                    let site = client.site.as_mut().unwrap();
                    let event = ClientEvent::Operation((*operation).clone());
                    site.handle_event(event, now).unwrap();
                }
                _ => {}
            }
        }
        // The room sends a newcomer all at once.
        let sites = self.clients.iter_mut().filter_map(|c| c.site.as_mut());
        for site in sites.filter(|site| site.is_catching_up()) {
            site.handle_event(ClientEvent::CaughtUp, now).unwrap();
        }
    }

    fn request(&mut self, kind: RequestKind) {
        self.requests += 1;
        let id = RequestId(self.requests);
        let event = PeerEvent::Request(Request { id, kind });
        self.room.handle_event(PeerKey(1), event, self.now());
        self.deliver();
    }

    /// Draws a slit across the block at `x`, in cells.
    fn cut(&mut self, x: f64) {
        let began = self.now_ms;
        let tip = |t: i64| [x * CELL, CELL * (t - began) as f64 * 0.1, 1.1 * CELL];
        let sample = |t: i64| ToolSample {
            time: ServerTime::from_micros(1000 * t),
            pose: Pose {
                position_m: tip(t),
                ..Pose::IDENTITY
            },
            buttons: 1,
            force_n: None,
        };
        self.now_ms += 80;
        let samples = (began..=self.now_ms).map(sample).collect();
        let motion = PeerMotion::on_time(samples, self.now());
        self.room
            .handle_event(PeerKey(1), PeerEvent::Motion(motion), self.now());
        let point = |i: i64| TimedBladePoint {
            time: ServerTime::from_micros(1000 * (began + 10 * i)),
            blade: BladePoint {
                tip_m: tip(began + 10 * i),
                axis: [0.0, 0.0, 1.0],
                depth_m: 0.02,
            },
        };
        self.request(RequestKind::Cut(CutRequest::whole(
            (0..=8).map(point).collect(),
            0.0,
        )));
    }

    /// Moves on until every operation has taken effect.
    fn settle(&mut self) {
        for _ in 0..10 {
            self.now_ms += 20;
            self.room.handle_tick(self.now(), &mut || false);
            self.deliver();
            let now = ClientTime::from_micros(1000 * self.now_ms);
            for (i, client) in self.clients.iter_mut().enumerate() {
                client.step(now, i % 3 == 0);
            }
        }
    }

    fn check(&self) {
        let (version, hash) = self.room.topology();
        assert!(self.room.boundary_closed());
        for client in &self.clients {
            assert_eq!(client.topology(), (version, hash.0), "{:?}", client.peer);
        }
    }
}

#[derive(Debug, Clone)]
enum Step {
    Cut(f64),
    Control(Control),
}

fn step() -> impl Strategy<Value = Step> {
    prop_oneof![
        4 => (1.0_f64..9.0).prop_map(Step::Cut),
        3 => Just(Step::Control(Control::Undo)),
        2 => Just(Step::Control(Control::Redo)),
        1 => Just(Step::Control(Control::Reset)),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(8))]

    #[test]
    fn all_sites_have_equal_topologies_after_cuts_undos_redos_and_resets(
        steps in prop::collection::vec(step(), 1..9),
        (snapshot, join) in (0_usize..9, 0_usize..9),
    ) {
        let mut lesson = Lesson::new();
        lesson.settle();
        let (snapshot, join) = (snapshot.min(steps.len()), join.min(steps.len()));
        for i in 0..=steps.len() {
            if i == snapshot {
                lesson.room.take_snapshot(lesson.now());
            }
            if i == join {
                // With the snapshot, if it is taken by now.
                lesson.join("dan", Role::Spectator, false);
                lesson.join("eve", Role::Spectator, true);
            }
            match steps.get(i) {
                Some(Step::Cut(x)) => lesson.cut(*x),
                Some(Step::Control(c)) => lesson.request(RequestKind::Control(c.clone())),
                None => {}
            }
            lesson.settle();
            lesson.check();
        }
        for _ in 0..9 {
            lesson.now_ms += 2000;
            lesson.request(RequestKind::Control(Control::Undo));
            lesson.settle();
            lesson.check();
        }
        let uncut = TopologyHash::of_uncut(&lesson.model);
        prop_assert_eq!(lesson.room.topology().1.0, uncut.0);
    }
}

#[test]
fn sequence_reaches_cuts_undos_and_redos() {
    let mut lesson = Lesson::new();
    lesson.settle();
    let mut hashes = vec![lesson.room.topology().1];
    for x in [2.1, 5.2, 7.3] {
        lesson.cut(x);
        lesson.settle();
        lesson.check();
        hashes.push(lesson.room.topology().1);
    }
    let expected = [
        (Control::Undo, 2),
        (Control::Undo, 1),
        (Control::Redo, 2),
        (Control::Redo, 3),
        (Control::Undo, 2),
        (Control::Reset, 0),
    ];
    for (i, (control, index)) in expected.into_iter().enumerate() {
        lesson.request(RequestKind::Control(control));
        lesson.settle();
        lesson.check();
        assert_eq!(lesson.room.topology(), (4 + i as u32, hashes[index]));
    }
}
