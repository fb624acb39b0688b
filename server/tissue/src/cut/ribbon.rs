//! The swept surface of a blade as triangles: crossed segments and nearest points.
//!
//! Whether a segment p q crosses a triangle a b c is decided by the signs of exact determinants:
//! p and q on different sides of the triangle's plane, and the line through them on the same side
//! of its three edges. A zero counts as positive, with the ends of an edge in one order for both
//! triangles that share it, so that a segment through a shared edge crosses exactly one of them.

use std::ops::Range;

use robust::{Coord3D, orient3d};

use super::stroke::BladePoint;
use crate::Vec3;
use crate::nearest::{Feature, nearest_feature};

/// How far the surface that nodes are snapped onto reaches beyond the blade's own, in spacings, so
/// that a node off the end of the cut is drawn into its plane and not to its rim.
const BEYOND: f64 = 3.0;
/// Farthest point with a foot on the surface, in spacings.
const REACH: f64 = 4.5;
/// Relative margin for rounding.
pub(super) const ROUNDING: f64 = 1e-9;

/// A triangle of the ribbon.
#[derive(Debug, Clone)]
pub(crate) struct Triangle {
    pub(crate) points: [Vec3; 3],
    /// Number of each point, the same in all triangles that share it.
    ids: [u32; 3],
    pub(crate) normal: Vec3,
    /// Which step of the stroke it belongs to.
    pub(crate) step: usize,
    bounds: Bounds,
}

/// A node of a tree of boxes in the order of the path; its left child is the next node.
#[derive(Debug)]
struct Node {
    bounds: Bounds,
    /// Triangles of a leaf: those beside each other on a short part of the path. Empty otherwise.
    triangles: Range<usize>,
    /// The node after its subtree.
    after: usize,
}

/// A box around points.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Bounds {
    pub(crate) low: Vec3,
    pub(crate) high: Vec3,
}

impl Bounds {
    /// A box around nothing.
    pub(crate) const EMPTY: Self = Self {
        low: Vec3::new(f64::INFINITY, f64::INFINITY, f64::INFINITY),
        high: Vec3::new(f64::NEG_INFINITY, f64::NEG_INFINITY, f64::NEG_INFINITY),
    };

    fn of([a, b, c]: &[Vec3; 3]) -> Self {
        Self {
            low: a.inf(b).inf(c),
            high: a.sup(b).sup(c),
        }
    }

    /// The box around points.
    pub(crate) fn around(points: impl Iterator<Item = Vec3>) -> Self {
        points.fold(Self::EMPTY, |all, p| Self {
            low: all.low.inf(&p),
            high: all.high.sup(&p),
        })
    }

    pub(crate) fn with(&self, other: &Self) -> Self {
        Self {
            low: self.low.inf(&other.low),
            high: self.high.sup(&other.high),
        }
    }

    pub(crate) fn grown(&self, by: f64) -> Self {
        Self {
            low: self.low.add_scalar(-by),
            high: self.high.add_scalar(by),
        }
    }

    pub(crate) fn overlaps(&self, other: &Self) -> bool {
        (0..3).all(|a| self.low[a] <= other.high[a] && other.low[a] <= self.high[a])
    }

    /// Squared distance of a point from the box.
    fn distance_squared(&self, p: &Vec3) -> f64 {
        let out = (self.low - p).sup(&(p - self.high));
        out.sup(&Vec3::zeros()).norm_squared()
    }

    /// Whether the box of a segment is beside it.
    fn is_apart(&self, p: &Vec3, q: &Vec3) -> bool {
        (0..3).any(|a| p[a].max(q[a]) < self.low[a] || p[a].min(q[a]) > self.high[a])
    }
}

impl Triangle {
    /// The two triangles between two places of a blade, without degenerate ones.
    pub(crate) fn swept([from, to]: [&BladePoint; 2], spacing: f64) -> impl Iterator<Item = Self> {
        let columns = [from, to].map(BladePoint::ends);
        Self::between(columns, 0, 0, spacing)
    }

