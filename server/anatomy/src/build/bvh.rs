//! A bounding volume hierarchy over triangles: nearest point, and first triangle along a short segment.
//!
//! Triangles are kept in single precision about an origin in their middle: 20 nm in a model of
//! 0.3 m, and 50 bytes per triangle with its share of the tree, so that a surface of ten million
//! triangles needs half a gigabyte.

use palpate_tissue::Vec3;
use palpate_tissue::nearest::{Feature, nearest_feature};

/// Most triangles in a leaf.
const LEAF: usize = 4;
/// Below this number of triangles a subtree is built by one thread.
const FORK: usize = 4096;
/// Deepest tree: halving 2^32 triangles.
const DEPTH_MAX: usize = 40;

/// Tag of a triangle without one.
pub(super) const NO_TAG: u16 = u16::MAX;

/// A triangle as stored in the tree.
#[derive(Debug, Clone, Copy)]
pub(super) struct Flat {
    /// Corners relative to the tree's origin.
    corners: [[f32; 3]; 3],
    /// Tag chosen by the owner, or [`NO_TAG`].
    tag: u16,
}

impl Flat {
    /// The same triangle with a tag.
    pub(super) fn tagged(self, tag: u16) -> Self {
        Self { tag, ..self }
    }
}

#[derive(Debug, Clone, Copy, Default)]
struct Node {
    low: [f32; 3],
    high: [f32; 3],
    /// First triangle of a leaf, or the number of the second child.
    start: u32,
    /// Triangles of a leaf, 0 for an inner node, whose first child follows it.
    count: u32,
}

/// The part of a line to search.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum LineSide {
    /// The part before the point, at lower coordinates.
    Before,
    /// The part after the point.
    After,
    /// The whole line.
    Both,
}

/// The tree.
#[derive(Debug, Default)]
pub(super) struct Bvh {
    origin: Vec3,
    nodes: Vec<Node>,
    triangles: Vec<Flat>,
}

impl Bvh {
    /// Sorts triangles, given relative to `origin`, into a tree.
    pub(super) fn new(origin: Vec3, mut triangles: Vec<Flat>) -> Self {
        triangles.shrink_to_fit();
        let mut nodes = vec![Node::default(); node_count(triangles.len())];
        if !triangles.is_empty() {
            split(&mut triangles, 0, &mut nodes, 0);
        }
        Self {
            origin,
            nodes,
            triangles,
        }
    }

    /// A triangle in the tree's precision.
    pub(super) fn flat(origin: &Vec3, corners: &[Vec3; 3]) -> Flat {
        let corners = corners.map(|p| {
            let p = p - origin;
            [p.x as f32, p.y as f32, p.z as f32]
        });
        let tag = NO_TAG;
        Flat { corners, tag }
    }

    /// Whether there is no triangle at all.
    pub(super) fn is_empty(&self) -> bool {
        self.triangles.is_empty()
    }

    /// Number of triangles.
    pub(super) fn len(&self) -> usize {
        self.triangles.len()
    }

    /// The corners of one triangle, in the order of the tree.
    pub(super) fn triangle(&self, index: usize) -> [Vec3; 3] {
        self.corners(&self.triangles[index])
    }

    /// The tag of one triangle.
    pub(super) fn tag(&self, index: usize) -> u16 {
        self.triangles[index].tag
    }

    fn corners(&self, triangle: &Flat) -> [Vec3; 3] {
        triangle.corners.map(|p| local(&p) + self.origin)
    }

    /// The point nearest to `point` that is not farther than `reach` (m).
    pub(super) fn nearest(&self, point: &Vec3, reach: f64) -> Option<Vec3> {
        self.nearest_of(point, reach, |_| true)
    }

    /// The same on the triangles whose tag `accept` takes.
    pub(super) fn nearest_tagged(
        &self,
        point: &Vec3,
        reach: f64,
        accept: impl Fn(u16) -> bool,
    ) -> Option<Vec3> {
        self.nearest_of(point, reach, |triangle| accept(triangle.tag))
    }

