//! Locations for tools on a model: two points on its outer surface with room for a stroke between them.
//!
//! The surface around a suitable location is one region without pinned parts and without edges (the end of a
//! limb, the rim of a block). Nothing pinned is close below. Of a sample of surface nodes, the node with the
//! best clearance and depth is the centre. The stroke direction v is that of the smallest surface curvature, so
//! that a straight blade keeps its depth. The two locations P and Q are at ±u, across the stroke.
//!
//! ```text
//!            v
//!            |  stroke
//!     P -----M----- Q   u
//!            |
//! ```

use std::collections::BTreeMap;

use palpate_tissue::{RegionId, Tissue, Topology, Vec3};

/// Maximum number of candidate nodes for the centre. Each costs one pass over the unsuitable and pinned nodes.
/// More do not improve the result, because adjacent candidates are similar.
const CANDIDATES_MAX: usize = 400;

/// Cosine between face and node normal below which the face belongs to an edge.
const EDGE_COS: f64 = 0.75;

/// Sufficient clearance: half the separation, a tool radius and a reserve.
const CLEARANCE_ENOUGH_M: f64 = 0.045;

/// Clearance for a tool that presses without sliding.
const ROOM_FOR_A_TOOL_M: f64 = 0.015;
const DEPTH_ENOUGH_M: f64 = 0.040;

/// Separation of the two locations if there is room.
const SEPARATION_M: f64 = 0.055;

/// Minimum cosine between the normals of a pressable location and of the centre. Its surface must also not be
/// farther below the centre than it is beside it.
const LEANS_COS: f64 = 0.6;

/// Number of separations to try, from the wanted one down.
const SEPARATIONS: usize = 16;

const NOWHERE: &str = "the model has no location to press and cut: every part of its outer surface is pinned, or is \
                       an edge; unpin a region or use a finer spacing";

/// A frame on the outer surface, with its clearance and depth.
#[derive(Debug, Clone)]
pub struct ToolLocation {
    /// The centre, a point of the surface, m.
    pub middle: Vec3,
    pub normal: Vec3,
    /// Unit vector towards the second location.
    pub u: Vec3,
    /// Unit vector along the stroke; u × v is the normal.
    pub v: Vec3,
    /// Distance to the nearest edge, m.
    pub clearance_m: f64,
    /// Depth of the nearest pinned part, m.
    pub depth_m: f64,
    pub spacing_m: f64,
    /// Distance of the two locations from the centre, m.
    beside_m: f64,
    triangles: Vec<[Vec3; 3]>,
}

#[derive(Debug, Clone, Copy)]
pub struct SurfacePoint {
    pub at: Vec3,
    /// Outward unit normal.
    pub normal: Vec3,
}

/// Nodes of the outer surface.
struct Skin<'a> {
    topology: &'a Topology,
    /// Area-weighted normal, triangles, and whether the node is clear of other regions and edges.
    nodes: BTreeMap<u32, SkinNode>,
}

#[derive(Default)]
struct SkinNode {
    normal: Vec3,
    triangles: Vec<usize>,
    is_bad: bool,
}

impl<'a> Skin<'a> {
    fn new(topology: &'a Topology) -> Self {
        let boundary = topology.boundary();
        let region = main_region(topology);
        let mut nodes: BTreeMap<u32, SkinNode> = BTreeMap::new();
        for (t, corners) in boundary.triangles.iter().enumerate() {
            let [a, b, c] = corners.map(|n| topology.rest(n));
            let area = (b - a).cross(&(c - a)) / 2.0;
            let cell = boundary.faces[t / 2].cell();
            for &n in corners {
                let node = nodes.entry(n).or_default();
                node.normal += area;
                node.triangles.push(t);
                node.is_bad |= Some(topology.region(cell)) != region || topology.is_pinned(n);
            }
        }
        for node in nodes.values_mut() {
            let length = node.normal.norm();
            if length > 0.0 {
                node.normal /= length;
            } else {
                node.is_bad = true;
            }
            let leans = |&t: &usize| normal_of(topology, t).dot(&node.normal) < EDGE_COS;
            node.is_bad |= node.triangles.iter().any(leans);
        }
        Self { topology, nodes }
    }

