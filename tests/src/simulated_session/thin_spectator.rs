//! A thin spectator in a simulated session, with its own clock. Its error is the distance of shown nodes
//! from the server's shape.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use palpate_protocol::handshake::{Hello, Subscription};
use palpate_protocol::session::{ClientEvent, Picture};
use palpate_protocol::{Role, ServerTime};
use palpate_site::{Site, ThinView};
use palpate_tissue::{Model, Shape};
use serde::Serialize;

use super::endpoint::Endpoint;
use super::host::{GRANT, Host};
use super::simulation::Participant;
use super::site_clock::SiteClock;
use crate::disagreement::DistancesMm;

/// Minimum displacement of a compared node from its first position, m. Resting nodes always agree and would
/// lower the percentiles.
const MOVED_M: f32 = 5e-5;

/// Turns between two updates of the site, as in the client.
const LIVE_EVERY: u64 = 4;

/// Turns between two byte counts, and counts per second.
const COUNT_EVERY: u64 = 50;
const COUNTS_PER_S: usize = 20;

#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct ThinSpectatorResult {
    /// Distance of each displaced node from the server's position at the shown time.
    pub apart_mm: DistancesMm,
    /// The same at the end, at rest.
    pub rest_mm: DistancesMm,
    /// Mean downlink rate, bit/s, with UDP, IP and QUIC overhead.
    pub bits_per_s: f64,
    /// Maximum downlink rate over one second, bit/s.
    pub bits_per_s_max: f64,
    pub nodes_per_s: f64,
    pub bits_per_node: f64,
    pub waiting_max: u32,
    pub lag_ms: f64,
    /// Views that were not compared: the server's shape was unknown or had another topology.
    pub not_compared: u64,
}

pub(super) struct ThinSpectator {
    endpoint: Endpoint,
    model: Arc<Model>,
    site: Option<Site>,
    turns: u64,
    at_first: BTreeMap<u32, [f32; 3]>,
    apart_mm: Vec<f32>,
    not_compared: u64,
    /// Start of the scripts: time, bytes and nodes received by then.
    began: Option<(i64, u64, u64)>,
    /// Byte counts of the last second, oldest first.
    looks: VecDeque<u64>,
    most: u64,
    bytes: u64,
}

impl ThinSpectator {
    pub(super) fn new(seat: usize, model: Arc<Model>, clock: SiteClock) -> Result<Self, String> {
        let hello = Hello {
            name: format!("spectator-{}", seat + 1),
            role: Role::Spectator,
            grant: GRANT,
            tool: None,
            subscription: Subscription::Thin,
            resume: None,
        };
        Ok(Self {
            endpoint: Endpoint::new(seat, hello, clock)?,
            model,
            site: None,
            turns: 0,
            at_first: BTreeMap::new(),
            apart_mm: Vec::new(),
            not_compared: 0,
            began: None,
            looks: VecDeque::new(),
            most: 0,
            bytes: 0,
        })
    }

    fn live(&mut self, at_us: i64, pictures: &BTreeMap<ServerTime, Arc<Picture>>) {
        let now = self.endpoint.clock.at(at_us);
        let Some(site) = &mut self.site else { return };
        self.endpoint.check(site.advance(now));
        let begins = site
            .script_start()
            .map(|at| self.endpoint.clock.true_us(at));
        if self.began.is_none() && begins.is_some_and(|b| b <= at_us) {
            let told = site
                .replica()
                .thin_view()
                .map_or(0, |t| t.counters().received);
            self.began = Some((at_us, self.bytes, told));
        }
        if let Some(frame) = site.next_view(now)
            && let Some((shape, version)) = site.seen()
        {
            let was = pictures.get(&frame.s);
            match was.filter(|p| p.topology_version == version) {
                Some(picture) if self.began.is_some() => {
                    compare(picture, shape, &self.at_first, &mut self.apart_mm);
                }
                Some(picture) => {
                    let all = picture.nodes.iter().copied();
                    self.at_first = all.zip(picture.displacements.iter().copied()).collect();
                }
                None => self.not_compared += u64::from(self.began.is_some()),
            }
        }
        while let Some(request) = site.poll_request() {
            let sent = self.endpoint.session.request(request).map(|_| ());
            self.endpoint.check(sent);
        }
        while site.poll_applied().is_some() {}
        while site.poll_notice().is_some() {}
    }

