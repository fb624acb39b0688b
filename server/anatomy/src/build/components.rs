//! The connected components of the input, and how much of each the model keeps.

use std::collections::BTreeMap;

use palpate_tissue::Vec3;

use super::parts::ClosedParts;
use super::rays::{Hits, Rays};
use super::small_parts::SmallPart;
use super::strands::{NO_WALL, Strands, WallEnds};

/// A piece of a component: all of it, unless necks thinner than the distance of rays join several pieces.
#[derive(Debug, Clone, Copy)]
pub(super) struct Piece {
    pub(super) region: u8,
    /// Volume in m³.
    pub(super) volume: f64,
    /// Part of the volume that the model's region has in common with it.
    pub(super) kept: f64,
    /// A point inside, the middle of its longest stretch.
    pub(super) at: Vec3,
    /// The component of the model's region that has most of it.
    pub(super) within: Option<u32>,
}

/// A connected component of a region of the input, less what later regions take.
#[derive(Debug, Clone)]
pub(super) struct Component {
    /// The component as a whole; it lies at the largest of its pieces, and within the component of the model that has
    /// most of one.
    pub(super) whole: Piece,
    /// Its pieces, if it has several.
    pub(super) pieces: Vec<Piece>,
}

impl From<Piece> for Component {
    fn from(whole: Piece) -> Self {
        Self {
            whole,
            pieces: Vec::new(),
        }
    }
}

impl Component {
    fn of(pieces: Vec<Piece>) -> Self {
        let sum = |of: &dyn Fn(&Piece) -> f64| pieces.iter().map(of).sum::<f64>();
        let most = |of: &dyn Fn(&Piece) -> f64| {
            // At equal volumes the first one, as everywhere.
            let pieces = pieces.iter().rev();
            pieces.max_by(|a, b| of(a).total_cmp(&of(b))).copied()
        };
        let kept = |p: &Piece| p.volume * p.kept;
        let volume = sum(&|p| p.volume);
        let largest = most(&|p| p.volume).expect("a component has a piece");
        let whole = Piece {
            volume,
            kept: sum(&kept) / volume,
            within: most(&kept).and_then(|p| p.within),
            ..largest
        };
        let several = pieces.len() > 1;
        Self {
            whole,
            pieces: if several { pieces } else { Vec::new() },
        }
    }
}

/// Length of rays in a component of the input: of all, or of those in a component of the same region of the model.
#[derive(Debug, Clone, Copy)]
pub(super) struct Shared {
    pub(super) input: u32,
    pub(super) model: Option<u32>,
    pub(super) length: f64,
}

/// Sorts by components and adds up the lengths of equal pairs.
pub(super) fn merge(shared: &mut Vec<Shared>) {
    // A stable sort: the sums have one order.
    shared.sort_by_key(|s| (s.input, s.model));
    shared.dedup_by(|next, kept| {
        let same = (next.input, next.model) == (kept.input, kept.model);
        if same {
            kept.length += next.length;
        }
        same
    });
}

/// The components that strands belong to, in the order of their first strands, with the measures of small parts. `point`
/// places a depth of a row of strands in the world, and `unit` is the volume of a unit of length.
pub(super) fn components(
    strands: &Strands,
    shared: &[Shared],
    (known, measured): (&KnownParts, &[Piece]),
    point: impl Fn([usize; 2], f64) -> Vec3,
    unit: f64,
) -> Vec<Component> {
    const NONE: u32 = u32::MAX;
    let mut slots = vec![NONE; strands.len()];
    let mut pieces: Vec<Piece> = Vec::new();
    let mut longest: Vec<f64> = Vec::new();
    let mut component_of: Vec<u32> = Vec::new();
    let [width, height] = strands.size();
    for (v, u) in (0..height).flat_map(|v| (0..width).map(move |u| (v, u))) {
        for (strand, part) in strands.of([u, v]) {
            let slot = &mut slots[part as usize];
            if *slot == NONE {
                *slot = pieces.len() as u32;
                longest.push(0.0);
                component_of.push(known.component(part));
                pieces.push(Piece {
                    region: strand.region,
                    volume: 0.0,
                    kept: 0.0,
                    at: Vec3::zeros(),
                    within: None,
                });
            }
            let (own, longest) = (&mut pieces[*slot as usize], &mut longest[*slot as usize]);
            let length = strand.to - strand.from;
            own.volume += length * unit;
            if length > *longest {
                *longest = length;
                own.at = point([u, v], f64::midpoint(strand.from, strand.to));
            }
        }
    }
    for same in shared.chunk_by(|a, b| a.input == b.input) {
        let own = &mut pieces[slots[same[0].input as usize] as usize];
        let sum = |common: bool| -> f64 {
            let lengths = same.iter().filter(|s| s.model.is_some() == common);
            // The sum of no numbers would be -0.
            lengths.fold(0.0, |sum, s| sum + s.length)
        };
        own.kept = sum(true) / sum(false);
        // At equal volumes the first one, so that the result does not depend on the order of rows.
        let common = same.iter().rev().filter(|s| s.model.is_some());
        let most = common.max_by(|a, b| a.length.total_cmp(&b.length));
        own.within = most.and_then(|s| s.model);
    }
    let mut order: Vec<usize> = (0..pieces.len()).collect();
    // Components have the number of their first strand.
    order.sort_by_key(|p| component_of[*p]);
    let same = order.chunk_by(|a, b| component_of[*a] == component_of[*b]);
    same.map(|same| {
        let mut own = Component::of(same.iter().map(|p| pieces[*p]).collect());
        if let Some(small) = known.small_of.get(&component_of[same[0]]) {
            own.whole = measured[*small];
        }
        own
    })
    .collect()
}