    /// The centre with the best score of clearance and depth: node, clearance, depth.
    fn middle(&self, score: impl Fn(f64, f64) -> f64) -> Option<(u32, f64, f64)> {
        let at = |n: u32| self.topology.rest(n);
        let is_bad = |n: &&u32| self.nodes[*n].is_bad;
        let (bad, good): (Vec<u32>, Vec<u32>) = self.nodes.keys().partition(is_bad);
        let bad: Vec<Vec3> = bad.into_iter().map(at).collect();
        let pinned = (0..self.topology.node_count() as u32).filter(|n| self.topology.is_pinned(*n));
        let pinned: Vec<Vec3> = pinned.map(at).collect();
        let nearest = |points: &[Vec3], p: Vec3| {
            let squares = points.iter().map(|q| (q - p).norm_squared());
            squares.fold(f64::INFINITY, f64::min).sqrt()
        };
        let extent = self.extent();
        let step = good.len().div_ceil(CANDIDATES_MAX).max(1);
        let mut best: Option<(f64, (u32, f64, f64))> = None;
        for n in good.into_iter().step_by(step) {
            let clearance = nearest(&bad, at(n)).min(extent / 2.0);
            let depth = nearest(&pinned, at(n)).min(extent);
            let score = score(clearance, depth);
            if best.as_ref().is_none_or(|b| score > b.0) {
                best = Some((score, (n, clearance, depth)));
            }
        }
        best.map(|b| b.1)
    }

    fn extent(&self) -> f64 {
        let (mut low, mut high) = (Vec3::repeat(f64::INFINITY), Vec3::repeat(f64::NEG_INFINITY));
        for n in self.nodes.keys() {
            low = low.inf(&self.topology.rest(*n));
            high = high.sup(&self.topology.rest(*n));
        }
        (high - low).norm()
    }
}

fn main_region(topology: &Topology) -> Option<RegionId> {
    let boundary = topology.boundary();
    let mut areas: BTreeMap<RegionId, f64> = BTreeMap::new();
    for (t, corners) in boundary.triangles.iter().enumerate() {
        let region = topology.region(boundary.faces[t / 2].cell());
        if !topology.model().regions[region.index()].pinned {
            let [a, b, c] = corners.map(|n| topology.rest(n));
            *areas.entry(region).or_default() += (b - a).cross(&(c - a)).norm();
        }
    }
    areas
        .into_iter()
        .max_by(|a, b| a.1.total_cmp(&b.1))
        .map(|(region, _)| region)
}

fn normal_of(topology: &Topology, triangle: usize) -> Vec3 {
    let [a, b, c] = topology.boundary().triangles[triangle].map(|n| topology.rest(n));
    (b - a)
        .cross(&(c - a))
        .try_normalize(0.0)
        .unwrap_or_else(Vec3::zeros)
}

impl ToolLocation {
    /// Moves the frame with the sag of the tissue under gravity, by the displacement of the nearest node.
    pub fn sag(&mut self, tissue: &Tissue) {
        let topology = tissue.topology();
        let nodes = topology.boundary().triangles.iter().flatten().copied();
        let apart = |node: &u32| (topology.rest(*node) - self.middle).norm();
        let nearest = nodes.min_by(|a, b| apart(a).total_cmp(&apart(b)));
        let by = nearest.map_or_else(Vec3::zeros, |n| tissue.sag_of(n));
        self.middle += by;
        for corner in self.triangles.iter_mut().flatten() {
            *corner += by;
        }
    }

    pub fn find(topology: &Topology) -> Result<Self, String> {
        let skin = Skin::new(topology);
        let found = skin.middle(|clearance, depth| {
            let room = (clearance / CLEARANCE_ENOUGH_M).min(1.0);
            room * (1.0 + (depth / DEPTH_ENOUGH_M).min(1.0)) + 0.1 * clearance
        });
        Self::around(topology, &skin, found)
    }

    /// Finds the location with the thinnest tissue (at least two spacings) above a pinned part, with room for a
    /// tool.
    pub fn find_thin(topology: &Topology) -> Result<Self, String> {
        let skin = Skin::new(topology);
        let least = 2.0 * topology.model().spacing_m;
        let found = skin.middle(|clearance, depth| {
            let room = (clearance / ROOM_FOR_A_TOOL_M).min(1.0);
            room - depth.max(least) / DEPTH_ENOUGH_M
        });
        Self::around(topology, &skin, found)
    }