    /// Results until `at_us`; `last` is the server's shape at that time.
    pub(super) fn result(&mut self, at_us: i64, last: Option<&Picture>) -> ThinSpectatorResult {
        let (began_us, bytes, told) = self.began.unwrap_or((at_us, self.bytes, 0));
        let seconds = ((at_us - began_us) as f64 * 1e-6).max(1e-3);
        let bits_per_s = (self.bytes - bytes) as f64 * 8.0 / seconds;
        let mut rest = Vec::new();
        let seen = self.site.as_ref().and_then(Site::seen);
        if let Some((picture, (shape, _))) = last.zip(seen) {
            compare(picture, shape, &self.at_first, &mut rest);
        }
        let thin = self.site.as_ref().and_then(|s| s.replica().thin_view());
        let counters = thin.map(ThinView::counters).unwrap_or_default();
        let nodes = (counters.received - told) as f64 / seconds;
        ThinSpectatorResult {
            apart_mm: DistancesMm::of(&mut self.apart_mm),
            rest_mm: DistancesMm::of(&mut rest),
            bits_per_s,
            bits_per_s_max: self.most as f64 * 8.0,
            nodes_per_s: nodes,
            bits_per_node: bits_per_s / nodes.max(1.0),
            waiting_max: counters.waiting_max,
            lag_ms: thin.map_or(0.0, |t| t.lag().as_millis_f64()),
            not_compared: self.not_compared,
        }
    }

    pub(super) fn topology(&self) -> Option<(u32, u64)> {
        let topology = self.site.as_ref()?.replica().topology();
        Some((topology.version(), topology.hash().0))
    }
}

impl Participant for ThinSpectator {
    fn endpoint(&mut self) -> &mut Endpoint {
        &mut self.endpoint
    }

    fn take_events(&mut self, at_us: i64) {
        let now = self.endpoint.clock.at(at_us);
        while let Some(event) = self.endpoint.session.poll_event() {
            match &event {
                ClientEvent::Welcomed(welcome) => {
                    self.site = Some(Site::thin(welcome, Arc::clone(&self.model), None));
                }
                ClientEvent::Closed(reason) => {
                    self.endpoint.check(Err(reason));
                }
                _ => {}
            }
            if let Some(site) = &mut self.site {
                self.endpoint.check(site.handle_event(event, now));
            }
        }
    }

    /// Views are compared with the server's shapes once the scripts have started.
    fn turn(&mut self, at_us: i64, host: &Host) {
        self.endpoint.handle_timeout(at_us);
        self.take_events(at_us);
        if self.turns.is_multiple_of(LIVE_EVERY) {
            self.live(at_us, &host.pictures);
        }
        self.turns += 1;
        self.bytes = host.bytes_to(self.endpoint.seat);
        if self.began.is_some() && self.turns.is_multiple_of(COUNT_EVERY) {
            self.looks.push_back(self.bytes);
            if self.looks.len() > COUNTS_PER_S {
                let before = self.looks.pop_front().unwrap_or(self.bytes);
                self.most = self.most.max(self.bytes - before);
            }
        }
    }
}

fn compare(
    picture: &Picture,
    shape: &Shape,
    at_first: &BTreeMap<u32, [f32; 3]>,
    into: &mut Vec<f32>,
) {
    for (node, at) in picture.nodes.iter().zip(&picture.displacements) {
        let Some(shown) = shape.displacement.get(*node as usize) else {
            continue;
        };
        let shown = [shown.x as f32, shown.y as f32, shown.z as f32];
        let first = at_first.get(node).copied().unwrap_or([f32::INFINITY; 3]);
        if distance(shown, first).max(distance(*at, first)) > MOVED_M {
            into.push(distance(shown, *at) * 1e3);
        }
    }
}

fn distance(a: [f32; 3], b: [f32; 3]) -> f32 {
    let square = |i: usize| (a[i] - b[i]) * (a[i] - b[i]);
    (0..3).map(square).sum::<f32>().sqrt()
}
