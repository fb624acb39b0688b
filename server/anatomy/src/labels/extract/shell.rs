//! The surface of one region, taken from the shared mesh.

use std::collections::BTreeMap;

use super::Sides;
use super::fans::{Fan, Fans, face};
use super::net::{Net, Quad};
use crate::Surface;

/// Sides of a quadrilateral's corners along the two axes of its plane, in the order of the corners.
const SIDES: [[usize; 2]; 4] = [[0, 0], [1, 0], [1, 1], [0, 1]];

/// The closed surface around all voxels whose region passes `is_in`, wound outwards, in the world; and the
/// regions on the sides of each triangle.
pub(super) fn shell(net: &Net, is_in: impl Fn(u8) -> bool) -> (Surface, Vec<Sides>) {
    let fans = Fans::new();
    let filled: Vec<u8> = net
        .corners
        .iter()
        .map(|c| (0..8).fold(0, |set, b| set | u8::from(is_in(c.block[b])) << b))
        .collect();
    let mut shell = Shell {
        net,
        fans: &fans,
        pinched: BTreeMap::new(),
        filled: &filled,
        first: Vec::with_capacity(filled.len()),
        midpoints: BTreeMap::new(),
        mirrored: net.to_world.determinant() < 0.0,
        surface: Surface::default(),
    };
    let mut sides = Vec::new();
    for (v, set) in filled.iter().enumerate() {
        shell.first.push(shell.surface.vertices.len() as u32);
        let at = net.to_world.world(&net.position(v as u32));
        let corner = &net.corners[v];
        if corner.pinched != 0 {
            let fan = Fan::new(*set, corner.faces, corner.pinched);
            shell.pinched.insert(v as u32, fan);
        }
        let copies = usize::from(shell.fan(v as u32).count);
        shell
            .surface
            .vertices
            .extend(std::iter::repeat_n(at, copies));
    }
    for quad in &net.quads {
        let [near, far] = quad.sides.map(&is_in);
        if near != far {
            shell.add(quad, near);
            // Region numbers plus one, and 0 for voxels of no region.
            let own = Sides {
                behind: quad.sides[usize::from(!near)] - 1,
                before: quad.sides[usize::from(near)].checked_sub(1),
            };
            sides.resize(shell.surface.triangles.len(), own);
        }
    }
    (shell.surface, sides)
}

struct Shell<'a> {
    net: &'a Net,
    fans: &'a Fans,
    /// The fans at pinched edges.
    pinched: BTreeMap<u32, Fan>,
    /// The voxels around each vertex that are in the region.
    filled: &'a [u8],
    /// First copy of each vertex in the surface.
    first: Vec<u32>,
    /// Vertices in the middle of edges that four triangles would share: (lower end, axis, voxel of the lower
    /// end's block that the faces belong to).
    midpoints: BTreeMap<(u32, u8, u8), u32>,
    /// Whether voxel indices are left-handed in the world.
    mirrored: bool,
    surface: Surface,
}

impl Shell<'_> {
    /// The fans of the region around a vertex.
    fn fan(&self, v: u32) -> &Fan {
        let of_set = || self.fans.of(self.filled[v as usize]);
        self.pinched.get(&v).unwrap_or_else(of_set)
    }

    /// Adds a face; `near` is whether its nearer voxel is the inner one.
    fn add(&mut self, quad: &Quad, near: bool) {
        let axis = usize::from(quad.axis);
        let vertices: [u32; 4] = std::array::from_fn(|c| {
            let v = quad.corners[c];
            let [u, w] = SIDES[c];
            let fan = self.fan(v);
            self.first[v as usize] + u32::from(fan.of_face[face(axis, 1 - u, 1 - w)])
        });
        let middles: [Option<u32>; 4] = std::array::from_fn(|e| self.midpoint(quad, e, near));
        for [a, b, c] in quad.triangles() {
            // Edges of the quadrilateral run from a corner to the next; the diagonal has no middle.
            let middle = |from: usize, to: usize| {
                if (from + 1) % 4 == to {
                    middles[from]
                } else {
                    None
                }
            };
            let sides = [middle(a, b), middle(b, c), middle(c, a)];
            self.triangles([a, b, c].map(|i| vertices[i]), sides, near);
        }
    }

    /// The vertex in the middle of side `e`, if four triangles would share it otherwise.
    fn midpoint(&mut self, quad: &Quad, e: usize, near: bool) -> Option<u32> {
        let plane = usize::from(quad.axis);
        let (u, w) = ((plane + 1) % 3, (plane + 2) % 3);
        // Sides 0 and 2 run along u, 1 and 3 along w; the lower end comes first in 0 and 1.
        let axis = if e.is_multiple_of(2) { u } else { w };
        let (low, high) = if e < 2 { (e, e + 1) } else { ((e + 1) % 4, e) };
        let doubled = |c: usize, direction: usize| {
            let fan = self.fan(quad.corners[c]);
            fan.doubled >> direction & 1 == 1
        };
        if !(doubled(low, 2 * axis + 1) && doubled(high, 2 * axis)) {
            return None;
        }
        let [su, sw] = SIDES[low];
        // Connected faces share their inner voxel, at a pinched edge the outer one.
        let lower = &self.net.corners[quad.corners[low] as usize];
        let is_pinched = lower.pinched >> (2 * axis + 1) & 1 == 1;
        let voxel = (1 - su) << u | (1 - sw) << w | usize::from(near == is_pinched) << plane;
        let key = (quad.corners[low], axis as u8, voxel as u8);
        let vertices = &mut self.surface.vertices;
        let net = self.net;
        Some(*self.midpoints.entry(key).or_insert_with(|| {
            let [a, b] = [low, high].map(|c| net.position(quad.corners[c]));
            vertices.push(net.to_world.world(&((a + b) * 0.5)));
            (vertices.len() - 1) as u32
        }))
    }

    /// Adds a triangle whose sides may have a vertex in the middle.
    fn triangles(&mut self, corners: [u32; 3], middles: [Option<u32>; 3], near: bool) {
        let Some(first) = (0..3).find(|s| middles[*s].is_some()) else {
            let [a, b, c] = corners;
            let outward = near != self.mirrored;
            self.surface
                .triangles
                .push(if outward { [a, b, c] } else { [a, c, b] });
            return;
        };
        // Split from the middle of the first such side to the opposite corner.
        let [a, b, c] = [0, 1, 2].map(|i| corners[(first + i) % 3]);
        let side = |i: usize| middles[(first + i) % 3];
        let middle = side(0).unwrap_or(a);
        self.triangles([a, middle, c], [None, None, side(2)], near);
        self.triangles([middle, b, c], [None, side(1), None], near);
    }
}
