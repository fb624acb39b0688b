//! The solver's end of the view: it hands over shapes and never waits.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError, TryLockError};
use std::time::{SystemTime, UNIX_EPOCH};

use palpate_protocol::tool::part_owner;
use palpate_protocol::{ServerTime, Span};
use palpate_tissue::{Reaction, Shape, Topology};
use tokio::sync::mpsc;

use crate::shape_code::{ShapeSample, ShownReaction};
use crate::step_limit::PointLimits;

/// Shapes that may wait for the hub; further ones are dropped, because the next one replaces them.
const WAITING_MAX: usize = 2;

/// Time between two surfaces while a blade cuts. Until the next one, pages draw the surface that they have.
const SURFACE_PERIOD: Span = Span::from_millis(250);

/// News of the tissue for the hub.
pub(crate) enum TissueUpdate {
    /// A new topology, or the present one for the first page.
    Topology(Arc<Topology>),
    /// The newest topology again, because a page asks for springs.
    Springs(Arc<Topology>),
    /// A shape of the newest topology.
    Shape(ShapeSample),
}

/// The nodes that pages draw, by version of the topology.
pub(crate) type DrawnNodes = Option<(u32, Arc<[u32]>)>;

/// Shared by the hub and the feed.
#[derive(Debug, Default)]
pub(crate) struct FeedState {
    /// Number of pages that draw.
    watchers: AtomicUsize,
    /// Whether the hub wants the topology for springs.
    wants_springs: AtomicBool,
    nodes: Mutex<DrawnNodes>,
}

impl FeedState {
    pub(crate) fn is_watched(&self) -> bool {
        self.watchers.load(Ordering::Relaxed) > 0
    }

    pub(crate) fn set_watchers(&self, count: usize) {
        self.watchers.store(count, Ordering::Relaxed);
    }

    /// Asks for the topology once more.
    pub(crate) fn request_springs(&self) {
        self.wants_springs.store(true, Ordering::Relaxed);
    }

    pub(crate) fn set_nodes(&self, nodes: DrawnNodes) {
        *self.nodes.lock().unwrap_or_else(PoisonError::into_inner) = nodes;
    }
}

/// Hands the tissue to the pages. Without a page it does nothing; otherwise [`show`](Self::show) copies the displacements
/// of the drawn nodes.
#[derive(Debug)]
pub struct Feed {
    state: Arc<FeedState>,
    updates: mpsc::Sender<TissueUpdate>,
    /// The topology that the hub received, and the displayed time.
    sent: Option<(Arc<Topology>, ServerTime)>,
    /// Displayed nodes of a version.
    limits: (u32, PointLimits),
}

impl Clone for Feed {
    /// Another end; it begins with its topology.
    fn clone(&self) -> Self {
        Self {
            state: Arc::clone(&self.state),
            updates: self.updates.clone(),
            sent: None,
            limits: Default::default(),
        }
    }
}

impl Feed {
    pub(crate) fn new() -> (Self, Arc<FeedState>, mpsc::Receiver<TissueUpdate>) {
        let (updates, receiver) = mpsc::channel(WAITING_MAX);
        let state = Arc::<FeedState>::default();
        let feed = Self {
            state: Arc::clone(&state),
            updates,
            sent: None,
            limits: Default::default(),
        };
        (feed, state, receiver)
    }

