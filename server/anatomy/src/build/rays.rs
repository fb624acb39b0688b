//! Parallel rays through closed surfaces, watertight (Lin 2007, section 3.3 and fig. 3.5).
//!
//! A ray hits a triangle when it passes on the same side of its three edges, seen along the ray. The
//! side is decided exactly (adaptive predicates), and a ray that runs through an edge or a vertex is
//! taken to be shifted by an infinitesimal (ε, ε²): two triangles that share an edge see the same
//! shift, so every ray crosses a closed surface an even number of times, without exception.

use palpate_tissue::{Rows, Vec3};
use rayon::prelude::*;
use robust::{Coord, orient2d};

use crate::Surface;

/// A rectangular bundle of rays along one axis.
#[derive(Debug, Clone, Copy)]
pub(super) struct Rays {
    /// 0, 1, 2: the axis that the rays run along; the others follow in cyclic order as u and v.
    pub(super) axis: usize,
    /// u and v of ray (0, 0) in m.
    pub(super) first: [f64; 2],
    /// Distance between neighbouring rays in m.
    pub(super) step: f64,
    /// Number of rays along u and v.
    pub(super) count: [usize; 2],
}

impl Rays {
    /// u and v of a ray.
    pub(super) fn position(&self, ray: [usize; 2]) -> [f64; 2] {
        [
            self.first[0] + ray[0] as f64 * self.step,
            self.first[1] + ray[1] as f64 * self.step,
        ]
    }

    /// Index of a ray, u fastest.
    pub(super) fn index(&self, ray: [usize; 2]) -> usize {
        ray[0] + self.count[0] * ray[1]
    }

    /// Range of ray numbers along u or v that may lie between two coordinates.
    fn range(&self, side: usize, low: f64, high: f64) -> std::ops::Range<usize> {
        let at = |x: f64| (x - self.first[side]) / self.step;
        let from = (at(low) - 1e-6).ceil().max(0.0) as usize;
        let to = (at(high) + 1e-6).floor();
        if to < 0.0 {
            0..0
        } else {
            from..(to as usize + 1).min(self.count[side])
        }
    }
}

/// Intersection of a ray with a surface.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Hit {
    /// Coordinate along the ray in m.
    pub(super) depth: f64,
    /// The number of the triangle.
    pub(super) triangle: u32,
    /// +1 where the ray enters the solid, -1 where it leaves it.
    pub(super) turn: i8,
}

/// The hits of all rays of a bundle with one surface, sorted along each ray.
#[derive(Debug)]
pub(super) struct Hits(Rows<Hit>);

impl Hits {
    /// Hits of one ray, from low to high.
    pub(super) fn of(&self, ray: usize) -> &[Hit] {
        self.0.row(ray as u32)
    }

    /// Calls `each` with every stretch of a ray that lies inside; see [`Winding`].
    pub(super) fn inside(&self, ray: usize, each: impl FnMut(f64, f64)) {
        inside(self.of(ray), each);
    }

    /// See [`windings`].
    pub(super) fn windings(&self, ray: usize, each: impl FnMut(f64, f64, i32)) -> bool {
        windings(self.of(ray), each)
    }
}

/// Calls `each` with every stretch of a ray with these hits, from low to high, that lies inside; see [`Winding`].
pub(super) fn inside(hits: &[Hit], mut each: impl FnMut(f64, f64)) {
    let mut last: Option<(f64, f64)> = None;
    windings(hits, |from, to, _| match &mut last {
        Some(last) if last.1 == from => last.1 = to,
        _ => {
            if let Some((from, to)) = last.replace((from, to)) {
                each(from, to);
            }
        }
    });
    if let Some((from, to)) = last {
        each(from, to);
    }
}

/// Calls `each` with every stretch of a ray whose winding number is not zero, and that number. Where the turns do not
/// cancel, every other stretch has the number one. Returns whether they cancel.
fn windings(hits: &[Hit], mut each: impl FnMut(f64, f64, i32)) -> bool {
    let cancel = hits.iter().map(|h| i32::from(h.turn)).sum::<i32>() == 0;
    let (mut winding, mut from) = (0_i32, 0.0);
    for hit in hits {
        if winding != 0 && hit.depth > from {
            each(from, hit.depth, winding);
        }
        winding = if cancel {
            winding + i32::from(hit.turn)
        } else {
            1 - winding
        };
        from = hit.depth;
    }
    cancel
}

