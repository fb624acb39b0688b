//! Which parts of the input surfaces are the interfaces of the model, and the nearest point on them.
//!
//! Surfaces overlap: bone reaches into skin, flat ends of skin, muscle and bone lie in one plane. A
//! piece of a surface counts as an interface of its region when that region really holds the material
//! just behind it; it belongs to the *outer* patch when nothing lies before it, and to the *inner*
//! patch of its region otherwise. What a later region hides belongs to none.

use parry3d_f64::query::PointQuery as _;
use parry3d_f64::shape::TriMesh;
use rayon::prelude::*;

use super::label::PointQuery;
use crate::{Surface, Vec3};

/// Longest side, in spacings, of a piece that is classified as a whole.
const PIECE_SIDE_MAX: f64 = 4.0;
/// How far behind and before a piece one looks, in spacings: far enough to clear rounding, near
/// enough not to cross the thinnest layer worth modelling.
const LOOK: f64 = 0.02;

/// A set of triangles that answers for the point on it nearest to a given one.
pub(super) struct Patch(Option<TriMesh>);

impl Patch {
    fn new(pieces: &[[Vec3; 3]]) -> Self {
        if pieces.is_empty() {
            return Self(None);
        }
        let bridge = |p: &Vec3| parry3d_f64::math::Vector::new(p.x, p.y, p.z);
        let vertices = pieces.iter().flatten().map(bridge).collect();
        let triangles = (0..pieces.len() as u32)
            .map(|t| [3 * t, 3 * t + 1, 3 * t + 2])
            .collect();
        Self(TriMesh::new(vertices, triangles).ok())
    }

    /// The nearest point on the patch, or `None` when the patch is empty.
    pub(super) fn nearest(&self, point: &Vec3) -> Option<Vec3> {
        let at = parry3d_f64::math::Vector::new(point.x, point.y, point.z);
        let nearest = self.0.as_ref()?.project_local_point(at, false).point;
        Some(Vec3::new(nearest.x, nearest.y, nearest.z))
    }
}

/// The interfaces of the model.
pub(super) struct Interfaces {
    /// Where the model ends.
    pub(super) outer: Patch,
    /// For each region, where it meets regions that it overrides.
    pub(super) inner: Vec<Patch>,
    /// Edges of the outer patch where it turns sharply.
    pub(super) rims: super::rim::Rims,
}

impl Interfaces {
    /// Sorts the triangles of all surfaces.
    pub(super) fn new(surfaces: &[&Surface], query: &PointQuery<'_>, spacing: f64) -> Self {
        let mut outer = Vec::new();
        let mut inner = vec![Vec::new(); surfaces.len()];
        let mut rims = super::rim::Rims::default();
        for (region, surface) in surfaces.iter().enumerate() {
            let sorted: Vec<Sorted> = surface
                .triangles
                .par_iter()
                .map(|t| {
                    let corners = t.map(|v| surface.vertices[v as usize]);
                    sort_triangle(&corners, region, query, spacing)
                })
                .collect();
            let faces_out: Vec<bool> = sorted.iter().map(|s| !s.outer.is_empty()).collect();
            rims.collect(surface, &faces_out);
            for pieces in sorted {
                outer.extend(pieces.outer);
                inner[region].extend(pieces.inner);
            }
        }
        rims.index(spacing);
        Self {
            outer: Patch::new(&outer),
            inner: inner.iter().map(|p| Patch::new(p)).collect(),
            rims,
        }
    }
}

/// The pieces of one triangle; what is hidden is in neither list.
#[derive(Default)]
struct Sorted {
    outer: Vec<[Vec3; 3]>,
    inner: Vec<[Vec3; 3]>,
}

/// Cuts a triangle into pieces small enough to be classified as a whole, and sorts them.
fn sort_triangle(
    corners: &[Vec3; 3],
    region: usize,
    query: &PointQuery<'_>,
    spacing: f64,
) -> Sorted {
    let mut sorted = Sorted::default();
    let normal = (corners[1] - corners[0]).cross(&(corners[2] - corners[0]));
    let Some(normal) = normal.try_normalize(0.0) else {
        return sorted;
    };
    let look = normal * (LOOK * spacing);
    let mut stack = vec![*corners];
    while let Some(piece) = stack.pop() {
        if let Some(halves) = halve(&piece, PIECE_SIDE_MAX * spacing) {
            stack.extend(halves);
            continue;
        }
        let middle = (piece[0] + piece[1] + piece[2]) / 3.0;
        match (
            query.region_at(middle + look),
            query.region_at(middle - look),
        ) {
            (None, Some(_)) => sorted.outer.push(piece),
            // Surfaces that touch without overlap, as those of a label volume, hold every interface
            // twice; it is the later region's, as where it overrides.
            (Some(before), Some(behind)) if behind == region && before < region => {
                sorted.inner.push(piece);
            }
            _ => {}
        }
    }
    sorted
}

/// The two halves of a triangle across its longest side, if that is longer than `side_max`.
fn halve(piece: &[Vec3; 3], side_max: f64) -> Option<[[Vec3; 3]; 2]> {
    let side = |e: usize| (piece[(e + 1) % 3] - piece[e]).norm();
    let longest = (0..3).max_by(|&e, &f| side(e).total_cmp(&side(f)))?;
    if side(longest) <= side_max {
        return None;
    }
    let [a, b, c] = [0, 1, 2].map(|e| piece[(longest + e) % 3]);
    let middle = (a + b) / 2.0;
    Some([[a, middle, c], [middle, b, c]])
}
