//! Spatial index of the surface: a bounding volume hierarchy, refitted to the deformation near the tools only (fig
//! 6.2).
//!
//! The upper levels are parry's tree over the boxes of all triangles at rest. Deformation does not change it, and cuts
//! update it in place. A search in this tree alone would have to widen its reach by the longest displacement: a press
//! of 15 mm would make a sphere of 8 mm visit nine times the surface it touches.
//!
//! So the lowest levels are rebuilt around the tools ([`Watched`]): groups of neighbouring triangles that at rest lie
//! within reach plus displacement of a tool, with boxes around their current positions. They are refitted before every
//! round of searches. Deformation far from all tools costs nothing, and a tool that reaches it later finds it, because
//! a region is refitted before it is searched.
//!
//! Refitting parry's own tree took 60 µs per step under a tool (2 mm apart, 15 mm deep), at 90 ns per triangle; a
//! linear scan took 27 µs.
//!
//! Results do not depend on the shape or history of the tree: they equal a test of every triangle's own box, in the
//! order of their numbers.
//!
//! Memory: about 150 bytes per triangle and 12 per node; growth after cuts may double that.

use parry3d_f64::bounding_volume::Aabb;
use parry3d_f64::math::Vector;
use parry3d_f64::partitioning::{Bvh, BvhBuildStrategy, BvhNode, TraversalAction};

use super::ball::Ball;
use super::watched::Watched;
use crate::equilibrium::{SLACK, overlaid};
use crate::{Rows, Topology, Vec3};

/// Margin of the watched region relative to the reach. A larger margin refits more triangles per step, a smaller one
/// rebuilds more often.
const PAD: f64 = 0.25;
/// Relative margin for rounding.
pub(super) const ROUNDING: f64 = 1e-9;
const NONE: u32 = u32::MAX;

/// Triangles of the surface around each node, in the order of their numbers.
fn node_triangles(topology: &Topology) -> Rows<u32> {
    let triangles = topology.exposed.triangles.iter().flatten().zip(0..);
    let pairs = triangles.flat_map(|(nodes, t)| nodes.map(|node| (node, t)));
    let mut rows = Rows::new(topology.node_count(), pairs);
    rows.reserve();
    rows
}

/// The surface around a cut, computed once for all indices of the topology.
#[derive(Clone, Default)]
pub(crate) struct SurfaceChange {
    /// Triangles around nodes, in the order of their numbers.
    around: Vec<(u32, Vec<u32>)>,
    /// Boxes of triangles at rest, sorted.
    boxes: Vec<(u32, Aabb)>,
}

impl SurfaceChange {
    /// The change of a cut or an undo that made `topology` and touched these nodes.
    pub(crate) fn of(topology: &Topology, touched: &[u32]) -> Self {
        let mut change = Self::default();
        let mut near = Vec::new();
        for &node in touched {
            if topology.is_within(node) {
                change.around.push((node, Vec::new()));
                continue;
            }
            let faces = topology.exposed_faces(node);
            let own = faces.flat_map(|position| [2 * position as u32, 2 * position as u32 + 1]);
            let mut own: Vec<u32> = own.collect();
            near.extend_from_slice(&own);
            own.retain(|&t| topology.triangle(t).contains(&node));
            own.sort_unstable();
            own.dedup();
            change.around.push((node, own));
        }
        near.sort_unstable();
        near.dedup();
        let with_box = |t: u32| (t, rest_box(topology, &topology.triangle(t)));
        change.boxes = near.into_iter().map(with_box).collect();
        change
    }

    /// This change and a later one.
    pub(crate) fn then(self, later: Self) -> Self {
        Self {
            around: overlaid(self.around, later.around),
            boxes: overlaid(self.boxes, later.boxes),
        }
    }
}

/// The tree over the boxes of all triangles at rest.
pub(crate) struct SurfaceTree(Bvh);

