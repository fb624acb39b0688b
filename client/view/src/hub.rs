//! The task that owns all pages: it encodes each shape once and sends it to every page.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use axum::body::Bytes;
use axum::extract::ws::Utf8Bytes;
use palpate_tissue::Topology;
use tokio::sync::mpsc;

use crate::feed::{FeedState, TissueUpdate};
use crate::page::{PageId, Reliable};
use crate::shape_code::{ShapeCode, ShapeEncoder, ShapeSample};
use crate::springs::springs;
use crate::surface::Surface;

/// An event for the hub.
pub(crate) enum HubEvent {
    /// A page was opened.
    Opened(PageId, mpsc::Sender<Reliable>, mpsc::Sender<Bytes>),
    /// A page is gone.
    Closed(PageId),
    /// A page does not get a shape that was sent to it, so it needs a full one.
    Missed(PageId),
    /// A page shows the springs of this region from now on, or none.
    Springs(PageId, Option<u16>),
    /// A page takes part from now on; the message goes to it first.
    Admitted(PageId, String),
    /// A text for one page.
    Text(PageId, String),
    /// The end of a page, after a last text.
    End(PageId, String, String),
    /// The end of all pages, after a last text.
    Close(String, String),
    /// The state of the session, for all pages.
    State(String),
    /// A text for all pages that take part.
    Everyone(String),
    /// The tools, for all pages.
    Tools(Vec<u8>),
}

struct PageQueues {
    reliable: mpsc::Sender<Reliable>,
    frames: mpsc::Sender<Bytes>,
    is_admitted: bool,
    /// The shape that it has.
    has: Option<u32>,
    /// The region whose springs it shows.
    springs: Option<u16>,
    /// Regions whose springs it has, of the newest topology.
    has_springs: BTreeSet<u16>,
}

/// The newest surface, and the springs that pages asked for.
struct Drawn {
    version: u32,
    bytes: Bytes,
    nodes: Arc<[u32]>,
    /// Number of regions of the model.
    regions: usize,
    /// Messages by region.
    springs: BTreeMap<u16, Bytes>,
}

/// See the module.
pub(crate) struct Hub {
    pages: BTreeMap<PageId, PageQueues>,
    feed: Arc<FeedState>,
    encoder: ShapeEncoder,
    drawn: Option<Drawn>,
    state: Option<Utf8Bytes>,
}

impl Hub {
    pub(crate) fn new(feed: Arc<FeedState>) -> Self {
        Self {
            pages: BTreeMap::new(),
            feed,
            encoder: ShapeEncoder::default(),
            drawn: None,
            state: None,
        }
    }

    /// Runs until all senders of events are gone.
    pub(crate) async fn run(
        mut self,
        mut events: mpsc::Receiver<HubEvent>,
        mut news: mpsc::Receiver<HubEvent>,
        mut tissue: mpsc::Receiver<TissueUpdate>,
    ) {
        loop {
            tokio::select! {
                event = events.recv() => match event {
                    Some(event) => self.handle(event),
                    None => return,
                },
                Some(event) = news.recv() => self.handle(event),
                Some(update) = tissue.recv() => self.draw(update),
            }
        }
    }

    pub(crate) fn handle(&mut self, event: HubEvent) {
        match event {
            HubEvent::Opened(id, reliable, frames) => {
                let page = PageQueues {
                    reliable,
                    frames,
                    is_admitted: false,
                    has: None,
                    springs: None,
                    has_springs: BTreeSet::new(),
                };
                self.pages.insert(id, page);
            }
            HubEvent::Closed(id) => {
                self.pages.remove(&id);
                self.count();
            }
            HubEvent::Missed(id) => {
                if let Some(page) = self.pages.get_mut(&id) {
                    page.has = None;
                }
            }
            HubEvent::Springs(id, region) => self.show_springs(id, region),
            HubEvent::Admitted(id, welcome) => self.admit(id, welcome),
            HubEvent::Text(id, text) => {
                self.send(id, Reliable::Text(text.into()));
            }
            HubEvent::End(id, text, sentence) => {
                self.send(id, Reliable::Text(text.into()));
                self.send(id, Reliable::Close(sentence));
                self.pages.remove(&id);
                self.count();
            }
            HubEvent::Close(text, sentence) => {
                let pages: Vec<PageId> = self.pages.keys().copied().collect();
                for id in pages {
                    self.handle(HubEvent::End(id, text.clone(), sentence.clone()));
                }
            }
            HubEvent::State(text) => {
                let text = Utf8Bytes::from(text);
                self.state = Some(text.clone());
                self.send_all(&Reliable::Text(text));
            }
            HubEvent::Everyone(text) => self.send_all(&Reliable::Text(text.into())),
            HubEvent::Tools(bytes) => {
                let bytes = Bytes::from(bytes);
                for page in self.pages.values().filter(|p| p.is_admitted) {
                    // The next frame replaces one that finds no room.
                    let _ = page.frames.try_send(bytes.clone());
                }
            }
        }
    }