    /// The same on the triangles that face along `way`.
    pub(super) fn nearest_facing(&self, point: &Vec3, reach: f64, way: &Vec3) -> Option<Vec3> {
        self.nearest_of(point, reach, |triangle| {
            let [a, b, c] = triangle.corners.map(|p| local(&p));
            (b - a).cross(&(c - a)).dot(way) > 0.0
        })
    }

    /// The same on the triangles that `accept` takes.
    fn nearest_of(&self, point: &Vec3, reach: f64, accept: impl Fn(&Flat) -> bool) -> Option<Vec3> {
        if self.nodes.is_empty() {
            return None;
        }
        let at = point - self.origin;
        let mut best = reach * reach;
        let mut found = None;
        let mut stack = [(0_u32, 0.0_f64); DEPTH_MAX];
        stack[0].1 = self.nodes[0].distance_squared(&at);
        let mut height = 1;
        while height > 0 {
            height -= 1;
            let (index, distance) = stack[height];
            if distance > best {
                continue;
            }
            let node = &self.nodes[index as usize];
            if node.count > 0 {
                let from = node.start as usize;
                for triangle in &self.triangles[from..from + node.count as usize] {
                    let [a, b, c] = &triangle.corners;
                    if box_of(&triangle.corners).distance_squared(&at) > best || !accept(triangle) {
                        continue;
                    }
                    let candidate = nearest_on(&at, &[local(a), local(b), local(c)]);
                    let distance = (candidate - at).norm_squared();
                    if distance < best || (distance == best && found.is_none()) {
                        best = distance;
                        found = Some(candidate);
                    }
                }
                continue;
            }
            let child = |child: u32| (child, self.nodes[child as usize].distance_squared(&at));
            let (left, right) = (child(index + 1), child(node.start));
            // The nearer child is searched first.
            let (first, second) = if left.1 <= right.1 {
                (left, right)
            } else {
                (right, left)
            };
            if second.1 <= best {
                stack[height] = second;
                height += 1;
            }
            if first.1 <= best {
                stack[height] = first;
                height += 1;
            }
        }
        found.map(|p| p + self.origin)
    }

    /// Whether a point lies in the box around all triangles.
    pub(super) fn may_contain(&self, point: &Vec3) -> bool {
        let at = point - self.origin;
        let root = self.nodes.first();
        root.is_some_and(|node| node.distance_squared(&at) == 0.0)
    }

    /// The side of a point along an axis on which the box around all triangles ends sooner.
    pub(super) fn nearer_end(&self, point: &Vec3, axis: usize) -> LineSide {
        let at = point[axis] - self.origin[axis];
        match self.nodes.first() {
            Some(n) if f64::from(n.high[axis]) - at < at - f64::from(n.low[axis]) => {
                LineSide::After
            }
            _ => LineSide::Before,
        }
    }

    /// Calls `each` with every triangle whose box the line along `axis` through `point`, or the part of it
    /// before or after the point, may cross. Point and corners are relative to the tree's origin.
    pub(super) fn for_line(
        &self,
        point: &Vec3,
        axis: usize,
        way: LineSide,
        mut each: impl FnMut(&Vec3, &[Vec3; 3]),
    ) {
        let at = point - self.origin;
        let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
        // Rounded outwards by one last digit, so that the boxes can be compared in single precision.
        let (p, q) = (at[u] as f32, at[v] as f32);
        let (p0, p1, q0, q1) = (p.next_down(), p.next_up(), q.next_down(), q.next_up());
        let d = at[axis] as f32;
        let (first, last) = match way {
            LineSide::Before => (f32::NEG_INFINITY, d.next_up()),
            LineSide::After => (d.next_down(), f32::INFINITY),
            LineSide::Both => (f32::NEG_INFINITY, f32::INFINITY),
        };
        let misses = |n: &Node| {
            n.low[u] > p1
                || n.high[u] < p0
                || n.low[v] > q1
                || n.high[v] < q0
                || n.low[axis] > last
                || n.high[axis] < first
        };
        self.walk(misses, |index| {
            let [a, b, c] = &self.triangles[index].corners;
            let apart = a[u].max(b[u]).max(c[u]) < p0
                || a[u].min(b[u]).min(c[u]) > p1
                || a[v].max(b[v]).max(c[v]) < q0
                || a[v].min(b[v]).min(c[v]) > q1;
            if !apart {
                each(&at, &[local(a), local(b), local(c)]);
            }
        });
    }