    /// The two triangles between two columns, without degenerate ones. `id` is the number of the first point.
    fn between(
        [[a, b], [c, d]]: [[Vec3; 2]; 2],
        id: u32,
        step: usize,
        spacing: f64,
    ) -> impl Iterator<Item = Self> {
        let triangles = [
            ([a, c, d], [id, id + 2, id + 3]),
            ([a, d, b], [id, id + 3, id + 1]),
        ];
        triangles.into_iter().filter_map(move |(points, ids)| {
            let normal = (points[1] - points[0]).cross(&(points[2] - points[0]));
            let size = normal.norm();
            (size > 1e-9 * spacing * spacing).then(|| Self {
                bounds: Bounds::of(&points),
                points,
                ids,
                normal: normal / size,
                step,
            })
        })
    }

    /// Whether a segment crosses it; see the file's head.
    fn crosses(&self, p: &Vec3, q: &Vec3) -> bool {
        if self.bounds.is_apart(p, q) {
            return false;
        }
        // Early exit; points within rounding of the plane are left to the exact determinants.
        let (hp, hq) = (self.height(p), self.height(q));
        if hp * hq > 0.0 && hp.abs().min(hq.abs()) > 1e-6 * (q - p).amax() {
            return false;
        }
        let [a, b, c] = self.points.map(coordinates);
        let [p, q] = [*p, *q].map(coordinates);
        if (orient3d(a, b, c, p) >= 0.0) == (orient3d(a, b, c, q) >= 0.0) {
            return false;
        }
        let side = |i: usize, j: usize| {
            let [u, v] = [i, j].map(|k| coordinates(self.points[k]));
            if self.ids[i] < self.ids[j] {
                orient3d(p, q, u, v) >= 0.0
            } else {
                orient3d(p, q, v, u) < 0.0
            }
        };
        let first = side(0, 1);
        first == side(1, 2) && first == side(2, 0)
    }

    /// Distance of a point from its plane.
    pub(crate) fn height(&self, p: &Vec3) -> f64 {
        (p - self.points[0]).dot(&self.normal)
    }

    /// Whether all of another triangle is within a distance of one column of this one.
    fn is_beside(&self, other: &Self, distance: f64) -> bool {
        // Even numbers are those of tips, odd ones those of tops.
        let column = |id: u32| {
            let last = (0..3).rfind(|&i| self.ids[i] % 2 == id % 2);
            last.map(|i| self.points[i])
        };
        (0..3).all(|i| {
            let end = column(other.ids[i]);
            end.is_some_and(|end| (other.points[i] - end).norm() <= distance)
        })
    }

    /// Distance of a point's foot in its plane from the triangle itself.
    pub(crate) fn beside(&self, p: &Vec3) -> f64 {
        (p - self.nearest(p) - self.normal * self.height(p)).norm()
    }

    /// The nearest point of it, by the region of the plane that the point's foot falls into.
    fn nearest(&self, p: &Vec3) -> Vec3 {
        let corners = &self.points;
        match nearest_feature(p, corners) {
            Feature::Corner(i) => corners[i],
            Feature::Edge(i, j, part) => corners[i] + (corners[j] - corners[i]) * part,
            Feature::Face(_) => p - self.normal * self.height(p),
        }
    }
}

fn coordinates(p: Vec3) -> Coord3D<f64> {
    Coord3D {
        x: p.x,
        y: p.y,
        z: p.z,
    }
}

/// A foot on the ribbon.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Foot {
    pub(crate) point: Vec3,
    pub(crate) normal: Vec3,
    pub(crate) step: usize,
}

/// The swept surface.
#[derive(Debug)]
pub(crate) struct Ribbon {
    triangles: Vec<Triangle>,
    tree: Vec<Node>,
    spacing: f64,
}