/// Decides from the hits of a whole line, in any order, whether a point on it lies inside.
///
/// Inside is where the winding number is not zero, so an inverted part of the surface still fills its interior.
/// When the crossings of the whole line do not cancel, some triangles are wound inconsistently; every other
/// stretch then counts as inside.
#[derive(Debug, Default)]
pub(super) struct Winding {
    whole: i32,
    before: i32,
    hits_before: u32,
}

impl Winding {
    /// Takes a hit, before the point or behind it.
    pub(super) fn add(&mut self, turn: i8, before: bool) {
        self.whole += i32::from(turn);
        if before {
            self.before += i32::from(turn);
            self.hits_before += 1;
        }
    }

    /// Whether the point lies inside.
    pub(super) fn is_inside(&self) -> bool {
        if self.whole == 0 {
            self.before != 0
        } else {
            self.hits_before % 2 == 1
        }
    }
}

/// Sends the rays through the surface.
pub(super) fn cast(surface: &Surface, rays: &Rays) -> Hits {
    cast_at(&surface.vertices, &surface.triangles, rays)
}

/// Sends the rays through triangles over these vertices.
pub(super) fn cast_at(vertices: &[Vec3], triangles: &[[u32; 3]], rays: &Rays) -> Hits {
    let found: Vec<(u32, Hit)> = triangles
        .par_iter()
        .enumerate()
        .fold(Vec::new, |mut found, (number, triangle)| {
            let corners = triangle.map(|v| vertices[v as usize]);
            cast_triangle(number as u32, &corners, rays, &mut found);
            found
        })
        .reduce(Vec::new, |mut all, mut more| {
            all.append(&mut more);
            all
        });
    let mut hits = Rows::new(rays.count[0] * rays.count[1], found.iter().copied());
    hits.sort_rows(along_ray);
    Hits(hits)
}

/// The order of hits along a ray. At equal depth it must not depend on the thread that found a hit.
pub(super) fn along_ray(a: &Hit, b: &Hit) -> std::cmp::Ordering {
    let depth = a.depth.total_cmp(&b.depth);
    depth.then((b.turn, a.triangle).cmp(&(a.turn, b.triangle)))
}

fn cast_triangle(triangle: u32, corners: &[Vec3; 3], rays: &Rays, found: &mut Vec<(u32, Hit)>) {
    let (u, v) = ((rays.axis + 1) % 3, (rays.axis + 2) % 3);
    let flat = corners.map(|p| [p[u], p[v]]);
    if flat[0] == flat[1] || flat[1] == flat[2] || flat[2] == flat[0] {
        // A triangle parallel to the rays projects to a line, and an edge of zero length has no sides.
        return;
    }
    let low = |a: usize| flat.iter().map(|p| p[a]).fold(f64::INFINITY, f64::min);
    let high = |a: usize| flat.iter().map(|p| p[a]).fold(f64::NEG_INFINITY, f64::max);
    for j in rays.range(1, low(1), high(1)) {
        for i in rays.range(0, low(0), high(0)) {
            let ray = rays.position([i, j]);
            if let Some(hit) = hit(triangle, corners, &flat, rays.axis, ray) {
                found.push((rays.index([i, j]) as u32, hit));
            }
        }
    }
}

/// Intersection of the line along `axis` through `at` (u, v) with a triangle, which has number 0.
pub(super) fn hit_at(corners: &[Vec3; 3], axis: usize, at: [f64; 2]) -> Option<Hit> {
    let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
    let flat = corners.map(|p| [p[u], p[v]]);
    if flat[0] == flat[1] || flat[1] == flat[2] || flat[2] == flat[0] {
        return None;
    }
    hit(0, corners, &flat, axis, at)
}

fn hit(
    triangle: u32,
    corners: &[Vec3; 3],
    flat: &[[f64; 2]; 3],
    axis: usize,
    ray: [f64; 2],
) -> Option<Hit> {
    let sides = [0, 1, 2].map(|e| side(flat[e], flat[(e + 1) % 3], ray));
    if sides[0].0 != sides[1].0 || sides[1].0 != sides[2].0 {
        return None;
    }
    // A counter-clockwise triangle faces along the ray: the ray leaves there.
    let turn = if sides[0].0 { -1 } else { 1 };
    let weights = [sides[1].1, sides[2].1, sides[0].1];
    let depth = depth_at(&corners.map(|p| p[axis]), weights);
    Some(Hit {
        depth,
        triangle,
        turn,
    })
}