    /// Calls `each` with the number of every triangle in the leaves that `misses` rejects neither by themselves nor by
    /// a node above them.
    fn walk(&self, misses: impl Fn(&Node) -> bool, mut each: impl FnMut(usize)) {
        if self.nodes.is_empty() {
            return;
        }
        let mut stack = [0_u32; DEPTH_MAX];
        let mut height = 1;
        while height > 0 {
            height -= 1;
            let index = stack[height];
            let node = &self.nodes[index as usize];
            if misses(node) {
                continue;
            }
            if node.count == 0 {
                stack[height] = node.start;
                stack[height + 1] = index + 1;
                height += 2;
                continue;
            }
            let start = node.start as usize;
            (start..start + node.count as usize).for_each(&mut each);
        }
    }

    /// Distance along `way` (m, from `from`) to the first triangle that it crosses, with the triangle's number;
    /// `None` without a crossing.
    pub(super) fn first_along(&self, from: &Vec3, way: &Vec3) -> Option<(f64, usize)> {
        let from = from - self.origin;
        let to = from + way;
        let (low, high) = (from.inf(&to), from.sup(&to));
        let misses = |n: &Node| {
            (0..3).any(|a| f64::from(n.low[a]) > high[a] || f64::from(n.high[a]) < low[a])
        };
        let mut best: Option<(f64, usize)> = None;
        self.walk(misses, |index| {
            let [a, b, c] = &self.triangles[index].corners;
            if let Some(t) = crossing(&from, way, &[local(a), local(b), local(c)])
                && best.is_none_or(|b| t < b.0)
            {
                best = Some((t, index));
            }
        });
        best.map(|(t, index)| (t * way.norm(), index))
    }
}

impl Node {
    /// Squared distance of a point from the box.
    fn distance_squared(&self, at: &Vec3) -> f64 {
        let mut sum = 0.0;
        for a in 0..3 {
            let below = f64::from(self.low[a]) - at[a];
            let above = at[a] - f64::from(self.high[a]);
            let outside = below.max(above).max(0.0);
            sum += outside * outside;
        }
        sum
    }
}

/// The box around a triangle.
fn box_of([a, b, c]: &[[f32; 3]; 3]) -> Node {
    let mut node = Node::default();
    for i in 0..3 {
        node.low[i] = a[i].min(b[i]).min(c[i]);
        node.high[i] = a[i].max(b[i]).max(c[i]);
    }
    node
}

fn local(p: &[f32; 3]) -> Vec3 {
    Vec3::new(f64::from(p[0]), f64::from(p[1]), f64::from(p[2]))
}

/// Number of tree nodes over so many triangles; splitting in halves makes it a function of the number.
fn node_count(triangles: usize) -> usize {
    if triangles == 0 {
        0
    } else if triangles <= LEAF {
        1
    } else {
        let half = triangles / 2;
        1 + node_count(half) + node_count(triangles - half)
    }
}