impl Ribbon {
    pub(crate) fn swept(points: &[BladePoint], spacing: f64) -> Self {
        let columns: Vec<[Vec3; 2]> = points.iter().map(BladePoint::ends).collect();
        Self::between(&columns, spacing, 0)
    }

    /// The same surface, continued beyond all its rims.
    pub(crate) fn continued(points: &[BladePoint], spacing: f64) -> Self {
        let beyond = BEYOND * spacing;
        let mut columns: Vec<[Vec3; 2]> = points
            .iter()
            .map(|p| [p.tip - p.axis * beyond, p.top() + p.axis * beyond])
            .collect();
        let last = points.len() - 1;
        let out = |end: usize, before: usize| (points[end].tip - points[before].tip).normalize();
        let (back, ahead) = (out(0, 1) * beyond, out(last, last - 1) * beyond);
        columns.insert(0, columns[0].map(|p| p + back));
        columns.push(columns[last + 1].map(|p| p + ahead));
        Self::between(&columns, spacing, 1)
    }

    /// Two triangles between each pair of columns; `ahead` columns stand before the first step.
    fn between(columns: &[[Vec3; 2]], spacing: f64, ahead: usize) -> Self {
        let steps = columns.len() - 1 - 2 * ahead;
        let mut triangles = Vec::with_capacity(2 * columns.len());
        for (index, pair) in columns.windows(2).enumerate() {
            let step = index.saturating_sub(ahead).min(steps - 1);
            let pair = [pair[0], pair[1]];
            triangles.extend(Triangle::between(pair, 2 * index as u32, step, spacing));
        }
        let mut ribbon = Self {
            triangles,
            tree: Vec::new(),
            spacing,
        };
        let leaves = ribbon.leaves();
        ribbon.push(&leaves);
        ribbon
    }

    /// Triangles beside each other, in order.
    fn leaves(&self) -> Vec<Range<usize>> {
        let mut leaves = Vec::new();
        let mut first = 0;
        while let Some(lead) = self.triangles.get(first) {
            let rest = &self.triangles[first + 1..];
            let others = rest.iter().take_while(|t| lead.is_beside(t, self.spacing));
            let end = first + 1 + others.count();
            leaves.push(first..end);
            first = end;
        }
        leaves
    }

    /// Adds the tree over some leaves.
    fn push(&mut self, leaves: &[Range<usize>]) {
        let (Some(first), Some(last)) = (leaves.first(), leaves.last()) else {
            return;
        };
        let at = self.tree.len();
        let is_leaf = leaves.len() == 1;
        self.tree.push(Node {
            bounds: bounds_of(&self.triangles[first.start..last.end]),
            triangles: if is_leaf { first.clone() } else { 0..0 },
            after: at,
        });
        if !is_leaf {
            let (front, back) = leaves.split_at(leaves.len() / 2);
            self.push(front);
            self.push(back);
        }
        self.tree[at].after = self.tree.len();
    }

    /// The leaves of the tree: a box and its triangles.
    pub(crate) fn parts(&self) -> impl Iterator<Item = (&Bounds, &[Triangle])> {
        let leaves = self.tree.iter().filter(|node| !node.triangles.is_empty());
        leaves.map(|leaf| (&leaf.bounds, &self.triangles[leaf.triangles.clone()]))
    }

    /// Whether any triangle passes a test, among those in boxes that are to be entered.
    fn any(
        &self,
        enters: impl Fn(&Bounds) -> bool,
        mut test: impl FnMut(&Triangle) -> bool,
    ) -> bool {
        let mut at = 0;
        while let Some(node) = self.tree.get(at) {
            if !enters(&node.bounds) {
                at = node.after;
                continue;
            }
            if self.triangles[node.triangles.clone()].iter().any(&mut test) {
                return true;
            }
            at += 1;
        }
        false
    }

