//! The watched surface near the tools: the three lowest levels of the hierarchy, at current positions.

use parry3d_f64::bounding_volume::Aabb;
use parry3d_f64::math::Vector;

use super::ball::Ball;
use super::surface_index::ROUNDING;
use crate::equilibrium::{laid_out, trim};
use crate::{Topology, Vec3};

/// Triangles per box; they are consecutive in the tree, hence neighbours.
const GROUP: usize = 16;
/// Groups per box of the level above.
const CLUSTER: usize = 16;
const NONE: u32 = u32::MAX;

/// Triangles in groups, and boxes around them as they were at the last refit.
#[derive(Clone)]
pub(crate) struct Watched {
    /// Every triangle that at rest intersects one of these balls is watched.
    balls: Vec<Ball>,
    /// Groups of [`GROUP`], the last one may be smaller.
    triangles: Vec<u32>,
    /// Places in `nodes` of the corners of each triangle.
    corners: Vec<[u32; 3]>,
    nodes: Vec<u32>,
    /// Current positions of the nodes in m.
    at: Vec<Vector>,
    groups: Vec<Group>,
    /// Boxes around every [`CLUSTER`] groups.
    clusters: Vec<[Vector; 2]>,
    /// Places in `nodes` of the corners of each group, one group after the other.
    shared: Vec<u32>,
    /// Place in `nodes` of every node of the model, while the lists are made.
    place: Vec<u32>,
}

#[derive(Clone)]
struct Group {
    /// End of its corners in `shared`.
    end: u32,
    mins: Vector,
    maxs: Vector,
}

impl Watched {
    pub(crate) fn new(node_count: usize) -> Self {
        Self {
            balls: Vec::new(),
            triangles: Vec::new(),
            corners: Vec::new(),
            nodes: Vec::new(),
            at: Vec::new(),
            groups: Vec::new(),
            clusters: Vec::new(),
            shared: Vec::new(),
            place: laid_out(NONE, node_count),
        }
    }

    /// Watches nothing on a surface with this many nodes.
    pub(crate) fn follow(&mut self, node_count: usize) {
        self.balls.clear();
        if node_count < self.place.len() {
            let mut place = std::mem::take(&mut self.place);
            trim(&mut place, node_count);
            *self = Self {
                place,
                ..Self::new(0)
            };
        }
        self.place.resize(node_count, NONE);
    }

    /// Whether every triangle that at rest intersects the ball is watched.
    pub(crate) fn covers(&self, ball: &Ball) -> bool {
        self.balls.iter().any(|b| b.holds(ball))
    }

    /// Watches these triangles: all that at rest intersect one of the balls.
    pub(crate) fn set(&mut self, topology: &Topology, triangles: Vec<u32>, balls: Vec<Ball>) {
        self.corners.clear();
        self.nodes.clear();
        self.groups.clear();
        self.shared.clear();
        // Group that last listed each corner.
        let mut listed: Vec<usize> = Vec::new();
        for (g, group) in triangles.chunks(GROUP).enumerate() {
            for &t in group {
                let corners = topology.triangle(t).map(|n| self.enlist(n));
                listed.resize(self.nodes.len(), usize::MAX);
                for corner in corners {
                    if std::mem::replace(&mut listed[corner as usize], g) != g {
                        self.shared.push(corner);
                    }
                }
                self.corners.push(corners);
            }
            self.groups.push(Group {
                end: self.shared.len() as u32,
                mins: Vector::ZERO,
                maxs: Vector::ZERO,
            });
        }
        for &node in &self.nodes {
            self.place[node as usize] = NONE;
        }
        self.triangles = triangles;
        self.balls = balls;
    }

    fn enlist(&mut self, node: u32) -> u32 {
        let place = &mut self.place[node as usize];
        if *place == NONE {
            *place = self.nodes.len() as u32;
            self.nodes.push(node);
        }
        *place
    }