    /// Hands over the shape of the displayed time `s`, with the reactions on the tools. `returns` is whether a tool
    /// returns from a hold: pages then show it with bounded steps.
    pub fn show(
        &mut self,
        topology: &Arc<Topology>,
        shape: &Shape,
        (s, returns): (ServerTime, bool),
        reactions: &[Reaction],
    ) {
        if !self.state.is_watched() {
            self.limits = Default::default();
            return;
        }
        let Some(sent) = self.drawn(topology, s) else {
            let update = TissueUpdate::Topology(Arc::clone(topology));
            if self.updates.try_send(update).is_ok() {
                self.sent = Some((Arc::clone(topology), s));
            }
            return;
        };
        let version = sent.version();
        if self.state.wants_springs.swap(false, Ordering::Relaxed) {
            let update = TissueUpdate::Springs(Arc::clone(&sent));
            if self.updates.try_send(update).is_err() {
                self.state.request_springs();
            }
        }
        let Some(nodes) = self.drawn_nodes(version) else {
            return;
        };
        let displacement = |node: &u32| {
            // A cut moves rest positions.
            let d = shape.position(topology, *node) - sent.rest(*node);
            [d.x as f32, d.y as f32, d.z as f32]
        };
        let mut displacements: Vec<[f32; 3]> = nodes.iter().map(displacement).collect();
        if self.limits.0 != version {
            self.limits = (version, PointLimits::default());
        }
        self.limits.1.limit(&mut displacements, returns);
        let sample = ShapeSample {
            version,
            time_us: s.as_micros() as f64,
            made_ms: wall_ms(),
            displacements,
            reactions: reactions.iter().filter_map(shown).collect(),
        };
        // A hub that is behind draws the next shape.
        let _ = self.updates.try_send(TissueUpdate::Shape(sample));
    }

    /// The topology that pages draw; `None` if that of the shape is due.
    fn drawn(&self, topology: &Arc<Topology>, s: ServerTime) -> Option<Arc<Topology>> {
        let (sent, since) = self.sent.as_ref()?;
        let is_newest = sent.version() == topology.version();
        let can_wait = s - *since < SURFACE_PERIOD && sent.node_count() <= topology.node_count();
        (is_newest || can_wait).then(|| Arc::clone(sent))
    }

    /// The drawn nodes, if the hub has them for this version.
    fn drawn_nodes(&self, version: u32) -> Option<Arc<[u32]>> {
        let nodes = match self.state.nodes.try_lock() {
            Ok(nodes) => nodes,
            Err(TryLockError::Poisoned(nodes)) => nodes.into_inner(),
            Err(TryLockError::WouldBlock) => return None,
        };
        let (known, nodes) = nodes.as_ref()?;
        (*known == version).then(|| Arc::clone(nodes))
    }
}

/// A reaction for the pages; `None` for a tool that touches nothing.
fn shown(reaction: &Reaction) -> Option<ShownReaction> {
    (reaction.contacts > 0).then(|| ShownReaction {
        participant: part_owner(reaction.tool).0,
        force: reaction.force,
        at: reaction.at,
        contacts: reaction
            .contact_patches
            .iter()
            .map(|patch| [reaction.at + patch.lever, patch.force])
            .chain(reaction.shaft.iter().flat_map(|shaft| {
                let along = (shaft.tip, shaft.axis * shaft.axial_n);
                let [tip, entry] = shaft.stations;
                [along, tip, entry].map(|(lever, force)| [reaction.at + lever, force])
            }))
            .collect(),
    })
}

/// Milliseconds since 1970, for the latency to the screen on the same machine.
fn wall_ms() -> f64 {
    SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .map_or(0.0, |since| since.as_secs_f64() * 1e3)
}

#[cfg(test)]
mod tests {
    use palpate_tissue::{BladePoint, CutStroke, Material, Tissue, Vec3, block};

    use super::*;

    fn show(feed: &mut Feed, tissue: &Tissue, s: ServerTime, returns: bool) {
        feed.show(tissue.topology(), tissue.shape(), (s, returns), &[]);
    }

