//! The parts of the input surfaces that are interfaces of the model, and the nearest point on them.
//!
//! Surfaces overlap: bone reaches into skin, and flat ends of skin, muscle and bone lie in one plane. A piece
//! of a surface is an interface of its region when that region really holds the material just behind it and not
//! before it; pieces of inverted parts are turned outwards. The piece belongs to the *outer* interface when nothing
//! lies before it, else to the *inner* one of its region.
//! Pieces that a later region hides belong to neither.

use palpate_tissue::Vec3;
use rayon::prelude::*;

use super::bvh::{Bvh, Flat};
use super::faces::OUTSIDE;
use super::inside::PointQuery;
use super::rim::{self, Rims};
use crate::Surface;
use crate::labels::Sides;

/// Longest side, in spacings, of a piece that is classified as a whole.
const PIECE_SIDE_MAX: f64 = 4.0;
/// A piece of mixed kind is cut down to this side, in spacings.
const PIECE_SIDE_MIN: f64 = 0.25;
/// The same for a piece of one kind that has several regions on a side.
const SIDES_PIECE_MIN: f64 = 0.5;
/// Fraction of the way from the middle of a piece to its corners at which further probes are placed.
const TOWARDS_CORNER: f64 = 0.9;
/// Distance of the probes behind and before a piece, in spacings: far enough to clear rounding, near enough not
/// to cross the thinnest layer worth modelling.
const LOOK: f64 = 0.02;
/// Triangles sorted per task.
const CHUNK: usize = 4096;

/// The interfaces of the model.
pub(super) struct Interfaces {
    /// The outer surface of the model.
    pub(super) outer: Bvh,
    /// For each region, where it meets regions that it overrides.
    pub(super) inner: Vec<Bvh>,
    /// Edges where an interface turns sharply: those of the outer one, then those of each region.
    pub(super) rims: Vec<Rims>,
    /// Lattice spacing in m.
    pub(super) spacing: f64,
}

impl Interfaces {
    /// Sorts the triangles of all surfaces. `sides` holds, for each surface, the regions behind and
    /// before each triangle where these are known, and no elements where they have to be looked for.
    pub(super) fn new(
        surfaces: &[&Surface],
        sides: &[Vec<Sides>],
        query: &PointQuery,
        spacing: f64,
        middle: Vec3,
    ) -> Self {
        let mut outer = Vec::new();
        let mut inner = Vec::with_capacity(surfaces.len());
        let mut outer_rims = Rims::default();
        let mut rims = vec![Rims::default()];
        for (region, surface) in surfaces.iter().enumerate() {
            let sorter = Sorter {
                region,
                query,
                spacing,
                origin: &middle,
            };
            let sorted = if sides[region].is_empty() {
                sorter.look_at_all(surface)
            } else {
                sorter.take_all(surface, &sides[region])
            };
            let faces_out: Vec<bool> = sorted.iter().flat_map(|s| &s.faces_out).copied().collect();
            let faces_in: Vec<bool> = sorted.iter().flat_map(|s| &s.faces_in).copied().collect();
            let turned: Vec<bool> = sorted.iter().flat_map(|s| &s.turned).copied().collect();
            let mut own_rims = Rims::default();
            for (which, segment) in rim::sharp_edges(surface, [&faces_out, &faces_in], &turned) {
                let rims = [&mut outer_rims, &mut own_rims];
                rims[which].add(segment);
            }
            own_rims.index(spacing);
            rims.push(own_rims);
            let mut own = Vec::new();
            for mut pieces in sorted {
                outer.append(&mut pieces.outer);
                own.append(&mut pieces.inner);
            }
            inner.push(Bvh::new(middle, own));
        }
        outer_rims.index(spacing);
        rims[0] = outer_rims;
        Self {
            outer: Bvh::new(middle, outer),
            inner,
            rims,
            spacing,
        }
    }

    pub(super) fn bvh(&self, interface: Interface) -> &Bvh {
        match interface {
            Interface::Outer => &self.outer,
            Interface::Of(region) => &self.inner[region],
        }
    }

    /// All interfaces, the outer one first.
    pub(super) fn all(&self) -> impl Iterator<Item = Interface> + use<> {
        std::iter::once(Interface::Outer).chain((0..self.inner.len()).map(Interface::Of))
    }
}

/// Tag of a triangle of an interface: the regions behind and before it, or [`OUTSIDE`].
pub(super) fn tag([behind, before]: [u16; 2]) -> u16 {
    // A scene has fewer regions than a byte counts.
    (behind << 8) | (before & 0xff)
}