    /// Fits the boxes to the surface displaced by `u`.
    pub(crate) fn refit(&mut self, topology: &Topology, u: &[Vec3]) {
        self.at.clear();
        self.at.extend(self.nodes.iter().map(|&n| {
            let at = topology.rest(n) + u[n as usize];
            Vector::new(at.x, at.y, at.z)
        }));
        let mut start = 0;
        for group in &mut self.groups {
            let corners = &self.shared[start as usize..group.end as usize];
            start = group.end;
            (group.mins, group.maxs) = (Vector::MAX, Vector::MIN);
            for &corner in corners {
                let at = self.at[corner as usize];
                group.mins = group.mins.min(at);
                group.maxs = group.maxs.max(at);
            }
        }
        self.clusters.clear();
        self.clusters
            .extend(self.groups.chunks(CLUSTER).map(|groups| {
                let around = |[mins, maxs]: [Vector; 2], group: &Group| {
                    [mins.min(group.mins), maxs.max(group.maxs)]
                };
                groups.iter().fold([Vector::MAX, Vector::MIN], around)
            }));
    }

    fn box_of(&self, i: usize) -> Aabb {
        let [a, b, c] = self.corners[i].map(|k| self.at[k as usize]);
        Aabb::new(a.min(b).min(c), a.max(b).max(c))
    }

    /// Whether any watched triangle whose box intersects the ball passes a test.
    pub(crate) fn any_near(&self, ball: &Ball, mut test: impl FnMut(u32) -> bool) -> bool {
        for (cluster, &[mins, maxs]) in self.clusters.iter().enumerate() {
            if !ball.reaches(mins, maxs) {
                continue;
            }
            for (group, triangles) in self.groups_of(cluster) {
                if ball.reaches(group.mins, group.maxs) {
                    for i in triangles {
                        if ball.reaches_box(&self.box_of(i)) && test(self.triangles[i]) {
                            return true;
                        }
                    }
                }
            }
        }
        false
    }

    /// The watched triangle with the smallest `square` within the ball, and that square; of equal ones the
    /// lowest.
    pub(crate) fn nearest(&self, ball: &Ball, square: impl Fn(u32) -> f64) -> Option<(u32, f64)> {
        let mut best = (NONE, ball.radius * ball.radius);
        // Rounding of the boxes must not hide one of two triangles that share the nearest point.
        let too_far = |mins, maxs, best| ball.away(mins, maxs) * (1.0 - ROUNDING) > best;
        for (cluster, &[mins, maxs]) in self.clusters.iter().enumerate() {
            if too_far(mins, maxs, best.1) {
                continue;
            }
            for (group, triangles) in self.groups_of(cluster) {
                if too_far(group.mins, group.maxs, best.1) {
                    continue;
                }
                for i in triangles {
                    let b = self.box_of(i);
                    if !too_far(b.mins, b.maxs, best.1) {
                        let (t, square) = (self.triangles[i], square(self.triangles[i]));
                        if square < best.1 || (square == best.1 && t < best.0 && best.0 != NONE) {
                            best = (t, square);
                        }
                    }
                }
            }
        }
        (best.0 != NONE).then_some(best)
    }

    /// The groups of a cluster, each with the positions of its triangles.
    fn groups_of(&self, cluster: usize) -> impl Iterator<Item = (&Group, std::ops::Range<usize>)> {
        let first = cluster * CLUSTER;
        let last = (first + CLUSTER).min(self.groups.len());
        let count = self.triangles.len();
        (first..last).map(move |g| {
            let range = g * GROUP..(g * GROUP + GROUP).min(count);
            (&self.groups[g], range)
        })
    }

    #[cfg(test)]
    pub(super) fn nodes(&self) -> &[u32] {
        &self.nodes
    }

    #[cfg(test)]
    pub(super) fn heap_bytes(&self) -> usize {
        self.triangles.capacity() * size_of::<u32>()
            + self.corners.capacity() * size_of::<[u32; 3]>()
            + (self.nodes.capacity() + self.shared.capacity()) * size_of::<u32>()
            + self.at.capacity() * size_of::<Vector>()
            + self.groups.capacity() * size_of::<Group>()
            + self.clusters.capacity() * size_of::<[Vector; 2]>()
            + self.place.capacity() * size_of::<u32>()
    }
}