impl SurfaceTree {
    pub(crate) fn of(topology: &Topology) -> Self {
        let triangles = topology.exposed.triangles.iter().flatten();
        let boxes = triangles.map(|t| rest_box(topology, t)).enumerate();
        Self(Bvh::from_iter(BvhBuildStrategy::Binned, boxes))
    }
}

/// Number of triangles for which trees keep memory. Trees that follow undos give none back, so the thread of cuts builds new ones.
#[derive(Clone)]
pub(crate) struct TreeRoom(usize);

impl TreeRoom {
    pub(crate) fn of(topology: &Topology) -> Self {
        Self(topology.exposed.faces.len())
    }

    /// Follows a change of the surface; whether trees need to be built again.
    pub(crate) fn follow(&mut self, topology: &Topology) -> bool {
        let now = Self::of(topology).0;
        let is_exceeded = now < self.0 - self.0 / SLACK;
        self.0 = if is_exceeded { now } else { now.max(self.0) };
        is_exceeded
    }
}

#[derive(Clone)]
pub(crate) struct SurfaceIndex {
    /// Tree of rest positions; leaf `t` is triangle `t`.
    tree: Bvh,
    /// Number of triangles.
    count: u32,
    node_triangles: Rows<u32>,
    watched: Watched,
    spacing: f64,
    /// Upper bound of surface displacements in m, since the last watch.
    displaced: f64,
}

impl SurfaceIndex {
    pub(crate) fn new(topology: &Topology) -> Self {
        Self {
            tree: SurfaceTree::of(topology).0,
            count: 2 * topology.exposed.faces.len() as u32,
            node_triangles: node_triangles(topology),
            watched: Watched::new(topology.node_count()),
            spacing: topology.model().spacing_m,
            displaced: 0.0,
        }
    }

    /// Follows a cut or an undo. A tree of the new surface is exchanged for the present one.
    pub(crate) fn follow(
        &mut self,
        topology: &Topology,
        change: &SurfaceChange,
        tree: Option<&mut SurfaceTree>,
    ) {
        match tree {
            Some(tree) => std::mem::swap(&mut self.tree, &mut tree.0),
            None => self.update_tree(topology, change),
        }
        self.count = 2 * topology.exposed.faces.len() as u32;
        self.node_triangles.truncate(topology.node_count());
        for (node, row) in &change.around {
            self.node_triangles.set(*node, row);
        }
        self.watched.follow(topology.node_count());
    }

    /// Refits the boxes of changed triangles, removes those that are gone and inserts new ones.
    fn update_tree(&mut self, topology: &Topology, change: &SurfaceChange) {
        for t in 2 * topology.exposed.faces.len() as u32..self.count {
            self.tree.remove(t);
        }
        let mut changed = Vec::with_capacity(change.boxes.len());
        for &(t, new) in &change.boxes {
            if self.tree.leaf_node(t).map(BvhNode::aabb) != Some(new) {
                self.tree.insert(new, t);
                changed.push(t);
            }
        }
        // Insertion only widens boxes on the way to the root; this makes them tight again.
        self.tree.refit_partial(&[], &changed);
    }

    /// Refits the regions of the following searches, in the surface displaced by `u`, with displacements of at most
    /// `displaced`. Searches outside these balls are slower.
    pub(crate) fn watch(
        &mut self,
        topology: &Topology,
        u: &[Vec3],
        displaced: f64,
        balls: &[Ball],
    ) {
        self.displaced = displaced;
        let known = |b: &Ball| self.watched.covers(&self.at_rest(b));
        if !balls.iter().all(known) {
            let pad = |b: &Ball| {
                let ball = self.at_rest(b);
                ball.wider(PAD * ball.radius + self.spacing)
            };
            let balls: Vec<Ball> = balls.iter().map(pad).collect();
            let mut found = Vec::new();
            self.tree.traverse(|node| {
                if !balls.iter().any(|b| b.reaches(node.mins(), node.maxs())) {
                    return TraversalAction::Prune;
                }
                found.extend(node.leaf_data());
                TraversalAction::Continue
            });
            self.watched.set(topology, found, balls);
        }
        self.watched.refit(topology, u);
    }