/// The regions behind and before a triangle of an interface with this tag, or [`OUTSIDE`].
pub(super) fn sides_of(tag: u16) -> [u16; 2] {
    let before = if tag & 0xff == 0xff {
        OUTSIDE
    } else {
        tag & 0xff
    };
    [tag >> 8, before]
}

/// One interface of the model: the outer surface, or where region `r` overrides others.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Interface {
    /// The outer surface of the model.
    Outer,
    /// Where this region overrides others.
    Of(usize),
}

/// The pieces of some triangles; hidden pieces are in neither list.
#[derive(Default)]
struct Sorted {
    outer: Vec<Flat>,
    inner: Vec<Flat>,
    /// Whether some of each triangle is in the outer interface.
    faces_out: Vec<bool>,
    /// Whether some of each triangle is in the inner interface.
    faces_in: Vec<bool>,
    /// Whether each triangle faces into its region.
    turned: Vec<bool>,
}

/// Sorts triangles of one region's surface.
struct Sorter<'a> {
    region: usize,
    query: &'a PointQuery,
    spacing: f64,
    origin: &'a Vec3,
}

impl Sorter<'_> {
    /// Sorts the triangles of a surface by probes behind and before them.
    fn look_at_all(&self, surface: &Surface) -> Vec<Sorted> {
        let at_vertices = vertex_kinds(surface, self.region, self.query, self.spacing);
        let chunks = surface.triangles.par_chunks(CHUNK).map(|chunk| {
            let mut sorted = Sorted::default();
            for t in chunk {
                let corners = t.map(|v| surface.vertices[v as usize]);
                let before = (sorted.outer.len(), sorted.inner.len());
                let kinds = t.map(|v| at_vertices[v as usize]);
                let turned = self.sort(&corners, kinds, &mut sorted);
                sorted.turned.push(turned);
                sorted.faces_out.push(sorted.outer.len() > before.0);
                sorted.faces_in.push(sorted.inner.len() > before.1);
            }
            sorted
        });
        chunks.collect()
    }

    /// Sorts the triangles of a surface whose two sides are known: none are hidden behind another region's, and
    /// the first region's surface goes around all.
    fn take_all(&self, surface: &Surface, sides: &[Sides]) -> Vec<Sorted> {
        let mut sorted = Sorted::default();
        for (t, sides) in sides.iter().enumerate() {
            let corners = surface.corners(t);
            let vector = (corners[1] - corners[0]).cross(&(corners[2] - corners[0]));
            let has_sides = vector.try_normalize(0.0).is_some();
            let outer = has_sides && sides.before.is_none() && self.region == 0;
            let inner = has_sides && sides.before.is_some_and(|b| usize::from(b) < self.region);
            let (behind, before) = (
                u16::from(sides.behind),
                sides.before.map_or(OUTSIDE, u16::from),
            );
            let piece = Bvh::flat(self.origin, &corners).tagged(tag([behind, before]));
            if outer {
                sorted.outer.push(piece);
            } else if inner {
                sorted.inner.push(piece);
            }
            sorted.faces_out.push(outer);
            sorted.faces_in.push(inner);
            sorted.turned.push(false);
        }
        vec![sorted]
    }

    /// Cuts a triangle into pieces small enough to be classified as a whole, and sorts them. `at_corners` is
    /// the classification of its vertices. Returns whether a piece was turned outwards.
    fn sort(&self, corners: &[Vec3; 3], at_corners: [Kind; 3], sorted: &mut Sorted) -> bool {
        let normal = (corners[1] - corners[0]).cross(&(corners[2] - corners[0]));
        let Some(normal) = normal.try_normalize(0.0) else {
            return false;
        };
        let look = normal * (LOOK * self.spacing);
        let mut any_turned = false;
        let kind = |at: Vec3| kind(self.region, self.query, at, look);
        let mut stack = vec![*corners];
        while let Some(piece) = stack.pop() {
            if let Some(halves) = halve(&piece, PIECE_SIDE_MAX * self.spacing) {
                stack.extend(halves);
                continue;
            }
            let middle = (piece[0] + piece[1] + piece[2]) / 3.0;
            // A triangle far smaller than the spacing takes the classification of its vertices.
            let fine = piece == *corners && at_corners == [at_corners[0]; 3];
            let fine = fine && halve(&piece, PIECE_SIDE_MIN * self.spacing).is_none();
            let here = if fine { at_corners[0] } else { kind(middle) };
            let whole = piece == *corners && at_corners == [here; 3];
            // Near the border between interfaces a piece may have mixed kinds. Where only the regions on its sides
            // differ, larger pieces will do.
            let coarse = halve(&piece, SIDES_PIECE_MIN * self.spacing).is_some();
            let mixed = || {
                (piece.iter())
                    .map(|p| middle.lerp(p, TOWARDS_CORNER))
                    .map(kind)
                    .any(|other| other != here && (coarse || !other.is_like(here)))
            };
            if !whole
                && let Some(halves) = halve(&piece, PIECE_SIDE_MIN * self.spacing)
                && mixed()
            {
                stack.extend(halves);
                continue;
            }
            let (pieces, turned, sides) = match here {
                Kind::Outer { turned, behind } => (&mut sorted.outer, turned, [behind, OUTSIDE]),
                Kind::Inner { turned, before } => {
                    (&mut sorted.inner, turned, [self.region as u16, before])
                }
                Kind::Hidden => continue,
            };
            any_turned |= turned;
            let [a, b, c] = piece;
            let outwards = if turned { [a, c, b] } else { piece };
            pieces.push(Bvh::flat(self.origin, &outwards).tagged(tag(sides)));
        }
        any_turned
    }
}