/// Whether `ray` lies to the left of a -> b, shifted infinitesimally in a tie, and twice the area of
/// the triangle that the three span.
fn side(a: [f64; 2], b: [f64; 2], ray: [f64; 2]) -> (bool, f64) {
    let coord = |p: [f64; 2]| Coord { x: p[0], y: p[1] };
    let area = orient2d(coord(a), coord(b), coord(ray));
    let left = if area != 0.0 {
        area > 0.0
    } else if b[1] != a[1] {
        // d(area)/d(ray.x) = -(b.y - a.y)
        b[1] < a[1]
    } else {
        b[0] > a[0]
    };
    (left, area)
}

fn depth_at(depths: &[f64; 3], weights: [f64; 3]) -> f64 {
    let sum: f64 = weights.iter().sum();
    let low = depths.iter().copied().fold(f64::INFINITY, f64::min);
    let high = depths.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    if sum == 0.0 {
        return f64::midpoint(low, high);
    }
    let depth = (depths[0] * weights[0] + depths[1] * weights[1] + depths[2] * weights[2]) / sum;
    depth.clamp(low, high)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn octahedron(radius: f64) -> Surface {
        let mut vertices = Vec::new();
        for axis in 0..3 {
            for sign in [-1.0, 1.0] {
                let mut p = Vec3::zeros();
                p[axis] = sign * radius;
                vertices.push(p);
            }
        }
        let mut triangles = Vec::new();
        for octant in 0..8_u32 {
            let [x, y, z] = [octant & 1, octant >> 1 & 1, octant >> 2 & 1];
            let corners = [x, 2 + y, 4 + z];
            let flip = (x + y + z) % 2 == 0;
            triangles.push(if flip {
                [corners[0], corners[2], corners[1]]
            } else {
                corners
            });
        }
        Surface {
            vertices,
            triangles,
        }
    }

    #[test]
    fn rays_through_edges_and_vertices_count_once() {
        let surface = octahedron(1.0);
        for axis in 0..3 {
            // Steps of a quarter pass exactly through all vertices and along edges.
            let rays = Rays {
                axis,
                first: [-1.25, -1.25],
                step: 0.25,
                count: [11, 11],
            };
            let hits = cast(&surface, &rays);
            for j in 0..11 {
                for i in 0..11 {
                    let [u, v] = rays.position([i, j]);
                    let found = hits.of(rays.index([i, j]));
                    assert_eq!(found.len() % 2, 0, "odd number of hits at {u} {v}");
                    assert_eq!(found.iter().map(|h| i32::from(h.turn)).sum::<i32>(), 0);
                    let reach = 1.0 - u.abs() - v.abs();
                    if reach > 1e-9 {
                        assert_eq!(found.len(), 2, "at {u} {v}");
                        assert!((found[0].depth + reach).abs() < 1e-12);
                        assert!((found[1].depth - reach).abs() < 1e-12);
                        assert_eq!(found[0].turn, 1);
                    } else if reach < -1e-9 {
                        assert!(found.is_empty());
                    }
                }
            }
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn rays_enter_and_leave_closed_surfaces_equally_often(
            shape in prop::collection::vec(-2_i32..=2, 18), axis in 0_usize..3,
        ) {
            // Vertices on a coarse integer grid: flat, folded and touching triangles all occur.
            let mut surface = octahedron(1.0);
            for (vertex, offset) in surface.vertices.iter_mut().zip(shape.chunks(3)) {
                *vertex += Vec3::new(f64::from(offset[0]), f64::from(offset[1]), f64::from(offset[2]));
            }
            let rays = Rays { axis, first: [-4.0, -4.0], step: 0.5, count: [17, 17] };
            let hits = cast(&surface, &rays);
            for ray in 0..17 * 17 {
                prop_assert_eq!(hits.of(ray).iter().map(|h| i32::from(h.turn)).sum::<i32>(), 0);
            }
        }
    }
}
