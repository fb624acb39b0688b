//! Where to look for surface triangles: a bounding volume hierarchy of the surface, refitted to the
//! deformation in reach of the tools only (fig 6.2).
//!
//! The upper levels are parry's tree over the boxes of all triangles at rest. It costs nothing while
//! tissue is pressed, and follows cuts in place. A search that has only this tree widens its reach by
//! the longest displacement there is: a press of 15 mm would make a sphere of 8 mm look at nine times
//! the surface it touches, once per search.
//!
//! So the lowest levels are made anew where tools are ([`Watched`]): the triangles that at rest lie within
//! reach and displacement of a tool, in groups of neighbours, with boxes around where they *are*. These are
//! refitted before every round of searches. What is deformed far from all tools costs nothing,
//! and a tool that comes to a place deformed long ago finds it, because what comes into reach is refitted
//! before it is searched.
//!
//! Refitting parry's tree itself was measured: under a tool every node moves in every step, and at 90 ns per
//! triangle whose way to the root is widened that took 60 µs per step (2 mm apart, 15 mm deep), more than
//! looking at everything did (27 µs).
//!
//! What is found does not depend on the shape of the tree, hence not on its history: it is what a test
//! of every triangle's own box would find, in the order of their numbers.
//!
//! Memory: about 150 bytes per triangle and 8 per node; vectors that grow after cuts may double that.

use parry3d_f64::bounding_volume::Aabb;
use parry3d_f64::math::Vector;
use parry3d_f64::partitioning::{Bvh, BvhBuildStrategy, BvhNode, TraversalAction};

use super::ball::Ball;
use super::fans::Fans;
use super::watched::Watched;
use crate::{Topology, Vec3};

/// Part of what is within reach by which what is watched goes beyond it. More of it is refitted for
/// nothing in every step, less is collected more often.
const PAD: f64 = 0.25;
/// Part of a distance that covers rounding.
pub(super) const ROUNDING: f64 = 1e-9;
const NONE: u32 = u32::MAX;

#[derive(Clone)]
pub(crate) struct SurfaceIndex {
    /// Of rest positions; leaf `t` is triangle `t`.
    tree: Bvh,
    fans: Fans,
    watched: Watched,
    spacing: f64,
    /// No node of the surface is displaced by more than this in m, since the last watch.
    displaced: f64,
}

impl SurfaceIndex {
    pub(crate) fn new(topology: &Topology) -> Self {
        let triangles = &topology.boundary().triangles;
        let boxes = triangles.iter().map(|t| rest_box(topology, t)).enumerate();
        Self {
            tree: Bvh::from_iter(BvhBuildStrategy::Binned, boxes),
            fans: Fans::new(topology),
            watched: Watched::new(topology.node_count()),
            spacing: topology.model().spacing_m,
            displaced: 0.0,
        }
    }

    /// Takes in what cuts did to the surface: boxes of triangles that changed are refitted, new ones
    /// inserted. Starts over if the surface was rebuilt shorter.
    pub(crate) fn follow(&mut self, topology: &Topology) {
        let triangles = &topology.boundary().triangles;
        if triangles.len() < self.tree.leaf_count() as usize {
            *self = Self::new(topology);
            return;
        }
        let mut changed = Vec::new();
        for (t, nodes) in triangles.iter().enumerate() {
            let (t, new) = (t as u32, rest_box(topology, nodes));
            let known = self.tree.leaf_node(t).map(BvhNode::aabb);
            if known != Some(new) {
                self.tree.insert(new, t);
                changed.push(t);
            }
        }
        // Insertion only widens boxes on the way to the root; this makes them tight again.
        self.tree.refit_partial(&[], &changed);
        self.fans = Fans::new(topology);
        self.watched = Watched::new(topology.node_count());
    }

    /// Refits what is in reach. Call it before searches in the surface displaced by `u`, of which none is
    /// longer than `displaced`, and give it the balls in which they will be; elsewhere they take longer.
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

    /// Where the triangles are at rest that may now have a part in the ball.
    fn at_rest(&self, ball: &Ball) -> Ball {
        ball.wider((1.0 + ROUNDING) * self.displaced)
    }

    /// The triangles whose boxes have a part in the ball, in the order of their numbers. `corners` gives
    /// those of a triangle.
    pub(crate) fn near(&self, ball: &Ball, corners: impl Fn(u32) -> [Vec3; 3]) -> Vec<u32> {
        let mut found = Vec::new();
        self.any_near(ball, corners, |t| {
            found.push(t);
            false
        });
        found.sort_unstable();
        found
    }

    /// Whether a triangle whose box has a part in the ball passes a test. They are tested in any order.
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

    /// The triangle with the smallest `square` of a distance to the centre of the ball, and that square;
    /// of equal ones the lowest. Only such within the ball count.
    pub(crate) fn nearest(&self, ball: &Ball, square: impl Fn(u32) -> f64) -> Option<(u32, f64)> {
        if self.watched.covers(&self.at_rest(ball)) {
            return self.watched.nearest(ball, square);
        }
        self.nearest_within(ball, self.displaced, square)
    }

    /// The same where no triangle is farther than `displaced` m from where it is at rest.
    pub(crate) fn nearest_within(
        &self,
        ball: &Ball,
        displaced: f64,
        square: impl Fn(u32) -> f64,
    ) -> Option<(u32, f64)> {
        let reach = ball.radius * ball.radius;
        // A few nanometres off the surface, digits of the distance are lost in those of the place.
        let slack = (1.0 + ROUNDING) * displaced + ROUNDING * self.spacing;
        let least = |node: &BvhNode| {
            let away = ball.away(node.mins(), node.maxs()).sqrt() - slack;
            away.max(0.0) * away.max(0.0) * (1.0 - ROUNDING)
        };
        let (_, best) =
            self.tree
                .find_best(reach, |node, _| least(node), |t, _| Some(square(t)))?;
        // Which of equal ones comes first depends on the tree.
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
        self.fans.of(node)
    }

    #[cfg(test)]
    pub(super) fn watched(&self) -> &Watched {
        &self.watched
    }

    /// Bytes on the heap.
    #[cfg(test)]
    pub(super) fn heap_bytes(&self) -> usize {
        self.tree.heap_memory_size() + self.fans.heap_bytes() + self.watched.heap_bytes()
    }
}

fn rest_box(topology: &Topology, nodes: &[u32; 3]) -> Aabb {
    box_of(nodes.map(|n| topology.rest(n)))
}

pub(super) fn box_of(corners: [Vec3; 3]) -> Aabb {
    let [a, b, c] = corners.map(|v| Vector::new(v.x, v.y, v.z));
    Aabb::new(a.min(b).min(c), a.max(b).max(c))
}