    /// Surface points with room for a tool each, by farthest-point sampling. Returns fewer than `n` if the
    /// surface has no more.
    pub fn spread(topology: &Topology, n: usize) -> Result<Vec<SurfacePoint>, String> {
        let skin = Skin::new(topology);
        let at = |node: u32| topology.rest(node);
        let is_good = |node: &&u32| !skin.nodes[*node].is_bad;
        let (good, bad): (Vec<u32>, Vec<u32>) = skin.nodes.keys().partition(|n| is_good(n));
        let step = good.len().div_ceil(CANDIDATES_MAX.max(4 * n)).max(1);
        let has_room = |node: &u32| {
            let near = |b: &u32| (at(*b) - at(*node)).norm() < ROOM_FOR_A_TOOL_M;
            !bad.iter().any(near)
        };
        let some: Vec<u32> = good.iter().copied().step_by(step).collect();
        let roomy: Vec<u32> = some.iter().copied().filter(has_room).collect();
        let candidates = if roomy.is_empty() { some } else { roomy };
        let first = *candidates.first().ok_or(NOWHERE)?;
        let apart = |a: u32, b: u32| (at(a) - at(b)).norm();
        let mut chosen = vec![first];
        let mut distance: Vec<f64> = candidates.iter().map(|c| apart(*c, first)).collect();
        while chosen.len() < n {
            let farthest =
                (0..candidates.len()).max_by(|a, b| distance[*a].total_cmp(&distance[*b]));
            let Some(next) = farthest.filter(|i| distance[*i] > 0.0) else {
                break;
            };
            chosen.push(candidates[next]);
            for (d, c) in distance.iter_mut().zip(&candidates) {
                *d = d.min(apart(*c, candidates[next]));
            }
        }
        let point = |node: u32| SurfacePoint {
            at: at(node),
            normal: skin.nodes[&node].normal,
        };
        Ok(chosen.into_iter().map(point).collect())
    }

    fn around(
        topology: &Topology,
        skin: &Skin<'_>,
        found: Option<(u32, f64, f64)>,
    ) -> Result<Self, String> {
        let (node, clearance_m, depth_m) = found.ok_or(NOWHERE)?;
        let middle = topology.rest(node);
        let reach = clearance_m.min(CLEARANCE_ENOUGH_M);
        let normal = mean_normal(skin, middle, reach).unwrap_or(skin.nodes[&node].normal);
        let v = flattest(skin, middle, reach, normal);
        let u = v.cross(&normal);
        let near = 2.0 * CLEARANCE_ENOUGH_M;
        let triangles = topology
            .boundary()
            .triangles
            .iter()
            .map(|t| t.map(|n| topology.rest(n)))
            .filter(|t| (t[0] - middle).norm() < near)
            .collect();
        let mut location = Self {
            middle,
            normal,
            u,
            v,
            clearance_m,
            depth_m,
            spacing_m: topology.model().spacing_m,
            beside_m: 0.0,
            triangles,
        };
        location.beside_m = location.farthest_beside();
        Ok(location)
    }

    /// The largest distance from the centre, up to half of [`SEPARATION_M`], with a surface on both sides that
    /// faces like the centre. On a handle, whose surface has no edge, it ends where the side falls away.
    fn farthest_beside(&self) -> f64 {
        let wished = SEPARATION_M * self.scale() / 2.0;
        let step = wished / SEPARATIONS as f64;
        let faces = |a: f64| {
            self.hit(a, 0.0).is_some_and(|point| {
                let below = (self.middle - point.at).dot(&self.normal);
                point.normal.dot(&self.normal) >= LEANS_COS && below.abs() <= a.abs()
            })
        };
        let tried = (1..=SEPARATIONS).rev().map(|k| step * k as f64);
        let mut fits = tried.filter(|a| faces(*a) && faces(-a));
        fits.next().unwrap_or(step)
    }

    /// Scale of the available room; 1 if both locations have the wanted separation.
    pub fn scale(&self) -> f64 {
        (self.clearance_m / CLEARANCE_ENOUGH_M).min(1.0)
    }

    pub fn separation_m(&self) -> f64 {
        2.0 * self.beside_m
    }

    /// The surface at `a` metres along u and `b` along v from the centre, projected along the normal; the
    /// tangent plane if the line misses.
    pub fn surface(&self, a: f64, b: f64) -> SurfacePoint {
        self.hit(a, b).unwrap_or(SurfacePoint {
            at: self.middle + self.u * a + self.v * b,
            normal: self.normal,
        })
    }