/// The connectivity of strands that follows from closed parts.
#[derive(Default)]
pub(super) struct KnownParts {
    /// The component of each strand; without elements each part of the strands is one.
    component_of: Vec<u32>,
    /// The small part that a component of strands is.
    small_of: BTreeMap<u32, usize>,
    /// Small parts that no strand belongs to.
    pub(super) missed: Vec<usize>,
}

impl KnownParts {
    fn component(&self, part: u32) -> u32 {
        self.component_of
            .get(part as usize)
            .copied()
            .unwrap_or(part)
    }
}

/// The closed parts of all surfaces, numbered in one sequence, as the walls that strands end on.
pub(super) struct PartWalls {
    /// Number of the first part of each surface, and one past the last of all.
    first: Vec<u32>,
    /// Hits of each part.
    hits: Vec<u32>,
    /// The part at either end of each strand, or [`NO_WALL`].
    of: Vec<[u32; 2]>,
}

/// Distance in m within which a hit is the end of a strand: another surface may begin in the same place.
const SAME: f64 = 1e-9;

impl PartWalls {
    /// Finds the part that each strand ends on.
    pub(super) fn of(strands: &Strands, hits: &[Hits], rays: &Rays, parts: &[ClosedParts]) -> Self {
        let mut first = vec![0];
        for parts in parts {
            first.push(first[first.len() - 1] + parts.boxes.len() as u32);
        }
        let walls = first[first.len() - 1] as usize;
        let mut hit = vec![0; walls];
        let mut of = vec![[NO_WALL; 2]; strands.len()];
        let [width, height] = rays.count;
        for (v, u) in (0..height).flat_map(|v| (0..width).map(move |u| (v, u))) {
            let ray = rays.index([u, v]);
            for (region, hits) in hits.iter().enumerate() {
                let own = strands.range(ray);
                let mut own = own.filter(|s| usize::from(strands.strand(*s).0.region) == region);
                let mut next = own.next();
                for at in hits.of(ray) {
                    let part = parts[region].of_triangle[at.triangle as usize];
                    let wall = first[region] + part;
                    hit[wall as usize] += 1;
                    while let Some(strand) = next {
                        let (stretch, _) = strands.strand(strand);
                        let ends = [stretch.from, stretch.to];
                        let is_same = |end: &f64| (end - at.depth).abs() < SAME;
                        if let Some(end) = ends.iter().position(is_same) {
                            of[strand][end] = wall;
                        }
                        if stretch.to > at.depth - SAME {
                            break;
                        }
                        next = own.next();
                    }
                }
            }
        }
        Self {
            first,
            hits: hit,
            of,
        }
    }

    /// Hits of a part of a surface.
    pub(super) fn hits(&self, surface: usize, part: u32) -> u32 {
        self.hits[(self.first[surface] + part) as usize]
    }

    /// Whether it matters that a part is whole: few rays meet it, or its strands are several pieces, or one piece with those of
    /// another part. Of each surface.
    pub(super) fn in_doubt(&self, strands: &Strands, few: u32) -> Vec<Vec<bool>> {
        const NONE: u32 = u32::MAX;
        let walls = self.hits.len();
        let (mut piece_of, mut wall_of) = (vec![NONE; walls], vec![NONE; strands.len()]);
        let mut doubt: Vec<bool> = self.hits.iter().map(|hits| *hits < few).collect();
        for (strand, ends) in self.of.iter().enumerate() {
            let piece = strands.strand(strand).1;
            for &wall in ends.iter().filter(|w| **w != NO_WALL) {
                let (own, other) = (&mut piece_of[wall as usize], &mut wall_of[piece as usize]);
                if *own == NONE {
                    *own = piece;
                }
                if *other == NONE {
                    *other = wall;
                }
                let is_alone = *own == piece && *other == wall;
                doubt[wall as usize] |= !is_alone;
                doubt[*other as usize] |= !is_alone;
            }
        }
        let ranges = self.first.windows(2).map(|w| w[0] as usize..w[1] as usize);
        ranges.map(|range| doubt[range].to_vec()).collect()
    }

    /// Connects the strands by the walls of parts that are whole, of each surface.
    pub(super) fn join(
        self,
        strands: &mut Strands,
        are_whole: &[Vec<bool>],
        small: &[SmallPart],
    ) -> KnownParts {
        let ends = WallEnds {
            of: self.of,
            is_whole: are_whole.concat(),
        };
        let component_of = strands.join_by_walls(&ends);
        let mut strand_at = vec![None; ends.is_whole.len()];
        for (strand, walls) in ends.of.iter().enumerate() {
            for wall in walls.iter().filter(|w| **w != NO_WALL) {
                strand_at[*wall as usize].get_or_insert(strand);
            }
        }
        let mut known = KnownParts::default();
        for (number, part) in small.iter().enumerate() {
            let wall = self.first[usize::from(part.region)] + part.part;
            match strand_at[wall as usize] {
                Some(strand) => {
                    known.small_of.insert(component_of[strand], number);
                }
                None => known.missed.push(number),
            }
        }
        known.component_of = component_of;
        known
    }
}