    fn admit(&mut self, id: PageId, welcome: String) {
        let Some(page) = self.pages.get_mut(&id) else {
            return;
        };
        page.is_admitted = true;
        // It forgets its springs and asks again.
        page.springs = None;
        page.has_springs.clear();
        let state = self.state.clone().map(Reliable::Text);
        let surface = self
            .drawn
            .as_ref()
            .map(|drawn| Reliable::Bytes(drawn.bytes.clone()));
        let first = Reliable::Welcome(welcome.into());
        for message in [Some(first), state, surface].into_iter().flatten() {
            self.send(id, message);
        }
        self.count();
    }

    pub(crate) fn draw(&mut self, update: TissueUpdate) {
        match update {
            TissueUpdate::Topology(topology) => {
                let surface = Surface::of(&topology);
                let bytes = Bytes::from(surface.bytes);
                let nodes: Arc<[u32]> = surface.nodes.into();
                self.drawn = Some(Drawn {
                    version: surface.version,
                    bytes: bytes.clone(),
                    nodes: Arc::clone(&nodes),
                    regions: topology.model().regions.len(),
                    springs: BTreeMap::new(),
                });
                for page in self.pages.values_mut() {
                    page.has = None;
                    page.has_springs.clear();
                }
                self.send_all(&Reliable::Bytes(bytes));
                self.feed.set_nodes(Some((surface.version, nodes)));
                self.draw_springs(&topology);
            }
            TissueUpdate::Springs(topology) => self.draw_springs(&topology),
            TissueUpdate::Shape(sample) => self.draw_shape(&sample),
        }
    }

    /// A page asks for the springs of a region. It gets those of each region once per topology, so that asking costs the
    /// host little.
    fn show_springs(&mut self, id: PageId, region: Option<u16>) {
        let Some(page) = self.pages.get_mut(&id).filter(|page| page.is_admitted) else {
            return;
        };
        page.springs = region;
        let (Some(region), Some(drawn)) = (region, &self.drawn) else {
            return;
        };
        if usize::from(region) >= drawn.regions || page.has_springs.contains(&region) {
            return;
        }
        match drawn.springs.get(&region) {
            Some(bytes) => {
                page.has_springs.insert(region);
                let message = Reliable::Bytes(bytes.clone());
                self.send(id, message);
            }
            None => self.feed.request_springs(),
        }
    }

    /// Sends the springs that pages show and do not have.
    fn draw_springs(&mut self, topology: &Topology) {
        let Some(drawn) = &mut self.drawn else {
            return;
        };
        if drawn.version != topology.version() {
            return;
        }
        let mut due = Vec::new();
        for (id, page) in &mut self.pages {
            let Some(region) = page.springs else {
                continue;
            };
            if usize::from(region) < drawn.regions && page.has_springs.insert(region) {
                let build = || Bytes::from(springs(topology, &drawn.nodes, region));
                let bytes = drawn.springs.entry(region).or_insert_with(build);
                due.push((*id, Reliable::Bytes(bytes.clone())));
            }
        }
        for (id, message) in due {
            self.send(id, message);
        }
    }