/// Classification of the surface at each of its vertices, probed along the mean normal there. A triangle whose
/// corners and middle agree needs no further probes.
fn vertex_kinds(surface: &Surface, region: usize, query: &PointQuery, spacing: f64) -> Vec<Kind> {
    let mut normals = vec![Vec3::zeros(); surface.vertices.len()];
    for t in &surface.triangles {
        let [a, b, c] = t.map(|v| surface.vertices[v as usize]);
        let vector = (b - a).cross(&(c - a));
        for v in t {
            normals[*v as usize] += vector;
        }
    }
    surface
        .vertices
        .par_iter()
        .zip(&normals)
        .map(|(at, normal)| match normal.try_normalize(0.0) {
            Some(normal) => kind(region, query, *at, normal * (LOOK * spacing)),
            None => Kind::Hidden,
        })
        .collect()
}

/// Classification of a piece of a region's surface; a turned piece faces into its region. `behind` and `before` are the
/// regions there once it faces outwards.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Outer { turned: bool, behind: u16 },
    Inner { turned: bool, before: u16 },
    Hidden,
}

impl Kind {
    /// Whether two kinds differ in the regions on their sides only.
    fn is_like(self, other: Self) -> bool {
        match (self, other) {
            (Self::Outer { turned: a, .. }, Self::Outer { turned: b, .. })
            | (Self::Inner { turned: a, .. }, Self::Inner { turned: b, .. }) => a == b,
            (Self::Hidden, Self::Hidden) => true,
            _ => false,
        }
    }
}

/// Probes behind and before a point of the surface of `region`.
fn kind(region: usize, query: &PointQuery, at: Vec3, look: Vec3) -> Kind {
    match [at - look, at + look].map(|p| query.region_at(p)) {
        // Flat ends that several regions share are of this kind for each of these regions.
        [Some(behind), None] => Kind::Outer {
            turned: false,
            behind: behind as u16,
        },
        [None, Some(behind)] if query.contains(region, at + look) => Kind::Outer {
            turned: true,
            behind: behind as u16,
        },
        // Before a later region, the wall of the later region stands in the same position and counts instead.
        [Some(behind), Some(before)] if behind == region && before < region => Kind::Inner {
            turned: false,
            before: before as u16,
        },
        [Some(behind), Some(before)] if before == region && behind < region => Kind::Inner {
            turned: true,
            before: behind as u16,
        },
        _ => Kind::Hidden,
    }
}

/// The two halves of a triangle across its longest side, if that is longer than `side_max`.
pub(super) fn halve(piece: &[Vec3; 3], side_max: f64) -> Option<[[Vec3; 3]; 2]> {
    let side = |e: usize| (piece[(e + 1) % 3] - piece[e]).norm();
    let longest = (0..3).max_by(|&e, &f| side(e).total_cmp(&side(f)))?;
    if side(longest) <= side_max {
        return None;
    }
    let [a, b, c] = [0, 1, 2].map(|e| piece[(longest + e) % 3]);
    let middle = (a + b) / 2.0;
    Some([[a, middle, c], [middle, b, c]])
}