    /// The surface at that position, if the line hits it.
    fn hit(&self, a: f64, b: f64) -> Option<SurfacePoint> {
        let base = self.middle + self.u * a + self.v * b;
        let hit = self
            .triangles
            .iter()
            .filter_map(|t| height(t, &base, &self.normal).map(|h| (h, t)))
            .max_by(|x, y| x.0.total_cmp(&y.0));
        hit.map(|(h, [a, b, c])| SurfacePoint {
            at: base + self.normal * h,
            normal: (b - a).cross(&(c - a)).normalize(),
        })
    }

    /// The surface at that position, with its normal averaged over a tool radius.
    pub fn spot(&self, a: f64, b: f64, radius_m: f64) -> SurfacePoint {
        let around = [(0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)];
        let sum: Vec3 = around
            .iter()
            .map(|(x, y)| self.surface(a + x * radius_m, b + y * radius_m).normal)
            .sum();
        SurfacePoint {
            at: self.surface(a, b).at,
            normal: sum.try_normalize(0.1).unwrap_or(self.normal),
        }
    }
}

/// Distance along `d` from `p` to a triangle that faces along `d`.
fn height([a, b, c]: &[Vec3; 3], p: &Vec3, d: &Vec3) -> Option<f64> {
    let (e, f) = (b - a, c - a);
    let normal = e.cross(&f);
    let facing = normal.dot(d);
    if facing <= 0.0 {
        return None;
    }
    let h = (a - p).dot(&normal) / facing;
    let q = p + d * h - a;
    let square = normal.norm_squared();
    let (s, t) = (
        q.cross(&f).dot(&normal) / square,
        e.cross(&q).dot(&normal) / square,
    );
    // A line along an edge hits both triangles.
    let slack = -1e-9;
    (s >= slack && t >= slack && s + t <= 1.0 - slack).then_some(h)
}

fn near<'a>(skin: &'a Skin<'a>, at: Vec3, reach: f64) -> impl Iterator<Item = &'a SkinNode> {
    skin.nodes
        .iter()
        .filter(move |(n, node)| !node.is_bad && (skin.topology.rest(**n) - at).norm() <= reach)
        .map(|(_, node)| node)
}

fn mean_normal(skin: &Skin<'_>, at: Vec3, reach: f64) -> Option<Vec3> {
    let sum: Vec3 = near(skin, at, reach / 2.0).map(|node| node.normal).sum();
    sum.try_normalize(0.1)
}

/// The tangent direction with the smallest change of the normal.
fn flattest(skin: &Skin<'_>, at: Vec3, reach: f64, normal: Vec3) -> Vec3 {
    let axis = if normal.x.abs() < 0.7 {
        Vec3::x()
    } else {
        Vec3::y()
    };
    let s = (axis - normal * normal.dot(&axis)).normalize();
    let t = normal.cross(&s);
    let (mut ss, mut st, mut tt) = (0.0, 0.0, 0.0);
    for node in near(skin, at, reach) {
        let (x, y) = (node.normal.dot(&s), node.normal.dot(&t));
        ss += x * x;
        st += x * y;
        tt += y * y;
    }
    // The smaller principal axis of [[ss, st], [st, tt]]; the larger one is at this angle.
    let angle = 0.5 * (2.0 * st).atan2(ss - tt);
    t * angle.cos() - s * angle.sin()
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use palpate_tissue::{Material, Topology, block};

    use super::ToolLocation;

    #[test]
    fn block_location_is_the_centre_of_the_free_side() {
        let soft = Material {
            name: "soft".into(),
            young_pa: 1e4,
            density_kg_m3: 1000.0,
            friction_static: 0.4,
            friction_dynamic: 0.3,
            source: "test".into(),
            ..Material::default()
        };
        let topology = Topology::new(Arc::new(block([30, 30, 10], 0.004, &soft, 1)));
        let location = ToolLocation::find(&topology).unwrap();
        assert!(
            (location.normal.z - 1.0).abs() < 1e-9,
            "{}",
            location.normal
        );
        assert!((location.middle.z - 0.04).abs() < 1e-9);
        assert!((location.middle.x - 0.06).abs() < 0.02 && (location.middle.y - 0.06).abs() < 0.02);
        assert!((location.u.cross(&location.v) - location.normal).norm() < 1e-9);
        let point = location.surface(0.02, -0.01);
        assert!((point.at.z - 0.04).abs() < 1e-9 && (point.normal.z - 1.0).abs() < 1e-9);
    }
}