    #[test]
    fn feed_copies_drawn_nodes_and_never_waits() {
        let mut tissue = Tissue::new(block([2, 2, 2], 4e-3, &Material::default(), 1).into());
        tissue.displace(&[(5, Vec3::new(0.0, 0.0, -1e-3))]);
        let (mut feed, state, mut updates) = Feed::new();
        let show = |feed: &mut Feed| show(feed, &tissue, ServerTime::ZERO, false);
        show(&mut feed);
        assert!(updates.try_recv().is_err(), "no page watches");
        state.set_watchers(1);
        show(&mut feed);
        assert!(matches!(updates.try_recv(), Ok(TissueUpdate::Topology(_))));
        show(&mut feed);
        assert!(
            updates.try_recv().is_err(),
            "the drawn nodes are not known yet"
        );
        state.set_nodes(Some((0, vec![4, 5].into())));
        for _ in 0..5 {
            show(&mut feed);
        }
        let Ok(TissueUpdate::Shape(sample)) = updates.try_recv() else {
            panic!("no shape");
        };
        assert_eq!(sample.displacements, [[0.0; 3], [0.0, 0.0, -1e-3]]);
    }

    #[test]
    fn shape_after_a_stall_is_handed_over_with_bounded_steps() {
        let mut tissue = Tissue::new(block([2, 2, 2], 4e-3, &Material::default(), 1).into());
        let (mut feed, state, mut updates) = Feed::new();
        state.set_watchers(1);
        show(&mut feed, &tissue, ServerTime::ZERO, false);
        assert!(matches!(updates.try_recv(), Ok(TissueUpdate::Topology(_))));
        state.set_nodes(Some((0, vec![5].into())));
        let mut shown_mm = |tissue: &Tissue, returns| {
            show(&mut feed, tissue, ServerTime::ZERO, returns);
            let Ok(TissueUpdate::Shape(sample)) = updates.try_recv() else {
                panic!("no shape");
            };
            (1e4 * sample.displacements[0][2]).round() / 10.0
        };
        assert_eq!(shown_mm(&tissue, false), 0.0);
        tissue.displace(&[(5, Vec3::new(0.0, 0.0, -1.2e-3))]);
        let after = [true, false, false, false].map(|returns| shown_mm(&tissue, returns));
        assert_eq!(after, [-0.5, -1.0, -1.2, -1.2]);
    }

    #[test]
    fn surface_waits_while_a_blade_cuts() {
        let mut tissue = Tissue::new(block([6, 6, 4], 4e-3, &Material::default(), 1).into());
        let (mut feed, state, mut updates) = Feed::new();
        state.set_watchers(1);
        let at = |ms: i64| ServerTime::from_micros(1000 * ms);
        show(&mut feed, &tissue, at(0), false);
        assert!(matches!(updates.try_recv(), Ok(TissueUpdate::Topology(_))));
        state.set_nodes(Some((
            0,
            (0..tissue.topology().node_count() as u32).collect(),
        )));
        let point = |y: f64| BladePoint {
            tip: Vec3::new(0.0117, y, 0.006),
            axis: Vec3::z(),
            depth_m: 0.02,
        };
        let stroke = CutStroke {
            points: vec![point(0.0), point(0.016)],
            width_m: 0.0,
        };
        let before = tissue.topology().clone();
        tissue.cut(&stroke).unwrap();
        show(&mut feed, &tissue, at(30), false);
        let Ok(TissueUpdate::Shape(sample)) = updates.try_recv() else {
            panic!("no shape of the surface that pages have");
        };
        assert_eq!(sample.version, 0);
        // The drawn positions are those of the newest shape.
        for (node, d) in sample.displacements.iter().enumerate() {
            let drawn = before.rest(node as u32) + Vec3::from(d.map(f64::from));
            let apart = drawn - tissue.shape().position(tissue.topology(), node as u32);
            assert!(apart.norm() < 1e-6);
        }
        show(&mut feed, &tissue, at(250), false);
        assert!(matches!(updates.try_recv(), Ok(TissueUpdate::Topology(t)) if t.version() == 1));
        state.set_nodes(Some((
            1,
            (0..tissue.topology().node_count() as u32).collect(),
        )));
        // A surface with nodes that are gone is replaced at once.
        show(&mut feed, &Tissue::at_rest(before), at(260), false);
        assert!(matches!(updates.try_recv(), Ok(TissueUpdate::Topology(t)) if t.version() == 0));
    }
}