    fn draw_shape(&mut self, sample: &ShapeSample) {
        if self
            .drawn
            .as_ref()
            .is_none_or(|drawn| drawn.version != sample.version)
        {
            return;
        }
        let last = self.encoder.sequence();
        let is_behind = |page: &PageQueues| page.is_admitted && page.has != Some(last);
        let wants_full = self.pages.values().any(is_behind);
        let ShapeCode {
            sequence,
            change,
            full,
        } = self.encoder.encode(sample, wants_full);
        let (change, full) = (Bytes::from(change), Bytes::from(full));
        for page in self.pages.values_mut().filter(|p| p.is_admitted) {
            let is_next = page.has == Some(last);
            let bytes = if is_next { &change } else { &full };
            let is_sent = page.frames.try_send(bytes.clone()).is_ok();
            page.has = is_sent.then_some(sequence);
        }
    }

    /// Sends to one page. A page whose queue is full is dropped: its task then closes the connection.
    fn send(&mut self, id: PageId, message: Reliable) {
        let is_lost = self
            .pages
            .get(&id)
            .is_some_and(|page| page.reliable.try_send(message).is_err());
        if is_lost {
            self.pages.remove(&id);
            self.count();
        }
    }

    fn send_all(&mut self, message: &Reliable) {
        let before = self.pages.len();
        self.pages
            .retain(|_, page| !page.is_admitted || page.reliable.try_send(message.clone()).is_ok());
        if self.pages.len() != before {
            self.count();
        }
    }

    fn count(&self) {
        let drawing = self.pages.values().filter(|p| p.is_admitted).count();
        self.feed.set_watchers(drawing);
    }
}

#[cfg(test)]
mod tests {
    use palpate_tissue::{BladePoint, CutStroke, Material, Tissue, Vec3, block};

    use super::*;
    use crate::feed::Feed;
    use crate::page::{FRAMES_MAX, TEXTS_MAX};
    use palpate_protocol::{ServerTime, Span};

    struct Opened {
        id: PageId,
        reliable: mpsc::Receiver<Reliable>,
        frames: mpsc::Receiver<Bytes>,
    }

    fn open(hub: &mut Hub, id: u64) -> Opened {
        let (reliable_sender, reliable) = mpsc::channel(TEXTS_MAX);
        let (frame_sender, frames) = mpsc::channel(FRAMES_MAX);
        let id = PageId(id);
        hub.handle(HubEvent::Opened(id, reliable_sender, frame_sender));
        hub.handle(HubEvent::Admitted(id, "welcome".to_owned()));
        Opened {
            id,
            reliable,
            frames,
        }
    }

    /// A solver that shows a block.
    struct Solver {
        feed: Feed,
        updates: mpsc::Receiver<TissueUpdate>,
        tissue: Tissue,
        now: ServerTime,
    }

    impl Solver {
        fn new() -> (Self, Hub) {
            let (feed, state, updates) = Feed::new();
            let tissue = Tissue::new(block([4, 4, 3], 4e-3, &Material::default(), 1).into());
            let solver = Self {
                feed,
                updates,
                tissue,
                now: ServerTime::ZERO,
            };
            (solver, Hub::new(state))
        }

        /// Cuts across x, all through above the pinned base.
        fn cut(&mut self, x: f64) {
            let point = |y| BladePoint {
                tip: Vec3::new(x, y, 0.006),
                axis: Vec3::z(),
                depth_m: 0.02,
            };
            let stroke = CutStroke {
                points: vec![point(-0.002), point(0.018)],
                width_m: 0.0,
            };
            self.tissue.cut(&stroke).unwrap();
        }

        fn tick(&mut self, hub: &mut Hub, dz: f64) {
            self.tissue.displace(&[(0, Vec3::new(0.0, 0.0, dz))]);
            // Later than the next surface is due.
            self.now = self.now + Span::from_millis(300);
            let tissue = &self.tissue;
            let at = (self.now, false);
            self.feed.show(tissue.topology(), tissue.shape(), at, &[]);
            while let Ok(update) = self.updates.try_recv() {
                hub.draw(update);
            }
        }
    }