/// Fills `nodes` with the tree over `triangles`. Their first entries have the numbers `triangle_base` and
/// `node_base` in the whole tree.
fn split(triangles: &mut [Flat], triangle_base: usize, nodes: &mut [Node], node_base: usize) {
    let mut node = Node {
        low: [f32::INFINITY; 3],
        high: [f32::NEG_INFINITY; 3],
        start: triangle_base as u32,
        count: triangles.len() as u32,
    };
    for p in triangles.iter().flat_map(|t| &t.corners) {
        for a in 0..3 {
            node.low[a] = node.low[a].min(p[a]);
            node.high[a] = node.high[a].max(p[a]);
        }
    }
    if triangles.len() > LEAF {
        let extent = [0, 1, 2].map(|a| node.high[a] - node.low[a]);
        let axis = (0..3).fold(0, |b, a| if extent[a] > extent[b] { a } else { b });
        let middle = |t: &Flat| t.corners.iter().map(|c| c[axis]).sum::<f32>();
        let half = triangles.len() / 2;
        // Equal middles are ordered by the corners, so the tree depends on the set alone.
        triangles.select_nth_unstable_by(half, |t, u| {
            middle(t).total_cmp(&middle(u)).then_with(|| {
                let corners = |t: &'_ Flat| t.corners.into_iter().flatten();
                let pairs = corners(t).zip(corners(u));
                pairs.fold(std::cmp::Ordering::Equal, |o, (x, y)| {
                    o.then_with(|| x.total_cmp(&y))
                })
            })
        });
        let children = node_count(half);
        node.count = 0;
        node.start = (node_base + 1 + children) as u32;
        let fork = triangles.len() > FORK;
        let (left, right) = triangles.split_at_mut(half);
        let (left_nodes, right_nodes) = nodes[1..].split_at_mut(children);
        let mut on_left = || split(left, triangle_base, left_nodes, node_base + 1);
        let mut on_right = || {
            let base = node_base + 1 + children;
            split(right, triangle_base + half, right_nodes, base);
        };
        if fork {
            rayon::join(on_left, on_right);
        } else {
            on_left();
            on_right();
        }
    }
    nodes[0] = node;
}

/// The point of a triangle nearest to `p`.
fn nearest_on(p: &Vec3, corners: &[Vec3; 3]) -> Vec3 {
    let [a, b, c] = corners;
    match nearest_feature(p, corners) {
        Feature::Corner(i) => corners[i],
        Feature::Edge(i, j, part) => corners[i] + (corners[j] - corners[i]) * part,
        Feature::Face([va, vb, vc]) => {
            let sum = va + vb + vc;
            if sum > 0.0 {
                a + (b - a) * (vb / sum) + (c - a) * (vc / sum)
            } else {
                *a
            }
        }
    }
}

/// The fraction of `way` at which it crosses a triangle (Möller and Trumbore 1997).
fn crossing(from: &Vec3, way: &Vec3, [a, b, c]: &[Vec3; 3]) -> Option<f64> {
    let (ab, ac) = (b - a, c - a);
    let normal = way.cross(&ac);
    let det = ab.dot(&normal);
    if det == 0.0 {
        return None;
    }
    let to = from - a;
    let u = to.dot(&normal) / det;
    let side = to.cross(&ab);
    let v = way.dot(&side) / det;
    let t = ac.dot(&side) / det;
    (u >= 0.0 && v >= 0.0 && u + v <= 1.0 && (0.0..=1.0).contains(&t)).then_some(t)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn tree_queries_equal_brute_force(
            numbers in prop::collection::vec(-1.0_f32..1.0, 9..900), point in prop::array::uniform3(-2.0..2.0),
            way in prop::array::uniform3(-2.0..2.0),
        ) {
            let triangles: Vec<Flat> = numbers
                .chunks_exact(9)
                .map(|n| Flat {
                    corners: [[n[0], n[1], n[2]], [n[3], n[4], n[5]], [n[6], n[7], n[8]]],
                    tag: NO_TAG,
                })
                .collect();
            let tree = Bvh::new(Vec3::new(0.5, 0.0, 0.0), triangles);
            let (point, way) = (Vec3::from(point), Vec3::from(way));
            let each = (0..tree.len()).map(|t| tree.triangle(t)).map(|t| (nearest_on(&point, &t) - point).norm());
            let least = each.fold(f64::INFINITY, f64::min);
            let found = (tree.nearest(&point, 10.0).unwrap() - point).norm();
            prop_assert!((found - least).abs() < 1e-9, "{found} {least}");
            prop_assert!(tree.nearest(&point, least * 0.99).is_none());
            let crossings = (0..tree.len()).map(|t| tree.triangle(t)).filter_map(|t| crossing(&point, &way, &t));
            let first = crossings.fold(f64::INFINITY, f64::min) * way.norm();
            let found = tree.first_along(&point, &way).map_or(f64::INFINITY, |f| f.0);
            prop_assert!(found == first || (found - first).abs() < 1e-9);
        }
    }
}