    /// Whether a point may be nearer to the surface than a distance; `false` is certain.
    pub(crate) fn may_reach(&self, p: &Vec3, distance: f64) -> bool {
        let enters = |bounds: &Bounds| bounds.distance_squared(p) < distance * distance;
        self.any(enters, |t| {
            t.height(p).abs() < distance && enters(&t.bounds)
        })
    }

    /// Whether a segment in a box may cross the surface; `false` is certain.
    pub(crate) fn may_cross(&self, within: &Bounds) -> bool {
        let middle = (within.low + within.high) / 2.0;
        // The heights of the corners of the box differ from that of its middle by at most this.
        let half = (within.high - within.low) / 2.0;
        self.any(
            |bounds| bounds.overlaps(within),
            |t| {
                let reach = t.normal.abs().dot(&half) * (1.0 + ROUNDING);
                t.bounds.overlaps(within) && t.height(&middle).abs() <= reach
            },
        )
    }

    /// Whether a segment crosses the surface.
    pub(crate) fn crosses(&self, p: &Vec3, q: &Vec3) -> bool {
        self.any(|bounds| !bounds.is_apart(p, q), |t| t.crosses(p, q))
    }

    /// The point of the surface nearest to `p`, if it is near at all.
    pub(crate) fn nearest(&self, p: &Vec3) -> Option<Foot> {
        let mut best = (REACH * self.spacing).powi(2);
        let mut nearest = None;
        let mut at = 0;
        while let Some(node) = self.tree.get(at) {
            if node.bounds.distance_squared(p) >= best {
                at = node.after;
                continue;
            }
            for triangle in &self.triangles[node.triangles.clone()] {
                let bound = triangle.bounds.distance_squared(p);
                if bound.max(triangle.height(p).powi(2)) >= best {
                    continue;
                }
                let point = triangle.nearest(p);
                let distance = (point - p).norm_squared();
                if distance < best {
                    best = distance;
                    nearest = Some(Foot {
                        point,
                        normal: triangle.normal,
                        step: triangle.step,
                    });
                }
            }
            at += 1;
        }
        nearest
    }
}

/// The box around triangles.
fn bounds_of(triangles: &[Triangle]) -> Bounds {
    let first = triangles[0].bounds;
    triangles.iter().fold(first, |b, t| b.with(&t.bounds))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn place() -> impl Strategy<Value = Vec3> {
        prop::array::uniform3(-20.0..20.0f64).prop_map(Vec3::from)
    }

    proptest! {
        #[test]
        fn tree_finds_what_a_test_of_every_triangle_finds(
            path in prop::collection::vec((place(), 1.0..9.0f64), 2..30),
            points in prop::collection::vec((place(), -2.0..2.0f64), 20),
        ) {
            let blade = |&(tip, depth_m): &(Vec3, f64)| BladePoint { tip, axis: Vec3::z(), depth_m };
            let points_of_blade: Vec<BladePoint> = path.iter().map(blade).collect();
            let ribbon = Ribbon::swept(&points_of_blade, 1.0);
            for (p, step) in points {
                let distances = ribbon.triangles.iter().map(|t| (t.nearest(&p) - p).norm());
                let expected = Some(distances.fold(f64::INFINITY, f64::min)).filter(|d| *d < REACH);
                let found = ribbon.nearest(&p).map(|foot| (foot.point - p).norm());
                prop_assert_eq!(found.is_some(), expected.is_some());
                let apart = found.zip(expected).map_or(0.0, |(a, b)| (a - b).abs());
                prop_assert!(apart < 1e-9, "{:?} instead of {:?}", found, expected);
                prop_assert!(expected.is_none_or(|d| ribbon.may_reach(&p, d + 1e-9)));
                let q = p + Vec3::new(step, 0.5 * step, step);
                let crosses = ribbon.triangles.iter().any(|t| t.crosses(&p, &q));
                prop_assert_eq!(ribbon.crosses(&p, &q), crosses);
                prop_assert!(ribbon.may_cross(&Bounds::around([p, q].into_iter())) || !crosses);
            }
        }
    }
}