    #[test]
    fn page_that_missed_a_shape_gets_a_full_one_and_others_only_changes() {
        let (mut solver, mut hub) = Solver::new();
        let mut quick = open(&mut hub, 1);
        let mut slow = open(&mut hub, 2);
        let mut kinds = Vec::new();
        for _ in 0..12 {
            solver.tick(&mut hub, 1e-4);
            while let Ok(frame) = quick.frames.try_recv() {
                kinds.push(frame[1]);
            }
        }
        assert_eq!(kinds[0], 1, "the first shape is full");
        assert!(kinds[1..].iter().all(|full| *full == 0), "{kinds:?}");
        assert_eq!(slow.frames.len(), FRAMES_MAX, "a slow page loses frames");
        while slow.frames.try_recv().is_ok() {}
        solver.tick(&mut hub, 0.0);
        assert_eq!(
            slow.frames.try_recv().unwrap()[1],
            1,
            "and continues with a full shape"
        );
        assert_eq!(quick.frames.try_recv().unwrap()[1], 0);
        // The welcome, then the surface.
        assert!(matches!(quick.reliable.try_recv(), Ok(Reliable::Welcome(t)) if t == "welcome"));
        assert!(matches!(quick.reliable.try_recv(), Ok(Reliable::Bytes(b)) if b[0] == 1));
    }

    #[test]
    fn page_that_does_not_get_a_sent_shape_gets_a_full_one_next() {
        let (mut solver, mut hub) = Solver::new();
        let mut page = open(&mut hub, 1);
        for _ in 0..4 {
            solver.tick(&mut hub, 1e-4);
        }
        while page.frames.try_recv().is_ok() {}
        solver.tick(&mut hub, 1e-4);
        assert_eq!(page.frames.try_recv().unwrap()[1], 0);
        hub.handle(HubEvent::Missed(page.id));
        solver.tick(&mut hub, 1e-4);
        assert_eq!(page.frames.try_recv().unwrap()[1], 1);
    }

    #[test]
    fn page_gets_springs_of_a_region_once_per_topology_and_only_on_request() {
        let (mut solver, mut hub) = Solver::new();
        let mut curious = open(&mut hub, 1);
        let mut other = open(&mut hub, 2);
        solver.tick(&mut hub, 0.0);
        let kinds = |page: &mut Opened| -> Vec<u8> {
            let messages = std::iter::from_fn(|| page.reliable.try_recv().ok());
            let kind = |message| match message {
                Reliable::Bytes(bytes) => Some(bytes[0]),
                _ => None,
            };
            messages.filter_map(kind).collect()
        };
        assert_eq!(kinds(&mut curious), [1]);
        for region in [Some(0), Some(0), None, Some(7), Some(0)] {
            hub.handle(HubEvent::Springs(curious.id, region));
            solver.tick(&mut hub, 0.0);
        }
        assert_eq!(kinds(&mut curious), [4], "region 7 does not exist");
        solver.cut(0.0041);
        solver.tick(&mut hub, 0.0);
        assert_eq!(kinds(&mut curious), [1, 4], "again after a cut");
        hub.handle(HubEvent::Springs(curious.id, None));
        solver.cut(0.0121);
        solver.tick(&mut hub, 0.0);
        assert_eq!(kinds(&mut curious), [1]);
        assert_eq!(kinds(&mut other), [1, 1, 1]);
        // A page that is welcomed again has forgotten its springs.
        hub.handle(HubEvent::Springs(curious.id, Some(0)));
        solver.tick(&mut hub, 0.0);
        hub.handle(HubEvent::Admitted(curious.id, "again".to_owned()));
        hub.handle(HubEvent::Springs(curious.id, Some(0)));
        assert_eq!(kinds(&mut curious), [4, 1, 4]);
    }

    #[test]
    fn newcomer_gets_state_and_surface_and_a_page_with_a_full_queue_is_dropped() {
        let (mut solver, mut hub) = Solver::new();
        let idle = open(&mut hub, 1);
        solver.tick(&mut hub, 0.0);
        for k in 0..=TEXTS_MAX {
            hub.handle(HubEvent::State(k.to_string()));
        }
        assert!(!hub.pages.contains_key(&idle.id));
        let mut late = open(&mut hub, 2);
        let mut texts = Vec::new();
        while let Ok(message) = late.reliable.try_recv() {
            texts.push(match message {
                Reliable::Text(text) | Reliable::Welcome(text) => text.to_string(),
                Reliable::Bytes(bytes) => format!("kind {}", bytes[0]),
                Reliable::Close(sentence) => sentence,
            });
        }
        assert_eq!(texts, ["welcome", &TEXTS_MAX.to_string(), "kind 1"]);
    }
}