    /// The ball in which triangles at rest may now intersect `ball`.
    fn at_rest(&self, ball: &Ball) -> Ball {
        ball.wider((1.0 + ROUNDING) * self.displaced)
    }

    /// The triangles whose boxes intersect the ball, in the order of their numbers. `corners` returns the corners of a
    /// triangle.
    pub(crate) fn near(&self, ball: &Ball, corners: impl Fn(u32) -> [Vec3; 3]) -> Vec<u32> {
        let mut found = Vec::new();
        self.any_near(ball, corners, |t| {
            found.push(t);
            false
        });
        found.sort_unstable();
        found
    }

    /// Whether any triangle whose box intersects the ball passes a test, in any order.
    pub(crate) fn any_near(
        &self,
        ball: &Ball,
        corners: impl Fn(u32) -> [Vec3; 3],
        mut test: impl FnMut(u32) -> bool,
    ) -> bool {
        let whole = self.at_rest(ball);
        if self.watched.covers(&whole) {
            return self.watched.any_near(ball, test);
        }
        let mut any = false;
        self.tree.traverse(|node| {
            if !whole.reaches(node.mins(), node.maxs()) {
                return TraversalAction::Prune;
            }
            let inside = |&t: &u32| ball.reaches_box(&box_of(corners(t)));
            any = node.leaf_data().filter(inside).is_some_and(&mut test);
            if any {
                TraversalAction::EarlyExit
            } else {
                TraversalAction::Continue
            }
        });
        any
    }

    /// The triangle within the ball with the smallest `square` of a distance to its centre, and that square; the lowest
    /// number at ties.
    pub(crate) fn nearest(&self, ball: &Ball, square: impl Fn(u32) -> f64) -> Option<(u32, f64)> {
        if self.watched.covers(&self.at_rest(ball)) {
            return self.watched.nearest(ball, square);
        }
        self.nearest_within(ball, self.displaced, square)
    }

    /// The same where every triangle is within `displaced` m of its rest position.
    pub(crate) fn nearest_within(
        &self,
        ball: &Ball,
        displaced: f64,
        square: impl Fn(u32) -> f64,
    ) -> Option<(u32, f64)> {
        let reach = ball.radius * ball.radius;
        // A few nanometres off the surface, the position has fewer digits than the distance needs.
        let slack = (1.0 + ROUNDING) * displaced + ROUNDING * self.spacing;
        let least = |node: &BvhNode| {
            let away = ball.away(node.mins(), node.maxs()).sqrt() - slack;
            away.max(0.0) * away.max(0.0) * (1.0 - ROUNDING)
        };
        let (_, best) =
            self.tree
                .find_best(reach, |node, _| least(node), |t, _| Some(square(t)))?;
        // The order of ties depends on the tree.
        let mut lowest = NONE;
        self.tree.traverse(|node| {
            if least(node) > best {
                return TraversalAction::Prune;
            }
            let same = |&t: &u32| t < lowest && square(t) == best;
            lowest = node.leaf_data().filter(same).unwrap_or(lowest);
            TraversalAction::Continue
        });
        Some((lowest, best))
    }

    /// Triangles around a node, in the order of their numbers.
    pub(crate) fn around(&self, node: u32) -> &[u32] {
        self.node_triangles.row(node)
    }

    #[cfg(test)]
    pub(super) fn watched(&self) -> &Watched {
        &self.watched
    }

    #[cfg(test)]
    pub(super) fn heap_bytes(&self) -> usize {
        self.tree.heap_memory_size() + self.node_triangles.heap_bytes() + self.watched.heap_bytes()
    }
}

fn rest_box(topology: &Topology, nodes: &[u32; 3]) -> Aabb {
    box_of(nodes.map(|n| topology.rest(n)))
}

pub(super) fn box_of(corners: [Vec3; 3]) -> Aabb {
    let [a, b, c] = corners.map(|v| Vector::new(v.x, v.y, v.z));
    Aabb::new(a.min(b).min(c), a.max(b).max(c))
}
